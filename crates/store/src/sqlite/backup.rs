//! A consistent copy of the database while it is in use.
//!
//! The copy is taken from one read snapshot through the engine's own backup interface, under a
//! temporary name, synced and only then renamed: a file of the final name is always whole.

use super::directory;
use super::engine::failed;
use crate::StoreError;
use rusqlite::Connection;
use rusqlite::backup::{Backup, StepResult};
use std::path::Path;

/// Copies the database behind `connection` to `target`, which must not exist; returns its size in
/// bytes.
pub(super) fn write(connection: &Connection, target: &Path) -> Result<u64, StoreError> {
    let io = |context: &'static str| {
        let path = target.to_owned();
        move |source| StoreError::Io {
            context,
            path,
            source,
        }
    };
    if target.exists() {
        return Err(StoreError::BackupExists {
            path: target.to_owned(),
        });
    }
    let mut partial = target.as_os_str().to_owned();
    partial.push(".partial");
    let partial = Path::new(&partial);
    let copied = copy(connection, partial);
    if let Err(error) = copied {
        let _ = std::fs::remove_file(partial);
        return Err(error);
    }
    let file = std::fs::File::open(partial).map_err(io("cannot open the backup"))?;
    file.sync_all().map_err(io("cannot sync the backup"))?;
    let bytes = file.metadata().map_err(io("cannot read the backup"))?.len();
    // Unlike a rename, a hard link refuses a name that has appeared meanwhile.
    std::fs::hard_link(partial, target).map_err(io("cannot name the backup"))?;
    std::fs::remove_file(partial).map_err(io("cannot finish the backup"))?;
    let parent = target
        .parent()
        .filter(|parent| !parent.as_os_str().is_empty());
    directory::sync(parent.unwrap_or(Path::new(".")))?;
    Ok(bytes)
}

fn copy(source: &Connection, partial: &Path) -> Result<(), StoreError> {
    let copying = failed("copying it");
    let mut target = Connection::open(partial).map_err(&copying)?;
    // The snapshot keeps concurrent writers from restarting the copy.
    let snapshot = source.unchecked_transaction().map_err(&copying)?;
    snapshot
        .query_row("SELECT count(*) FROM map", [], |_| Ok(()))
        .map_err(&copying)?;
    let backup = Backup::new(&snapshot, &mut target).map_err(&copying)?;
    loop {
        match backup.step(256).map_err(&copying)? {
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
    target
        .pragma_update_and_check(None, "journal_mode", "delete", |_| Ok(()))
        .map_err(&copying)?;
    target.close().map_err(|(_, error)| copying(error))?;
    snapshot.finish().map_err(&copying)
}
