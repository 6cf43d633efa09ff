//! The data directory, which one process at a time may use.
//!
//! The process holds an advisory lock on the file `LOCK`. The system drops the lock with the
//! process, however that ends, so no stale lock can remain.

use crate::error::StoreError;
use placeformer_core::files::{create_private_directory, create_private_file};
use std::fs::{File, OpenOptions, TryLockError};
use std::io::{ErrorKind, Read, Seek, Write};
use std::path::{Path, PathBuf};

/// Name of the database inside the data directory.
pub(super) const DATABASE: &str = "placeformer.db";
/// Name of the file that is locked inside the data directory.
pub(super) const LOCK: &str = "LOCK";

/// Makes a function that turns an error of the file system into ours.
pub(super) fn io(
    context: &'static str,
    path: &Path,
) -> impl FnOnce(std::io::Error) -> StoreError + use<> {
    let path = path.to_owned();
    move |source| match source.kind() {
        ErrorKind::StorageFull | ErrorKind::QuotaExceeded => StoreError::DiskFull,
        _ => StoreError::Io {
            context,
            path,
            source,
        },
    }
}

/// The locked data directory; unlocked when dropped.
pub(super) struct DataDirectory {
    _lock: File,
    path: PathBuf,
}

impl DataDirectory {
    /// Creates the directory if need be and locks it.
    pub(super) fn claim(path: &Path) -> Result<Self, StoreError> {
        create_private_directory(path).map_err(io("cannot create directory", path))?;
        let lock_path = path.join(LOCK);
        create_private_file(&lock_path).map_err(io("cannot create", &lock_path))?;
        let mut lock = OpenOptions::new()
            .read(true)
            .write(true)
            .open(&lock_path)
            .map_err(io("cannot open", &lock_path))?;
        match lock.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => {
                return Err(StoreError::Locked {
                    directory: path.to_owned(),
                    holder: read_owner(&lock),
                });
            }
            Err(TryLockError::Error(source)) => return Err(io("cannot lock", &lock_path)(source)),
        }
        write_owner(&mut lock);
        Ok(Self {
            _lock: lock,
            path: path.to_owned(),
        })
    }

    /// The directory itself.
    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// Path of the database.
    pub(super) fn database(&self) -> PathBuf {
        self.path.join(DATABASE)
    }
}

/// Which process says in the lock file that the lock is its own; empty if that cannot be read.
/// That the directory is locked is certain without it.
fn read_owner(lock: &File) -> String {
    let mut owner = String::new();
    let _ = lock.take(100).read_to_string(&mut owner);
    owner.trim().to_owned()
}

/// Names this process in the lock file. On a full disk the text may not fit; the lock is valid all
/// the same.
fn write_owner(lock: &mut File) {
    let _ = lock.set_len(0).and_then(|()| lock.rewind());
    let _ = write!(lock, "process {}", std::process::id());
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_second_claim_fails_and_names_the_first() {
        let directory = tempfile::tempdir().unwrap();
        let first = DataDirectory::claim(directory.path()).unwrap();
        match DataDirectory::claim(directory.path()) {
            Err(StoreError::Locked { holder, .. }) => {
                assert_eq!(holder, format!("process {}", std::process::id()))
            }
            other => panic!("{:?}", other.err()),
        }
        drop(first);
        DataDirectory::claim(directory.path()).unwrap();
    }
}
