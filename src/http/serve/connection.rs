//! One connection, from its handshake to its end.

use super::activity::Activity;
use super::connections::Place;
use super::watched::WatchedStream;
use super::{Accepted, Surface};
use crate::http::authorise::Peer;
use crate::http::connection_info::ConnectionInfo;
use crate::ops::metrics::{ConnectionCut, ConnectionKind};
use axum::body::{Body, HttpBody};
use axum::extract::Request;
use axum::response::Response;
use bytes::Bytes;
use hyper::body::{Frame, Incoming, SizeHint};
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper_util::rt::{TokioIo, TokioTimer};
use std::convert::Infallible;
use std::net::SocketAddr;
use std::pin::{Pin, pin};
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::time::{sleep, timeout};
use tower::ServiceExt;

/// Least room for the bytes of one connection that have arrived and are not yet asked for.
const MIN_BUFFER_BYTES: usize = 64 << 10;

/// Serves one connection to its end.
pub(super) async fn serve_connection(accepted: Accepted, surface: Arc<Surface>) {
    let Accepted {
        stream,
        peer,
        place,
    } = accepted;
    let slowest = (&surface.state.http).into();
    let Ok(stream) = WatchedStream::new(stream, slowest, place.activity.clone()) else {
        // The client has left meanwhile.
        return;
    };
    let Some(certificate) = &surface.certificate else {
        return drive(stream, peer, &place, &surface).await;
    };
    let longest = Duration::from_millis(surface.state.http.header_timeout_ms);
    let handshake = timeout(longest, certificate.acceptor().accept(stream));
    let outcome = tokio::select! {
        outcome = handshake => outcome,
        () = place.evicted.cancelled() => return,
        () = surface.closing.cancelled() => return,
    };
    match outcome {
        Ok(Ok(stream)) => drive(stream, peer, &place, &surface).await,
        Ok(Err(error)) => handshake_failed(&surface, peer, &error.to_string()),
        Err(_) => handshake_failed(&surface, peer, "it took too long"),
    }
}

fn handshake_failed(surface: &Surface, peer: SocketAddr, reason: &str) {
    tracing::debug!(%peer, reason, "the TLS handshake failed");
    surface
        .state
        .metrics
        .connection_cut(ConnectionCut::Handshake);
}

/// Answers the requests of a connection until it ends, or is ended for one of these reasons: its
/// place is given to another, it has become too old, or the server drains.
async fn drive<S>(stream: S, peer: SocketAddr, place: &Place, surface: &Arc<Surface>)
where
    S: AsyncRead + AsyncWrite + Unpin + Send + 'static,
{
    let http = &surface.state.http;
    let info = ConnectionInfo {
        is_reserved: place.kind == ConnectionKind::Reserved,
        is_loopback: surface.is_loopback,
        is_tls: surface.certificate.is_some(),
    };
    let activity = place.activity.clone();
    let router = surface.router.clone();
    let service = service_fn(move |request: Request<Incoming>| {
        let under_way = UnderWay::begin(activity.clone());
        let mut request = request.map(Body::new);
        request.extensions_mut().insert(Peer(peer));
        request.extensions_mut().insert(info);
        let answering = router.clone().oneshot(request);
        async move {
            let response: Response = answering.await?;
            Ok::<_, Infallible>(response.map(|body| AnswerBody {
                body,
                _under_way: under_way,
            }))
        }
    });
    let connection = http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(Duration::from_millis(http.header_timeout_ms))
        .max_header_size(http.max_header_bytes)
        .max_buf_size(http.max_header_bytes.max(MIN_BUFFER_BYTES))
        // Every answer leaves before the next request is looked at, so that requests sent ahead
        // cannot pile up answers.
        .pipeline_flush(false)
        .serve_connection(TokioIo::new(stream), service);
    let mut connection = pin!(connection);
    let last_request = async {
        tokio::select! {
            () = surface.closing.cancelled() => {}
            () = sleep(Duration::from_millis(http.max_connection_age_ms)) => {}
        }
    };
    let mut last_request = pin!(last_request);
    let (mut is_evicted, mut is_closing) = (false, false);
    let ended = loop {
        tokio::select! {
            biased;
            ended = connection.as_mut() => break ended,
            () = place.evicted.cancelled(), if !is_evicted => {
                if place.can_end_at_once() {
                    return;
                }
                is_evicted = true;
                connection.as_mut().graceful_shutdown();
            }
            () = &mut last_request, if !is_closing => {
                is_closing = true;
                connection.as_mut().graceful_shutdown();
            }
        }
    };
    if place.activity.was_too_slow() {
        surface
            .state
            .metrics
            .connection_cut(ConnectionCut::SlowReader);
    }
    // Time-outs and resets of single clients are nothing that operators need to know.
    if let Err(error) = ended {
        tracing::debug!(%peer, %error, "connection ended");
    }
}

/// A request that has begun; ends when dropped.
struct UnderWay(Arc<Activity>);

impl UnderWay {
    fn begin(activity: Arc<Activity>) -> Self {
        activity.request_began();
        Self(activity)
    }
}

impl Drop for UnderWay {
    fn drop(&mut self) {
        self.0.request_ended();
    }
}

/// The body of an answer, whose request is under way until all of it is handed over for writing.
struct AnswerBody {
    body: Body,
    _under_way: UnderWay,
}

impl HttpBody for AnswerBody {
    type Data = Bytes;
    type Error = axum::Error;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, axum::Error>>> {
        Pin::new(&mut self.body).poll_frame(context)
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}
