//! Rows of the database <-> the types of the crate, and the checksum that every row carries.
//!
//! A checksum covers each column with a tag for its presence and its length, so that no two
//! different rows share their bytes, and it covers the row's number, so that a row cannot pass for
//! another. Reading verifies it; a row that fails is [`RowError::Damaged`] and the caller has it
//! quarantined.

use super::engine::{damage, failed};
use crate::{StoreError, codec};
use placeformer_core::types::{
    Calibration, ContentHash, GeoPoint, Heading, MapName, ModelId, Reference, ReferenceFields,
    ReferenceId,
};
use rusqlite::{Connection, OptionalExtension, Row, params};
use time::{OffsetDateTime, UtcOffset};

/// Why a row could not be read.
#[derive(Debug)]
pub(super) enum RowError {
    /// Its content is not what was written; says what is wrong.
    Damaged(String),
    /// The engine failed for another reason.
    Engine(rusqlite::Error),
}

impl From<rusqlite::Error> for RowError {
    fn from(error: rusqlite::Error) -> Self {
        match damage(&error) {
            Some(reason) => Self::Damaged(reason),
            None => Self::Engine(error),
        }
    }
}

/// Feeds columns to a CRC-32 so that their borders matter.
struct Checksum(crc32fast::Hasher);

impl Checksum {
    fn of(table: &str) -> Self {
        Self(crc32fast::Hasher::new()).bytes(table.as_bytes())
    }

    fn bytes(mut self, value: &[u8]) -> Self {
        self.0.update(&(value.len() as u64).to_le_bytes());
        self.0.update(value);
        self
    }

    fn integer(self, value: i64) -> Self {
        self.bytes(&value.to_le_bytes())
    }

    fn optional(mut self, value: Option<impl AsRef<[u8]>>) -> Self {
        self.0.update(&[u8::from(value.is_some())]);
        match value {
            Some(value) => self.bytes(value.as_ref()),
            None => self,
        }
    }

    fn finish(self) -> i64 {
        i64::from(self.0.finalize())
    }
}

/// Microseconds since 1970; finer parts are cut.
pub(super) fn to_micros(time: OffsetDateTime) -> i64 {
    // The years -9999 to 9999 span 6.4e17 microseconds.
    time.unix_timestamp_nanos().div_euclid(1000) as i64
}

fn from_micros(micros: i64) -> Result<OffsetDateTime, RowError> {
    OffsetDateTime::from_unix_timestamp_nanos(i128::from(micros) * 1000)
        .map_err(|_| RowError::Damaged(format!("{micros} is not a time")))
}

/// The instant as the store keeps it: whole microseconds, UTC.
pub(super) fn as_stored(time: OffsetDateTime) -> OffsetDateTime {
    let time = time.to_offset(UtcOffset::UTC);
    let micros = time.nanosecond() / 1000 * 1000;
    time.replace_nanosecond(micros).unwrap_or(time)
}

/// A map's row.
#[derive(Debug, Clone)]
pub(super) struct MapRow {
    pub number: i64,
    pub name: MapName,
    pub model: ModelId,
    pub version: i64,
    pub pending_version: Option<i64>,
    pub reference_count: i64,
    pub calibration: Option<String>,
    pub created_at: OffsetDateTime,
}

const MAP_COLUMNS: &str = "number, name, model, version, pending_version, reference_count, calibration, created_at, checksum";

impl MapRow {
    pub(super) fn checksum(&self) -> i64 {
        Checksum::of("map")
            .integer(self.number)
            .bytes(self.name.as_str().as_bytes())
            .bytes(self.model.as_str().as_bytes())
            .integer(self.version)
            .optional(self.calibration.as_ref())
            .integer(to_micros(self.created_at))
            .finish()
    }

    fn read(row: &Row<'_>) -> Result<Self, RowError> {
        let name: String = row.get(1)?;
        let map = Self {
            number: row.get(0)?,
            name: name
                .parse()
                .map_err(|error| RowError::Damaged(format!("{error}")))?,
            model: ModelId::new(row.get::<_, String>(2)?),
            version: row.get(3)?,
            pending_version: row.get(4)?,
            reference_count: row.get(5)?,
            calibration: row.get(6)?,
            created_at: from_micros(row.get(7)?)?,
        };
        verify(row.get(8)?, map.checksum())?;
        Ok(map)
    }

