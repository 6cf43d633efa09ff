//! The embedded store: one SQLite database in a data directory that one process owns.
//!
//! | file | holds |
//! |---|---|
//! | `directory.rs` | the lock on the data directory; the reserve for a full disk |
//! | `engine.rs` | connections, the pool of readers, what the engine's errors mean |
//! | `migrations.rs` | the schema's history |
//! | `rows.rs` | rows <-> types, checksums |
//! | `writer.rs` | the one writing thread and its group commit |
//! | `insert.rs`, `change.rs`, `purge.rs`, `rehead.rs` | what is written |
//! | `read.rs`, `verify.rs`, `backup.rs` | what is read |
//! | `quarantine.rs` | references known to be damaged |

mod backup;
mod change;
mod directory;
mod engine;
mod insert;
mod migrations;
mod purge;
mod quarantine;
mod read;
mod rehead;
mod rows;
mod verify;
mod writer;

use self::directory::{DataDirectory, Reserve};
use self::engine::Readers;
use self::insert::{Prepared, Replaced};
use self::quarantine::Quarantine;
use self::rows::MapRow;
use self::writer::{Effect, Pending, Writer};
use super::{
    Damage, GlobalRow, HeadExchange, Inserted, MapInfo, NewHead, Page, PlaceStore, Quarantined,
    ReferencePatch, StoreConfig, StoreError, VerifyReport,
};
use placeformer_core::types::{
    Calibration, ExternalId, MapName, NewReference, PackedPatches, Reference, ReferenceId,
};
use rusqlite::Connection;
use std::path::{Path, PathBuf};

/// A store in one directory, shared by all threads of one process.
pub struct SqliteStore {
    // Fields drop in this order: the writer finishes and closes the log while the directory is
    // still locked.
    writer: Writer,
    readers: Readers,
    quarantine: Quarantine,
    path: PathBuf,
    config: StoreConfig,
    _directory: DataDirectory,
}

impl SqliteStore {
    /// Opens the store in `directory`, creating and migrating it as needed.
    ///
    /// Fails with [`StoreError::Locked`] while another process has it, and with
    /// [`StoreError::SchemaTooNew`] if a newer release wrote it.
    pub fn open(directory: &Path, config: &StoreConfig) -> Result<Self, StoreError> {
        let claimed = DataDirectory::claim(directory)?;
        let reserve = Reserve::take(directory, config)?;
        let path = claimed.database();
        let is_new = !path.exists();
        let mut connection = engine::open_writer(&path, config, reserve.log_bytes(config))?;
        migrations::apply(&mut connection)?;
        if is_new {
            directory::sync(directory)?;
        }
        purge::abandon_unfinished_heads(&connection)?;
        let quarantine = Quarantine::load(&connection)?;
        let writer = Writer::start(connection, reserve, config.queue)?;
        let readers = Readers::new(path.clone(), config.clone());
        Ok(Self {
            writer,
            readers,
            quarantine,
            path,
            config: config.clone(),
            _directory: claimed,
        })
    }

    /// Name of the database inside a data directory.
    pub const DATABASE: &str = directory::DATABASE;

    /// As [`PlaceStore::backup`], of the store in a directory that another process may have open:
    /// only its database is read. `target` must not exist.
    pub fn backup_of(
        directory: &Path,
        config: &StoreConfig,
        target: &Path,
    ) -> Result<u64, StoreError> {
        let path = directory.join(directory::DATABASE);
        backup::write(&engine::open_reader(&path, config)?, target)
    }

    /// Takes a damaged reference out of service and records why.
    fn put_in_quarantine(&self, number: i64, map: i64, id: ReferenceId, reason: &str) {
        if !self.quarantine.add(number, map, id, reason) {
            return;
        }
        tracing::error!(reference = %id, reason, "a stored reference is damaged; it is quarantined");
        let owned = reason.to_owned();
        let record =
            move |connection: &Connection| change::quarantine(connection, number, map, id, &owned);
        if let Err(error) = self.writer.run(Effect::Shrinks, record) {
            // It stays out of service while this process lives and will be found again by the next.
            tracing::warn!(%error, reference = %id, "cannot record the quarantine");
        }
    }

