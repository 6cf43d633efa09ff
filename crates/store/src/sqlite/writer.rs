//! The one thread that writes, and how many writers share one sync of the disk.
//!
//! Callers hand in jobs and wait. The thread takes the first job and all that wait by then. It
//! runs them in one transaction, each under a savepoint of its own, commits once, and only then
//! answers every caller. While the disk syncs, the next group gathers by itself; an idle store
//! commits a lone job at once. A job that fails undoes itself only. If the group as a whole fails,
//! each job is tried again alone, so that no caller suffers from the fault of another.
//!
//! On a full disk the log is folded into the database and the job tried once more; deletes may
//! then use up the [`Reserve`], and until it can be restored jobs that grow the store are refused.

use super::engine::failed;
use super::job::{Effect, Job, Pending, job};
use super::purge;
use super::reserve::Reserve;
use crate::crash_points;
use crate::error::StoreError;
use rusqlite::Connection;
use std::sync::mpsc::{Receiver, RecvError, SyncSender, TryRecvError, sync_channel};
use std::thread::JoinHandle;

/// Most jobs in one transaction.
const GROUP_JOBS: usize = 256;

/// Most new bytes in one transaction.
const GROUP_BYTES: usize = 8 << 20;

/// The handle to the writing thread. Dropping it finishes the jobs handed in, then closes the
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
        let (job, pending) = job(effect, work);
        let jobs = self.jobs.as_ref().ok_or(StoreError::Closing)?;
        jobs.send(job).map_err(|_| StoreError::Closing)?;
        Ok(pending)
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

/// The writing thread's own state.
struct Worker {
    connection: Connection,
    reserve: Reserve,
    waiting: Receiver<Box<dyn Job>>,
    /// Whether deleted maps or retired vectors still lie on disk.
    purging: bool,
}

/// Jobs that share a transaction.
struct Group {
    jobs: Vec<Box<dyn Job>>,
    /// Whether any of them deletes.
    shrinks: bool,
}

impl Worker {
    fn run(mut self) {
        while let Ok(first) = self.next() {
            let group = self.gather(first);
            self.commit(group.jobs);
            // Any deletion may have left something to remove. Looking whether it has costs two
            // lookups in an index.
            self.purging = self.purging || group.shrinks;
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

    /// `first` and the jobs that wait by now, as far as they fit in one transaction.
    fn gather(&self, first: Box<dyn Job>) -> Group {
        let mut group = Group {
            jobs: Vec::new(),
            shrinks: false,
        };
        let mut bytes = 0;
        let mut next = Some(first);
        while let Some(job) = next {
            match job.effect() {
                Effect::Grows(more) => bytes += more,
                Effect::Shrinks => group.shrinks = true,
            }
            group.jobs.push(job);
            if group.jobs.len() == GROUP_JOBS || bytes >= GROUP_BYTES {
                break;
            }
            next = self.waiting.try_recv().ok();
        }
        group
    }

    /// Makes a group durable and answers its callers.
    fn commit(&mut self, jobs: Vec<Box<dyn Job>>) {
        let mut admitted = self.admit(jobs);
        if admitted.is_empty() {
            return;
        }
        match self.attempt(&mut admitted) {
            Ok(()) => {
                for job in admitted {
                    job.finish(None);
                }
            }
            Err(error) if admitted.len() == 1 => {
                for job in admitted {
                    self.retry(job, &error);
                }
            }
            Err(_) => {
                for job in admitted {
                    self.commit_alone(job);
                }
            }
        }
    }

    /// The jobs that may run. Without the reserve those that grow the store are refused.
    fn admit(&mut self, jobs: Vec<Box<dyn Job>>) -> Vec<Box<dyn Job>> {
        if self.reserve.is_in_place() || self.restore_reserve() {
            return jobs;
        }
        let mut admitted = Vec::new();
        for job in jobs {
            match job.effect() {
                Effect::Shrinks => admitted.push(job),
                Effect::Grows(_) => job.finish(Some(StoreError::DiskFull)),
            }
        }
        admitted
    }

    fn commit_alone(&mut self, mut job: Box<dyn Job>) {
        match self.attempt(std::slice::from_mut(&mut job)) {
            Ok(()) => job.finish(None),
            Err(error) => self.retry(job, &error),
        }
    }

    /// The last attempt for a lone job whose transaction failed with `first`.
    fn retry(&mut self, mut job: Box<dyn Job>, first: &StoreError) {
        if matches!(first, StoreError::DiskFull) {
            self.make_room(job.effect());
        }
        let outcome = self.attempt(std::slice::from_mut(&mut job));
        job.finish(outcome.err());
        self.restore_reserve();
    }

    /// Runs jobs in one transaction. An error means that nothing of any of them remains.
    fn attempt(&self, jobs: &mut [Box<dyn Job>]) -> Result<(), StoreError> {
        crash_points::reach(crash_points::BEFORE_BEGIN);
        self.execute("BEGIN IMMEDIATE")?;
        let outcome = self.run_all(jobs).and_then(|()| {
            crash_points::reach(crash_points::BEFORE_COMMIT);
            self.execute("COMMIT")
        });
        if outcome.is_ok() {
            crash_points::reach(crash_points::AFTER_COMMIT);
        } else if !self.connection.is_autocommit()
            && let Err(error) = self.execute("ROLLBACK")
        {
            tracing::error!(%error, "cannot roll back");
        }
        outcome
    }

    /// Runs every job under a savepoint, and undoes those that fail. An error means that all of
    /// them have to start over.
    fn run_all(&self, jobs: &mut [Box<dyn Job>]) -> Result<(), StoreError> {
        for job in jobs {
            self.execute("SAVEPOINT job")?;
            job.run(&self.connection);
            match job.error() {
                None => self.execute("RELEASE job")?,
                Some(StoreError::DiskFull) => return Err(StoreError::DiskFull),
                // The engine has rolled the whole transaction back by itself, and the jobs before
                // this one with it.
                Some(_) if self.connection.is_autocommit() => {
                    return Err(StoreError::Busy { context: "writing" });
                }
                Some(_) => self.execute("ROLLBACK TO job; RELEASE job")?,
            }
        }
        Ok(())
    }

    fn execute(&self, sql: &str) -> Result<(), StoreError> {
        self.connection
            .execute_batch(sql)
            .map_err(failed("writing"))
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
        if !self.reserve.is_in_place() {
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
        let sql = "PRAGMA wal_checkpoint(TRUNCATE)";
        if let Err(error) = self.connection.query_row(sql, [], |_| Ok(())) {
            tracing::warn!(%error, "cannot fold the log into the database now");
        }
    }
}
