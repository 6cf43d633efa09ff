//! Rows of table `reference`.

use super::checksum::RowChecksum;
use super::engine::{damage, failed};
use super::keys::{MapNumber, ReferenceNumber};
use super::row::{RowError, from_micros, id_or_zeros, verify};
use crate::error::StoreError;
use placeformer_core::types::{
    Altitude, ContentHash, ExternalId, GeoPoint, Heading, MapName, Metadata, ModelId, Reference,
    ReferenceFields, ReferenceId, Timestamp,
};
use rusqlite::{Connection, OptionalExtension, Row, Statement, named_params};

/// What a statement selects from [`REFERENCE_SOURCE`] for [`ReferenceColumns`].
pub(super) const REFERENCE_COLUMNS: &str = "r.number AS number, r.id AS id, r.map AS map, \
     r.external_id AS external_id, r.lat AS lat, r.lon AS lon, r.alt AS alt, r.heading AS heading, \
     r.captured_at AS captured_at, r.metadata AS metadata, r.content_hash AS content_hash, \
     r.created_at AS created_at, r.checksum AS checksum, m.name AS map_name, m.model AS map_model";

/// References `r` of maps `m` that are not deleted.
pub(super) const REFERENCE_SOURCE: &str =
    "reference r JOIN map m ON m.number = r.map AND m.name IS NOT NULL";

/// Where the columns of [`REFERENCE_COLUMNS`] are in a statement, found by their names.
///
/// The engine finds a name by comparing it with one column after the other, which for this many
/// columns takes about as long as reading the row. So a scan looks them up once and not per row.
pub(super) struct ReferenceColumns {
    number: usize,
    id: usize,
    map: usize,
    external_id: usize,
    lat: usize,
    lon: usize,
    alt: usize,
    heading: usize,
    captured_at: usize,
    metadata: usize,
    content_hash: usize,
    created_at: usize,
    checksum: usize,
    map_name: usize,
    map_model: usize,
}

impl ReferenceColumns {
    /// Finds them in a statement that selects [`REFERENCE_COLUMNS`].
    pub(super) fn of(statement: &Statement<'_>) -> rusqlite::Result<Self> {
        Ok(Self {
            number: statement.column_index("number")?,
            id: statement.column_index("id")?,
            map: statement.column_index("map")?,
            external_id: statement.column_index("external_id")?,
            lat: statement.column_index("lat")?,
            lon: statement.column_index("lon")?,
            alt: statement.column_index("alt")?,
            heading: statement.column_index("heading")?,
            captured_at: statement.column_index("captured_at")?,
            metadata: statement.column_index("metadata")?,
            content_hash: statement.column_index("content_hash")?,
            created_at: statement.column_index("created_at")?,
            checksum: statement.column_index("checksum")?,
            map_name: statement.column_index("map_name")?,
            map_model: statement.column_index("map_model")?,
        })
    }

    /// The reference's number, which is readable even where the rest of the row is damaged.
    pub(super) fn number(&self, row: &Row<'_>) -> rusqlite::Result<ReferenceNumber> {
        row.get(self.number)
    }

    /// The reference's identity as far as it can be read.
    pub(super) fn id_or_zeros(&self, row: &Row<'_>) -> ReferenceId {
        id_or_zeros(row.get(self.id))
    }

    /// The number of the reference's map as far as it can be read.
    pub(super) fn map_or_unknown(&self, row: &Row<'_>) -> MapNumber {
        row.get(self.map).unwrap_or(MapNumber::UNKNOWN)
    }