    /// Reads with a connection from the pool; damage that no single record answers for is counted
    /// here.
    fn reading<T>(
        &self,
        work: impl FnOnce(&Connection) -> Result<T, StoreError>,
    ) -> Result<T, StoreError> {
        self.noticing(self.readers.with(work))
    }

    /// Writes, and waits until it is durable; as [`Self::reading`].
    fn writing<T: Send + 'static>(
        &self,
        effect: Effect,
        work: impl FnMut(&Connection) -> Result<T, StoreError> + Send + 'static,
    ) -> Result<T, StoreError> {
        self.noticing(self.writer.run(effect, work))
    }

    fn noticing<T>(&self, outcome: Result<T, StoreError>) -> Result<T, StoreError> {
        outcome.inspect_err(|error| match error {
            StoreError::Damaged { .. }
            | StoreError::CorruptMap { .. }
            | StoreError::CorruptHead { .. } => {
                self.quarantine.met(error.to_string(), None);
            }
            _ => {}
        })
    }

    fn submit_insert(
        &self,
        new: NewReference,
    ) -> Result<Pending<(Inserted, Option<Replaced>)>, StoreError> {
        let prepared = Prepared::new(new)?;
        self.writer
            .submit(Effect::Grows(prepared.bytes()), move |connection| {
                insert::insert(connection, &prepared)
            })
    }

    fn finish_insert(
        &self,
        pending: Pending<(Inserted, Option<Replaced>)>,
    ) -> Result<Inserted, StoreError> {
        let (inserted, healed) = self.noticing(pending.wait())?;
        healed
            .into_iter()
            .for_each(|(number, id)| self.quarantine.replaced(number, id));
        Ok(inserted)
    }

    fn info(&self, map: MapRow) -> MapInfo {
        let references =
            (map.reference_count.max(0) as u64).saturating_sub(self.quarantine.count(map.number));
        let calibration = map.calibration();
        MapInfo {
            name: map.name,
            model: map.model,
            references,
            created_at: map.created_at,
            calibration,
        }
    }
}

impl PlaceStore for SqliteStore {
    fn insert(&self, new: NewReference) -> Result<Inserted, StoreError> {
        let pending = self.submit_insert(new)?;
        self.finish_insert(pending)
    }

    fn insert_many(&self, new: Vec<NewReference>) -> Vec<Result<Inserted, StoreError>> {
        let pending: Vec<_> = new.into_iter().map(|new| self.submit_insert(new)).collect();
        pending
            .into_iter()
            .map(|pending| self.finish_insert(pending?))
            .collect()
    }

    fn get(&self, id: ReferenceId) -> Result<Reference, StoreError> {
        self.reading(|connection| self.read_reference(connection, id))
    }

    fn find_external(
        &self,
        map: &MapName,
        external_id: &ExternalId,
    ) -> Result<Option<Reference>, StoreError> {
        self.reading(|connection| self.read_external(connection, map, external_id))
    }

    fn update(&self, id: ReferenceId, patch: ReferencePatch) -> Result<Reference, StoreError> {
        self.get(id)?;
        self.writing(Effect::Grows(1024), move |connection| {
            change::update(connection, id, patch.clone())
        })
    }

    fn delete(&self, id: ReferenceId) -> Result<Reference, StoreError> {
        let (number, reference) = self.writing(Effect::Shrinks, move |connection| {
            change::delete(connection, id)
        })?;
        self.quarantine.forget(number);
        Ok(reference)
    }

    fn list(
        &self,
        map: Option<&MapName>,
        after: Option<ReferenceId>,
        limit: usize,
    ) -> Result<Page, StoreError> {
        self.reading(|connection| self.read_page(connection, map, after, limit))
    }

