//! Connections to the database: how they are opened, a pool of readers, and what the engine's
//! errors mean to us.
//!
//! Write-ahead logging lets readers go on beside the one writer; `synchronous = FULL` syncs the log
//! on every commit. Readers are opened read-only, so that no read path can ever write. Pages are
//! large because most bytes are patch blobs of a hundred kilobytes: fewer overflow pages to chain
//! through.

use crate::{EngineCause, StoreConfig, StoreError};
use rusqlite::{Connection, ErrorCode as SqliteCode, OpenFlags};
use std::path::{Path, PathBuf};
use std::sync::{Condvar, Mutex, PoisonError};
use std::time::Duration;

/// Longest wait of a reader for a lock inside the engine; only recovery and checkpoints ever hold
/// one against it.
const READER_BUSY_TIMEOUT: Duration = Duration::from_secs(10);

/// Longest wait of the writer. Nobody else writes, so all it can wait for is readers that keep a
/// checkpoint from cutting the log, and those it need not wait for: the next checkpoint will.
const WRITER_BUSY_TIMEOUT: Duration = Duration::from_millis(50);

/// Prepared statements kept per connection.
const STATEMENTS: usize = 64;

/// Extended code of a shared-memory file that cannot grow (`SQLITE_IOERR_SHMSIZE`): the disk is
/// full.
const SHM_CANNOT_GROW: i32 = 4874;

/// Turns an engine error met while `context` into ours.
pub(super) fn failed(context: &'static str) -> impl Fn(rusqlite::Error) -> StoreError {
    move |error| match &error {
        rusqlite::Error::SqliteFailure(cause, _) if cause.code == SqliteCode::DiskFull => {
            StoreError::DiskFull
        }
        rusqlite::Error::SqliteFailure(cause, _) if cause.extended_code == SHM_CANNOT_GROW => {
            StoreError::DiskFull
        }
        rusqlite::Error::SqliteFailure(cause, _)
            if matches!(
                cause.code,
                SqliteCode::DatabaseBusy | SqliteCode::DatabaseLocked
            ) =>
        {
            StoreError::Busy { context }
        }
        rusqlite::Error::SqliteFailure(cause, _)
            if matches!(
                cause.code,
                SqliteCode::DatabaseCorrupt | SqliteCode::NotADatabase
            ) =>
        {
            StoreError::Damaged {
                context,
                source: EngineCause::from(error),
            }
        }
        _ => StoreError::Engine {
            context,
            source: EngineCause::from(error),
        },
    }
}

/// Whether an error says that what was read is damaged, and how.
pub(super) fn damage(error: &rusqlite::Error) -> Option<String> {
    use rusqlite::Error::*;
    match error {
        SqliteFailure(cause, _)
            if matches!(
                cause.code,
                SqliteCode::DatabaseCorrupt | SqliteCode::NotADatabase
            ) =>
        {
            Some(error.to_string())
        }
        FromSqlConversionFailure(..)
        | IntegralValueOutOfRange(..)
        | Utf8Error(..)
        | InvalidColumnType(..) => Some(error.to_string()),
        _ => None,
    }
}

/// Opens the writing connection, creating the database if there is none.
pub(super) fn open_writer(
    path: &Path,
    config: &StoreConfig,
    log_bytes: u64,
) -> Result<Connection, StoreError> {
    let opening = failed("opening it for writing");
    let flags = OpenFlags::SQLITE_OPEN_READ_WRITE
        | OpenFlags::SQLITE_OPEN_CREATE
        | OpenFlags::SQLITE_OPEN_NO_MUTEX;
    let connection = Connection::open_with_flags(path, flags).map_err(&opening)?;
    // The page size is honoured only before the first page exists, so it comes before the journal
    // mode.
    connection
        .pragma_update(None, "page_size", config.page_bytes)
        .map_err(&opening)?;
    connection
        .pragma_update_and_check(None, "journal_mode", "wal", |row| row.get::<_, String>(0))
        .map_err(&opening)
        .and_then(|mode| {
            let cause = || {
                EngineCause::from(format!(
                    "write-ahead logging is refused here (journal mode {mode})"
                ))
            };
            if mode == "wal" {
                Ok(())
            } else {
                Err(StoreError::Engine {
                    context: "opening it",
                    source: cause(),
                })
            }
        })?;
    connection
        .pragma_update(None, "synchronous", "full")
        .map_err(&opening)?;
    connection
        .pragma_update(None, "foreign_keys", true)
        .map_err(&opening)?;
    let log_pages = (log_bytes / u64::from(config.page_bytes)).max(16) as i64;
    connection
        .pragma_update(None, "wal_autocheckpoint", log_pages)
        .map_err(&opening)?;
    connection
        .busy_timeout(WRITER_BUSY_TIMEOUT)
        .map_err(&opening)?;
    prepare(&connection, config).map_err(&opening)?;
    Ok(connection)
}

