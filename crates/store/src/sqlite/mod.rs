//! The embedded store: one SQLite database in a data directory that one process owns.
//!
//! | file | holds |
//! |---|---|
//! | `directory.rs`, `reserve.rs` | the lock on the data directory; room for a full disk |
//! | `engine.rs`, `readers.rs` | connections, what the engine's errors mean; the pool of readers |
//! | `migrations.rs` | the schema's history |
//! | `keys.rs`, `checksum.rs`, `row.rs` | what all rows have in common |
//! | `map_row.rs`, `reference_row.rs`, `parts.rs`, `sequence.rs` | the rows of each table |
//! | `job.rs`, `writer.rs` | the one writing thread and its group commit |
//! | `storage.rs` | whether what is open is still what lies in the data directory |
//! | `mark.rs`, `tail.rs` | the number of the last commit; whether a database has reached it |
//! | `insert.rs`, `change.rs`, `remove.rs`, `purge.rs` | what is written |
//! | `database.rs`, `quarantine.rs` | all connections; references known to be damaged |
//! | `read.rs`, `page.rs`, `globals.rs` | what is read |
//! | `replace_head.rs` | giving a map another head |
//! | `verify.rs`, `backup.rs` | maintenance |

mod backup;
mod change;
mod checksum;
mod database;
mod directory;
mod engine;
mod globals;
mod insert;
mod job;
mod keys;
mod map_row;
mod mark;
mod migrations;
mod page;
mod parts;
mod purge;
mod quarantine;
mod read;
mod readers;
mod reference_row;
mod remove;
mod replace_head;
mod reserve;
mod row;
mod sequence;
mod storage;
mod tail;
mod verify;
mod writer;

use self::database::Database;
use self::directory::DataDirectory;
use self::insert::Prepared;
use self::job::{Effect, Pending};
use self::map_row::MapRow;
use self::quarantine::Quarantine;
use self::readers::Readers;
use self::reserve::Reserve;
use self::storage::Storage;
pub use self::tail::LostTail;
use self::writer::{Files, Writer};
use crate::config::StoreConfig;
use crate::crash_points;
use crate::error::StoreError;
use crate::records::{
    Cursor, Damage, Footprint, GlobalRow, Inserted, MapInfo, NewHead, Page, Quarantined,
    ReferencePatch, VerifyReport,
};
use crate::traits::{HeadExchange, MaintainPlaces, ReadPlaces, WritePlaces};
use placeformer_core::files::{sync_directory, with_suffix};
use placeformer_core::types::{
    Calibration, ExternalId, MapName, NewReference, PackedPatches, Reference, ReferenceId,
};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Bytes that a change of metadata adds to the store, about.
const PATCH_BYTES: usize = 1024;

/// Bytes that a calibration adds to the store, about.
const CALIBRATION_BYTES: usize = 2048;

/// A store in one directory, shared by all threads of one process.
pub struct SqliteStore {
    // Fields drop in this order: the writer finishes and closes the log while the directory is
    // still locked.
    database: Database,
    path: PathBuf,
    storage: Arc<Storage>,
    config: StoreConfig,
    directory: DataDirectory,
}

impl SqliteStore {
    /// Name of the database inside a data directory.
    pub const DATABASE: &str = directory::DATABASE;

    /// Opens the store in `directory`, creating and migrating it as needed.
    ///
    /// # Errors
    /// [`StoreError::Locked`] while another process has it open, [`StoreError::SchemaTooNew`] if a
    /// newer release wrote it, [`StoreError::LostCommits`] or [`StoreError::NoCommitMark`] if
    /// acknowledged commits are missing or may be, or whatever keeps the database from being
    /// opened.
    pub fn open(directory: &Path, config: &StoreConfig) -> Result<Self, StoreError> {
        Self::open_with(directory, config, LostTail::Refuse)
    }

    /// As [`SqliteStore::open`]; `tail` says what to do if acknowledged commits are missing.
    ///
    /// # Errors
    /// As [`SqliteStore::open`].
    pub fn open_with(
        directory: &Path,
        config: &StoreConfig,
        tail: LostTail,
    ) -> Result<Self, StoreError> {
        let claimed = DataDirectory::claim(directory)?;
        let reserve = Reserve::take(directory, config)?;
        let path = claimed.database();
        let is_new = !path.exists();
        let needed = tail::inspect(directory, config, tail)?;
        let mut connection = engine::open_writer(&path, config, reserve.log_bytes(config))?;
        migrations::apply(&mut connection)?;
        if is_new {
            sync_directory(directory).map_err(directory::io("cannot sync directory", directory))?;
        }
        let mark = tail::attach(directory, &connection, needed)?;
        tail::begin(&connection);
        purge::abandon_unfinished_heads(&connection)?;
        let quarantine = Quarantine::load(&connection)?;
        let storage = Arc::new(Storage::watch(
            directory,
            engine::data_version(&connection),
        )?);
        let files = Files {
            reserve,
            mark,
            storage: storage.clone(),
        };
        let database = Database {
            writer: Writer::start(connection, files, config.queue)?,
            readers: Readers::new(path.clone(), config.clone(), storage.clone()),
            quarantine,
        };
        Ok(Self {
            database,
            path,
            storage,
            config: config.clone(),
            directory: claimed,
        })
    }

