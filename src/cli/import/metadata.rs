//! Position, height, heading and time of a photo: from the positions file, else from its name, else
//! from its own EXIF and XMP.
//!
//! Each field is taken from the first source that has it.

use super::positions::{Positions, Row};
use super::timezone::ClockZone;
use placeformer_core::geography::{UtmName, UtmZone};
use placeformer_core::types::{ExternalId, ReferenceFields};
use placeformer_vision::image::read_exif;

/// What is known of the photos, and how to read what they say.
#[derive(Default)]
pub(super) struct Metadata {
    /// The rows of the positions file.
    pub(super) positions: Positions,
    /// The zone of names that carry a UTM position without one.
    pub(super) utm_zone: Option<UtmZone>,
    /// The time zone of cameras that do not say theirs.
    pub(super) timezone: Option<ClockZone>,
    /// Whether what the photos say about themselves is left alone.
    pub(super) ignores_exif: bool,
}

/// What is known of one photo.
#[derive(Debug, Default)]
pub(super) struct PhotoFacts {
    pub(super) fields: ReferenceFields,
    /// Which fields come from an argument of this import. They replace what the map has; what the
    /// photo says by itself only fills gaps, because the map's value may be a better one.
    pub(super) given: GivenFields,
    /// What is wrong with the photo's name.
    pub(super) doubt: Option<String>,
}

/// For each field, whether it comes from an argument of the import.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct GivenFields {
    pub(super) location: bool,
    pub(super) alt: bool,
    pub(super) heading: bool,
    pub(super) captured_at: bool,
}

/// A source of facts.
#[derive(Default)]
struct Source {
    row: Row,
    given: GivenFields,
}

impl Metadata {
    /// The facts of one photo.
    pub(super) fn facts(&self, name: &str, external_id: ExternalId, image: &[u8]) -> PhotoFacts {
        let listed = Source {
            row: self.positions.row(name),
            given: GivenFields {
                location: true,
                alt: true,
                heading: true,
                captured_at: true,
            },
        };
        let (named, doubt) = self.facts_of_name(name);
        let sources = [listed, named, self.facts_of_photo(image)];
        let mut facts = PhotoFacts {
            doubt,
            ..PhotoFacts::default()
        };
        let fields = &mut facts.fields;
        fields.external_id = Some(external_id);
        for Source { row, given } in sources {
            if fields.location.is_none() && row.location.is_some() {
                fields.location = row.location;
                facts.given.location = given.location;
            }
            if fields.alt.is_none() && row.alt.is_some() {
                fields.alt = row.alt;
                facts.given.alt = given.alt;
            }
            if fields.heading.is_none() && row.heading.is_some() {
                fields.heading = row.heading;
                facts.given.heading = given.heading;
            }
            if fields.captured_at.is_none() && row.captured_at.is_some() {
                fields.captured_at = row.captured_at;
                facts.given.captured_at = given.captured_at;
            }
        }
        facts
    }

    /// What the name says, if it is one of the UTM names, and what is wrong with that.
    fn facts_of_name(&self, name: &str) -> (Source, Option<String>) {
        let Ok(parsed) = UtmName::parse(name) else {
            return (Source::default(), None);
        };
        let position = parsed.position(self.utm_zone);
        let source = Source {
            row: Row {
                location: position.location,
                alt: None,
                heading: parsed.heading,
                captured_at: parsed.captured_at,
            },
            given: GivenFields {
                location: parsed.zone.is_none() && self.utm_zone.is_some(),
                ..GivenFields::default()
            },
        };
        (source, position.doubt)
    }

    fn facts_of_photo(&self, image: &[u8]) -> Source {
        if self.ignores_exif {
            return Source::default();
        }
        let exif = read_exif(image);
        let zone = self.timezone.as_ref();
        let in_zone = zone.and_then(|zone| zone.instant(exif.local_time?));
        Source {
            row: Row {
                location: exif.location,
                alt: exif.alt,
                heading: exif.heading,
                captured_at: in_zone.or(exif.captured_at),
            },
            given: GivenFields {
                captured_at: in_zone.is_some(),
                ..GivenFields::default()
            },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use placeformer_core::types::GeoPoint;
    use std::path::PathBuf;

    const UTM: &str = "@500000@5000000@@@@@@@123@.jpg";

    fn id() -> ExternalId {
        "x".parse().unwrap()
    }

    #[test]
    fn rows_come_first_then_names() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("positions.csv");
        let csv = format!(
            "file,lat,lon,heading,captured_at\r\n\
             a\\b.jpg,45.5,12.25,-90,2026-05-17T09:30:00Z\r\n{UTM},,,10,\r\n"
        );
        std::fs::write(&path, csv).unwrap();
        let photos = ["a/b.jpg", UTM].map(|name| (name.to_owned(), PathBuf::from(name)));
        let metadata = Metadata {
            positions: Positions::read(&path, folder.path(), &photos, None).unwrap(),
            utm_zone: Some("33T".parse().unwrap()),
            ..Metadata::default()
        };
        let facts = metadata.facts("a/b.jpg", id(), b"");
        let fields = &facts.fields;
        assert_eq!(fields.location, Some(GeoPoint::new(45.5, 12.25).unwrap()));
        assert_eq!(fields.heading.unwrap().degrees(), 270.0);
        let micros = fields.captured_at.unwrap().unix_micros();
        assert_eq!(micros, 1_779_010_200_000_000);
        assert!(facts.given.location && facts.given.heading && facts.given.captured_at);
        // The position comes from the name and the zone given, the heading from the row.
        let facts = metadata.facts(UTM, id(), b"");
        let expected = GeoPoint::new(45.153, 15.0).unwrap();
        assert!(facts.fields.location.unwrap().distance_m(expected) < 100.0);
        assert_eq!(facts.fields.heading.unwrap().degrees(), 10.0);
        assert!(facts.given.location && facts.given.heading);
        let nothing = metadata.facts("unknown.jpg", id(), b"");
        assert_eq!(nothing.fields.location, None);
    }

    #[test]
    fn what_a_name_says_by_itself_is_not_given_and_what_is_wrong_with_it_is_told() {
        let metadata = Metadata::default();
        let facts = metadata.facts("@500000@5000000@33@T@.jpg", id(), b"");
        assert!(facts.fields.location.is_some());
        assert_eq!((facts.given, facts.doubt), (GivenFields::default(), None));
        let facts = metadata.facts("@48.85@2.29@.jpg", id(), b"");
        assert_eq!(facts.fields.location, None);
        assert!(facts.doubt.unwrap().contains("UTM"));
    }
}
