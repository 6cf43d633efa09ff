//! A file system that fills up soon.

use std::io::Write;
use std::path::Path;
use std::process::Command;
use tempfile::TempDir;

/// A 10 MB file system in memory, unmounted when dropped.
pub struct SmallDisk(TempDir);

impl SmallDisk {
    /// Mounts one. `None`, with a line that says so, where this process may not; where it may, it
    /// must work.
    pub fn mount() -> Option<Self> {
        let point = tempfile::tempdir().unwrap();
        let mounting = Command::new("mount")
            .args(["-t", "tmpfs", "-o", "size=10m", "tmpfs"])
            .arg(point.path())
            .output()
            .unwrap();
        if mounting.status.success() {
            return Some(Self(point));
        }
        let reason = String::from_utf8_lossy(&mounting.stderr).into_owned();
        assert!(
            !may_mount(),
            "this process may mount file systems, and cannot: {reason}"
        );
        println!("SKIPPED: this process may not mount a small file system: {reason}");
        None
    }

    /// Where it is mounted.
    pub fn path(&self) -> &Path {
        self.0.path()
    }

    /// Takes the very last bytes, as another process might, until the file is removed.
    pub fn fill(&self) -> std::path::PathBuf {
        let filler = self.path().join("filler");
        let mut file = std::fs::File::create(&filler).unwrap();
        while file.write_all(&[1; 4096]).is_ok() {}
        filler
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg(self.path()).status();
    }
}

/// Whether the kernel must let this process mount: being root does not suffice in a container; what
/// counts is the capability, and that it is one of the whole machine.
fn may_mount() -> bool {
    const CAP_SYS_ADMIN: u64 = 1 << 21;
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    let effective = status
        .lines()
        .find_map(|line| line.strip_prefix("CapEff:"))
        .unwrap();
    let capable = u64::from_str_radix(effective.trim(), 16).unwrap() & CAP_SYS_ADMIN != 0;
    let users = std::fs::read_to_string("/proc/self/uid_map").unwrap();
    capable && users.split_whitespace().eq(["0", "0", "4294967295"])
}