    /// As [`MaintainPlaces::backup`], of the store in a directory that another process may have
    /// open: only its database is read.
    ///
    /// # Errors
    /// There is no store, or `target` exists or cannot be written.
    pub fn backup_of(
        directory: &Path,
        config: &StoreConfig,
        target: &Path,
    ) -> Result<u64, StoreError> {
        let least = tail::least_of_foreign_copy(directory, config)?;
        let path = directory.join(directory::DATABASE);
        backup::write(&engine::open_reader(&path, config)?, target, least)
    }

    fn submit_insert(&self, new: NewReference) -> Result<Pending<insert::Outcome>, StoreError> {
        let prepared = Prepared::new(new)?;
        let effect = Effect::Grows(prepared.bytes());
        let insert = move |connection: &_| insert::insert(connection, &prepared);
        self.database.writer.submit(effect, insert)
    }

    fn finish_insert(&self, pending: Pending<insert::Outcome>) -> Result<Inserted, StoreError> {
        let outcome = self.database.wait(pending)?;
        if let Some(replaced) = outcome.replaced {
            let quarantine = &self.database.quarantine;
            quarantine.replaced(replaced.number, replaced.id);
        }
        Ok(outcome.inserted)
    }

    fn info(&self, map: MapRow) -> MapInfo {
        let recorded = map.reference_count.max(0) as u64;
        let quarantined = self.database.quarantine.count(map.number);
        let calibration = map.calibration();
        MapInfo {
            name: map.name,
            model: map.model,
            references: recorded.saturating_sub(quarantined),
            created_at: map.created_at,
            calibration,
        }
    }
}

impl ReadPlaces for SqliteStore {
    fn get(&self, id: ReferenceId) -> Result<Reference, StoreError> {
        let database = &self.database;
        database.read(|connection| database.reference(connection, id))
    }

    fn get_many(&self, ids: &[ReferenceId]) -> Result<Vec<Reference>, StoreError> {
        let database = &self.database;
        database.read(|connection| database.references(connection, ids))
    }

    fn find_external(
        &self,
        map: &MapName,
        external_id: &ExternalId,
    ) -> Result<Option<Reference>, StoreError> {
        let database = &self.database;
        database.read(|connection| database.reference_by_external_id(connection, map, external_id))
    }

    fn map_of(&self, id: ReferenceId) -> Result<MapName, StoreError> {
        self.database
            .read(|connection| reference_row::map_of(connection, id))
    }

    fn list(
        &self,
        map: Option<&MapName>,
        after: Option<Cursor>,
        limit: usize,
    ) -> Result<Page, StoreError> {
        let database = &self.database;
        database.read(|connection| database.page(connection, map, after, limit))
    }

    fn patches(&self, id: ReferenceId) -> Result<PackedPatches, StoreError> {
        let database = &self.database;
        database.read(|connection| database.patches(connection, id))
    }

    fn maps(&self) -> Result<Vec<MapInfo>, StoreError> {
        let maps = self.database.read(MapRow::all)?;
        for map in maps.damaged {
            let error = StoreError::CorruptMap { map };
            tracing::error!(%error, "a map is not served");
            let quarantine = &self.database.quarantine;
            quarantine.count_other(error.to_string(), None);
        }
        Ok(maps.sound.into_iter().map(|map| self.info(map)).collect())
    }

    fn map(&self, name: &MapName) -> Result<MapInfo, StoreError> {
        let map = self
            .database
            .read(|connection| MapRow::require(connection, name))?;
        Ok(self.info(map))
    }

    fn head(&self, map: &MapName) -> Result<Option<Vec<u8>>, StoreError> {
        self.database.read(|connection| {
            let map = MapRow::require(connection, map)?;
            replace_head::read_head(connection, &map)
        })
    }

