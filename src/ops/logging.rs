//! Logs: text for people, or one JSON object a line for collectors.
//!
//! Standard error may be a full disk, a pipe that nobody reads, or closed. None of that is a reason
//! for a request to fail or to wait. So lines go to a bounded queue, from which one thread writes
//! them. A line that finds the queue full, or that cannot be written, is lost and counted.

use serde::{Deserialize, Serialize};
use std::backtrace::{Backtrace, BacktraceStatus};
use std::io::{self, ErrorKind, Write};
use std::mem::ManuallyDrop;
use std::panic::PanicHookInfo;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};
use tracing_appender::non_blocking::{ErrorCounter, NonBlocking, NonBlockingBuilder, WorkerGuard};
use tracing_subscriber::EnvFilter;
use tracing_subscriber::fmt::MakeWriter;
use tracing_subscriber::fmt::format::FmtSpan;
use utoipa::ToSchema;

/// Most lines that wait to be written. A reader that keeps up leaves the queue empty; one that has
/// stalled costs this many lines of memory and no more.
const QUEUED_LINES: usize = 2048;

/// Longest wait for the last lines to be written when the process ends.
const FLUSH_LIMIT: Duration = Duration::from_secs(1);

/// Pause before a pipe that takes nothing now is tried again.
const FULL_PIPE_PAUSE: Duration = Duration::from_millis(20);

/// How log lines look.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum LogFormat {
    /// Coloured text.
    #[default]
    Human,
    /// One JSON object a line.
    Json,
}

/// Settings of the logs. The comments of the fields are printed as the manual of the
/// configuration file.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(default, deny_unknown_fields)]
pub struct LogConfig {
    /// "human" (coloured text) or "json" (one object a line).
    #[schema(value_type = String)]
    pub format: LogFormat,
    /// What is logged, in the syntax of `tracing` directives: "info", "placeformer=debug", ...
    pub filter: String,
}

impl Default for LogConfig {
    fn default() -> Self {
        Self {
            format: LogFormat::Human,
            filter: "info".into(),
        }
    }
}

/// The log filter is not a list of directives.
#[derive(Debug, thiserror::Error)]
#[error("log.filter {filter:?} is not valid: {reason}")]
pub struct InvalidFilter {
    filter: String,
    reason: String,
}

impl LogConfig {
    /// Checks the filter.
    ///
    /// # Errors
    /// It is not a list of directives.
    pub fn check(&self) -> Result<(), InvalidFilter> {
        self.directives().map(drop)
    }

    fn directives(&self) -> Result<EnvFilter, InvalidFilter> {
        EnvFilter::try_new(&self.filter).map_err(|error| InvalidFilter {
            filter: self.filter.clone(),
            reason: error.to_string(),
        })
    }
}

/// Sends all events and the text of panics to standard error from now on. After a second call the
/// settings of the first one stay in force. The last lines are written when the guard is dropped.
///
/// # Errors
/// The filter is not a list of directives.
pub fn init(config: &LogConfig) -> Result<FlushGuard, InvalidFilter> {
    let directives = config.directives()?;
    let lines = tracing_subscriber::fmt()
        .with_env_filter(directives)
        .with_span_events(FmtSpan::NONE)
        // What cannot be logged would be reported by `eprintln!`, which blocks and panics.
        .log_internal_errors(false)
        .with_writer(queue());
    let outcome = match config.format {
        LogFormat::Human => lines.try_init(),
        LogFormat::Json => lines
            .json()
            .flatten_event(true)
            .with_current_span(true)
            .with_span_list(false)
            .try_init(),
    };
    match outcome {
        Ok(()) => std::panic::set_hook(Box::new(log_panic)),
        Err(_) => tracing::debug!("logs were set up before"),
    }
    Ok(FlushGuard(()))
}

/// Log lines lost so far, because the queue was full or because they could not be written.
pub fn lost_lines() -> u64 {
    QUEUE.get().map_or(0, |queue| {
        let dropped = queue.dropped.dropped_lines() as u64;
        dropped + FAILED.load(Ordering::Relaxed)
    })
}

/// Waits until the lines logged so far are written when it is dropped, but no longer than a second:
/// nobody may be reading them.
#[must_use = "the last lines of the log are lost without it"]
#[derive(Debug)]
pub struct FlushGuard(());

impl Drop for FlushGuard {
    fn drop(&mut self) {
        let began = Instant::now();
        while has_waiting_lines() && began.elapsed() < FLUSH_LIMIT {
            std::thread::sleep(Duration::from_millis(2));
        }
    }
}

/// The one queue of the process.
static QUEUE: OnceLock<LineQueue> = OnceLock::new();

/// Lines given to the queue, whether it took them or not.
static OFFERED: AtomicU64 = AtomicU64::new(0);

/// Lines that the thread has taken out of the queue and written.
static WRITTEN: AtomicU64 = AtomicU64::new(0);

/// Lines that the thread has taken out of the queue and could not write.
static FAILED: AtomicU64 = AtomicU64::new(0);

/// Lines on their way to the thread that writes them.
struct LineQueue {
    entrance: NonBlocking,
    /// Counts the lines that found the queue full.
    dropped: ErrorCounter,
    /// Never dropped: when nobody reads the log, its destructor would write to the terminal, which
    /// blocks or panics. [`FlushGuard`] waits for the last lines instead.
    _worker: ManuallyDrop<WorkerGuard>,
}

