//! Room on the disk that holds the store.

use std::io;
use std::path::Path;

/// Space on a file system, in bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DiskSpace {
    /// Free to unprivileged users.
    pub free: u64,
    /// In all.
    pub total: u64,
}

/// Asks the file system that holds `path`.
pub fn space(path: &Path) -> io::Result<DiskSpace> {
    let stat = rustix::fs::statvfs(path)?;
    Ok(DiskSpace {
        free: stat.f_bavail * stat.f_frsize,
        total: stat.f_blocks * stat.f_frsize,
    })
}

impl DiskSpace {
    /// Whether less than `reserve` is free; on a small disk less than a twentieth of it.
    pub fn is_short_of(&self, reserve: u64) -> bool {
        self.free < reserve.min(self.total / 20)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_reserve_shrinks_on_small_disks() {
        let small = DiskSpace {
            free: 1 << 20,
            total: 10 << 20,
        };
        assert!(!small.is_short_of(64 << 20));
        assert!(
            DiskSpace {
                free: 400 << 10,
                ..small
            }
            .is_short_of(64 << 20)
        );
        let large = DiskSpace {
            free: 60 << 20,
            total: 1 << 40,
        };
        assert!(large.is_short_of(64 << 20));
    }

    #[test]
    fn a_real_disk_answers() {
        let found = space(&std::env::temp_dir()).unwrap();
        assert!(found.total >= found.free && found.total > 0);
    }
}
