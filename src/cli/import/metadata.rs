//! Position, heading and time of a photo: from the positions file, else from its name, else from
//! its EXIF.
//!
//! Each field is taken from the first source that has it.

use anyhow::{Context, anyhow, bail, ensure};
use placeformer_core::geography::{UtmName, UtmZone};
use placeformer_core::types::{ExternalId, GeoPoint, Heading, ReferenceFields, Timestamp};
use placeformer_vision::image::read_exif;
use std::collections::{HashMap, HashSet};
use std::path::Path;

/// What is known of the photos from other sources than their content.
pub(super) struct Metadata {
    /// The rows of the positions file by the photo's name.
    rows: HashMap<String, Row>,
    /// The zone of names that carry a UTM position without one.
    zone: Option<UtmZone>,
    require_position: bool,
}

#[derive(Debug, Clone, Copy, Default, PartialEq)]
struct Row {
    location: Option<GeoPoint>,
    heading: Option<Heading>,
    captured_at: Option<Timestamp>,
}

impl Row {
    /// Each field of this row, or that of `other` where this one has none.
    fn or(self, other: Self) -> Self {
        Self {
            location: self.location.or(other.location),
            heading: self.heading.or(other.heading),
            captured_at: self.captured_at.or(other.captured_at),
        }
    }
}

impl Metadata {
    /// Reads the positions file, if there is one. Its rows name photos by their path from `folder`
    /// or from the folder in which the file itself lies.
    pub(super) fn read(
        positions: Option<&Path>,
        folder: &Path,
        zone: Option<UtmZone>,
        require_position: bool,
    ) -> anyhow::Result<Self> {
        let rows = match positions {
            Some(path) => {
                let rows = read_positions(path)
                    .with_context(|| format!("cannot use {}", path.display()))?;
                named_from(folder, path, rows)
            }
            None => HashMap::new(),
        };
        Ok(Self {
            rows,
            zone,
            require_position,
        })
    }

    /// Rows that name none of the images, sorted.
    pub(super) fn without_image<'a>(&self, images: impl Iterator<Item = &'a str>) -> Vec<&str> {
        let images: HashSet<&str> = images.collect();
        let mut names: Vec<&str> = self
            .rows
            .keys()
            .map(String::as_str)
            .filter(|name| !images.contains(name))
            .collect();
        names.sort_unstable();
        names
    }

    /// The fields of one photo; the error says that a position was required and none was found.
    pub(super) fn fields(
        &self,
        name: &str,
        external_id: ExternalId,
        image: &[u8],
    ) -> Result<ReferenceFields, String> {
        let listed = self.rows.get(name).copied().unwrap_or_default();
        let named = self.row_of_name(name).unwrap_or_default();
        let row = listed.or(named).or(from_exif(image));
        if self.require_position && row.location.is_none() {
            return Err("no position in the positions file, the name or the EXIF".into());
        }
        Ok(ReferenceFields {
            external_id: Some(external_id),
            location: row.location,
            heading: row.heading,
            captured_at: row.captured_at,
            metadata: None,
        })
    }

    /// What the name says, if it is one of the UTM names.
    fn row_of_name(&self, name: &str) -> Option<Row> {
        let parsed = UtmName::parse(name).ok()?;
        Some(Row {
            location: parsed.location(self.zone),
            heading: parsed.heading,
            captured_at: parsed.captured_at,
        })
    }
}

fn from_exif(image: &[u8]) -> Row {
    let exif = read_exif(image);
    Row {
        location: exif.location,
        heading: exif.heading,
        captured_at: exif.captured_at,
    }
}

/// Renames rows whose names begin at the folder of the positions file to names below `folder`.
fn named_from(folder: &Path, positions: &Path, rows: HashMap<String, Row>) -> HashMap<String, Row> {
    let Some(prefix) = path_down(positions, folder) else {
        return rows;
    };
    rows.into_iter()
        .map(|(file, row)| match file.strip_prefix(&prefix) {
            Some(name) => (name.to_owned(), row),
            None => (file, row),
        })
        .collect()
}

/// The path from the folder of `file` down to `folder`, with a slash at the end; `None` if `folder`
/// does not lie below.
fn path_down(file: &Path, folder: &Path) -> Option<String> {
    let from = file.parent()?.canonicalize().ok()?;
    let to = folder.canonicalize().ok()?;
    let path = to.strip_prefix(from).ok()?.to_str()?.replace('\\', "/");
    (!path.is_empty()).then(|| path + "/")
}

/// Reads the rows of a positions file, by the name of their photo.
fn read_positions(path: &Path) -> anyhow::Result<HashMap<String, Row>> {
    let bytes = std::fs::read(path)?;
    // Spreadsheets begin their files with a byte order mark.
    let bytes = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(&bytes);
    let mut reader = csv::ReaderBuilder::new()
        .trim(csv::Trim::All)
        .from_reader(bytes);
    let headers = reader.headers()?.clone();
    check_columns(&headers)?;
    let mut rows = HashMap::new();
    for record in reader.records() {
        let record = record?;
        let line = record.position().map_or(0, csv::Position::line);
        let field = |name: &str| {
            let column = headers.iter().position(|header| header == name)?;
            record.get(column).filter(|text| !text.is_empty())
        };
        let file = field("file").ok_or_else(|| anyhow!("line {line}: file is empty"))?;
        let file = file.replace('\\', "/");
        let row = parse_row(&field).with_context(|| format!("line {line}"))?;
        let earlier = rows.insert(file.clone(), row);
        ensure!(earlier.is_none(), "line {line}: {file:?} has a row already");
    }
    Ok(rows)
}

