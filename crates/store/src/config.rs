//! Settings of the embedded store.

use placeformer_core::types::InvalidValue;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// Most connections, and most waiting writes. Each reader keeps files open and each waiting write
/// keeps a descriptor in memory, so a larger number can only be a mistake.
const MOST_AT_ONCE: usize = 65_536;

/// Settings of the embedded store.
///
/// The comments of the fields are printed as the manual of the configuration file.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(default, deny_unknown_fields)]
pub struct StoreConfig {
    /// Most reading connections open at once, 1 to 65536. They are opened when needed and kept;
    /// further readers wait until one is free.
    pub readers: usize,
    /// Page cache of each connection in KiB, 1 to 2147483647. There is one connection per reader
    /// and one for the writer. Patches are read through the system's cache, so this one need not
    /// be large.
    pub cache_kib: u32,
    /// Size of a database page in bytes, a power of two from 4096 to 65536. It is fixed when the
    /// database is created; a later change has no effect on an existing database.
    pub page_bytes: u32,
    /// Size in bytes at which the write-ahead log is folded into the database. Never more than a
    /// quarter of the reserve, whatever is set here, so that giving up the reserve always leaves
    /// room to fold the log; and never less than 16 pages.
    pub log_bytes: u64,
    /// Bytes kept free on the disk so that deletes succeed when it is full. When a store is opened
    /// it takes at most a quarter of what the disk has left. A delete on a full disk gives the
    /// reserve up. It is taken again as soon as the disk has room for at least half of it, and
    /// until then new references are refused. 0 keeps nothing free.
    pub reserve_bytes: u64,
    /// Writes that may wait for the writer, 1 to 65536. Further ones block their caller.
    pub queue: usize,
}

impl Default for StoreConfig {
    fn default() -> Self {
        Self {
            readers: 8,
            cache_kib: 2048,
            page_bytes: 16 << 10,
            log_bytes: 16 << 20,
            reserve_bytes: 64 << 20,
            queue: 256,
        }
    }
}

impl StoreConfig {
    /// Checks every setting against its range.
    ///
    /// # Errors
    /// Names the first setting that is out of range. The database engine would silently replace
    /// such a page size or cache size by one of its own; a store without readers or without a queue
    /// could not be used.
    pub fn check(&self) -> Result<(), InvalidValue> {
        self.check_page_bytes()?;
        check_count("store.readers", self.readers)?;
        check_count("store.queue", self.queue)?;
        self.check_cache_kib()
    }

    fn check_page_bytes(&self) -> Result<(), InvalidValue> {
        let pages = self.page_bytes;
        if pages.is_power_of_two() && (4096..=65_536).contains(&pages) {
            return Ok(());
        }
        let reason = format!("{pages} is not a power of two from 4096 to 65536");
        Err(InvalidValue::new("store.page_bytes", reason))
    }

    fn check_cache_kib(&self) -> Result<(), InvalidValue> {
        let largest = i32::MAX as u32;
        if (1..=largest).contains(&self.cache_kib) {
            return Ok(());
        }
        let reason = format!("{} is outside 1 to {largest}", self.cache_kib);
        Err(InvalidValue::new("store.cache_kib", reason))
    }
}

fn check_count(field: &'static str, value: usize) -> Result<(), InvalidValue> {
    if (1..=MOST_AT_ONCE).contains(&value) {
        return Ok(());
    }
    let reason = format!("{value} is outside 1 to {MOST_AT_ONCE}");
    Err(InvalidValue::new(field, reason))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn refused(change: impl FnOnce(&mut StoreConfig)) -> &'static str {
        let mut config = StoreConfig::default();
        change(&mut config);
        config.check().unwrap_err().field
    }

    #[test]
    fn settings_out_of_range_are_refused_by_name() {
        StoreConfig::default().check().unwrap();
        assert_eq!(refused(|c| c.page_bytes = 5000), "store.page_bytes");
        assert_eq!(refused(|c| c.page_bytes = 2048), "store.page_bytes");
        assert_eq!(refused(|c| c.readers = 0), "store.readers");
        assert_eq!(refused(|c| c.queue = 65_537), "store.queue");
        assert_eq!(refused(|c| c.cache_kib = 0), "store.cache_kib");
        assert_eq!(refused(|c| c.cache_kib = 1 << 31), "store.cache_kib");
    }
}