    /// The map of this name, if there is one.
    pub(super) fn find(
        connection: &Connection,
        name: &MapName,
    ) -> Result<Option<Self>, StoreError> {
        let reading = failed("reading a map");
        let sql = format!("SELECT {MAP_COLUMNS} FROM map WHERE name = ?1");
        let mut statement = connection.prepare_cached(&sql).map_err(&reading)?;
        let mut rows = statement.query([name.as_str()]).map_err(&reading)?;
        let Some(row) = rows.next().map_err(&reading)? else {
            return Ok(None);
        };
        match Self::read(row) {
            Ok(map) => Ok(Some(map)),
            Err(RowError::Damaged(_)) => Err(StoreError::CorruptMap {
                map: name.to_string(),
            }),
            Err(RowError::Engine(error)) => Err(reading(error)),
        }
    }

    /// The map of this name, or an error that names it.
    pub(super) fn require(connection: &Connection, name: &MapName) -> Result<Self, StoreError> {
        Self::find(connection, name)?.ok_or_else(|| StoreError::MapNotFound { map: name.clone() })
    }

    /// Every map by name; damaged ones apart, as far as their name can be read.
    pub(super) fn all(connection: &Connection) -> Result<(Vec<Self>, Vec<String>), StoreError> {
        let reading = failed("listing maps");
        let sql = format!("SELECT {MAP_COLUMNS} FROM map WHERE name IS NOT NULL ORDER BY name");
        let mut statement = connection.prepare_cached(&sql).map_err(&reading)?;
        let mut rows = statement.query([]).map_err(&reading)?;
        let (mut maps, mut damaged) = (Vec::new(), Vec::new());
        while let Some(row) = rows.next().map_err(&reading)? {
            match Self::read(row) {
                Ok(map) => maps.push(map),
                Err(RowError::Damaged(_)) => {
                    damaged.push(row.get::<_, String>(1).unwrap_or_else(|_| "?".into()))
                }
                Err(RowError::Engine(error)) => return Err(reading(error)),
            }
        }
        Ok((maps, damaged))
    }

    /// The map's calibration, if it has one that this release can read. Its bytes are as they were
    /// written (the row's checksum says so), so one that cannot be read comes from another release:
    /// the map goes on without it.
    pub(super) fn calibration(&self) -> Option<Calibration> {
        let text = self.calibration.as_deref()?;
        serde_json::from_str(text)
            .inspect_err(|error| tracing::warn!(map = %self.name, %error, "the map's calibration cannot be read"))
            .ok()
    }

    /// Writes the covered columns back after a change.
    pub(super) fn save(&self, connection: &Connection) -> Result<(), StoreError> {
        let sql = "UPDATE map SET model = ?2, version = ?3, pending_version = ?4, calibration = ?5, checksum = ?6
                   WHERE number = ?1";
        connection
            .prepare_cached(sql)
            .and_then(|mut statement| {
                statement.execute(params![
                    self.number,
                    self.model.as_str(),
                    self.version,
                    self.pending_version,
                    self.calibration,
                    self.checksum()
                ])
            })
            .map_err(failed("writing a map"))?;
        Ok(())
    }
}

fn verify(stored: i64, found: i64) -> Result<(), RowError> {
    if stored == found {
        Ok(())
    } else {
        Err(RowError::Damaged(format!(
            "row checksum {found:08x} where {stored:08x} was stored"
        )))
    }
}

/// Columns of a reference and its map, for `reference r JOIN map m`.
pub(super) const REFERENCE_COLUMNS: &str = "r.number, r.id, r.map, r.external_id, r.lat, r.lon, r.heading, \
     r.captured_at, r.metadata, r.content_hash, r.created_at, r.checksum, m.name, m.model";

/// References of maps that are not deleted.
pub(super) const REFERENCE_SOURCE: &str =
    "reference r JOIN map m ON m.number = r.map AND m.name IS NOT NULL";

