//! Blocking work off the async threads.

use tokio::task::spawn_blocking;
use tokio_util::task::AbortOnDropHandle;
use tracing::Span;

/// The work panicked. The panic's text is in the log.
#[derive(Debug)]
pub(super) struct Panicked;

/// Runs `work` on a blocking thread, inside the caller's span.
///
/// Cancel safety: dropped before the work began, it never begins; dropped later, the work runs to
/// its end, because a blocking thread cannot be stopped, and its outcome is lost.
pub(super) async fn blocking<T: Send + 'static>(
    work: impl FnOnce() -> T + Send + 'static,
) -> Result<T, Panicked> {
    let span = Span::current();
    let task = AbortOnDropHandle::new(spawn_blocking(move || span.in_scope(work)));
    task.await.map_err(|error| {
        // Only dropping the handle aborts the task, and then nobody waits here: it panicked.
        tracing::error!(%error, "a blocking task failed");
        Panicked
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::mpsc;
    use tokio::sync::oneshot;

    #[tokio::test]
    async fn a_panic_is_contained() {
        assert!(blocking(|| panic!("planted")).await.is_err());
        assert_eq!(blocking(|| 7).await.unwrap(), 7);
    }

    #[test]
    fn work_that_has_not_begun_when_its_caller_leaves_never_begins() {
        let runtime = tokio::runtime::Builder::new_current_thread()
            .max_blocking_threads(1)
            .build()
            .unwrap();
        runtime.block_on(async {
            let (release, released) = mpsc::sync_channel::<()>(1);
            let (started, has_started) = oneshot::channel();
            let occupying = tokio::spawn(blocking(move || {
                started.send(()).unwrap();
                released.recv().unwrap();
            }));
            has_started.await.unwrap();

            let (begun, has_begun) = mpsc::sync_channel(1);
            let waiting = tokio::spawn(blocking(move || begun.send(())));
            tokio::task::yield_now().await;
            waiting.abort();
            assert!(waiting.await.unwrap_err().is_cancelled());

            release.send(()).unwrap();
            occupying.await.unwrap().unwrap();
            blocking(|| ()).await.unwrap();
            assert!(has_begun.try_recv().is_err());
        });
    }
}