    fn scan_globals(
        &self,
        map: &MapName,
        visit: &mut dyn FnMut(GlobalRow),
    ) -> Result<(), StoreError> {
        let database = &self.database;
        database.read(|connection| database.scan_globals(connection, map, visit))
    }
}

impl WritePlaces for SqliteStore {
    fn insert(&self, new: NewReference) -> Result<Inserted, StoreError> {
        let pending = self.submit_insert(new)?;
        self.finish_insert(pending)
    }

    fn insert_many(&self, new: Vec<NewReference>) -> Vec<Result<Inserted, StoreError>> {
        // All are handed in before the first is waited for, so that they share syncs of the disk.
        let pending: Vec<_> = new.into_iter().map(|new| self.submit_insert(new)).collect();
        pending
            .into_iter()
            .map(|pending| self.finish_insert(pending?))
            .collect()
    }

    fn update(&self, id: ReferenceId, patch: ReferencePatch) -> Result<Reference, StoreError> {
        // Reading it first refuses a quarantined reference and quarantines a damaged one.
        self.get(id)?;
        let effect = Effect::Grows(PATCH_BYTES);
        let updated = self.database.write(effect, move |connection| {
            change::update(connection, id, patch.clone())
        });
        // It may have been damaged only after it was read.
        if let Err(StoreError::CorruptRecord { id, reason }) = &updated {
            self.database.quarantine_damaged_by_id(*id, reason);
        }
        updated
    }

    fn delete(&self, id: ReferenceId) -> Result<Reference, StoreError> {
        let deleted = self.database.write(Effect::Shrinks, move |connection| {
            change::delete(connection, id)
        })?;
        self.database.quarantine.forget(deleted.number);
        Ok(deleted.reference)
    }

    fn delete_map(&self, name: &MapName) -> Result<u64, StoreError> {
        let name = name.clone();
        let deleted = self.database.write(Effect::Shrinks, move |connection| {
            change::delete_map(connection, &name)
        })?;
        crash_points::reach(crash_points::MAP_DELETED);
        let quarantine = &self.database.quarantine;
        let quarantined = quarantine.count(deleted.number);
        quarantine.forget_map(deleted.number);
        Ok(deleted.references.saturating_sub(quarantined))
    }

    fn replace_globals(
        &self,
        map: &MapName,
        head: NewHead,
        exchange: &mut dyn HeadExchange,
    ) -> Result<(), StoreError> {
        self.database.replace_head(map, head, exchange)
    }

    fn set_calibration(
        &self,
        map: &MapName,
        calibration: Option<Calibration>,
    ) -> Result<(), StoreError> {
        let map = map.clone();
        let effect = Effect::Grows(CALIBRATION_BYTES);
        self.database.write(effect, move |connection| {
            change::set_calibration(connection, &map, calibration.as_ref())
        })
    }
}

impl MaintainPlaces for SqliteStore {
    fn quarantined(&self) -> Result<Vec<Quarantined>, StoreError> {
        Ok(self.database.quarantine.list())
    }

    fn drain_damage(&self) -> Damage {
        self.database.quarantine.drain()
    }

    fn verify(&self) -> Result<VerifyReport, StoreError> {
        // Damage of a map is in the report, so it is not counted a second time.
        let database = &self.database;
        database.readers.with(|connection| {
            let mut report = database.verify(connection)?;
            let complaint = tail::complaint(self.directory.path(), connection);
            report.engine_errors.extend(complaint);
            Ok(report)
        })
    }

    fn backup(&self, target: &Path) -> Result<u64, StoreError> {
        self.storage.check_names()?;
        let least = tail::least_of_copy(self.directory.path())?;
        backup::write(
            &engine::open_reader(&self.path, &self.config)?,
            target,
            least,
        )
    }

    fn check_storage(&self) -> Result<(), StoreError> {
        let is_as_left = self.storage.is_as_left()?;
        if !is_as_left || self.storage.has_failed() {
            // Whether the disk takes writes again is known once it has taken one; whether what has
            // changed is right, the writer can ask the engine.
            self.database.write(Effect::Shrinks, |_| Ok(()))?;
        }
        Ok(())
    }

    fn footprint(&self) -> Result<Footprint, StoreError> {
        let size = |path: &Path| std::fs::metadata(path).map_or(0, |meta| meta.len());
        let log = size(&with_suffix(&self.path, "-wal"));
        let log_index = size(&with_suffix(&self.path, "-shm"));
        let writer = 1;
        let connections = self.database.readers.open() as u64 + writer;
        Ok(Footprint {
            disk_bytes: size(&self.path) + log + log_index,
            cache_bytes: connections * u64::from(self.config.cache_kib) * 1024,
        })
    }
}