/// A reference's row, column by column.
#[derive(Debug, Clone)]
pub(super) struct ReferenceRow {
    pub number: i64,
    pub id: [u8; 16],
    pub map: i64,
    pub external_id: Option<String>,
    pub lat: Option<f64>,
    pub lon: Option<f64>,
    pub heading: Option<f64>,
    pub captured_at: Option<i64>,
    pub metadata: Option<String>,
    pub content_hash: [u8; 32],
    pub created_at: i64,
}

impl ReferenceRow {
    /// The columns that hold `fields`.
    pub(super) fn set_fields(&mut self, fields: &ReferenceFields) {
        self.external_id = fields.external_id.as_ref().map(|id| id.as_str().to_owned());
        self.lat = fields.location.map(GeoPoint::lat);
        self.lon = fields.location.map(GeoPoint::lon);
        self.heading = fields.heading.map(Heading::degrees);
        self.captured_at = fields.captured_at.map(to_micros);
        self.metadata = fields
            .metadata
            .as_ref()
            .map(|object| serde_json::Value::from(object.clone()).to_string());
    }

    pub(super) fn checksum(&self) -> i64 {
        Checksum::of("reference")
            .integer(self.number)
            .bytes(&self.id)
            .integer(self.map)
            .optional(self.external_id.as_ref())
            .optional(self.lat.map(f64::to_le_bytes))
            .optional(self.lon.map(f64::to_le_bytes))
            .optional(self.heading.map(f64::to_le_bytes))
            .optional(self.captured_at.map(i64::to_le_bytes))
            .optional(self.metadata.as_ref())
            .bytes(&self.content_hash)
            .integer(self.created_at)
            .finish()
    }

    /// Reads and verifies columns in the order of [`REFERENCE_COLUMNS`].
    pub(super) fn read(row: &Row<'_>) -> Result<Self, RowError> {
        let read = Self {
            number: row.get(0)?,
            id: row.get(1)?,
            map: row.get(2)?,
            external_id: row.get(3)?,
            lat: row.get(4)?,
            lon: row.get(5)?,
            heading: row.get(6)?,
            captured_at: row.get(7)?,
            metadata: row.get(8)?,
            content_hash: row.get(9)?,
            created_at: row.get(10)?,
        };
        verify(row.get(11)?, read.checksum())?;
        Ok(read)
    }

    pub(super) fn id(&self) -> ReferenceId {
        ReferenceId::from_bytes(self.id)
    }

    /// Location and capture time, which the search index filters by.
    pub(super) fn place_and_time(
        &self,
    ) -> Result<(Option<GeoPoint>, Option<OffsetDateTime>), RowError> {
        let location = match (self.lat, self.lon) {
            (Some(lat), Some(lon)) => {
                Some(GeoPoint::new(lat, lon).map_err(|e| RowError::Damaged(e.to_string()))?)
            }
            _ => None,
        };
        Ok((location, self.captured_at.map(from_micros).transpose()?))
    }

    /// The reference that the row describes.
    pub(super) fn reference(self, map: MapName, model: ModelId) -> Result<Reference, RowError> {
        let wrong = |what: String| RowError::Damaged(what);
        let (location, captured_at) = self.place_and_time()?;
        let id = self.id();
        Ok(Reference {
            id,
            map,
            fields: ReferenceFields {
                external_id: self
                    .external_id
                    .map(|id| id.parse())
                    .transpose()
                    .map_err(|e| wrong(format!("{e}")))?,
                location,
                heading: self
                    .heading
                    .map(Heading::new)
                    .transpose()
                    .map_err(|e| wrong(e.to_string()))?,
                captured_at,
                metadata: self
                    .metadata
                    .map(|text| serde_json::from_str(&text))
                    .transpose()
                    .map_err(|e| wrong(format!("metadata: {e}")))?,
            },
            content_hash: ContentHash(self.content_hash),
            model,
            created_at: from_micros(self.created_at)?,
        })
    }
}

/// Reads a reference with its map from a row of [`REFERENCE_COLUMNS`].
pub(super) fn read_reference(row: &Row<'_>) -> Result<Reference, RowError> {
    let columns = ReferenceRow::read(row)?;
    let name: String = row.get(12)?;
    let map = name
        .parse()
        .map_err(|error| RowError::Damaged(format!("{error}")))?;
    columns.reference(map, ModelId::new(row.get::<_, String>(13)?))
}

