//! Whether what is open is still what lies in the data directory.
//!
//! An open file outlives its name. When the data directory is removed, renamed, mounted over or
//! exchanged under a running server, the engine goes on writing and syncing files that nobody will
//! ever open again. So before and after each commit the files are looked up by their names and
//! compared with those that were opened: a few system calls, microseconds beside a sync of the
//! disk. The database and its log are written through the engine alone, so their size and time of
//! change must also be what the writer left, unless the engine knows of another connection that has
//! committed since; otherwise another program has written to them.
//!
//! What is found is the state of this moment. A directory that is put back, or a disk that can be
//! written again, is used again; a file that is another one needs a restart.

use super::directory::{DATABASE, LOCK};
use super::mark::MARK;
use crate::error::StoreError;
use placeformer_core::files::with_suffix;
use rustix::fs::{Stat, StatVfsMountFlags};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError, TryLockError};

/// The files of an open store, and what is known of them.
pub(super) struct Storage {
    directory: PathBuf,
    /// The two that only the writer writes.
    written: [OpenFile; 2],
    /// The others.
    fixed: Vec<OpenFile>,
    /// How the writer left the files of `written`; locked while it writes.
    left: Mutex<Left>,
    /// Why the last write failed, if the disk was the reason.
    failed: Mutex<Option<String>>,
}

/// How the writer left the files that it writes.
struct Left {
    /// None if they could not be looked at then.
    contents: Option<[Content; 2]>,
    /// The engine's count of what other connections have committed.
    version: Option<i64>,
}

/// A file by its name, and which one it was when it was opened.
struct OpenFile {
    path: PathBuf,
    device: u64,
    inode: u64,
}

/// What changes when a file is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Content {
    bytes: i64,
    seconds: i64,
    nanoseconds: i64,
}

impl Content {
    fn of(stat: &Stat) -> Self {
        Self {
            bytes: stat.st_size,
            seconds: stat.st_mtime,
            nanoseconds: stat.st_mtime_nsec as i64,
        }
    }
}

impl OpenFile {
    /// The file that has this name now. It must have been opened just before.
    fn named(path: PathBuf) -> Result<(Self, Content), StoreError> {
        let stat = look_up(&path)?;
        let file = Self {
            device: stat.st_dev,
            inode: stat.st_ino,
            path,
        };
        Ok((file, Content::of(&stat)))
    }

    /// Its content now; an error if its name has gone or stands for another file.
    fn look_up(&self) -> Result<Content, StoreError> {
        let stat = look_up(&self.path)?;
        if (stat.st_dev, stat.st_ino) == (self.device, self.inode) {
            return Ok(Content::of(&stat));
        }
        Err(lost(format!(
            "{} is another file than the one that is open; put the old one back, or restart on \
             this one",
            self.path.display()
        )))
    }
}

fn look_up(path: &Path) -> Result<Stat, StoreError> {
    rustix::fs::stat(path).map_err(|error| lost(format!("cannot find {}: {error}", path.display())))
}

fn lost(reason: String) -> StoreError {
    StoreError::StorageLost { reason }
}

impl Storage {
    /// Remembers the files of `directory`, all of which have just been opened. `version` is the
    /// engine's count of what other connections have committed.
    pub(super) fn watch(directory: &Path, version: Option<i64>) -> Result<Self, StoreError> {
        let database = directory.join(DATABASE);
        let log = with_suffix(&database, "-wal");
        let log_index = with_suffix(&database, "-shm");
        let mut fixed = vec![
            OpenFile::named(log_index)?.0,
            OpenFile::named(directory.join(LOCK))?.0,
        ];
        let mark = directory.join(MARK);
        // A damaged database may have none.
        if mark.exists() {
            fixed.push(OpenFile::named(mark)?.0);
        }
        let (database, database_left) = OpenFile::named(database)?;
        let (log, log_left) = OpenFile::named(log)?;
        Ok(Self {
            directory: directory.to_owned(),
            written: [database, log],
            fixed,
            left: Mutex::new(Left {
                contents: Some([database_left, log_left]),
                version,
            }),
            failed: Mutex::default(),
        })
    }

    /// Whether every name still stands for the file that is open, on a disk that can be written.
    pub(super) fn check_names(&self) -> Result<(), StoreError> {
        self.look_up().map(drop)
    }

    /// What the files of `written` are like now.
    fn contents(&self) -> Result<[Content; 2], StoreError> {
        let [database, log] = &self.written;
        Ok([database.look_up()?, log.look_up()?])
    }

