//! Lines on standard output.
//!
//! `println!` panics when the reader of a pipe has gone, as `head` goes when it has enough.
//! [`say!`] returns an error instead, on which `main` ends silently.

use std::fmt;
use std::io::{self, Write, stdout};

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

/// `println!` that returns an [`OutputError`].
macro_rules! say {
    ($($text:tt)*) => { $crate::cli::output::write(format_args!("{}\n", format_args!($($text)*))) };
}

/// `print!` that returns an [`OutputError`].
macro_rules! say_part {
    ($($text:tt)*) => { $crate::cli::output::write(format_args!($($text)*)) };
}

pub(super) use {say, say_part};

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