    fn maps(&self) -> Result<Vec<MapInfo>, StoreError> {
        let (maps, damaged) = self.reading(MapRow::all)?;
        for map in damaged {
            let error = StoreError::CorruptMap { map };
            tracing::error!(%error, "a map is not served");
            self.quarantine.met(error.to_string(), None);
        }
        Ok(maps.into_iter().map(|map| self.info(map)).collect())
    }

    fn map(&self, name: &MapName) -> Result<MapInfo, StoreError> {
        self.reading(|connection| MapRow::require(connection, name))
            .map(|map| self.info(map))
    }

    fn delete_map(&self, name: &MapName) -> Result<u64, StoreError> {
        let name = name.clone();
        let (number, references) = self.writing(Effect::Shrinks, move |connection| {
            change::delete_map(connection, &name)
        })?;
        super::crash_points::reach(super::crash_points::MAP_DELETED);
        let damaged = self.quarantine.count(number);
        self.quarantine.forget_map(number);
        Ok(references.saturating_sub(damaged))
    }

    fn get_many(&self, ids: &[ReferenceId]) -> Result<Vec<Reference>, StoreError> {
        self.reading(|connection| {
            let mut references = Vec::with_capacity(ids.len());
            for &id in ids {
                match self.read_reference(connection, id) {
                    Ok(reference) => references.push(reference),
                    Err(StoreError::ReferenceNotFound { .. } | StoreError::Corrupt { .. }) => {}
                    Err(error) => return Err(error),
                }
            }
            Ok(references)
        })
    }

    fn patches(&self, id: ReferenceId) -> Result<PackedPatches, StoreError> {
        self.reading(|connection| self.read_patches(connection, id))
    }

    fn scan_globals(
        &self,
        map: &MapName,
        visit: &mut dyn FnMut(GlobalRow),
    ) -> Result<(), StoreError> {
        self.reading(|connection| {
            // One snapshot: a head exchanged meanwhile must not pull the version away.
            let scanning = engine::failed("reading global vectors");
            let snapshot = connection.unchecked_transaction().map_err(&scanning)?;
            let map = MapRow::require(&snapshot, map)?;
            self.read_globals(&snapshot, &map, visit)
        })
    }

    fn replace_globals(
        &self,
        map: &MapName,
        head: NewHead,
        exchange: &mut dyn HeadExchange,
    ) -> Result<(), StoreError> {
        self.exchange_head(map, head, exchange)
    }

    fn head(&self, map: &MapName) -> Result<Option<Vec<u8>>, StoreError> {
        self.reading(|connection| rehead::read_head(connection, &MapRow::require(connection, map)?))
    }

    fn set_calibration(
        &self,
        map: &MapName,
        calibration: Option<Calibration>,
    ) -> Result<(), StoreError> {
        let map = map.clone();
        self.writing(Effect::Grows(2048), move |connection| {
            change::set_calibration(connection, &map, calibration.as_ref())
        })
    }

    fn quarantined(&self) -> Result<Vec<Quarantined>, StoreError> {
        Ok(self.quarantine.list())
    }

    fn drain_damage(&self) -> Damage {
        self.quarantine.drain()
    }

    fn verify(&self) -> Result<VerifyReport, StoreError> {
        self.readers.with(|connection| self.verify_all(connection))
    }

    fn backup(&self, target: &Path) -> Result<u64, StoreError> {
        backup::write(&engine::open_reader(&self.path, &self.config)?, target)
    }

    fn footprint(&self) -> Result<(u64, u64), StoreError> {
        let size = |suffix: &str| {
            let mut name = self.path.as_os_str().to_owned();
            name.push(suffix);
            std::fs::metadata(name).map_or(0, |meta| meta.len())
        };
        let on_disk = size("") + size("-wal") + size("-shm");
        let connections = self.readers.open() as u64 + 1;
        Ok((
            on_disk,
            connections * u64::from(self.config.cache_kib) * 1024,
        ))
    }
}