fn queue() -> &'static LineQueue {
    QUEUE.get_or_init(|| {
        let (entrance, worker) = NonBlockingBuilder::default()
            .lossy(true)
            .buffered_lines_limit(QUEUED_LINES)
            .thread_name("log-writer")
            .finish(LineWriter::new(io::stderr()));
        LineQueue {
            dropped: entrance.error_counter(),
            entrance,
            _worker: ManuallyDrop::new(worker),
        }
    })
}

fn has_waiting_lines() -> bool {
    let Some(queue) = QUEUE.get() else {
        return false;
    };
    // Counted in this order, a line that is offered meanwhile is at worst waited for.
    let done = WRITTEN.load(Ordering::Acquire) + FAILED.load(Ordering::Acquire);
    let dropped = queue.dropped.dropped_lines() as u64;
    OFFERED.load(Ordering::Acquire) > done + dropped
}

impl<'a> MakeWriter<'a> for &'static LineQueue {
    type Writer = Entrance<'a>;

    fn make_writer(&'a self) -> Self::Writer {
        Entrance(&self.entrance)
    }
}

/// Where one line enters the queue, whole.
struct Entrance<'a>(&'a NonBlocking);

impl Write for Entrance<'_> {
    fn write(&mut self, line: &[u8]) -> io::Result<usize> {
        OFFERED.fetch_add(1, Ordering::Release);
        self.0.clone().write(line)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// Writes whole lines, and never fails: a line that cannot be written is counted.
struct LineWriter<W> {
    out: W,
    /// Whether the last line was written in part, so that the next must not continue it.
    is_broken_off: bool,
}

impl<W: Write> LineWriter<W> {
    fn new(out: W) -> Self {
        Self {
            out,
            is_broken_off: false,
        }
    }

    fn write_line(&mut self, line: &[u8]) -> io::Result<()> {
        if self.is_broken_off {
            self.write_some(b"\n")?;
            self.is_broken_off = false;
        }
        let mut rest = line;
        while !rest.is_empty() {
            match self.write_some(rest) {
                Ok(written) => rest = &rest[written..],
                Err(error) => {
                    self.is_broken_off = rest.len() < line.len();
                    return Err(error);
                }
            }
        }
        Ok(())
    }

    /// Writes at least one byte. A pipe that was made non-blocking by whoever shares it is waited
    /// for like any other; only this thread waits.
    fn write_some(&mut self, bytes: &[u8]) -> io::Result<usize> {
        loop {
            match self.out.write(bytes) {
                Ok(0) => return Err(ErrorKind::WriteZero.into()),
                Ok(written) => return Ok(written),
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                Err(error) if error.kind() == ErrorKind::WouldBlock => {
                    std::thread::sleep(FULL_PIPE_PAUSE);
                }
                Err(error) => return Err(error),
            }
        }
    }
}

impl<W: Write> Write for LineWriter<W> {
    fn write(&mut self, line: &[u8]) -> io::Result<usize> {
        let counter = match self.write_line(line) {
            Ok(()) => &WRITTEN,
            Err(_) => &FAILED,
        };
        counter.fetch_add(1, Ordering::Release);
        Ok(line.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        // Standard error is not buffered, and what fails to be flushed cannot be reported anywhere.
        Ok(())
    }
}

/// Logs a panic as an event: one line in the format of the others, with the request during which it
/// happened.
fn log_panic(panic: &PanicHookInfo<'_>) {
    let backtrace = Backtrace::capture();
    let captured = backtrace.status() == BacktraceStatus::Captured;
    let backtrace = captured.then(|| backtrace.to_string());
    let location = panic.location().map(ToString::to_string);
    tracing::error!(
        panic = panic.payload_as_str().unwrap_or("no text"),
        location,
        backtrace,
        "a thread panicked"
    );
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Takes so many bytes, then fails, then takes everything.
    struct Failing {
        taken: Vec<u8>,
        before: usize,
        failures: usize,
    }

    impl Write for Failing {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            if self.before > 0 {
                let taken = bytes.len().min(self.before);
                self.before -= taken;
                self.taken.extend(&bytes[..taken]);
                return Ok(taken);
            }
            if self.failures > 0 {
                self.failures -= 1;
                return Err(ErrorKind::StorageFull.into());
            }
            self.taken.extend(bytes);
            Ok(bytes.len())
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn a_line_that_is_broken_off_spoils_no_other() {
        let mut writer = LineWriter::new(Failing {
            taken: Vec::new(),
            before: 8,
            failures: 2,
        });
        for line in ["first\n", "second\n", "third\n", "fourth\n"] {
            assert_eq!(writer.write(line.as_bytes()).unwrap(), line.len());
        }
        assert_eq!(writer.out.taken, b"first\nse\nfourth\n");
    }

    #[test]
    fn a_pipe_that_takes_nothing_now_is_tried_again() {
        struct Slow(usize, Vec<u8>);
        impl Write for Slow {
            fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
                self.0 += 1;
                if !self.0.is_multiple_of(3) {
                    return Err(ErrorKind::WouldBlock.into());
                }
                self.1.push(bytes[0]);
                Ok(1)
            }

            fn flush(&mut self) -> io::Result<()> {
                Ok(())
            }
        }
        let mut writer = LineWriter::new(Slow(0, Vec::new()));
        writer.write_line(b"ab\n").unwrap();
        assert_eq!(writer.out.1, b"ab\n");
    }

    #[test]
    fn a_wrong_filter_is_named() {
        let config = LogConfig {
            filter: "placeformer=loud".into(),
            ..Default::default()
        };
        assert!(
            config
                .check()
                .unwrap_err()
                .to_string()
                .contains("placeformer=loud")
        );
        assert!(LogConfig::default().check().is_ok());
    }
}
