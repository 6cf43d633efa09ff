//! The one thread that writes, and how many writers share one sync of the disk.
//!
//! Callers hand in jobs and wait. The thread takes the first job and whatever else waits by then,
//! runs all in one transaction, each under a savepoint of its own, commits once, and only then
//! tells every caller. While the disk syncs, the next group gathers by itself; an idle store
//! commits a lone job at once. A job that fails undoes itself only. If the group as a whole fails,
//! each job is tried again alone, so that nobody pays for another's fault.
//!
//! On a full disk the log is folded into the database and the job tried once more; deletes may then
//! use up the [`Reserve`], and until it can be restored jobs that grow the store are refused.

use super::directory::Reserve;
use super::engine::failed;
use super::purge;
use crate::{StoreError, crash_points};
use rusqlite::Connection;
use std::sync::mpsc::{Receiver, RecvError, SyncSender, TryRecvError, sync_channel};
use std::thread::JoinHandle;

/// Most jobs in one transaction.
const GROUP_JOBS: usize = 256;

/// Most new bytes in one transaction.
const GROUP_BYTES: usize = 8 << 20;

/// Whether a job needs more room on the disk when done.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Effect {
    /// Takes new bytes in; the number bounds the size of a group.
    Grows(usize),
    /// Deletes or marks; may use the reserve.
    Shrinks,
}

/// A unit of writing that can be run again from the start after a rollback.
trait Job: Send {
    fn effect(&self) -> Effect;
    /// Runs inside a transaction; keeps its outcome.
    fn run(&mut self, connection: &Connection);
    /// The kept outcome's error, if any.
    fn error(&self) -> Option<&StoreError>;
    /// Tells the caller: the kept outcome, or `failure` if the transaction failed.
    fn finish(self: Box<Self>, failure: Option<StoreError>);
}

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
        self.outcome
            .as_ref()
            .and_then(|outcome| outcome.as_ref().err())
    }

    fn finish(self: Box<Self>, failure: Option<StoreError>) {
        let outcome = failure
            .map(Err)
            .or(self.outcome)
            .unwrap_or(Err(StoreError::Closing));
        // A caller that stopped waiting has nothing to hear.
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

/// The handle to the writing thread; dropping it finishes the jobs at hand, then closes the
/// database.
pub(super) struct Writer {
    jobs: Option<SyncSender<Box<dyn Job>>>,
    thread: Option<JoinHandle<()>>,
}

impl Writer {
    /// Starts the thread on `connection`. At most `queue` jobs wait; further callers block.
    pub(super) fn start(
        connection: Connection,
        reserve: Reserve,
        queue: usize,
    ) -> Result<Self, StoreError> {
        let (jobs, waiting) = sync_channel(queue.max(1));
        let purging = purge::is_pending(&connection)?;
        let worker = Worker {
            connection,
            reserve,
            waiting,
            purging,
        };
        let thread = std::thread::Builder::new()
            .name("store-writer".into())
            .spawn(move || worker.run())
            .map_err(|source| StoreError::Engine {
                context: "starting its writer thread",
                source: Box::new(source),
            })?;
        Ok(Self {
            jobs: Some(jobs),
            thread: Some(thread),
        })
    }

    /// Hands in a job without waiting for its outcome. It may run more than once, so it must not
    /// keep state between runs.
    pub(super) fn submit<T: Send + 'static>(
        &self,
        effect: Effect,
        work: impl FnMut(&Connection) -> Result<T, StoreError> + Send + 'static,
    ) -> Result<Pending<T>, StoreError> {
        let (reply, answer) = sync_channel(1);
        let task = Task {
            effect,
            work,
            outcome: None,
            reply,
        };
        let jobs = self.jobs.as_ref().ok_or(StoreError::Closing)?;
        jobs.send(Box::new(task)).map_err(|_| StoreError::Closing)?;
        Ok(Pending(answer))
    }

    /// Hands in a job and waits until it is durable.
    pub(super) fn run<T: Send + 'static>(
        &self,
        effect: Effect,
        work: impl FnMut(&Connection) -> Result<T, StoreError> + Send + 'static,
    ) -> Result<T, StoreError> {
        self.submit(effect, work)?.wait()
    }
}

impl Drop for Writer {
    fn drop(&mut self) {
        self.jobs = None;
        if let Some(thread) = self.thread.take()
            && thread.join().is_err()
        {
            tracing::error!("the store's writer thread panicked");
        }
    }
}

struct Worker {
    connection: Connection,
    reserve: Reserve,
    waiting: Receiver<Box<dyn Job>>,
    /// Whether deleted maps or retired vectors still lie on disk.
    purging: bool,
}

impl Worker {
    fn run(mut self) {
        while let Ok(first) = self.next() {
            let (group, shrinks) = self.gather(first);
            self.commit(group);
            // Any deletion may have left something behind; looking is two index lookups.
            self.purging = self.purging || shrinks;
            self.purge_some();
        }
        self.checkpoint();
    }

    /// The next job; removes deleted data while there is none.
    fn next(&mut self) -> Result<Box<dyn Job>, RecvError> {
        while self.purging {
            match self.waiting.try_recv() {
                Ok(job) => return Ok(job),
                Err(TryRecvError::Disconnected) => return Err(RecvError),
                Err(TryRecvError::Empty) => self.purge_some(),
            }
        }
        self.waiting.recv()
    }

