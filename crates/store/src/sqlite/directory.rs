//! The data directory: who may use it, and what keeps it usable when the disk is full.
//!
//! One process at a time holds an advisory lock on `LOCK`; the system drops it with the process,
//! however that ends.
//!
//! Even deleting needs room, for the log must grow before the database can shrink. So a file of
//! zeros, `reserve`, is kept beside the database. When a delete finds the disk full the reserve is
//! given up; until it can be restored nothing new is taken in, so that the room serves deletes
//! only. The log is checkpointed at a quarter of the reserve's size, so that giving up the reserve
//! always leaves room to fold the log into the database.

use crate::{StoreConfig, StoreError};
use std::fs::{File, OpenOptions};
use std::io::{ErrorKind, Read, Seek, Write};
use std::path::{Path, PathBuf};

/// The database inside the data directory.
pub(super) const DATABASE: &str = "placeformer.db";
const LOCK: &str = "LOCK";
const RESERVE: &str = "reserve";

fn io(context: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> StoreError {
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

/// Syncs a directory, so that names created or renamed in it survive a power cut.
pub(super) fn sync(directory: &Path) -> Result<(), StoreError> {
    File::open(directory)
        .and_then(|file| file.sync_all())
        .map_err(io("cannot sync directory", directory))
}

/// The locked data directory; unlocked when dropped.
pub(super) struct DataDirectory {
    _lock: File,
    path: PathBuf,
}

impl DataDirectory {
    /// Creates the directory if need be and locks it.
    pub(super) fn claim(path: &Path) -> Result<Self, StoreError> {
        std::fs::create_dir_all(path).map_err(io("cannot create directory", path))?;
        let lock_path = path.join(LOCK);
        let mut lock = OpenOptions::new()
            .read(true)
            .write(true)
            .create(true)
            .truncate(false)
            .open(&lock_path)
            .map_err(io("cannot open", &lock_path))?;
        match lock.try_lock() {
            Ok(()) => {}
            Err(std::fs::TryLockError::WouldBlock) => {
                let mut holder = String::new();
                // Who holds it is a courtesy; that it is held is certain.
                let _ = (&lock).take(100).read_to_string(&mut holder);
                return Err(StoreError::Locked {
                    directory: path.to_owned(),
                    holder: holder.trim().to_owned(),
                });
            }
            Err(std::fs::TryLockError::Error(source)) => {
                return Err(io("cannot lock", &lock_path)(source));
            }
        }
        // On a full disk the name of the holder may not fit; the lock holds all the same.
        let _ = lock.set_len(0).and_then(|()| lock.rewind());
        let _ = write!(lock, "process {}", std::process::id());
        Ok(Self {
            _lock: lock,
            path: path.to_owned(),
        })
    }

    pub(super) fn database(&self) -> PathBuf {
        self.path.join(DATABASE)
    }
}

/// Room kept for deletes on a full disk.
pub(super) struct Reserve {
    path: PathBuf,
    bytes: u64,
    held: bool,
}

impl Reserve {
    /// Takes the reserve: as configured, but never more than a quarter of what the disk has left
    /// (or of what an earlier reserve already holds plus that).
    pub(super) fn take(directory: &Path, config: &StoreConfig) -> Result<Self, StoreError> {
        let path = directory.join(RESERVE);
        let there = std::fs::metadata(&path).map(|meta| meta.len()).unwrap_or(0);
        let bytes = config
            .reserve_bytes
            .min(((available(directory)? + there) / 4).max(there));
        let mut reserve = Self {
            path,
            bytes,
            held: there >= bytes,
        };
        reserve.restore();
        Ok(reserve)
    }

    /// The size the log is allowed before it is folded into the database.
    pub(super) fn log_bytes(&self, config: &StoreConfig) -> u64 {
        config.log_bytes.min(self.bytes / 4)
    }

    /// Whether the reserve is there; while it is not, nothing new may be taken in.
    pub(super) fn held(&self) -> bool {
        self.held
    }

    /// Gives the room up.
    pub(super) fn release(&mut self) {
        if self.held {
            tracing::warn!(
                bytes = self.bytes,
                "the disk is full: giving up the reserve so that deletes succeed"
            );
        }
        self.held = false;
        if let Err(error) = std::fs::remove_file(&self.path)
            && error.kind() != ErrorKind::NotFound
        {
            tracing::error!(%error, path = %self.path.display(), "cannot give up the reserve");
        }
    }

    /// Tries to take the room again; true if it is held afterwards.
    pub(super) fn restore(&mut self) -> bool {
        if !self.held {
            self.held = self.fill().is_ok();
            if !self.held {
                let _ = std::fs::remove_file(&self.path);
            }
        }
        self.held
    }

    /// Takes the room in full, or at least half of it: what deletes have freed inside the database
    /// does not show as free on the disk, and half is still twice the log.
    fn fill(&self) -> std::io::Result<()> {
        let free = available_bytes(self.path.parent().unwrap_or(Path::new(".")))?;
        // The log must be able to grow beside it, or taking the reserve is what fills the disk.
        let bytes = self.bytes.min(free.saturating_sub(self.bytes / 4));
        if bytes < self.bytes / 2 {
            return Err(ErrorKind::StorageFull.into());
        }
        let mut file = File::create(&self.path)?;
        let zeros = vec![0u8; 1 << 20];
        let mut left = bytes;
        while left > 0 {
            let now = left.min(zeros.len() as u64);
            file.write_all(&zeros[..now as usize])?;
            left -= now;
        }
        file.sync_all()
    }
}

fn available_bytes(directory: &Path) -> std::io::Result<u64> {
    let disk = rustix::fs::statvfs(directory)?;
    Ok(disk.f_bavail.saturating_mul(disk.f_frsize))
}

/// Bytes left on the disk that holds `directory`.
pub(super) fn available(directory: &Path) -> Result<u64, StoreError> {
    available_bytes(directory).map_err(io("cannot read the free space of", directory))
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

    #[test]
    fn the_reserve_comes_and_goes() {
        let directory = tempfile::tempdir().unwrap();
        let config = StoreConfig {
            reserve_bytes: 3 << 20,
            ..StoreConfig::default()
        };
        let mut reserve = Reserve::take(directory.path(), &config).unwrap();
        let file = directory.path().join(RESERVE);
        assert!(reserve.held() && file.metadata().unwrap().len() == 3 << 20);
        reserve.release();
        assert!(!reserve.held() && !file.exists());
        assert!(reserve.restore() && file.exists());
    }
}