    /// Reads and verifies the columns of table `reference`.
    pub(super) fn read(&self, row: &Row<'_>) -> Result<ReferenceRow, RowError> {
        let read = ReferenceRow {
            number: row.get(self.number)?,
            id: row.get(self.id)?,
            map: row.get(self.map)?,
            external_id: row.get(self.external_id)?,
            lat: row.get(self.lat)?,
            lon: row.get(self.lon)?,
            alt: row.get(self.alt)?,
            heading: row.get(self.heading)?,
            captured_at: row.get(self.captured_at)?,
            metadata: row.get(self.metadata)?,
            content_hash: row.get(self.content_hash)?,
            created_at: row.get(self.created_at)?,
        };
        verify(row.get(self.checksum)?, read.checksum())?;
        Ok(read)
    }

    /// Reads and verifies a reference together with the name and model of its map.
    pub(super) fn read_reference(&self, row: &Row<'_>) -> Result<Reference, RowError> {
        let columns = self.read(row)?;
        let name: String = row.get(self.map_name)?;
        let model: String = row.get(self.map_model)?;
        let name = name.parse().map_err(RowError::damaged)?;
        columns.into_reference(name, ModelId::new(model))
    }
}

/// A reference's row, column by column.
#[derive(Debug, Clone)]
pub(super) struct ReferenceRow {
    pub number: ReferenceNumber,
    pub id: [u8; 16],
    pub map: MapNumber,
    pub external_id: Option<String>,
    pub lat: Option<f64>,
    pub lon: Option<f64>,
    pub alt: Option<f64>,
    pub heading: Option<f64>,
    pub captured_at: Option<i64>,
    pub metadata: Option<String>,
    pub content_hash: [u8; 32],
    pub created_at: i64,
}

impl ReferenceRow {
    /// Sets the columns that hold `fields`.
    pub(super) fn set_fields(&mut self, fields: &ReferenceFields) {
        self.external_id = fields.external_id.as_ref().map(|id| id.as_str().to_owned());
        self.lat = fields.location.map(GeoPoint::lat);
        self.lon = fields.location.map(GeoPoint::lon);
        self.alt = fields.alt.map(Altitude::metres);
        self.heading = fields.heading.map(Heading::degrees);
        self.captured_at = fields.captured_at.map(Timestamp::unix_micros);
        self.metadata = fields.metadata.as_ref().map(Metadata::to_string);
    }

    /// Rows from before there were heights have none, and the checksum that they always had.
    pub(super) fn checksum(&self) -> i64 {
        let sum = RowChecksum::of("reference")
            .integer(self.number.value())
            .bytes(&self.id)
            .integer(self.map.value())
            .optional(self.external_id.as_ref())
            .optional(self.lat.map(f64::to_le_bytes))
            .optional(self.lon.map(f64::to_le_bytes))
            .optional(self.heading.map(f64::to_le_bytes))
            .optional(self.captured_at.map(i64::to_le_bytes))
            .optional(self.metadata.as_ref())
            .bytes(&self.content_hash)
            .integer(self.created_at);
        match self.alt {
            Some(alt) => sum.optional(Some(alt.to_le_bytes())).finish(),
            None => sum.finish(),
        }
    }

    pub(super) fn id(&self) -> ReferenceId {
        ReferenceId::from_bytes(self.id)
    }

    pub(super) fn location(&self) -> Result<Option<GeoPoint>, RowError> {
        match (self.lat, self.lon) {
            (Some(lat), Some(lon)) => {
                let point = GeoPoint::new(lat, lon).map_err(RowError::damaged)?;
                Ok(Some(point))
            }
            _ => Ok(None),
        }
    }

    pub(super) fn alt(&self) -> Result<Option<Altitude>, RowError> {
        let alt = self.alt.map(Altitude::new).transpose();
        alt.map_err(RowError::damaged)
    }

    pub(super) fn heading(&self) -> Result<Option<Heading>, RowError> {
        let heading = self.heading.map(Heading::new).transpose();
        heading.map_err(RowError::damaged)
    }

    pub(super) fn captured_at(&self) -> Result<Option<Timestamp>, RowError> {
        self.captured_at.map(from_micros).transpose()
    }

