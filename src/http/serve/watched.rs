//! A TCP stream that ends when its client does not take what is written to it.
//!
//! An answer that nobody reads would otherwise hold its connection, and its memory, for as long as
//! the client likes. What the client has really taken is hidden behind the kernel's buffer, which
//! grows to megabytes; so the kernel is told to ask for more only when almost nothing is left
//! unsent. The kernel itself ends connections whose client acknowledges nothing, which also covers
//! the last bytes of an answer, after they have left this process.

use super::activity::Activity;
use crate::http::config::HttpConfig;
use socket2::SockRef;
use std::future::Future;
use std::io::{self, IoSlice};
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};
use std::time::Duration;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::TcpStream;
use tokio::time::{Instant, Sleep, sleep};

/// Bytes of an answer that wait in the kernel unsent, beyond those on their way.
const UNSENT_BYTES: u32 = 16 << 10;

/// How fast a client must take an answer that waits for it.
#[derive(Debug, Clone, Copy)]
pub(super) struct SlowestReader {
    /// The time over which the rate is measured.
    interval: Duration,
    /// Bytes to be taken within the interval.
    bytes: u64,
    /// Longest time without any acknowledgement of what the kernel has sent.
    silence: Duration,
}

impl From<&HttpConfig> for SlowestReader {
    fn from(config: &HttpConfig) -> Self {
        let milliseconds = config.answer_stall_timeout_ms;
        let bytes = config
            .min_answer_bytes_per_second
            .saturating_mul(milliseconds)
            / 1000;
        let silence = milliseconds.max(config.header_timeout_ms);
        Self {
            interval: Duration::from_millis(milliseconds),
            // No bytes at all are too few in every case.
            bytes: bytes.max(1),
            silence: Duration::from_millis(silence),
        }
    }
}

/// A TCP stream that tells what it is doing, and ends with a slow reader.
pub(super) struct WatchedStream {
    stream: TcpStream,
    slowest: SlowestReader,
    activity: Arc<Activity>,
    /// While an answer waits for the client.
    stall: Option<Stall>,
}

/// An interval in which the client has to take some of an answer.
struct Stall {
    end: Pin<Box<Sleep>>,
    taken: u64,
}

impl WatchedStream {
    /// Watches over `stream`.
    ///
    /// # Errors
    /// The connection is closed already.
    pub(super) fn new(
        stream: TcpStream,
        slowest: SlowestReader,
        activity: Arc<Activity>,
    ) -> io::Result<Self> {
        stream.set_nodelay(true)?;
        let socket = SockRef::from(&stream);
        socket.set_tcp_notsent_lowat(UNSENT_BYTES)?;
        socket.set_tcp_user_timeout(Some(slowest.silence))?;
        Ok(Self {
            stream,
            slowest,
            activity,
            stall: None,
        })
    }

    /// Takes note of the outcome of a write.
    fn watch(
        &mut self,
        context: &mut Context<'_>,
        written: Poll<io::Result<usize>>,
    ) -> Poll<io::Result<usize>> {
        match written {
            Poll::Ready(Ok(bytes)) => {
                if let Some(stall) = &mut self.stall {
                    stall.taken += bytes as u64;
                }
                written
            }
            Poll::Ready(Err(_)) => written,
            Poll::Pending => {
                ready!(self.poll_too_slow(context));
                self.activity.too_slow();
                let reason = "the client takes the answer too slowly";
                Poll::Ready(Err(io::Error::new(io::ErrorKind::TimedOut, reason)))
            }
        }
    }

    /// Ready when an interval is over in which the client took too little.
    fn poll_too_slow(&mut self, context: &mut Context<'_>) -> Poll<()> {
        let interval = self.slowest.interval;
        let stall = match &mut self.stall {
            Some(stall) => stall,
            None => {
                self.activity.stalled();
                self.stall.insert(Stall {
                    end: Box::pin(sleep(interval)),
                    taken: 0,
                })
            }
        };
        loop {
            ready!(stall.end.as_mut().poll(context));
            if stall.taken < self.slowest.bytes {
                return Poll::Ready(());
            }
            stall.taken = 0;
            stall.end.as_mut().reset(Instant::now() + interval);
        }
    }
}

impl AsyncRead for WatchedStream {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let before = buffer.filled().len();
        ready!(Pin::new(&mut self.stream).poll_read(context, buffer))?;
        if buffer.filled().len() > before {
            self.activity.received();
        }
        Poll::Ready(Ok(()))
    }
}

impl AsyncWrite for WatchedStream {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        let written = Pin::new(&mut self.stream).poll_write(context, bytes);
        self.watch(context, written)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        slices: &[IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let written = Pin::new(&mut self.stream).poll_write_vectored(context, slices);
        self.watch(context, written)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }

    /// Whoever writes flushes at the end of what there is to write.
    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        ready!(Pin::new(&mut self.stream).poll_flush(context))?;
        self.stall = None;
        self.activity.flushed();
        Poll::Ready(Ok(()))
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(context)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tokio::net::TcpListener;

    #[tokio::test]
    async fn the_kernel_hides_little_and_ends_what_nobody_acknowledges() {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let _client = TcpStream::connect(listener.local_addr().unwrap())
            .await
            .unwrap();
        let (stream, _) = listener.accept().await.unwrap();
        let config = HttpConfig {
            answer_stall_timeout_ms: 2000,
            header_timeout_ms: 7000,
            ..HttpConfig::default()
        };
        let activity = Arc::new(Activity::new());
        let watched = WatchedStream::new(stream, (&config).into(), activity).unwrap();
        let socket = SockRef::from(&watched.stream);
        assert_eq!(socket.tcp_notsent_lowat().unwrap(), UNSENT_BYTES);
        let silence = socket.tcp_user_timeout().unwrap();
        assert_eq!(silence, Some(Duration::from_secs(7)));
    }
}
