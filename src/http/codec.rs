//! Threads for taking bodies apart and for writing answers.
//!
//! Base64, JSON and multipart of 25 MB take long enough that probes would wait if the threads that
//! drive the connections did the work. Large and small pieces of work have threads of their own, so
//! that a small one never waits for large ones; of both kinds only a few run at once.

use super::problem::ApiError;
use placeformer_core::error::ErrorCode;
use std::sync::Arc;
use tokio::sync::Semaphore;
use tokio::task::spawn_blocking;
use tokio_util::task::AbortOnDropHandle;
use tracing::Span;

/// Bytes from which on a body is large: a hundredth of a second and more to take apart.
const LARGE_BYTES: usize = 1 << 20;

/// How many pieces of work may run at once.
pub struct CodecThreads {
    small: Arc<Semaphore>,
    large: Arc<Semaphore>,
}

/// How much work something is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Workload {
    /// Milliseconds at most.
    Small,
    /// More.
    Large,
}

impl Workload {
    /// Of a body of so many bytes.
    pub fn of_body(bytes: usize) -> Self {
        if bytes < LARGE_BYTES {
            Self::Small
        } else {
            Self::Large
        }
    }
}

impl CodecThreads {
    /// At most `threads` for each workload.
    pub fn new(threads: usize) -> Self {
        let semaphore = || Arc::new(Semaphore::new(threads.min(Semaphore::MAX_PERMITS)));
        Self {
            small: semaphore(),
            large: semaphore(),
        }
    }

    /// Runs `work` on a thread where it may block, within the caller's span, as soon as few enough
    /// others run.
    ///
    /// Cancel safety: dropped before the work began, it never begins; dropped later, the work runs
    /// to its end and keeps its place until then, and its outcome is lost.
    ///
    /// # Errors
    /// `shutting_down` if the runtime ends; otherwise those of the work.
    ///
    /// # Panics
    /// If the work does.
    pub async fn run<T: Send + 'static>(
        &self,
        workload: Workload,
        work: impl FnOnce() -> Result<T, ApiError> + Send + 'static,
    ) -> Result<T, ApiError> {
        let places = match workload {
            Workload::Small => &self.small,
            Workload::Large => &self.large,
        };
        // Nobody closes the semaphores.
        let place = places.clone().acquire_owned().await.map_err(stopped)?;
        let span = Span::current();
        let task = AbortOnDropHandle::new(spawn_blocking(move || {
            let _place = place;
            span.in_scope(work)
        }));
        match task.await {
            Ok(outcome) => outcome,
            Err(error) => match error.try_into_panic() {
                Ok(panic) => std::panic::resume_unwind(panic),
                Err(error) => Err(stopped(error)),
            },
        }
    }
}

fn stopped(error: impl std::error::Error) -> ApiError {
    tracing::debug!(%error, "work was not begun because the server stops");
    ApiError::new(ErrorCode::ShuttingDown, "the server stops")
}