    fn fields(&self) -> Result<ReferenceFields, RowError> {
        let external_id = match &self.external_id {
            Some(text) => Some(text.parse().map_err(RowError::damaged)?),
            None => None,
        };
        let metadata = match &self.metadata {
            Some(text) => Some(Metadata::from_stored(text.clone()).map_err(RowError::damaged)?),
            None => None,
        };
        Ok(ReferenceFields {
            external_id,
            location: self.location()?,
            alt: self.alt()?,
            heading: self.heading()?,
            captured_at: self.captured_at()?,
            metadata,
        })
    }

    /// The reference that the row describes, in the map of this name and model.
    pub(super) fn into_reference(
        self,
        map: MapName,
        model: ModelId,
    ) -> Result<Reference, RowError> {
        Ok(Reference {
            id: self.id(),
            map,
            fields: self.fields()?,
            content_hash: ContentHash(self.content_hash),
            model,
            created_at: from_micros(self.created_at)?,
        })
    }

    /// Writes the row, replacing the one with its number.
    pub(super) fn write(&self, connection: &Connection) -> rusqlite::Result<()> {
        let mut statement = connection.prepare_cached(
            "INSERT INTO reference (number, id, map, external_id, lat, lon, alt, heading,
                                    captured_at, metadata, content_hash, created_at, checksum)
             VALUES (:number, :id, :map, :external_id, :lat, :lon, :alt, :heading, :captured_at,
                     :metadata, :content_hash, :created_at, :checksum)
             ON CONFLICT (number) DO UPDATE SET external_id = :external_id, lat = :lat, lon = :lon,
                 alt = :alt, heading = :heading, captured_at = :captured_at, metadata = :metadata,
                 checksum = :checksum",
        )?;
        statement.execute(named_params! {
            ":number": self.number,
            ":id": self.id.as_slice(),
            ":map": self.map,
            ":external_id": self.external_id,
            ":lat": self.lat,
            ":lon": self.lon,
            ":alt": self.alt,
            ":heading": self.heading,
            ":captured_at": self.captured_at,
            ":metadata": self.metadata,
            ":content_hash": self.content_hash.as_slice(),
            ":created_at": self.created_at,
            ":checksum": self.checksum(),
        })?;
        Ok(())
    }
}

/// Where a reference is: its own number and its map's.
#[derive(Debug, Clone, Copy)]
pub(super) struct Located {
    pub number: ReferenceNumber,
    pub map: MapNumber,
}

/// Finds a reference through the index alone, whatever the state of its row.
///
/// If the index cannot be read there, it is this reference that is reported as damaged: others may
/// lie on sound pages.
pub(super) fn locate(connection: &Connection, id: ReferenceId) -> Result<Located, StoreError> {
    let find = || -> rusqlite::Result<Option<Located>> {
        let sql = format!(
            "SELECT r.number AS number, r.map AS map FROM {REFERENCE_SOURCE} WHERE r.id = ?1"
        );
        let mut statement = connection.prepare_cached(&sql)?;
        let located = statement.query_row([id.as_bytes().as_slice()], |row| {
            Ok(Located {
                number: row.get("number")?,
                map: row.get("map")?,
            })
        });
        located.optional()
    };
    match find() {
        Ok(Some(located)) => Ok(located),
        Ok(None) => Err(StoreError::ReferenceNotFound { id }),
        Err(error) => Err(match damage(&error) {
            Some(reason) => StoreError::CorruptRecord { id, reason },
            None => failed("finding a reference")(error),
        }),
    }
}

/// The name of the map that a reference is of, found without reading the reference's row.
pub(super) fn map_of(connection: &Connection, id: ReferenceId) -> Result<MapName, StoreError> {
    let map = locate(connection, id)?.map;
    let name: String = connection
        .prepare_cached("SELECT name FROM map WHERE number = ?1")
        .and_then(|mut statement| statement.query_row([map], |row| row.get("name")))
        .map_err(failed("finding the map of a reference"))?;
    name.parse()
        .map_err(|_| StoreError::CorruptMap { map: name })
}

