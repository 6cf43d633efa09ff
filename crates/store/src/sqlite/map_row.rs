//! Rows of table `map`.

use super::checksum::RowChecksum;
use super::engine::failed;
use super::keys::{MapNumber, Version};
use super::row::{RowError, from_micros, verify};
use crate::error::StoreError;
use placeformer_core::types::{Calibration, MapName, ModelId, Timestamp};
use rusqlite::{CachedStatement, Connection, Row, named_params};

/// A map's row.
#[derive(Debug, Clone)]
pub(super) struct MapRow {
    pub number: MapNumber,
    pub name: MapName,
    pub model: ModelId,
    /// The global vectors that the map uses.
    pub version: Version,
    /// The global vectors being made for another head.
    pub pending_version: Option<Version>,
    pub reference_count: i64,
    /// JSON, as it was given.
    pub calibration: Option<String>,
    pub created_at: Timestamp,
}

/// The maps that could be read, and the names of those that could not.
pub(super) struct AllMaps {
    pub sound: Vec<MapRow>,
    /// Names as far as they can be read.
    pub damaged: Vec<String>,
}

impl MapRow {
    pub(super) fn checksum(&self) -> i64 {
        RowChecksum::of("map")
            .integer(self.number.value())
            .bytes(self.name.as_str().as_bytes())
            .bytes(self.model.as_str().as_bytes())
            .integer(self.version.value())
            .optional(self.calibration.as_ref())
            .integer(self.created_at.unix_micros())
            .finish()
    }

    fn read(row: &Row<'_>) -> Result<Self, RowError> {
        let name: String = row.get("name")?;
        let model: String = row.get("model")?;
        let map = Self {
            number: row.get("number")?,
            name: name.parse().map_err(RowError::damaged)?,
            model: ModelId::new(model),
            version: row.get("version")?,
            pending_version: row.get("pending_version")?,
            reference_count: row.get("reference_count")?,
            calibration: row.get("calibration")?,
            created_at: from_micros(row.get("created_at")?)?,
        };
        verify(row.get("checksum")?, map.checksum())?;
        Ok(map)
    }

    /// The map of this name, if there is one.
    pub(super) fn find(
        connection: &Connection,
        name: &MapName,
    ) -> Result<Option<Self>, StoreError> {
        let find = || -> Result<Option<Self>, RowError> {
            let mut statement = select(connection, "name = ?1")?;
            let mut rows = statement.query([name.as_str()])?;
            match rows.next()? {
                Some(row) => Self::read(row).map(Some),
                None => Ok(None),
            }
        };
        find().map_err(|error| match error {
            RowError::Damaged(_) => StoreError::CorruptMap {
                map: name.to_string(),
            },
            RowError::Engine(error) => failed("reading a map")(error),
        })
    }

    /// The map of this name, or an error that names it.
    pub(super) fn require(connection: &Connection, name: &MapName) -> Result<Self, StoreError> {
        match Self::find(connection, name)? {
            Some(map) => Ok(map),
            None => Err(StoreError::MapNotFound { map: name.clone() }),
        }
    }

    /// Every map by name.
    pub(super) fn all(connection: &Connection) -> Result<AllMaps, StoreError> {
        let listing = failed("listing maps");
        let mut statement =
            select(connection, "name IS NOT NULL ORDER BY name").map_err(&listing)?;
        let mut rows = statement.query([]).map_err(&listing)?;
        let mut maps = AllMaps {
            sound: Vec::new(),
            damaged: Vec::new(),
        };
        while let Some(row) = rows.next().map_err(&listing)? {
            match Self::read(row) {
                Ok(map) => maps.sound.push(map),
                Err(RowError::Damaged(_)) => {
                    let name = row.get("name").unwrap_or_else(|_| "?".to_owned());
                    maps.damaged.push(name);
                }
                Err(RowError::Engine(error)) => return Err(listing(error)),
            }
        }
        Ok(maps)
    }

    /// The map's calibration, if it has one that this release can read.
    ///
    /// The row's checksum says that its bytes are as they were written. So a calibration that
    /// cannot be read was written by another release, and the map goes on without it.
    pub(super) fn calibration(&self) -> Option<Calibration> {
        let text = self.calibration.as_deref()?;
        match serde_json::from_str(text) {
            Ok(calibration) => Some(calibration),
            Err(error) => {
                tracing::warn!(map = %self.name, %error, "the map's calibration cannot be read");
                None
            }
        }
    }

    /// Adds the map's row.
    pub(super) fn insert(&self, connection: &Connection) -> rusqlite::Result<()> {
        connection.execute(
            "INSERT INTO map (number, name, model, version, reference_count, created_at, checksum)
             VALUES (:number, :name, :model, :version, :references, :created_at, :checksum)",
            named_params! {
                ":number": self.number,
                ":name": self.name.as_str(),
                ":model": self.model.as_str(),
                ":version": self.version,
                ":references": self.reference_count,
                ":created_at": self.created_at.unix_micros(),
                ":checksum": self.checksum(),
            },
        )?;
        Ok(())
    }

    /// Writes everything back that may change, except the count of references.
    pub(super) fn save(&self, connection: &Connection) -> Result<(), StoreError> {
        let update = || -> rusqlite::Result<usize> {
            let mut statement = connection.prepare_cached(
                "UPDATE map SET model = :model, version = :version, calibration = :calibration,
                                pending_version = :pending_version, checksum = :checksum
                 WHERE number = :number",
            )?;
            statement.execute(named_params! {
                ":number": self.number,
                ":model": self.model.as_str(),
                ":version": self.version,
                ":pending_version": self.pending_version,
                ":calibration": self.calibration,
                ":checksum": self.checksum(),
            })
        };
        update().map_err(failed("writing a map"))?;
        Ok(())
    }
}

/// Every column of the maps for which `condition` holds.
fn select<'c>(
    connection: &'c Connection,
    condition: &str,
) -> rusqlite::Result<CachedStatement<'c>> {
    connection.prepare_cached(&format!(
        "SELECT number, name, model, version, pending_version, reference_count, calibration,
                created_at, checksum
         FROM map WHERE {condition}"
    ))
}
