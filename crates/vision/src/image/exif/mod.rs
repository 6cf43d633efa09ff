//! What a photo says about itself: which side is up, and where, in which direction and when it was
//! taken. It says so in EXIF, in XMP, or in both.
//!
//! These blocks are often missing and often broken, so nothing here fails: a value that is
//! malformed or out of range counts as missing.
//!
//! They may also be made to keep a reader busy: directories that contain each other, thousands of
//! entries that share their bytes, values of four billion items. So the format is recognised first,
//! at most a few blocks of 64 KiB are looked at, each of three directories is read once, and only
//! the values that are used are read at all. The cost is linear in the length of the file.
//!
//! | module | holds |
//! |---|---|
//! | `block` | finding the blocks in a JPEG, PNG or WebP |
//! | `tiff` | directories and values of an EXIF block |
//! | `gps` | position, heading and time of the receiver |
//! | `moment` | which of several times to believe |
//! | `xmp` | the same facts from an XMP block |

mod block;
mod gps;
mod moment;
mod tiff;
mod xmp;

use ::image::metadata::Orientation;
use block::Blocks;
use gps::Gps;
use moment::Moment;
use placeformer_core::clock::{Clock, parse_fraction, parse_utc_offset};
use placeformer_core::types::{Altitude, GeoPoint, Heading, Timestamp};
use tiff::{Directory, Tiff};
use time::PrimitiveDateTime;
use xmp::Xmp;

/// Where, in which direction and when a photo was taken, as far as the photo itself says so. EXIF
/// comes before XMP.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ExifInfo {
    /// Position. There is none if the receiver marked it as invalid, if the hemisphere is unknown,
    /// or if it is (0, 0) and nothing else says that there was a fix.
    pub location: Option<GeoPoint>,
    /// Height in metres, by EXIF. There is none without a position.
    pub alt: Option<Altitude>,
    /// Direction in which the camera looked, in degrees. A bearing from magnetic north is not
    /// corrected.
    pub heading: Option<Heading>,
    /// When it was taken: DateTimeOriginal (else DateTimeDigitized) with its UTC offset. Without an
    /// offset it is the GPS time, which is in UTC, if that can be right. Without that too, the
    /// camera's clock is taken as UTC. The year is one of 1 to 9999, in UTC as well.
    pub captured_at: Option<Timestamp>,
    /// What the camera's clock showed, if `captured_at` is that, taken as UTC.
    pub local_time: Option<PrimitiveDateTime>,
    /// Which block each field comes from.
    pub sources: ExifSources,
}

/// Which block each field of an [`ExifInfo`] comes from; `None` where there is no value.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct ExifSources {
    /// That of the position.
    pub location: Option<MetadataBlock>,
    /// That of the height.
    pub alt: Option<MetadataBlock>,
    /// That of the heading.
    pub heading: Option<MetadataBlock>,
    /// That of the time.
    pub captured_at: Option<MetadataBlock>,
}

/// A kind of block in which a photo describes itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MetadataBlock {
    /// Tags in directories, written by the camera.
    Exif,
    /// XML, written by drones, panorama cameras and editors.
    Xmp,
}

/// Reads position, direction and time from a JPEG, PNG or WebP. Anything else says nothing.
pub fn read_exif(bytes: &[u8]) -> ExifInfo {
    let blocks = Blocks::find(bytes);
    let exif = ExifFacts::merged(&blocks);
    let xmp = Xmp::merged(&blocks);
    let (captured_at, time_source) = first(exif.moment(), Moment::of(xmp.clock, None));
    // A receiver that says that it had no fix says so about what others copied from it, too.
    let xmp_location = xmp.location.filter(|_| !exif.gps.is_void);
    let (location, location_source) = first(exif.gps.location, xmp_location);
    let (heading, heading_source) = first(exif.gps.heading, xmp.heading);
    // A receiver that had no fix noted no height either.
    let (alt, alt_source) = first(exif.gps.alt.filter(|_| location.is_some()), None);
    ExifInfo {
        location,
        alt,
        heading,
        captured_at: captured_at.map(|moment| moment.at),
        local_time: captured_at.and_then(|moment| moment.local),
        sources: ExifSources {
            location: location_source,
            alt: alt_source,
            heading: heading_source,
            captured_at: time_source,
        },
    }
}

fn first<T>(exif: Option<T>, xmp: Option<T>) -> (Option<T>, Option<MetadataBlock>) {
    let source = match (&exif, &xmp) {
        (Some(_), _) => Some(MetadataBlock::Exif),
        (None, Some(_)) => Some(MetadataBlock::Xmp),
        (None, None) => None,
    };
    (exif.or(xmp), source)
}