/// The identity in a row that may be unreadable otherwise; all zeros if even that is lost.
pub(super) fn id_of(connection: &Connection, number: ReferenceNumber) -> ReferenceId {
    let sql = "SELECT id FROM reference WHERE number = ?1";
    id_or_zeros(connection.query_row(sql, [number], |row| row.get("id")))
}

/// Whether a row with this number is there, sound or not.
pub(super) fn exists(connection: &Connection, number: ReferenceNumber) -> rusqlite::Result<bool> {
    connection
        .prepare_cached("SELECT 1 FROM reference WHERE number = ?1")?
        .exists([number])
}

/// The number of the reference with this external id.
pub(super) fn number_of_external(
    connection: &Connection,
    map: MapNumber,
    external_id: &ExternalId,
) -> rusqlite::Result<Option<ReferenceNumber>> {
    connection
        .prepare_cached(
            "SELECT number FROM reference WHERE map = :map AND external_id = :external_id",
        )?
        .query_row(
            named_params! { ":map": map, ":external_id": external_id.as_str() },
            |row| row.get("number"),
        )
        .optional()
}

/// The identity of the reference with this external id.
pub(super) fn id_of_external(
    connection: &Connection,
    map: MapNumber,
    external_id: &ExternalId,
) -> rusqlite::Result<Option<ReferenceId>> {
    connection
        .prepare_cached("SELECT id FROM reference WHERE map = :map AND external_id = :external_id")?
        .query_row(
            named_params! { ":map": map, ":external_id": external_id.as_str() },
            |row| row.get("id").map(ReferenceId::from_bytes),
        )
        .optional()
}

/// Reads the row of this number with `read`.
pub(super) fn read_by_number<T>(
    connection: &Connection,
    number: ReferenceNumber,
    read: impl FnOnce(&ReferenceColumns, &Row<'_>) -> Result<T, RowError>,
) -> Result<Option<T>, RowError> {
    let sql = format!("SELECT {REFERENCE_COLUMNS} FROM {REFERENCE_SOURCE} WHERE r.number = ?1");
    let mut statement = connection.prepare_cached(&sql)?;
    let columns = ReferenceColumns::of(&statement)?;
    let mut rows = statement.query([number])?;
    match rows.next()? {
        Some(row) => read(&columns, row).map(Some),
        None => Ok(None),
    }
}

/// The reference of this number.
pub(super) fn reference_by_number(
    connection: &Connection,
    number: ReferenceNumber,
) -> Result<Option<Reference>, RowError> {
    read_by_number(connection, number, ReferenceColumns::read_reference)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_from_before_there_were_heights_keep_their_checksum() {
        let row = ReferenceRow {
            number: ReferenceNumber::BEFORE_ALL,
            id: [1; 16],
            map: MapNumber::UNKNOWN,
            external_id: None,
            lat: Some(1.0),
            lon: Some(2.0),
            alt: None,
            heading: None,
            captured_at: None,
            metadata: None,
            content_hash: [2; 32],
            created_at: 3,
        };
        // What the first release summed up.
        let nothing: Option<[u8; 8]> = None;
        let first_release = RowChecksum::of("reference")
            .integer(row.number.value())
            .bytes(&row.id)
            .integer(row.map.value())
            .optional(nothing)
            .optional(Some(1.0f64.to_le_bytes()))
            .optional(Some(2.0f64.to_le_bytes()))
            .optional(nothing)
            .optional(nothing)
            .optional(nothing)
            .bytes(&row.content_hash)
            .integer(row.created_at)
            .finish();
        assert_eq!(row.checksum(), first_release);
        let high = ReferenceRow {
            alt: Some(0.0),
            ..row
        };
        assert_ne!(high.checksum(), first_release);
    }
}