    /// As [`Storage::check_names`], and what the files of `written` are like now.
    fn look_up(&self) -> Result<[Content; 2], StoreError> {
        for file in &self.fixed {
            file.look_up()?;
        }
        let contents = self.contents()?;
        let directory = self.directory.display();
        let disk = rustix::fs::statvfs(&self.directory)
            .map_err(|error| lost(format!("cannot look at the disk of {directory}: {error}")))?;
        if disk.f_flag.contains(StatVfsMountFlags::RDONLY) {
            return Err(lost(format!("{directory} is mounted read-only")));
        }
        Ok(contents)
    }

    /// Compares the files with what the writer left. `version` asks the engine for its count.
    fn compare(
        &self,
        left: &mut Left,
        version: &dyn Fn() -> Option<i64>,
    ) -> Result<(), StoreError> {
        let found = self.look_up()?;
        let Some(contents) = left.contents.filter(|contents| *contents != found) else {
            return Ok(());
        };
        // Asked after the files were looked at, so that what was seen in them is counted.
        let version = version();
        if version.is_some() && version != left.version {
            *left = Left {
                contents: Some(found),
                version,
            };
            return Ok(());
        }
        let changed = self.written.iter().zip(found.iter().zip(&contents));
        let mut changed = changed.filter(|(_, (found, left))| found != left);
        let path = changed
            .next()
            .map_or(&self.directory, |(file, _)| &file.path);
        Err(lost(format!(
            "another program has written to {}; stop the server, put the right file in place, and \
             start again",
            path.display()
        )))
    }

    /// Lets the writer write, if the files are as it left them. `version` asks the engine how much
    /// other connections have committed.
    pub(super) fn begin(
        &self,
        version: &dyn Fn() -> Option<i64>,
    ) -> Result<Writing<'_>, StoreError> {
        let mut left = self.left.lock().unwrap_or_else(PoisonError::into_inner);
        self.compare(&mut left, version)?;
        Ok(Writing {
            storage: self,
            left,
            cuts: false,
        })
    }

    /// As [`Storage::begin`], for folding the log into the database, after which it is cut.
    pub(super) fn begin_folding(
        &self,
        version: &dyn Fn() -> Option<i64>,
    ) -> Result<Writing<'_>, StoreError> {
        let mut writing = self.begin(version)?;
        writing.cuts = true;
        Ok(writing)
    }

    /// Whether the files are as the writer left them; if not, the writer has to say whether that is
    /// right. An error if they are not in place.
    pub(super) fn is_as_left(&self) -> Result<bool, StoreError> {
        let left = match self.left.try_lock() {
            Ok(left) => left,
            Err(TryLockError::Poisoned(left)) => left.into_inner(),
            // What it writes now, it compares itself.
            Err(TryLockError::WouldBlock) => return self.check_names().map(|()| true),
        };
        let found = self.look_up()?;
        Ok(left.contents.is_none_or(|contents| contents == found))
    }

    /// Remembers whether the disk took the last write.
    pub(super) fn wrote(&self, outcome: Result<(), &StoreError>) {
        let mut failed = self.failed.lock().unwrap_or_else(PoisonError::into_inner);
        match outcome {
            Ok(()) => *failed = None,
            Err(StoreError::StorageLost { reason }) => *failed = Some(reason.clone()),
            Err(_) => {}
        }
    }

    /// Whether the disk refused the last write.
    pub(super) fn has_failed(&self) -> bool {
        let failed = self.failed.lock().unwrap_or_else(PoisonError::into_inner);
        failed.is_some()
    }
}

/// The writer's turn. However it ends, what the files are like then is what the writer left.
pub(super) struct Writing<'a> {
    storage: &'a Storage,
    left: MutexGuard<'a, Left>,
    /// Whether the writer itself makes a file shorter.
    cuts: bool,
}

impl Writing<'_> {
    /// Whether the files are still in place, and none has become shorter, as neither ever does
    /// while the writer adds to it.
    pub(super) fn check(&self) -> Result<(), StoreError> {
        self.refuse_cut(&self.storage.look_up()?)
    }

    fn refuse_cut(&self, found: &[Content; 2]) -> Result<(), StoreError> {
        let Some(left) = self.left.contents.as_ref().filter(|_| !self.cuts) else {
            return Ok(());
        };
        for ((file, found), left) in self.storage.written.iter().zip(found).zip(left) {
            if found.bytes < left.bytes {
                let path = file.path.display();
                return Err(lost(format!("another program has cut {path} short")));
            }
        }
        Ok(())
    }
}

