//! What goes into a store and comes out of it.

use placeformer_core::types::{
    Altitude, Calibration, ExternalId, GeoPoint, Heading, InvalidValue, MapName, Metadata, ModelId,
    Reference, ReferenceFields, ReferenceId, Timestamp,
};
use std::fmt;
use std::str::FromStr;

/// What became of an insert.
#[derive(Debug, Clone, PartialEq)]
pub enum Inserted {
    /// It is new and durable.
    Created(Reference),
    /// The same external id with the same content was there before.
    AlreadyThere(Reference),
}

/// A map and what it is bound to.
#[derive(Debug, Clone, PartialEq)]
pub struct MapInfo {
    /// Its name.
    pub name: MapName,
    /// The model that made all its descriptors.
    pub model: ModelId,
    /// References in it, without the quarantined ones.
    pub references: u64,
    /// When it was created.
    pub created_at: Timestamp,
    /// How far its best answers can be trusted, if that was fitted for this map.
    pub calibration: Option<Calibration>,
}

/// A stored reference as the index needs it.
#[derive(Debug, Clone, PartialEq)]
pub struct GlobalRow {
    /// The reference.
    pub reference: ReferenceId,
    /// Its global descriptor, `[256]`.
    pub global: Vec<f32>,
    /// Its location.
    pub location: Option<GeoPoint>,
    /// How high it was taken.
    pub alt: Option<Altitude>,
    /// Where its camera looked.
    pub heading: Option<Heading>,
    /// Its capture time.
    pub captured_at: Option<Timestamp>,
}

/// One page of references, in the order they were added.
#[derive(Debug, Clone, PartialEq)]
pub struct Page {
    /// The references.
    pub references: Vec<Reference>,
    /// Pass as `after` for the next page; absent on the last.
    pub next: Option<Cursor>,
}

/// A place in the order in which references were added to a store, whatever map they are of.
///
/// It counts and does not measure time. So whoever reads page after page misses nothing that was
/// added before the last page was read, even if the clock was set back meanwhile; and a place stays
/// valid when the reference at it is deleted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Cursor(i64);

impl Cursor {
    /// What its text begins with, so that an id is not taken for one.
    const PREFIX: &'static str = "at-";

    /// The place of the `number`th reference.
    pub fn at(number: i64) -> Self {
        Self(number)
    }

    /// Which reference is at the place, counted over the life of the store.
    pub fn number(self) -> i64 {
        self.0
    }
}

impl fmt::Display for Cursor {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}{}", Self::PREFIX, self.0)
    }
}

impl FromStr for Cursor {
    type Err = InvalidValue;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let digits = text.strip_prefix(Self::PREFIX).filter(|digits| {
            // A parser of numbers would take a sign, too.
            digits.bytes().all(|byte| byte.is_ascii_digit())
        });
        let number = digits.and_then(|digits| digits.parse().ok());
        number.map(Self).ok_or_else(|| {
            let reason = "it is not the `next` of a page of this release; start again without it";
            InvalidValue::new("cursor", reason)
        })
    }
}

/// Fields to change; the outer `None` leaves a field as it is, the inner `None` clears it.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ReferencePatch {
    /// New external id.
    pub external_id: Option<Option<ExternalId>>,
    /// New location.
    pub location: Option<Option<GeoPoint>>,
    /// New height.
    pub alt: Option<Option<Altitude>>,
    /// New heading.
    pub heading: Option<Option<Heading>>,
    /// New capture time.
    pub captured_at: Option<Option<Timestamp>>,
    /// New metadata.
    pub metadata: Option<Option<Metadata>>,
}

impl ReferencePatch {
    /// Changes `fields` as the patch says.
    pub fn apply(self, fields: &mut ReferenceFields) {
        if let Some(external_id) = self.external_id {
            fields.external_id = external_id;
        }
        if let Some(location) = self.location {
            fields.location = location;
        }
        if let Some(alt) = self.alt {
            fields.alt = alt;
        }
        if let Some(heading) = self.heading {
            fields.heading = heading;
        }
        if let Some(captured_at) = self.captured_at {
            fields.captured_at = captured_at;
        }
        if let Some(metadata) = self.metadata {
            fields.metadata = metadata;
        }
    }
}

/// What a check of the whole store found.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct VerifyReport {
    /// References read.
    pub references: u64,
    /// Damaged ones, with what is wrong; they are quarantined.
    pub damaged: Vec<(ReferenceId, String)>,
    /// What the database engine itself reports.
    pub engine_errors: Vec<String>,
}

/// A reference taken out of service because its stored bytes are damaged.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Quarantined {
    /// Which reference, as far as its identity can be read; all zeros if it cannot.
    pub id: ReferenceId,
    /// What is wrong with it.
    pub reason: String,
}

/// Damage that a store has found since it was last asked.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Damage {
    /// Damaged records found for the first time, by whichever call read them.
    pub found: u64,
    /// References that are no longer served because of it: quarantined, or replaced by their image
    /// sent again.
    pub withdrawn: Vec<ReferenceId>,
}

/// The room that a store takes.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Footprint {
    /// Bytes on disk.
    pub disk_bytes: u64,
    /// Most bytes of memory that the engine's own caches can take with the connections now open.
    pub cache_bytes: u64,
}

/// The head that a map is given.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NewHead {
    /// The model that the map is bound to from then on.
    pub model: ModelId,
    /// The bytes of the head's file, which the store keeps with the map. None if the map uses the
    /// head that the server has loaded, so that there is nothing to keep.
    pub file: Option<Vec<u8>>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cursor_survives_its_text_and_nothing_else_is_one() {
        for number in [0, 1, 17, i64::MAX] {
            let cursor = Cursor::at(number);
            assert_eq!(cursor.to_string().parse::<Cursor>(), Ok(cursor));
        }
        let id = ReferenceId::generate().to_string();
        for text in [
            "",
            "at-",
            "at--1",
            "at-+1",
            "at-9223372036854775808",
            "1",
            "x",
            id.as_str(),
        ] {
            assert!(text.parse::<Cursor>().is_err(), "{text}");
        }
    }
}
