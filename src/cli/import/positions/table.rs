//! Reads a table of positions.
//!
//! Spreadsheets write UTF-8 with a mark before it, or UTF-16. Where the comma is the decimal point,
//! they separate columns by semicolons. Every tool has its own headings, and columns of its own. So
//! the delimiter is the one with which the first line has the most known headings, headings have
//! synonyms, and other columns are passed over. A value that cannot be understood ends the reading,
//! with its line: a position that is silently missing is found too late.

use super::Row;
use crate::cli::import::timezone::ClockZone;
use anyhow::{Context, anyhow, bail, ensure};
use csv::{ReaderBuilder, StringRecord, Trim};
use placeformer_core::clock::Clock;
use placeformer_core::printable::Printable;
use placeformer_core::types::{Altitude, GeoPoint, Heading, Timestamp};

/// A meaning with the headings for it, in lower case without spaces, dashes and underscores. Of two
/// columns with the same meaning, the one whose heading stands first here counts.
type Synonyms = (&'static str, &'static [&'static str]);

const FILE: Synonyms = (
    "file",
    &[
        "file",
        "filename",
        "sourcefile",
        "image",
        "imagename",
        "imagefile",
        "photo",
        "path",
        "filepath",
        "imagepath",
        "name",
        "key",
    ],
);
const LAT: Synonyms = ("lat", &["lat", "latitude", "gpslatitude", "y"]);
const LON: Synonyms = (
    "lon",
    &["lon", "lng", "long", "longitude", "gpslongitude", "x"],
);
const ALT: Synonyms = (
    "alt",
    &["alt", "altitude", "gpsaltitude", "elevation", "height", "z"],
);
const HEADING: Synonyms = (
    "heading",
    &[
        "heading",
        "headingdeg",
        "bearing",
        "azimuth",
        "compassangle",
        "gpsimgdirection",
        "yaw",
        "ca",
    ],
);
const CAPTURED_AT: Synonyms = (
    "captured_at",
    &["capturedat", "captured", "capturetime", "datetimeoriginal"],
);

/// The delimiters that are tried, the usual one first.
const DELIMITERS: [u8; 4] = [b',', b';', b'\t', b'|'];

/// A row and the file that it names.
pub(super) struct NamedRow {
    pub(super) line: u64,
    /// The name with `/` on every system.
    pub(super) file: String,
    pub(super) row: Row,
}

/// A table that was read.
pub(super) struct Table {
    pub(super) rows: Vec<NamedRow>,
    /// How its columns were read, in words.
    pub(super) columns: String,
}

/// Reads the bytes of a file. Times without an offset are in `zone`.
pub(super) fn read(bytes: &[u8], zone: Option<&ClockZone>) -> anyhow::Result<Table> {
    let text = decode(bytes)?;
    // Spreadsheets may name the delimiter in a line of its own.
    let text = match text.split_once('\n') {
        Some((first, rest)) if first.starts_with("sep=") => rest,
        _ => &text,
    };
    let headings = |delimiter: u8| {
        reader(text, delimiter)
            .headers()
            .cloned()
            .unwrap_or_default()
    };
    let known = |delimiter: &u8| Columns::find(&headings(*delimiter)).known();
    // The first of the best, as the usual delimiter stands first.
    let best = DELIMITERS.into_iter().rev().max_by_key(known);
    let mut reader = reader(text, best.unwrap_or(b','));
    let headings = reader.headers()?.clone();
    let columns = Columns::find(&headings);
    columns.check(&headings)?;
    let mut rows = Vec::new();
    for record in reader.records() {
        let record = record?;
        let line = record.position().map_or(0, csv::Position::line);
        if record.iter().all(str::is_empty) {
            continue;
        }
        let row = read_row(&record, &headings, &columns, zone);
        let (file, row) = row.with_context(|| format!("line {line}"))?;
        rows.push(NamedRow { line, file, row });
    }
    Ok(Table {
        rows,
        columns: columns.describe(&headings),
    })
}

fn reader(text: &str, delimiter: u8) -> csv::Reader<&[u8]> {
    ReaderBuilder::new()
        .delimiter(delimiter)
        .trim(Trim::All)
        .flexible(true)
        .from_reader(text.as_bytes())
}

/// The text of UTF-8 or UTF-16, with a byte order mark or without.
fn decode(bytes: &[u8]) -> anyhow::Result<String> {
    let utf16 = |rest: &[u8], unit: fn([u8; 2]) -> u16| {
        let (units, rest) = rest.as_chunks();
        ensure!(rest.is_empty(), "its UTF-16 ends within a character");
        let units = units.iter().map(|bytes| unit(*bytes));
        let text: Result<String, _> = char::decode_utf16(units).collect();
        text.context("it is not whole UTF-16")
    };
    match bytes {
        [0xff, 0xfe, rest @ ..] => return utf16(rest, u16::from_le_bytes),
        [0xfe, 0xff, rest @ ..] => return utf16(rest, u16::from_be_bytes),
        // A table begins with a letter, of which UTF-16 makes two bytes, one of them zero.
        [first, 0, ..] if *first != 0 => return utf16(bytes, u16::from_le_bytes),
        [0, first, ..] if *first != 0 => return utf16(bytes, u16::from_be_bytes),
        _ => {}
    }
    let bytes = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes);
    let text = std::str::from_utf8(bytes);
    let text = text.context("it is neither UTF-8 nor UTF-16; save it as UTF-8")?;
    Ok(text.to_owned())
}

/// Where the columns are that are used.
#[derive(Default)]
struct Columns {
    file: Option<usize>,
    lat: Option<usize>,
    lon: Option<usize>,
    alt: Option<usize>,
    heading: Option<usize>,
    captured_at: Option<usize>,
}

impl Columns {
    fn find(headings: &StringRecord) -> Self {
        let plain = |heading: &str| {
            let letters = heading.chars().filter(|c| !matches!(c, ' ' | '_' | '-'));
            letters.flat_map(char::to_lowercase).collect::<String>()
        };
        let headings: Vec<String> = headings.iter().map(plain).collect();
        let column = |(_, synonyms): Synonyms| {
            let at = |synonym: &&str| headings.iter().position(|heading| heading == synonym);
            synonyms.iter().find_map(at)
        };
        Self {
            file: column(FILE),
            lat: column(LAT),
            lon: column(LON),
            alt: column(ALT),
            heading: column(HEADING),
            captured_at: column(CAPTURED_AT),
        }
    }

    fn all(&self) -> [(&'static str, Option<usize>); 6] {
        [
            (FILE.0, self.file),
            (LAT.0, self.lat),
            (LON.0, self.lon),
            (ALT.0, self.alt),
            (HEADING.0, self.heading),
            (CAPTURED_AT.0, self.captured_at),
        ]
    }

    fn known(&self) -> usize {
        self.all().iter().filter(|(_, at)| at.is_some()).count()
    }

    fn check(&self, headings: &StringRecord) -> anyhow::Result<()> {
        let shown: Vec<&str> = headings.iter().take(20).collect();
        let shown = Printable(shown.join(", ")).to_string();
        ensure!(
            self.file.is_some(),
            "there is no column \"file\" among: {shown}"
        );
        ensure!(
            self.lat.is_some() == self.lon.is_some(),
            "there are no columns for both latitude and longitude among: {shown}"
        );
        ensure!(
            self.known() > 1,
            "there is no column for a position, height, heading or time among: {shown}"
        );
        Ok(())
    }

    /// For people: which column is read as what, and which are not.
    fn describe(&self, headings: &StringRecord) -> String {
        let named = |(name, at): (&str, Option<usize>)| {
            let heading = headings.get(at?)?;
            Some(format!("{name} from \"{}\"", Printable(heading)))
        };
        let read: Vec<String> = self.all().into_iter().filter_map(named).collect();
        let is_read = |index: usize| self.all().iter().any(|(_, at)| *at == Some(index));
        let others = (0..headings.len()).filter(|index| !is_read(*index)).count();
        match others {
            0 => read.join(", "),
            _ => format!("{}; {others} other columns are not read", read.join(", ")),
        }
    }
}

fn read_row(
    record: &StringRecord,
    headings: &StringRecord,
    columns: &Columns,
    zone: Option<&ClockZone>,
) -> anyhow::Result<(String, Row)> {
    // With a comma as the decimal point and between columns, a row is longer than its headings.
    let extra = record.iter().skip(headings.len());
    ensure!(
        record.len() >= headings.len() && extra.into_iter().all(str::is_empty),
        "it has {} fields, and there are {} headings",
        record.len(),
        headings.len()
    );
    let field = |column: Option<usize>| record.get(column?).filter(|text| !text.is_empty());
    let file = field(columns.file).ok_or_else(|| anyhow!("file is empty"))?;
    let number = |name, column| field(column).map(|text| number(name, text)).transpose();
    let location = match (number("lat", columns.lat)?, number("lon", columns.lon)?) {
        (Some(lat), Some(lon)) => Some(GeoPoint::new(lat, lon)?),
        (None, None) => None,
        _ => bail!("lat and lon must be given both or not at all"),
    };
    let alt = number("alt", columns.alt)?;
    let heading = number("heading", columns.heading)?;
    let captured_at = field(columns.captured_at).map(|text| parse_time(text, zone));
    let row = Row {
        location,
        alt: alt.map(Altitude::new).transpose()?,
        heading: heading.map(Heading::new).transpose()?,
        captured_at: captured_at.transpose()?,
    };
    Ok((file.replace('\\', "/"), row))
}

/// A number with a point or a comma before its decimals.
fn number(name: &str, text: &str) -> anyhow::Result<f64> {
    let has_decimal_comma = text.matches(',').count() == 1 && !text.contains('.');
    let parsed = match has_decimal_comma {
        true => text.replace(',', ".").parse(),
        false => text.parse(),
    };
    parsed.map_err(|_| anyhow!("{name} \"{}\" is not a number", Printable(text)))
}

fn parse_time(text: &str, zone: Option<&ClockZone>) -> anyhow::Result<Timestamp> {
    let shown = Printable(text);
    let clock = Clock::parse(text);
    let clock = clock
        .ok_or_else(|| anyhow!("captured_at \"{shown}\" is not a time as RFC 3339 writes it"))?;
    let instant = match (clock.offset, zone) {
        (Some(_), _) => clock.instant(),
        (None, Some(zone)) => zone.instant(clock.local),
        (None, None) => bail!(
            "captured_at \"{shown}\" has no offset from UTC, as RFC 3339 asks for; give --timezone"
        ),
    };
    instant.ok_or_else(|| anyhow!("captured_at \"{shown}\" is outside the years 1 to 9999"))
}