/// Opens a reading connection to a database that exists.
pub(super) fn open_reader(path: &Path, config: &StoreConfig) -> Result<Connection, StoreError> {
    let opening = failed("opening it for reading");
    let flags = OpenFlags::SQLITE_OPEN_READ_ONLY | OpenFlags::SQLITE_OPEN_NO_MUTEX;
    let connection = Connection::open_with_flags(path, flags).map_err(&opening)?;
    connection
        .busy_timeout(READER_BUSY_TIMEOUT)
        .map_err(&opening)?;
    prepare(&connection, config).map_err(&opening)?;
    Ok(connection)
}

fn prepare(connection: &Connection, config: &StoreConfig) -> rusqlite::Result<()> {
    connection.set_prepared_statement_cache_capacity(STATEMENTS);
    connection.pragma_update(None, "temp_store", "memory")?;
    // A negative size counts KiB instead of pages.
    connection.pragma_update(None, "cache_size", -i64::from(config.cache_kib))
}

/// A bounded set of reading connections, opened on demand.
pub(super) struct Readers {
    path: PathBuf,
    config: StoreConfig,
    state: Mutex<Pool>,
    returned: Condvar,
}

#[derive(Default)]
struct Pool {
    idle: Vec<Connection>,
    open: usize,
}

impl Readers {
    pub(super) fn new(path: PathBuf, config: StoreConfig) -> Self {
        Self {
            path,
            config,
            state: Mutex::default(),
            returned: Condvar::new(),
        }
    }

    /// Runs `work` with a connection of its own, waiting while all are taken.
    pub(super) fn with<T>(
        &self,
        work: impl FnOnce(&Connection) -> Result<T, StoreError>,
    ) -> Result<T, StoreError> {
        let lease = self.lease()?;
        // The lease holds its connection until it is dropped.
        match &lease.connection {
            Some(connection) => work(connection),
            None => Err(StoreError::Closing),
        }
    }

    /// Connections open now.
    pub(super) fn open(&self) -> usize {
        self.state
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .open
    }

    fn lease(&self) -> Result<Lease<'_>, StoreError> {
        let mut pool = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        loop {
            if let Some(connection) = pool.idle.pop() {
                return Ok(Lease {
                    readers: self,
                    connection: Some(connection),
                });
            }
            if pool.open < self.config.readers.max(1) {
                pool.open += 1;
                drop(pool);
                // Dropping a lease without a connection gives the place back if opening fails.
                let mut lease = Lease {
                    readers: self,
                    connection: None,
                };
                lease.connection = Some(open_reader(&self.path, &self.config)?);
                return Ok(lease);
            }
            pool = self
                .returned
                .wait(pool)
                .unwrap_or_else(PoisonError::into_inner);
        }
    }
}

/// A connection on loan; goes back when dropped, also when its user panics.
struct Lease<'a> {
    readers: &'a Readers,
    connection: Option<Connection>,
}

impl Drop for Lease<'_> {
    fn drop(&mut self) {
        let mut pool = self
            .readers
            .state
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        match self.connection.take() {
            // A panic may have left a transaction open; such a connection is not lent again.
            Some(connection) if connection.is_autocommit() => pool.idle.push(connection),
            _ => pool.open -= 1,
        }
        self.readers.returned.notify_one();
    }
}