    fn gather(&self, first: Box<dyn Job>) -> (Vec<Box<dyn Job>>, bool) {
        let mut group = vec![first];
        let (mut bytes, mut shrinks) = (0, false);
        loop {
            match group.last().map(|job| job.effect()) {
                Some(Effect::Grows(more)) => bytes += more,
                _ => shrinks = true,
            }
            if group.len() == GROUP_JOBS || bytes >= GROUP_BYTES {
                return (group, shrinks);
            }
            match self.waiting.try_recv() {
                Ok(job) => group.push(job),
                Err(_) => return (group, shrinks),
            }
        }
    }

    /// Makes a group durable and tells its callers.
    fn commit(&mut self, group: Vec<Box<dyn Job>>) {
        let (mut admitted, mut refused) = (group, Vec::new());
        if !self.reserve.held() && !self.restore_reserve() {
            (admitted, refused) = admitted
                .into_iter()
                .partition(|job| job.effect() == Effect::Shrinks);
        }
        refused
            .into_iter()
            .for_each(|job| job.finish(Some(StoreError::DiskFull)));
        if admitted.is_empty() {
            return;
        }
        match self.attempt(&mut admitted) {
            Ok(()) => admitted.into_iter().for_each(|job| job.finish(None)),
            Err(_) if admitted.len() > 1 => {
                admitted.into_iter().for_each(|job| self.commit_alone(job))
            }
            Err(error) => admitted.into_iter().for_each(|job| self.retry(job, &error)),
        }
    }

    fn commit_alone(&mut self, mut job: Box<dyn Job>) {
        match self.attempt(std::slice::from_mut(&mut job)) {
            Ok(()) => job.finish(None),
            Err(error) => self.retry(job, &error),
        }
    }

    /// The last attempt for a lone job whose transaction failed.
    fn retry(&mut self, mut job: Box<dyn Job>, first: &StoreError) {
        if matches!(first, StoreError::DiskFull) {
            self.make_room(job.effect());
        }
        match self.attempt(std::slice::from_mut(&mut job)) {
            Ok(()) => job.finish(None),
            Err(error) => job.finish(Some(error)),
        }
        self.restore_reserve();
    }

    /// Runs jobs in one transaction. An error means that nothing of any of them remains.
    fn attempt(&self, jobs: &mut [Box<dyn Job>]) -> Result<(), StoreError> {
        crash_points::reach(crash_points::BEFORE_BEGIN);
        let writing = failed("writing");
        self.connection
            .execute_batch("BEGIN IMMEDIATE")
            .map_err(&writing)?;
        let outcome = self.run_all(jobs).and_then(|()| {
            crash_points::reach(crash_points::BEFORE_COMMIT);
            self.connection.execute_batch("COMMIT").map_err(&writing)
        });
        if outcome.is_ok() {
            crash_points::reach(crash_points::AFTER_COMMIT);
        } else if !self.connection.is_autocommit()
            && let Err(error) = self.connection.execute_batch("ROLLBACK")
        {
            tracing::error!(%error, "cannot roll back");
        }
        outcome
    }

    fn run_all(&self, jobs: &mut [Box<dyn Job>]) -> Result<(), StoreError> {
        let writing = failed("writing");
        for job in jobs {
            self.connection
                .execute_batch("SAVEPOINT job")
                .map_err(&writing)?;
            job.run(&self.connection);
            match job.error() {
                None => self
                    .connection
                    .execute_batch("RELEASE job")
                    .map_err(&writing)?,
                // The engine may have rolled everything back itself; the others must then start
                // over.
                Some(StoreError::DiskFull) => return Err(StoreError::DiskFull),
                Some(_) if self.connection.is_autocommit() => {
                    return Err(StoreError::Busy { context: "writing" });
                }
                Some(_) => self
                    .connection
                    .execute_batch("ROLLBACK TO job; RELEASE job")
                    .map_err(&writing)?,
            }
        }
        Ok(())
    }

    /// Frees what can be freed for a job that found the disk full.
    fn make_room(&mut self, effect: Effect) {
        self.checkpoint();
        if effect == Effect::Shrinks || self.purging {
            self.reserve.release();
            while self.purging {
                self.purge_some();
            }
            self.checkpoint();
        }
    }

    fn restore_reserve(&mut self) -> bool {
        if !self.reserve.held() {
            self.checkpoint();
        }
        self.reserve.restore()
    }

    /// Removes one batch of deleted data.
    fn purge_some(&mut self) {
        if !self.purging {
            return;
        }
        match purge::batch(&self.connection) {
            Ok(more) => self.purging = more,
            Err(error) => {
                // Tried again after the next deletion or at the next start.
                tracing::warn!(%error, "cannot remove deleted data now");
                self.purging = false;
            }
        }
    }

    /// Folds the log into the database as far as readers allow, and cuts it.
    fn checkpoint(&self) {
        if let Err(error) = self
            .connection
            .query_row("PRAGMA wal_checkpoint(TRUNCATE)", [], |_| Ok(()))
        {
            tracing::warn!(%error, "cannot fold the log into the database now");
        }
    }
}