/// A reference's number and its map's, from the index alone, whatever the state of its row. Where
/// that cannot be read, it is this reference that is damaged: others may lie on sound pages.
pub(super) fn locate(connection: &Connection, id: ReferenceId) -> Result<(i64, i64), StoreError> {
    let sql = "SELECT r.number, r.map FROM reference r JOIN map m ON m.number = r.map AND m.name IS NOT NULL
               WHERE r.id = ?1";
    connection
        .prepare_cached(sql)
        .and_then(|mut statement| {
            statement
                .query_row([id.as_bytes().as_slice()], |row| {
                    Ok((row.get(0)?, row.get(1)?))
                })
                .optional()
        })
        .map_err(|error| match damage(&error) {
            Some(reason) => StoreError::Corrupt { id, reason },
            None => failed("finding a reference")(error),
        })?
        .ok_or(StoreError::ReferenceNotFound { id })
}

/// The identity in a row that may be unreadable otherwise; all zeros where even that is lost.
pub(super) fn id_of(connection: &Connection, number: i64) -> ReferenceId {
    let sql = "SELECT id FROM reference WHERE number = ?1";
    let id = connection.query_row(sql, [number], |row| row.get(0));
    ReferenceId::from_bytes(id.unwrap_or([0; 16]))
}

/// The reference of this number.
pub(super) fn reference_by_number(
    connection: &Connection,
    number: i64,
) -> Result<Option<Reference>, RowError> {
    let sql = format!("SELECT {REFERENCE_COLUMNS} FROM {REFERENCE_SOURCE} WHERE r.number = ?1");
    let mut statement = connection.prepare_cached(&sql)?;
    let mut rows = statement.query([number])?;
    rows.next()?.map(read_reference).transpose()
}

/// Checksum of a global vector's row.
pub(super) fn global_checksum(version: i64, number: i64, vector: &[u8]) -> i64 {
    Checksum::of("global_vector")
        .integer(version)
        .integer(number)
        .bytes(vector)
        .finish()
}

/// Verifies and reads a global vector.
pub(super) fn read_global(
    version: i64,
    number: i64,
    vector: &[u8],
    checksum: i64,
) -> Result<Vec<f32>, RowError> {
    verify(checksum, global_checksum(version, number, vector))?;
    codec::decode_f32(vector)
        .ok_or_else(|| RowError::Damaged("the global vector holds no numbers".into()))
}

/// Checksum of a head that the map of `model` keeps.
pub(super) fn head_checksum(version: i64, model: &ModelId, file: &[u8]) -> i64 {
    Checksum::of("map_head")
        .integer(version)
        .bytes(model.as_str().as_bytes())
        .bytes(file)
        .finish()
}

/// Checksum of a pooled vector's row.
pub(super) fn pooled_checksum(number: i64, vector: &[u8]) -> i64 {
    Checksum::of("pooled_vector")
        .integer(number)
        .bytes(vector)
        .finish()
}

/// Verifies and reads a pooled vector.
pub(super) fn read_pooled(number: i64, vector: &[u8], checksum: i64) -> Result<Vec<f32>, RowError> {
    verify(checksum, pooled_checksum(number, vector))?;
    codec::decode_f16(vector)
        .ok_or_else(|| RowError::Damaged("the pooled vector holds no numbers".into()))
}

/// Checksum of a patches row. The blob verifies itself; this binds its own checksum to the row's
/// number.
pub(super) fn patches_checksum(number: i64, blob: &[u8]) -> i64 {
    let sealed = codec::trailing_checksum(blob).unwrap_or_default();
    Checksum::of("patches")
        .integer(number)
        .integer(i64::from(sealed))
        .finish()
}

/// Verifies and reads key patches.
pub(super) fn read_patches(
    number: i64,
    blob: &[u8],
    checksum: i64,
) -> Result<placeformer_core::types::PackedPatches, RowError> {
    verify(checksum, patches_checksum(number, blob))?;
    codec::decode(blob).map_err(|error| RowError::Damaged(format!("key patches: {error}")))
}
