//! Blocking work off the async threads.

use std::future::Future;
use std::pin::Pin;
use std::task::{Context, Poll};
use tokio::task::{JoinHandle, spawn_blocking};
use tracing::Span;

/// The work panicked. The panic's text is in the log.
#[derive(Debug)]
pub(super) struct Panicked;

/// Runs `work` on a blocking thread, inside the caller's span.
///
/// Cancel safety: dropped before the work began, it never begins; dropped later, the work runs to
/// its end and its outcome is lost.
pub(super) async fn blocking<T: Send + 'static>(
    work: impl FnOnce() -> T + Send + 'static,
) -> Result<T, Panicked> {
    let span = Span::current();
    AbortOnDrop(spawn_blocking(move || span.in_scope(work))).await
}

struct AbortOnDrop<T>(JoinHandle<T>);

impl<T> Future for AbortOnDrop<T> {
    type Output = Result<T, Panicked>;

    fn poll(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Self::Output> {
        // Nothing else aborts the task, and a runtime that shuts down polls nobody.
        Pin::new(&mut self.0).poll(context).map_err(|error| {
            tracing::error!(%error, "a blocking task failed");
            Panicked
        })
    }
}

impl<T> Drop for AbortOnDrop<T> {
    fn drop(&mut self) {
        self.0.abort();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_panic_is_contained() {
        assert!(blocking(|| panic!("planted")).await.is_err());
        assert_eq!(blocking(|| 7).await.unwrap(), 7);
    }
}
