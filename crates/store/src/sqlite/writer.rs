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
//!
//! Callers are answered only if, after the commit, the [`Storage`] is still in place and the
//! [`MarkFile`] says durably that the commit was made. A commit for which that fails may be in the
//! database or not; its callers are told that the storage is lost.

use super::engine::{data_version, failed};
use super::job::{Effect, Job, Pending, job};
use super::mark::{CommitMark, MarkFile};
use super::purge;
use super::reserve::Reserve;
use super::sequence::{Progress, count_commit, set_closed};
use super::storage::{Storage, Writing};
use crate::crash_points;
use crate::error::StoreError;
use rusqlite::Connection;
use rusqlite::config::DbConfig;
use std::sync::Arc;
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
        files: Files,
        queue: usize,
    ) -> Result<Self, StoreError> {
        let (jobs, waiting) = sync_channel(queue.max(1));
        let purging = purge::is_pending(&connection)?;
        let worker = Worker {
            connection,
            files,
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

/// What the writer keeps beside the database.
pub(super) struct Files {
    pub reserve: Reserve,
    /// None if the database cannot say how far it has come.
    pub mark: Option<MarkFile>,
    pub storage: Arc<Storage>,
}

/// Why a transaction failed.
enum Failure {
    /// Nothing of it remains, and it may be tried again.
    Undone(StoreError),
    /// Nothing of it remains, and the storage is at fault, so that others would fail as well.
    Lost(String),
    /// It may be in the database, and nobody may be told so.
    Unmarked(String),
}

impl From<StoreError> for Failure {
    fn from(error: StoreError) -> Self {
        match error {
            StoreError::StorageLost { reason } => Self::Lost(reason),
            error => Self::Undone(error),
        }
    }
}

/// The writing thread's own state.
struct Worker {
    connection: Connection,
    files: Files,
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
        self.close();
    }

    /// Folds the log into the database before the connection closes.
    fn close(&self) {
        let said = self.begin().and_then(|_writing| {
            set_closed(&self.connection).map_err(failed("saying that it is closed"))
        });
        if let Err(error) = said {
            tracing::warn!(%error, "the database does not say that it is closed");
        }
        self.checkpoint();
        if let Err(error) = self.begin() {
            tracing::error!(%error, "the log is left as it is");
            // Closing would remove the log by its name, which may stand for another one by now.
            let keep_log = DbConfig::SQLITE_DBCONFIG_NO_CKPT_ON_CLOSE;
            if let Err(error) = self.connection.set_db_config(keep_log, true) {
                tracing::error!(%error, "cannot keep the log");
            }
        }
    }

    /// Lets this thread write, if the storage is in place.
    fn begin(&self) -> Result<Writing<'_>, StoreError> {
        self.files.storage.begin(&|| self.version())
    }

    fn version(&self) -> Option<i64> {
        data_version(&self.connection)
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
        // What follows may write to the directory even before a transaction begins.
        if let Err(error) = self.begin().map(drop) {
            return refuse(jobs, &reason_of(error));
        }
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
            Err(Failure::Lost(reason) | Failure::Unmarked(reason)) => refuse(admitted, &reason),
            Err(Failure::Undone(error)) if admitted.len() == 1 => {
                for job in admitted {
                    self.retry(job, &error);
                }
            }
            Err(Failure::Undone(_)) => {
                for job in admitted {
                    self.commit_alone(job);
                }
            }
        }
    }

    /// The jobs that may run. Without the reserve those that grow the store are refused.
    fn admit(&mut self, jobs: Vec<Box<dyn Job>>) -> Vec<Box<dyn Job>> {
        if self.files.reserve.is_in_place() || self.restore_reserve() {
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
            Err(Failure::Lost(reason) | Failure::Unmarked(reason)) => refuse([job], &reason),
            Err(Failure::Undone(error)) => self.retry(job, &error),
        }
    }

    /// The last attempt for a lone job whose transaction failed with `first`.
    fn retry(&mut self, mut job: Box<dyn Job>, first: &StoreError) {
        if matches!(first, StoreError::DiskFull) {
            self.make_room(job.effect());
        }
        match self.attempt(std::slice::from_mut(&mut job)) {
            Ok(()) => job.finish(None),
            Err(Failure::Undone(error)) => job.finish(Some(error)),
            Err(Failure::Lost(reason) | Failure::Unmarked(reason)) => refuse([job], &reason),
        }
        self.restore_reserve();
    }

    /// Runs jobs in one transaction and marks it.
    fn attempt(&self, jobs: &mut [Box<dyn Job>]) -> Result<(), Failure> {
        let storage = &self.files.storage;
        let outcome = self.begin().map_err(Failure::from).and_then(|writing| {
            let progress = self.transact(jobs, &writing)?;
            crash_points::reach(crash_points::AFTER_COMMIT);
            self.acknowledge(&writing, progress)
        });
        match &outcome {
            Ok(()) => storage.wrote(Ok(())),
            Err(Failure::Lost(reason) | Failure::Unmarked(reason)) => {
                tracing::error!(reason, "the storage is lost");
                storage.wrote(Err(&StoreError::StorageLost {
                    reason: reason.clone(),
                }));
            }
            Err(Failure::Undone(_)) => {}
        }
        outcome
    }

    /// Runs jobs in one transaction. An error means that nothing of any of them remains.
    fn transact(
        &self,
        jobs: &mut [Box<dyn Job>],
        writing: &Writing<'_>,
    ) -> Result<Option<Progress>, StoreError> {
        crash_points::reach(crash_points::BEFORE_BEGIN);
        self.execute("BEGIN IMMEDIATE")?;
        let outcome = self.run_all(jobs).and_then(|()| {
            let progress = self.count()?;
            crash_points::reach(crash_points::BEFORE_COMMIT);
            writing.check()?;
            self.execute("COMMIT")?;
            Ok(progress)
        });
        if outcome.is_err()
            && !self.connection.is_autocommit()
            && let Err(error) = self.execute("ROLLBACK")
        {
            tracing::error!(%error, "cannot roll back");
        }
        outcome
    }

    /// Counts the commit; none if damage keeps the database from counting, which must not keep
    /// what is damaged from being deleted.
    fn count(&self) -> Result<Option<Progress>, StoreError> {
        match count_commit(&self.connection).map_err(failed("counting commits")) {
            Err(error @ StoreError::Damaged { .. }) => {
                tracing::error!(%error, "this commit is not marked");
                Ok(None)
            }
            counted => counted,
        }
    }

    /// Makes sure that what was committed will be found again, and that its loss would be noticed.
    fn acknowledge(
        &self,
        writing: &Writing<'_>,
        progress: Option<Progress>,
    ) -> Result<(), Failure> {
        let unmarked = |error| Failure::Unmarked(reason_of(error));
        writing.check().map_err(unmarked)?;
        if let (Some(mark), Some(progress)) = (&self.files.mark, progress) {
            mark.record(&CommitMark::now(progress)).map_err(unmarked)?;
        }
        Ok(())
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
            self.files.reserve.release();
            while self.purging {
                self.purge_some();
            }
            self.checkpoint();
        }
    }

    fn restore_reserve(&mut self) -> bool {
        if !self.files.reserve.is_in_place() {
            self.checkpoint();
        }
        self.files.reserve.restore()
    }

    /// Removes one batch of deleted data.
    fn purge_some(&mut self) {
        if !self.purging {
            return;
        }
        let removed = self
            .begin()
            .and_then(|_writing| purge::batch(&self.connection));
        match removed {
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
        let folded = self
            .files
            .storage
            .begin_folding(&|| self.version())
            .and_then(|_writing| {
                let folded = self.connection.query_row(sql, [], |_| Ok(()));
                folded.map_err(failed("folding the log into it"))
            });
        if let Err(error) = folded {
            tracing::warn!(%error, "cannot fold the log into the database now");
        }
    }
}

/// What is wrong with the storage.
fn reason_of(error: StoreError) -> String {
    match error {
        StoreError::StorageLost { reason } => reason,
        other => other.to_string(),
    }
}

/// Answers that the storage is lost.
fn refuse(jobs: impl IntoIterator<Item = Box<dyn Job>>, reason: &str) {
    for job in jobs {
        job.finish(Some(StoreError::StorageLost {
            reason: reason.to_owned(),
        }));
    }
}
