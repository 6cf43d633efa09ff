//! Room that keeps the store usable when the disk is full.
//!
//! Even deleting needs room, for the log must grow before the database can shrink. So a file of
//! zeros, `reserve`, lies in the data directory. When a delete finds the disk full, the file is
//! removed; until it can be restored nothing new is taken in, so that the room serves deletes
//! only. The log is folded into the database at a quarter of the reserve's size, so that giving up
//! the reserve always leaves room for that.

use super::directory::io;
use crate::config::StoreConfig;
use crate::error::StoreError;
use placeformer_core::files::{create_private_file, directory_of};
use std::fs::File;
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};

const RESERVE: &str = "reserve";

/// Room kept for deletes on a full disk.
pub(super) struct Reserve {
    path: PathBuf,
    bytes: u64,
    in_place: bool,
}

impl Reserve {
    /// Takes the reserve: as large as configured, but at most a quarter of what the disk has left.
    /// A reserve that an earlier process left counts as free, and is never reduced for want of
    /// room.
    pub(super) fn take(directory: &Path, config: &StoreConfig) -> Result<Self, StoreError> {
        let path = directory.join(RESERVE);
        let existing = std::fs::metadata(&path).map_or(0, |meta| meta.len());
        let free =
            available_bytes(directory).map_err(io("cannot read the free space of", directory))?;
        let affordable = ((free + existing) / 4).max(existing);
        let bytes = config.reserve_bytes.min(affordable);
        let mut reserve = Self {
            path,
            bytes,
            in_place: existing >= bytes,
        };
        reserve.restore();
        Ok(reserve)
    }

    /// The size the log is allowed before it is folded into the database.
    pub(super) fn log_bytes(&self, config: &StoreConfig) -> u64 {
        config.log_bytes.min(self.bytes / 4)
    }

    /// Whether the reserve is in place; while it is not, nothing new may be taken in.
    pub(super) fn is_in_place(&self) -> bool {
        self.in_place
    }

    /// Gives the room up.
    pub(super) fn release(&mut self) {
        if self.in_place {
            tracing::warn!(
                bytes = self.bytes,
                "the disk is full: giving up the reserve so that deletes succeed"
            );
        }
        self.in_place = false;
        if let Err(error) = std::fs::remove_file(&self.path)
            && error.kind() != ErrorKind::NotFound
        {
            tracing::error!(%error, path = %self.path.display(), "cannot give up the reserve");
        }
    }

    /// Tries to take the room again; true if the reserve is in place afterwards.
    pub(super) fn restore(&mut self) -> bool {
        if !self.in_place {
            self.in_place = self.fill().is_ok();
            if !self.in_place {
                // A reserve written in part would only take the room that is short.
                let _ = std::fs::remove_file(&self.path);
            }
        }
        self.in_place
    }

    /// Writes the reserve in full, or at least half of it. What deletes have freed inside the
    /// database does not show as free on the disk, and half is still twice the log.
    fn fill(&self) -> std::io::Result<()> {
        let free = available_bytes(directory_of(&self.path))?;
        // The log must still be able to grow, or taking the reserve is what fills the disk.
        let bytes = self.bytes.min(free.saturating_sub(self.bytes / 4));
        if bytes < self.bytes / 2 {
            return Err(ErrorKind::StorageFull.into());
        }
        create_private_file(&self.path)?;
        let mut file = File::create(&self.path)?;
        let zeros = vec![0u8; 1 << 20];
        let mut remaining = bytes;
        while remaining > 0 {
            let now = remaining.min(zeros.len() as u64);
            file.write_all(&zeros[..now as usize])?;
            remaining -= now;
        }
        file.sync_all()
    }
}

/// Bytes left on the disk on which `directory` lies.
fn available_bytes(directory: &Path) -> std::io::Result<u64> {
    let disk = rustix::fs::statvfs(directory)?;
    Ok(disk.f_bavail.saturating_mul(disk.f_frsize))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn config(reserve_bytes: u64, log_bytes: u64) -> StoreConfig {
        StoreConfig {
            reserve_bytes,
            log_bytes,
            ..StoreConfig::default()
        }
    }

    #[test]
    fn the_reserve_comes_and_goes() {
        let directory = tempfile::tempdir().unwrap();
        let config = config(3 << 20, 1 << 20);
        let mut reserve = Reserve::take(directory.path(), &config).unwrap();
        let file = directory.path().join(RESERVE);
        assert!(reserve.is_in_place() && file.metadata().unwrap().len() == 3 << 20);
        reserve.release();
        assert!(!reserve.is_in_place() && !file.exists());
        assert!(reserve.restore() && file.exists());
    }

    #[test]
    fn the_log_takes_at_most_a_quarter_of_the_reserve() {
        let directory = tempfile::tempdir().unwrap();
        for (log_bytes, expected) in [(1 << 20, 1 << 19), (1000, 1000)] {
            let config = config(2 << 20, log_bytes);
            let reserve = Reserve::take(directory.path(), &config).unwrap();
            assert_eq!(reserve.log_bytes(&config), expected);
        }
    }
}
