//! A consistent copy of the database while it is in use.
//!
//! The copy is taken from one read snapshot through the engine's own backup interface, under a
//! temporary name, synced and only then given its final name: a file of the final name is always
//! whole.

use super::directory::io;
use super::engine::failed;
use super::mark::CommitMark;
use super::sequence::progress;
use crate::error::StoreError;
use placeformer_core::files::{create_private_file, directory_of, sync_directory, with_suffix};
use rusqlite::Connection;
use rusqlite::backup::{Backup, StepResult};
use std::fs::{self, File};
use std::path::Path;

/// Database pages copied per call of the engine.
const PAGES_PER_STEP: i32 = 256;

/// Copies the database behind `connection` to `target`, which must not exist; returns its size in
/// bytes. A copy that has not come as far as `least` is refused.
pub(super) fn write(
    connection: &Connection,
    target: &Path,
    least: Option<CommitMark>,
) -> Result<u64, StoreError> {
    if target.exists() {
        return Err(StoreError::BackupExists {
            path: target.to_owned(),
        });
    }
    let partial = with_suffix(target, ".partial");
    // What an interrupted backup left is of no use, and may be open to others.
    let _ = fs::remove_file(&partial);
    create_private_file(&partial).map_err(io("cannot create the backup", target))?;
    if let Err(error) = copy(connection, &partial, least) {
        // The caller needs the first error, so a failure to remove the rest is not reported.
        let _ = fs::remove_file(&partial);
        return Err(error);
    }
    let file = File::open(&partial).map_err(io("cannot open the backup", target))?;
    file.sync_all()
        .map_err(io("cannot sync the backup", target))?;
    let metadata = file.metadata();
    let bytes = metadata
        .map_err(io("cannot read the backup", target))?
        .len();
    // Unlike a rename, a hard link refuses a name that has appeared meanwhile.
    fs::hard_link(&partial, target).map_err(io("cannot name the backup", target))?;
    fs::remove_file(&partial).map_err(io("cannot finish the backup", target))?;
    let directory = directory_of(target);
    sync_directory(directory).map_err(io("cannot sync directory", directory))?;
    Ok(bytes)
}

fn copy(source: &Connection, partial: &Path, least: Option<CommitMark>) -> Result<(), StoreError> {
    let failed = failed("copying it");
    let mut target = Connection::open(partial).map_err(&failed)?;
    // The snapshot keeps concurrent writers from restarting the copy. It begins with the first
    // statement that reads.
    let snapshot = source.unchecked_transaction().map_err(&failed)?;
    snapshot
        .query_row("SELECT count(*) FROM map", [], |_| Ok(()))
        .map_err(&failed)?;
    let backup = Backup::new(&snapshot, &mut target).map_err(&failed)?;
    loop {
        match backup.step(PAGES_PER_STEP).map_err(&failed)? {
            StepResult::Done => break,
            StepResult::More => {}
            _ => {
                return Err(StoreError::Busy {
                    context: "copying it",
                });
            }
        }
    }
    drop(backup);
    if let Some(least) = least {
        let reached = progress(&target).map_err(&failed)?;
        if let Some(error) = least.missing(reached, directory_of(partial)) {
            return Err(error);
        }
    }
    // The copy is one file without a log.
    target
        .pragma_update_and_check(None, "journal_mode", "delete", |_| Ok(()))
        .map_err(&failed)?;
    target.close().map_err(|(_, error)| failed(error))?;
    snapshot.finish().map_err(&failed)
}
