//! Whether the newest commits are in a database, asked before it is opened for writing.
//!
//! The database is read only, so that one which is refused stays as it was found, with its log.

use super::directory::{DATABASE, io};
use super::engine::{failed, open_reader};
use super::mark::{CommitMark, Found, MARK, MarkFile};
use super::sequence::{Progress, is_closed, progress, set_open, skip_to};
use crate::config::StoreConfig;
use crate::error::StoreError;
use placeformer_core::files::with_suffix;
use rusqlite::Connection;
use std::fs::File;
use std::io::{ErrorKind, Read};
use std::path::Path;

/// What is being done when the engine fails.
const READING: &str = "reading how far it has come";

/// What to do about commits that are missing.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum LostTail {
    /// Refuse to open the store.
    #[default]
    Refuse,
    /// Go on without them. The log says what they were.
    Accept,
}

/// How the header of a database says that it is to be opened.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Header {
    /// There is none: no file, or an empty one.
    None,
    /// Without a log, as a backup has just been made.
    WithoutLog,
    /// With a log, as a store has it.
    WithLog,
}

/// What is to be done about the mark of a store that may be opened.
pub(super) enum MarkNeeded {
    /// It is there and holds.
    Kept,
    /// It must be made, of what the database says.
    Made,
    /// It must be made, behind commits that are given up: theirs and their references' numbers.
    Raised { commits: i64, references: i64 },
}

/// Compares the database in `directory` with its mark.
pub(super) fn inspect(
    directory: &Path,
    config: &StoreConfig,
    tail: LostTail,
) -> Result<MarkNeeded, StoreError> {
    let found = CommitMark::read(directory)?;
    match compare(directory, config, found) {
        Ok(needed) => Ok(needed),
        Err(error @ (StoreError::LostCommits { .. } | StoreError::NoCommitMark { .. }))
            if tail == LostTail::Accept =>
        {
            tracing::error!(%error, "going on without what is lost");
            Ok(behind(found))
        }
        Err(error) => Err(error),
    }
}

/// The first numbers that no lost commit can have taken.
fn behind(found: Found) -> MarkNeeded {
    match found {
        Found::Mark(mark) => MarkNeeded::Raised {
            commits: mark.progress.commits.saturating_add(1),
            references: mark.progress.references,
        },
        Found::Nothing | Found::Unreadable => MarkNeeded::Made,
    }
}

fn compare(directory: &Path, config: &StoreConfig, found: Found) -> Result<MarkNeeded, StoreError> {
    let header = header(directory)?;
    refuse_foreign_log(directory, header)?;
    let path = directory.join(DATABASE);
    match header {
        Header::None => of_database(directory, None, false, found),
        Header::WithLog => {
            let read = open_reader(&path, config).and_then(|connection| {
                let reached = progress(&connection).map_err(failed(READING))?;
                let is_closed = match reached {
                    Some(_) => is_closed(&connection).map_err(failed(READING))?,
                    None => false,
                };
                Ok((reached, is_closed))
            });
            match read {
                Ok((reached, is_closed)) => of_database(directory, reached, is_closed, found),
                // One unreadable page must not keep the rest from being served.
                Err(error @ StoreError::Damaged { .. }) => {
                    tracing::error!(%error, "nobody can say whether the newest commits are there");
                    Ok(unknown(found))
                }
                Err(error) => Err(error),
            }
        }
        // A backup is whole by itself. If a mark is there, it is that of the store whose place the
        // backup takes. It is made anew before the database is given a log.
        Header::WithoutLog => {
            let connection = open_reader(&path, config)?;
            let reached = progress(&connection);
            if let Ok(Some(reached)) = reached {
                MarkFile::create(directory, &CommitMark::now(reached))?;
            }
            Ok(MarkNeeded::Made)
        }
    }
}

/// What to do where the database cannot be asked.
fn unknown(found: Found) -> MarkNeeded {
    match found {
        Found::Mark(_) => MarkNeeded::Kept,
        Found::Nothing | Found::Unreadable => MarkNeeded::Made,
    }
}

/// Compares how far a database has come with what was found for its mark.
fn of_database(
    directory: &Path,
    reached: Option<Progress>,
    is_closed: bool,
    found: Found,
) -> Result<MarkNeeded, StoreError> {
    let no_mark = |reason| StoreError::NoCommitMark {
        path: directory.join(MARK),
        reason,
    };
    // Without any commit there is nothing that could be lost. A store that was closed is whole
    // without its log, and its database alone may have been copied.
    let is_fresh = is_closed || reached.is_none_or(|reached| reached.commits == 0);
    match found {
        Found::Nothing | Found::Unreadable if is_fresh => Ok(MarkNeeded::Made),
        Found::Nothing => Err(no_mark("is missing")),
        Found::Unreadable => Err(no_mark("is damaged")),
        Found::Mark(mark) => {
            let is_own = reached.is_some_and(|reached| reached.store == mark.progress.store);
            if !is_own && !is_fresh {
                return Err(no_mark("belongs to another store"));
            }
            match mark.missing(reached, directory) {
                Some(error) => Err(error),
                None if is_own => Ok(MarkNeeded::Kept),
                None => Ok(MarkNeeded::Made),
            }
        }
    }
}