/// How the stored pixels must be turned.
pub(super) fn orientation(bytes: &[u8]) -> Orientation {
    let blocks = Blocks::find(bytes);
    let stated = blocks.exif.iter().find_map(|block| {
        let tiff = Tiff::new(block)?;
        stated_orientation(&tiff.first_directory(&[ORIENTATION]))
    });
    stated.unwrap_or(Orientation::NoTransforms)
}

fn stated_orientation(directory: &Directory<'_>) -> Option<Orientation> {
    let value = directory.field(ORIENTATION)?.number(0)?;
    let is_stated = (1.0..=8.0).contains(&value) && value.fract() == 0.0;
    // The value is one of 1 to 8.
    is_stated.then(|| Orientation::from_exif(value as u8))?
}

// Tags of the first directory.
const ORIENTATION: u16 = 0x0112;
const EXIF_DIRECTORY: u16 = 0x8769;
const GPS_DIRECTORY: u16 = 0x8825;

// Tags of the EXIF directory.
const DATE_TIME_ORIGINAL: u16 = 0x9003;
const DATE_TIME_DIGITIZED: u16 = 0x9004;
const OFFSET_TIME: u16 = 0x9010;
const OFFSET_TIME_ORIGINAL: u16 = 0x9011;
const OFFSET_TIME_DIGITIZED: u16 = 0x9012;
const SUBSEC_TIME: u16 = 0x9290;
const SUBSEC_TIME_ORIGINAL: u16 = 0x9291;
const SUBSEC_TIME_DIGITIZED: u16 = 0x9292;

const EXIF_TAGS: [u16; 8] = [
    DATE_TIME_ORIGINAL,
    DATE_TIME_DIGITIZED,
    OFFSET_TIME,
    OFFSET_TIME_ORIGINAL,
    OFFSET_TIME_DIGITIZED,
    SUBSEC_TIME,
    SUBSEC_TIME_ORIGINAL,
    SUBSEC_TIME_DIGITIZED,
];

/// What the EXIF blocks of a photo say.
#[derive(Debug, Clone, Copy, Default)]
struct ExifFacts {
    /// DateTimeOriginal, else DateTimeDigitized.
    clock: Option<Clock>,
    gps: Gps,
}

impl ExifFacts {
    /// The facts of all blocks; of each the first that there is.
    fn merged(blocks: &Blocks<'_>) -> Self {
        let facts = blocks.exif.iter().filter_map(|block| Self::read(block));
        facts.fold(Self::default(), |known, more| Self {
            clock: known.clock.or(more.clock),
            gps: known.gps.or(more.gps),
        })
    }

    fn read(block: &[u8]) -> Option<Self> {
        let tiff = Tiff::new(block)?;
        let first = tiff.first_directory(&[EXIF_DIRECTORY, GPS_DIRECTORY]);
        let exif = tiff.child_directory(&first, EXIF_DIRECTORY, &EXIF_TAGS);
        let gps = tiff.child_directory(&first, GPS_DIRECTORY, &gps::TAGS);
        Some(Self {
            clock: exif.and_then(|exif| clock(&exif)),
            gps: gps.map(|gps| Gps::read(&gps)).unwrap_or_default(),
        })
    }

    fn moment(&self) -> Option<Moment> {
        Moment::of(self.clock, self.gps.time)
    }
}

fn clock(exif: &Directory<'_>) -> Option<Clock> {
    let original = || {
        let parts = [
            DATE_TIME_ORIGINAL,
            SUBSEC_TIME_ORIGINAL,
            OFFSET_TIME_ORIGINAL,
        ];
        clock_of_tags(exif, parts)
    };
    let digitized = || {
        let parts = [
            DATE_TIME_DIGITIZED,
            SUBSEC_TIME_DIGITIZED,
            OFFSET_TIME_DIGITIZED,
        ];
        clock_of_tags(exif, parts)
    };
    original().or_else(digitized)
}

/// A time with its fraction and offset, which may be part of its text, or in tags of their own, or
/// in the tags of the file's time, because many cameras write only those.
fn clock_of_tags(exif: &Directory<'_>, [time, fraction, offset]: [u16; 3]) -> Option<Clock> {
    let text = |tag| exif.field(tag)?.text();
    let mut clock = Clock::parse(&text(time)?)?;
    if clock.local.nanosecond() == 0 {
        let fraction = [fraction, SUBSEC_TIME].into_iter().find_map(text);
        let nanoseconds = fraction.and_then(|digits| parse_fraction(&digits));
        // Nine digits are fewer nanoseconds than a second has.
        let exact = clock.local.replace_nanosecond(nanoseconds.unwrap_or(0));
        clock.local = exact.unwrap_or(clock.local);
    }
    let offsets = [offset, OFFSET_TIME].into_iter().filter_map(text);
    let offset = || offsets.into_iter().find_map(|text| parse_utc_offset(&text));
    clock.offset = clock.offset.or_else(offset);
    Some(clock)
}

#[cfg(test)]
mod tests;