impl Drop for Writing<'_> {
    fn drop(&mut self) {
        let Ok(found) = self.storage.contents() else {
            self.left.contents = None;
            return;
        };
        // A file that was cut stays noticed: it is not what the writer left.
        if self.refuse_cut(&found).is_ok() {
            self.left.contents = Some(found);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    /// A folder with files that stand for those of a store.
    fn folder() -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        for name in [
            "placeformer.db",
            "placeformer.db-wal",
            "placeformer.db-shm",
            LOCK,
            MARK,
        ] {
            fs::write(folder.path().join(name), "0123456789").unwrap();
        }
        folder
    }

    /// The engine knows of no other connection that has committed.
    fn same() -> Option<i64> {
        Some(1)
    }

    fn check(storage: &Storage) -> Result<(), StoreError> {
        let as_writer = storage.begin(&same).map(drop);
        let is_as_left = storage.is_as_left();
        assert_eq!(as_writer.is_ok(), matches!(is_as_left, Ok(true)));
        as_writer
    }

    fn reason(outcome: Result<(), StoreError>) -> String {
        match outcome {
            Err(StoreError::StorageLost { reason }) => reason,
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn every_file_is_missed_when_it_is_gone_and_used_again_when_it_is_back() {
        let folder = folder();
        let storage = Storage::watch(folder.path(), Some(1)).unwrap();
        check(&storage).unwrap();
        for entry in fs::read_dir(folder.path()).unwrap() {
            let path = entry.unwrap().path();
            let aside = folder.path().with_extension("aside");
            fs::rename(&path, &aside).unwrap();
            assert!(reason(check(&storage)).contains(&path.display().to_string()));
            assert!(storage.begin(&same).is_err());
            fs::write(&path, "0123456789").unwrap();
            assert!(reason(check(&storage)).contains("another file"), "{path:?}");
            fs::rename(&aside, &path).unwrap();
            check(&storage).unwrap();
        }
    }

    #[test]
    fn what_the_writer_writes_is_its_own_and_what_others_write_is_not() {
        let folder = folder();
        let storage = Storage::watch(folder.path(), Some(1)).unwrap();
        let log = folder.path().join("placeformer.db-wal");
        let writing = storage.begin(&same).unwrap();
        fs::write(&log, "0123456789 and more").unwrap();
        writing.check().unwrap();
        assert!(storage.is_as_left().unwrap(), "the writer is at it");
        drop(writing);
        check(&storage).unwrap();
        fs::write(&log, "0123456789 and more, but not by the writer").unwrap();
        assert!(reason(check(&storage)).contains("another program"));
    }

    #[test]
    fn what_another_connection_of_the_engine_has_committed_is_taken_over() {
        let folder = folder();
        let storage = Storage::watch(folder.path(), Some(1)).unwrap();
        let log = folder.path().join("placeformer.db-wal");
        fs::write(&log, "another transaction").unwrap();
        assert!(!storage.is_as_left().unwrap());
        drop(storage.begin(&|| Some(2)).unwrap());
        assert!(storage.is_as_left().unwrap());
        // The same count again explains no further change.
        fs::write(&log, "no transaction").unwrap();
        assert!(storage.begin(&|| Some(2)).is_err());
    }

    #[test]
    fn a_file_that_is_cut_while_the_writer_writes_stays_noticed() {
        let folder = folder();
        let storage = Storage::watch(folder.path(), Some(1)).unwrap();
        let log = folder.path().join("placeformer.db-wal");
        let writing = storage.begin(&same).unwrap();
        fs::write(&log, "").unwrap();
        assert!(reason(writing.check()).contains("cut"));
        drop(writing);
        assert!(check(&storage).is_err());
        // Folding the log into the database is what cuts it otherwise.
        fs::write(&log, "0123456789").unwrap();
        let storage = Storage::watch(folder.path(), Some(1)).unwrap();
        let folding = storage.begin_folding(&same).unwrap();
        fs::write(&log, "").unwrap();
        drop(folding);
        check(&storage).unwrap();
    }

    #[test]
    fn a_write_that_the_disk_refused_is_remembered_until_one_succeeds() {
        let folder = folder();
        let storage = Storage::watch(folder.path(), Some(1)).unwrap();
        storage.wrote(Err(&StoreError::DiskFull));
        assert!(!storage.has_failed());
        storage.wrote(Err(&lost("an I/O error".into())));
        assert!(storage.has_failed());
        storage.wrote(Ok(()));
        assert!(!storage.has_failed());
    }
}