/// Reads the database's header. No connection of this process may be open: closing the file would
/// give up the engine's locks.
fn header(directory: &Path) -> Result<Header, StoreError> {
    /// Where the header says how the file is to be written, and the value for "without a log".
    const WRITE_VERSION: usize = 18;
    const LEGACY: u8 = 1;
    let path = directory.join(DATABASE);
    let mut start = Vec::new();
    match File::open(&path) {
        Ok(file) => file
            .take(WRITE_VERSION as u64 + 1)
            .read_to_end(&mut start)
            .map_err(io("cannot read", &path))?,
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(Header::None),
        Err(error) => return Err(io("cannot open", &path)(error)),
    };
    Ok(match start.get(WRITE_VERSION) {
        None if start.is_empty() => Header::None,
        Some(&LEGACY) => Header::WithoutLog,
        // What is no database at all is for the engine to say.
        _ => Header::WithLog,
    })
}

/// An error if a log lies beside a database that has none: it belongs to a database that was there
/// before, and the engine would apply it to this one.
fn refuse_foreign_log(directory: &Path, header: Header) -> Result<(), StoreError> {
    let log = with_suffix(&directory.join(DATABASE), "-wal");
    let has_log = std::fs::metadata(&log).is_ok_and(|log| log.len() > 0);
    if has_log && header != Header::WithLog {
        return Err(StoreError::ForeignLog { path: log });
    }
    Ok(())
}

/// Opens the mark of a database that is open, making it where that is needed; none if the database
/// cannot say how far it has come.
pub(super) fn attach(
    directory: &Path,
    connection: &Connection,
    needed: MarkNeeded,
) -> Result<Option<MarkFile>, StoreError> {
    match needed {
        MarkNeeded::Kept => return MarkFile::open(directory).map(Some),
        MarkNeeded::Made => {}
        MarkNeeded::Raised {
            commits,
            references,
        } => skip_to(connection, commits, references).map_err(failed(READING))?,
    }
    match progress(connection).map_err(failed(READING)) {
        Ok(Some(reached)) => MarkFile::create(directory, &CommitMark::now(reached)).map(Some),
        Ok(None) => Ok(None),
        Err(error @ StoreError::Damaged { .. }) => {
            tracing::error!(%error, "commits are not marked");
            Ok(None)
        }
        Err(error) => Err(error),
    }
}

/// Says in the database itself, and not only in its log, that it is open: whoever finds it so
/// knows that it may lack commits.
pub(super) fn begin(connection: &Connection) {
    let begun = set_open(connection).and_then(|()| {
        let fold = "PRAGMA wal_checkpoint(TRUNCATE)";
        connection.query_row(fold, [], |_| Ok(()))
    });
    if let Err(error) = begun {
        // On a full disk, for instance. The mark still tells what is missing.
        tracing::warn!(%error, "the database does not say that it is open");
    }
}

/// The mark that a copy of the store in `directory` must have reached; none if nothing is known to
/// be in the store.
pub(super) fn least_of_copy(directory: &Path) -> Result<Option<CommitMark>, StoreError> {
    match CommitMark::read(directory)? {
        Found::Mark(mark) => Ok(Some(mark)),
        Found::Nothing | Found::Unreadable => Ok(None),
    }
}

/// As [`least_of_copy`], of a store that this process has not open: a store whose mark is missing
/// may have lost its newest commits, and so would its copy.
pub(super) fn least_of_foreign_copy(
    directory: &Path,
    config: &StoreConfig,
) -> Result<Option<CommitMark>, StoreError> {
    // The mark is read before the database, which may be ahead of it but never behind.
    let found = CommitMark::read(directory)?;
    if header(directory)? == Header::WithLog {
        compare(directory, config, found)?;
        return least_of_copy(directory);
    }
    refuse_foreign_log(directory, header(directory)?)?;
    Ok(None)
}

/// What a database lacks of the mark in `directory`, in words; nothing if it lacks nothing.
pub(super) fn complaint(directory: &Path, connection: &Connection) -> Option<String> {
    let found = match CommitMark::read(directory) {
        Ok(found) => found,
        Err(error) => return Some(error.to_string()),
    };
    let reached = match progress(connection) {
        Ok(reached) => reached,
        Err(error) => return Some(failed(READING)(error).to_string()),
    };
    of_database(directory, reached, false, found)
        .err()
        .map(|error| error.to_string())
}
