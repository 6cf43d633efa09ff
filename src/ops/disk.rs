//! Free space on the disk of the store.

use std::io;
use std::path::Path;

/// Space on a file system, in bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DiskSpace {
    /// Free to users without privileges.
    pub free: u64,
    /// Size of the file system.
    pub total: u64,
}

/// Asks the file system on which `path` is.
///
/// # Errors
/// The path is not there, or the system refuses.
pub fn space(path: &Path) -> io::Result<DiskSpace> {
    let stat = rustix::fs::statvfs(path)?;
    Ok(DiskSpace {
        free: stat.f_bavail * stat.f_frsize,
        total: stat.f_blocks * stat.f_frsize,
    })
}

impl DiskSpace {
    /// Whether less than `reserve` bytes are free. On a small disk the bound is a twentieth of it,
    /// so that the reserve does not take the whole disk.
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
