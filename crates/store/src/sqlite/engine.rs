//! How connections to the database are opened, and what the engine's errors mean to us.
//!
//! Write-ahead logging lets readers go on while the one writer writes; `synchronous = FULL` syncs
//! the log on every commit. Readers are opened read-only, so that no read path can ever write.
//! Pages are large because most bytes are patch blobs of a hundred kilobytes: fewer overflow pages
//! to chain through.

use super::directory::io;
use crate::config::StoreConfig;
use crate::error::{EngineCause, StoreError};
use placeformer_core::files::create_private_file;
use rusqlite::{Connection, Error as SqliteError, ErrorCode as SqliteCode, OpenFlags};
use std::path::Path;
use std::time::Duration;

/// Longest wait of a reader for a lock inside the engine. Only recovery and checkpoints ever lock
/// readers out.
const READER_BUSY_TIMEOUT: Duration = Duration::from_secs(10);

/// Longest wait of the writer. Nobody else writes, so it can only wait for readers that keep a
/// checkpoint from cutting the log. It need not wait for those, because the next checkpoint will
/// cut it.
const WRITER_BUSY_TIMEOUT: Duration = Duration::from_millis(50);

/// Prepared statements kept per connection.
const STATEMENTS: usize = 64;

/// Fewest pages of the write-ahead log at which it is folded into the database.
const LEAST_LOG_PAGES: u64 = 16;

/// Extended code of a shared-memory file that cannot grow (`SQLITE_IOERR_SHMSIZE`): the disk is
/// full.
const SHM_CANNOT_GROW: i32 = 4874;

/// Extended code of an operation that failed for want of memory (`SQLITE_IOERR_NOMEM`), which says
/// nothing about the disk.
const IO_OUT_OF_MEMORY: i32 = 3082;

/// What a failure reported by the engine itself means.
enum Failure {
    DiskFull,
    Busy,
    Damaged,
    /// The system refused to read or write.
    Storage,
    Other,
}

fn classify(error: &SqliteError) -> Failure {
    let SqliteError::SqliteFailure(cause, _) = error else {
        return Failure::Other;
    };
    match cause.code {
        SqliteCode::DiskFull => Failure::DiskFull,
        _ if cause.extended_code == SHM_CANNOT_GROW => Failure::DiskFull,
        SqliteCode::DatabaseBusy | SqliteCode::DatabaseLocked => Failure::Busy,
        SqliteCode::DatabaseCorrupt | SqliteCode::NotADatabase => Failure::Damaged,
        SqliteCode::SystemIoFailure if cause.extended_code == IO_OUT_OF_MEMORY => Failure::Other,
        SqliteCode::SystemIoFailure | SqliteCode::ReadOnly => Failure::Storage,
        _ => Failure::Other,
    }
}

/// Makes a function that turns an error of the engine, which happened while `context`, into ours.
pub(super) fn failed(context: &'static str) -> impl Fn(SqliteError) -> StoreError {
    move |error| match classify(&error) {
        Failure::DiskFull => StoreError::DiskFull,
        Failure::Busy => StoreError::Busy { context },
        Failure::Damaged => StoreError::Damaged {
            context,
            source: EngineCause::from(error),
        },
        Failure::Storage => StoreError::StorageLost {
            reason: format!("the disk failed while {context}: {error}"),
        },
        Failure::Other => StoreError::Engine {
            context,
            source: EngineCause::from(error),
        },
    }
}

/// What is wrong with the data, if an error says that what was read is damaged.
pub(super) fn damage(error: &SqliteError) -> Option<String> {
    let is_damage = match error {
        SqliteError::SqliteFailure(..) => matches!(classify(error), Failure::Damaged),
        // The engine read the column, but its content does not fit the type written there.
        SqliteError::FromSqlConversionFailure(..)
        | SqliteError::IntegralValueOutOfRange(..)
        | SqliteError::Utf8Error(..)
        | SqliteError::InvalidColumnType(..) => true,
        _ => false,
    };
    is_damage.then(|| error.to_string())
}

/// Opens the writing connection, creating the database if there is none. The log is folded into
/// the database when it has reached `log_bytes`.
pub(super) fn open_writer(
    path: &Path,
    config: &StoreConfig,
    log_bytes: u64,
) -> Result<Connection, StoreError> {
    let opening = failed("opening it for writing");
    // The engine gives its log and its shared memory the mode of the database.
    create_private_file(path).map_err(io("cannot create", path))?;
    let flags = OpenFlags::SQLITE_OPEN_READ_WRITE
        | OpenFlags::SQLITE_OPEN_CREATE
        | OpenFlags::SQLITE_OPEN_NO_MUTEX;
    let connection = Connection::open_with_flags(path, flags).map_err(&opening)?;
    // The engine takes a page size only before the first page exists, and setting the journal mode
    // writes it.
    connection
        .pragma_update(None, "page_size", config.page_bytes)
        .map_err(&opening)?;
    let journal_mode: String = connection
        .pragma_update_and_check(None, "journal_mode", "wal", |row| row.get("journal_mode"))
        .map_err(&opening)?;
    if journal_mode != "wal" {
        let cause = format!("write-ahead logging is refused here (journal mode {journal_mode})");
        return Err(StoreError::Engine {
            context: "opening it",
            source: EngineCause::from(cause),
        });
    }
    let log_pages = (log_bytes / u64::from(config.page_bytes)).max(LEAST_LOG_PAGES);
    let set_up = || -> rusqlite::Result<()> {
        connection.pragma_update(None, "synchronous", "full")?;
        connection.pragma_update(None, "foreign_keys", true)?;
        connection.pragma_update(None, "wal_autocheckpoint", log_pages as i64)?;
        connection.busy_timeout(WRITER_BUSY_TIMEOUT)?;
        set_caches(&connection, config)
    };
    set_up().map_err(&opening)?;
    Ok(connection)
}

/// Opens a reading connection to a database that exists.
pub(super) fn open_reader(path: &Path, config: &StoreConfig) -> Result<Connection, StoreError> {
    let flags = OpenFlags::SQLITE_OPEN_READ_ONLY | OpenFlags::SQLITE_OPEN_NO_MUTEX;
    let open = || -> rusqlite::Result<Connection> {
        let connection = Connection::open_with_flags(path, flags)?;
        connection.busy_timeout(READER_BUSY_TIMEOUT)?;
        set_caches(&connection, config)?;
        Ok(connection)
    };
    open().map_err(failed("opening it for reading"))
}

/// The engine's count of what other connections have committed, as this one sees it: two numbers
/// of the same connection differ if any has in between.
pub(super) fn data_version(connection: &Connection) -> Option<i64> {
    let mut statement = connection.prepare_cached("PRAGMA data_version").ok()?;
    statement.query_row([], |row| row.get(0)).ok()
}

fn set_caches(connection: &Connection, config: &StoreConfig) -> rusqlite::Result<()> {
    connection.set_prepared_statement_cache_capacity(STATEMENTS);
    connection.pragma_update(None, "temp_store", "memory")?;
    // A negative size counts KiB instead of pages.
    connection.pragma_update(None, "cache_size", -i64::from(config.cache_kib))
}
