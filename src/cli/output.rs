//! Lines on standard output and standard error.
//!
//! `println!` panics when the reader of a pipe has gone, as `head` goes when it has enough.
//! [`say!`] returns an error instead, on which `main` ends silently. `eprintln!` panics likewise;
//! [`note!`] tells the user something beside the result, and a note that cannot be written is no
//! reason to end what is under way.

use std::fmt;
use std::io::{self, Write, stderr, stdout};
use std::sync::mpsc::sync_channel;
use std::time::Duration;

/// Longest wait for a terminal or pipe where waiting for ever would keep a process from its work
/// or from its end.
const PATIENCE: Duration = Duration::from_secs(2);

/// Standard output took no more.
#[derive(Debug, thiserror::Error)]
pub enum OutputError {
    /// The reader of the pipe has gone, mostly because it has what it wanted.
    #[error("the reader of standard output has gone")]
    Closed,
    /// Anything else, such as a full disk.
    #[error("cannot write to standard output")]
    Write(#[source] io::Error),
}

impl From<io::Error> for OutputError {
    fn from(error: io::Error) -> Self {
        match error.kind() {
            io::ErrorKind::BrokenPipe => Self::Closed,
            _ => Self::Write(error),
        }
    }
}

/// Writes text to standard output and flushes it, so that text without a line break (a question) is
/// seen at once.
pub(super) fn write(text: fmt::Arguments<'_>) -> Result<(), OutputError> {
    write_to(&mut stdout().lock(), text)
}

fn write_to(out: &mut impl Write, text: fmt::Arguments<'_>) -> Result<(), OutputError> {
    out.write_fmt(text)?;
    Ok(out.flush()?)
}

/// Writes a line to standard error, if it takes one.
pub(super) fn write_note(text: fmt::Arguments<'_>) {
    // There is nowhere else to say so.
    let _ = writeln!(stderr().lock(), "{text}");
}

/// The outcome of `write`, which runs on a thread of its own; none if that has not ended soon,
/// because nobody reads what it writes.
pub(super) fn within_patience<T: Send + 'static>(
    write: impl FnOnce() -> T + Send + 'static,
) -> Option<T> {
    let (done, outcome) = sync_channel(1);
    let started = std::thread::Builder::new().spawn(move || {
        // The receiver may have given up.
        let _ = done.send(write());
    });
    started.ok()?;
    outcome.recv_timeout(PATIENCE).ok()
}

/// Says why the process ends. Standard error may be a pipe that nobody reads, which must not keep
/// it from ending.
pub fn report_failure(error: &anyhow::Error) {
    let text = format!("error: {error:#}");
    // Without a reader nobody misses it.
    let _ = within_patience(move || write_note(format_args!("{text}")));
}

/// `eprintln!` that never panics.
macro_rules! note {
    ($($text:tt)*) => { $crate::cli::output::write_note(format_args!($($text)*)) };
}

/// `println!` that returns an [`OutputError`].
macro_rules! say {
    ($($text:tt)*) => { $crate::cli::output::write(format_args!("{}\n", format_args!($($text)*))) };
}

/// `print!` that returns an [`OutputError`].
macro_rules! say_part {
    ($($text:tt)*) => { $crate::cli::output::write(format_args!($($text)*)) };
}

pub(super) use {note, say, say_part};

#[cfg(test)]
mod tests {
    use super::*;

    struct Refusing(io::ErrorKind);

    impl Write for Refusing {
        fn write(&mut self, _: &[u8]) -> io::Result<usize> {
            Err(self.0.into())
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn a_reader_that_has_gone_is_distinguished_from_a_full_disk() {
        let refused = |kind| write_to(&mut Refusing(kind), format_args!("text"));
        assert!(matches!(
            refused(io::ErrorKind::BrokenPipe),
            Err(OutputError::Closed)
        ));
        assert!(matches!(
            refused(io::ErrorKind::StorageFull),
            Err(OutputError::Write(_))
        ));
    }
}
