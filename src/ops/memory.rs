//! How much memory the process uses, and how much it may use.

use std::fs;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

/// Resident bytes of this process; `None` where the kernel does not say.
pub fn resident_bytes() -> Option<u64> {
    kib_field(&fs::read_to_string("/proc/self/status").ok()?, "VmRSS:")
}

/// Bytes this process may use: the control group's limit if there is one, else the machine's
/// memory.
pub fn limit_bytes() -> Option<u64> {
    let machine = fs::read_to_string("/proc/meminfo")
        .ok()
        .and_then(|text| kib_field(&text, "MemTotal:"));
    // Version 2 of control groups, then version 1.
    let limits = [
        "/sys/fs/cgroup/memory.max",
        "/sys/fs/cgroup/memory/memory.limit_in_bytes",
    ];
    let group = limits
        .iter()
        .find_map(|path| fs::read_to_string(path).ok()?.trim().parse().ok());
    match (machine, group) {
        (Some(machine), Some(group)) => Some(u64::min(machine, group)),
        (machine, group) => machine.or(group),
    }
}

/// A field in bytes of a file of the kernel whose lines look like `VmRSS:   12 kB`.
fn kib_field(text: &str, name: &str) -> Option<u64> {
    let value = text.lines().find_map(|line| line.strip_prefix(name))?;
    let kib: u64 = value.trim().trim_end_matches("kB").trim().parse().ok()?;
    Some(kib * 1024)
}

/// A bound on resident memory. Reads the kernel's figure at most four times a second, because every
/// new reference asks.
#[derive(Debug)]
pub struct MemoryWatermark {
    /// In bytes; `None` where the kernel does not say how much the process may use.
    watermark: Option<u64>,
    /// When the kernel was asked last, and the resident bytes it gave.
    last: Mutex<Option<(Instant, u64)>>,
}

/// Memory is above the watermark.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("{resident} bytes are resident, above the watermark of {watermark}")]
pub struct MemoryShort {
    /// Resident bytes.
    pub resident: u64,
    /// The bound.
    pub watermark: u64,
}

impl MemoryWatermark {
    const READ_EVERY: Duration = Duration::from_millis(250);

    /// A bound in bytes; 0 means 85% of what the process may use.
    pub fn new(bytes: u64) -> Self {
        let watermark = if bytes == 0 {
            limit_bytes().map(|limit| limit / 100 * 85)
        } else {
            Some(bytes)
        };
        Self {
            watermark,
            last: Mutex::new(None),
        }
    }

    /// Compares resident memory with the bound.
    ///
    /// # Errors
    /// More bytes are resident than the bound allows.
    pub fn check(&self) -> Result<(), MemoryShort> {
        let Some(watermark) = self.watermark else {
            return Ok(());
        };
        match self.resident() {
            Some(resident) if resident > watermark => Err(MemoryShort {
                resident,
                watermark,
            }),
            _ => Ok(()),
        }
    }

    fn resident(&self) -> Option<u64> {
        let mut last = self.last.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((read, bytes)) = *last
            && read.elapsed() < Self::READ_EVERY
        {
            return Some(bytes);
        }
        let bytes = resident_bytes()?;
        *last = Some((Instant::now(), bytes));
        Some(bytes)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fields_are_read_in_kib() {
        assert_eq!(
            kib_field("Name:\tx\nVmRSS:\t  12 kB\n", "VmRSS:"),
            Some(12 * 1024)
        );
        assert_eq!(kib_field("Name:\tx\n", "VmRSS:"), None);
    }

    #[test]
    fn one_byte_is_always_exceeded_and_the_default_is_not() {
        assert!(MemoryWatermark::new(1).check().is_err());
        assert!(MemoryWatermark::new(u64::MAX).check().is_ok());
    }
}