fn check_columns(headers: &csv::StringRecord) -> anyhow::Result<()> {
    let known = ["file", "lat", "lon", "heading", "captured_at"];
    if let Some(unknown) = headers.iter().find(|header| !known.contains(header)) {
        bail!("column {unknown:?} is not one of {}", known.join(", "));
    }
    let has_file = headers.iter().any(|header| header == "file");
    ensure!(has_file, "there is no column \"file\"");
    Ok(())
}

fn parse_row<'a>(field: &impl Fn(&str) -> Option<&'a str>) -> anyhow::Result<Row> {
    let number = |name: &str| match field(name) {
        None => Ok(None),
        Some(text) => text
            .parse::<f64>()
            .map(Some)
            .map_err(|_| anyhow!("{name} {text:?} is not a number")),
    };
    let location = match (number("lat")?, number("lon")?) {
        (Some(lat), Some(lon)) => Some(GeoPoint::new(lat, lon)?),
        (None, None) => None,
        _ => bail!("lat and lon must be given both or not at all"),
    };
    let parse_time = |text: &str| text.parse::<Timestamp>().context("captured_at");
    Ok(Row {
        location,
        heading: number("heading")?.map(Heading::new).transpose()?,
        captured_at: field("captured_at").map(parse_time).transpose()?,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(csv: &str) -> anyhow::Result<Metadata> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("positions.csv");
        std::fs::write(&path, csv).unwrap();
        Metadata::read(
            Some(&path),
            folder.path(),
            Some("33T".parse().unwrap()),
            true,
        )
    }

    fn id() -> ExternalId {
        "x".parse().unwrap()
    }

    #[test]
    fn rows_may_be_named_from_where_the_file_lies() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("positions.csv");
        std::fs::write(
            &path,
            "file,lat,lon\ndatabase/a.jpg,1,2\nb.jpg,3,4\nqueries/c.jpg,5,6\n",
        )
        .unwrap();
        let database = folder.path().join("database");
        std::fs::create_dir(&database).unwrap();
        let metadata = Metadata::read(Some(&path), &database, None, true).unwrap();
        assert_eq!(
            metadata.without_image(["a.jpg", "b.jpg"].into_iter()),
            ["queries/c.jpg"]
        );
        let lat = |name: &str| {
            metadata
                .fields(name, id(), b"")
                .unwrap()
                .location
                .unwrap()
                .lat()
        };
        assert_eq!((lat("a.jpg"), lat("b.jpg")), (1.0, 3.0));
    }

    #[test]
    fn rows_come_first_then_names() {
        let csv = "\u{feff}file,lat,lon,heading,captured_at\r\n\
                   a\\b.jpg,45.5,12.25,-90,2026-05-17T09:30:00Z\r\n\
                   @500000@5000000@@@@@@@123@.jpg,,,10,\r\n";
        let metadata = read(csv).unwrap();
        let fields = metadata.fields("a/b.jpg", id(), b"").unwrap();
        assert_eq!(fields.location, Some(GeoPoint::new(45.5, 12.25).unwrap()));
        assert_eq!(fields.heading.unwrap().degrees(), 270.0);
        assert_eq!(
            fields.captured_at.unwrap().instant().unix_timestamp(),
            1_779_010_200
        );
        // The position comes from the name and the zone given, the heading from the row.
        let fields = metadata
            .fields("@500000@5000000@@@@@@@123@.jpg", id(), b"")
            .unwrap();
        assert!(
            fields
                .location
                .unwrap()
                .distance_m(GeoPoint::new(45.153, 15.0).unwrap())
                < 100.0,
            "{fields:?}"
        );
        assert_eq!(fields.heading.unwrap().degrees(), 10.0);
        assert!(metadata.fields("unknown.jpg", id(), b"").is_err());
        assert_eq!(metadata.without_image(["a/b.jpg"].into_iter()).len(), 1);
    }

    #[test]
    fn damaged_rows_are_named_by_line() {
        for (csv, part) in [
            ("file,lat,lon\na.jpg,95,0\n", "line 2"),
            ("file,lat,lon\na.jpg,1,\n", "both or not at all"),
            ("file,lat,lon\na.jpg,north,2\n", "\"north\""),
            ("file,captured_at\na.jpg,yesterday\n", "RFC 3339"),
            ("file,latitude\na.jpg,1\n", "latitude"),
            ("lat,lon\n1,2\n", "\"file\""),
            ("file,lat,lon\na.jpg,1,2\na.jpg,1,2\n", "line 3"),
        ] {
            let error = read(csv).err().unwrap();
            assert!(format!("{error:#}").contains(part), "{error:#}");
        }
    }
}
