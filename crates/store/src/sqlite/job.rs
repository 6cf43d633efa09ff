//! What is handed to the writing thread, and the answer that comes back.

use crate::error::StoreError;
use rusqlite::Connection;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};

/// Whether a job needs more room on the disk when done.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Effect {
    /// Takes this many new bytes in, about; the number bounds the size of a group.
    Grows(usize),
    /// Deletes or marks; may use the reserve.
    Shrinks,
}

/// A unit of writing that can be run again from the start after a rollback.
pub(super) trait Job: Send {
    fn effect(&self) -> Effect;
    /// Runs inside a transaction and keeps its outcome.
    fn run(&mut self, connection: &Connection);
    /// The error of the last run, if it failed.
    fn error(&self) -> Option<&StoreError>;
    /// Answers the caller: the outcome of the last run, or `failure` if the transaction failed.
    fn finish(self: Box<Self>, failure: Option<StoreError>);
}

/// A job made of a closure.
struct Task<T, F> {
    effect: Effect,
    work: F,
    outcome: Option<Result<T, StoreError>>,
    reply: SyncSender<Result<T, StoreError>>,
}

impl<T: Send, F: FnMut(&Connection) -> Result<T, StoreError> + Send> Job for Task<T, F> {
    fn effect(&self) -> Effect {
        self.effect
    }

    fn run(&mut self, connection: &Connection) {
        self.outcome = Some((self.work)(connection));
    }

    fn error(&self) -> Option<&StoreError> {
        match &self.outcome {
            Some(Err(error)) => Some(error),
            _ => None,
        }
    }

    fn finish(self: Box<Self>, failure: Option<StoreError>) {
        let outcome = match (failure, self.outcome) {
            (Some(failure), _) => Err(failure),
            (None, Some(outcome)) => outcome,
            (None, None) => Err(StoreError::Closing),
        };
        // Sending fails if the caller stopped waiting; then nobody needs the answer.
        let _ = self.reply.send(outcome);
    }
}

/// An answer that is on its way.
pub(super) struct Pending<T>(Receiver<Result<T, StoreError>>);

impl<T> Pending<T> {
    /// Blocks until the job is durable or has failed.
    pub(super) fn wait(self) -> Result<T, StoreError> {
        self.0.recv().unwrap_or(Err(StoreError::Closing))
    }
}

/// Makes a job of `work` and the place where its answer arrives. The work may run more than once,
/// so it must not keep state between runs.
pub(super) fn job<T: Send + 'static>(
    effect: Effect,
    work: impl FnMut(&Connection) -> Result<T, StoreError> + Send + 'static,
) -> (Box<dyn Job>, Pending<T>) {
    let (reply, answer) = sync_channel(1);
    let task = Task {
        effect,
        work,
        outcome: None,
        reply,
    };
    (Box::new(task), Pending(answer))
}
