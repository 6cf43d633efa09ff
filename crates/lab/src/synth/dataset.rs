//! A map and its queries as a folder, in the layout that place recognition data sets share.

use super::light::Condition;
use super::random::{Dice, seed_of};
use super::world::{Capture, PLACES_PER_STREET, StreetWorld, Viewpoint};
use placeformer_core::progress::{Progress, Task};
use placeformer_core::types::{GeoPoint, Heading, ImageSize};
use placeformer_vision::image::{ImageError, encode_jpeg};
use rayon::prelude::*;
use std::fs;
use std::path::{Path, PathBuf};
use time::format_description::well_known::Rfc3339;
use time::{Duration, OffsetDateTime};

/// A query matches references no farther than this in metres.
const MATCH_RADIUS_M: f64 = 25.0;
/// A query matches references whose heading differs by no more than this in degrees: beyond it the
/// two cameras see different fronts.
const MATCH_TURN_DEG: f64 = 45.0;
const JPEG_QUALITY: u8 = 90;
/// 2026-05-04T10:00:00Z.
const FIRST_CAPTURE: i64 = 1_777_888_800;

/// What to write.
#[derive(Debug, Clone)]
pub struct TownOptions {
    /// Mapped places.
    pub places: u64,
    /// Reference images of each place.
    pub views: u64,
    /// Seed of the town.
    pub seed: u64,
    /// Size of every image.
    pub size: ImageSize,
    /// Conditions of the queries, in turn; references are taken by day.
    pub conditions: Vec<Condition>,
}

/// What was written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TownSummary {
    /// Images in `database/`.
    pub references: usize,
    /// Images in `queries/`.
    pub queries: usize,
    /// Of these, how many show a place that is not mapped.
    pub unmatched: usize,
}

/// Why a data set was not written.
#[derive(Debug, thiserror::Error)]
pub enum SynthError {
    /// A file or folder cannot be written.
    #[error("cannot write {}: {source}", path.display())]
    Write {
        /// Which.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// A table cannot be written.
    #[error("cannot write {}: {source}", path.display())]
    Table {
        /// Which.
        path: PathBuf,
        /// The cause.
        source: csv::Error,
    },
    /// The folder already holds images, which would mix with the new ones.
    #[error("{} already holds images; choose an empty folder", .0.display())]
    NotEmpty(PathBuf),
    /// An image cannot be encoded, or has no pixels.
    #[error(transparent)]
    Image(#[from] ImageError),
    /// Nothing to render.
    #[error("{0}")]
    Nothing(&'static str),
}

/// One image of the set.
struct Shot {
    folder: &'static str,
    name: String,
    place: u64,
    viewpoint: Viewpoint,
    capture: Capture,
    location: GeoPoint,
    heading: Heading,
    captured_at: OffsetDateTime,
}

/// Renders `database/`, `queries/`, `ground_truth.csv` (query, reference) and `positions.csv`
/// (file, lat, lon, heading, captured_at) into `folder`; `progress` is told of each image.
///
/// # Errors
/// See [`SynthError`]. The tables are written last, so a folder that has them is complete.
pub fn write_town(
    folder: &Path,
    options: &TownOptions,
    progress: &dyn Progress,
) -> Result<TownSummary, SynthError> {
    if options.places == 0 || options.views == 0 || options.conditions.is_empty() {
        return Err(SynthError::Nothing(
            "a data set needs at least one place, one view and one condition",
        ));
    }
    let world = StreetWorld::new(options.seed);
    let references = references(world, options);
    let queries = queries(world, options);
    for name in ["database", "queries"] {
        make_empty(&folder.join(name))?;
    }
    let images = (references.len() + queries.len()) as u64;
    let task = Task::begin(progress, "rendering images", images);
    references.par_iter().chain(&queries).try_for_each(|shot| {
        let image = world.render_capture(shot.place, shot.viewpoint, shot.capture, options.size);
        let path = folder.join(shot.folder).join(&shot.name);
        let bytes = encode_jpeg(&image, JPEG_QUALITY)?;
        fs::write(&path, bytes).map_err(|source| SynthError::Write { path, source })?;
        task.add(1);
        Ok::<_, SynthError>(())
    })?;
    let unmatched = write_ground_truth(&folder.join("ground_truth.csv"), &queries, &references)?;
    write_positions(
        &folder.join("positions.csv"),
        references.iter().chain(&queries),
    )?;
    Ok(TownSummary {
        references: references.len(),
        queries: queries.len(),
        unmatched,
    })
}

fn unmatched_count(options: &TownOptions) -> u64 {
    options.places.div_ceil(10)
}

/// Views of a place in turn: ahead and to either side, so that every front is mapped.
fn reference_viewpoint(world: StreetWorld, place: u64, view: u64) -> Viewpoint {
    let mut dice = Dice::new(&[world.seed, 0xdb, place, view]);
    let side = if (place + view).is_multiple_of(2) {
        1.0
    } else {
        -1.0
    };
    Viewpoint {
        along_m: f64::from(dice.real(-3.0..3.0)),
        across_m: -side * f64::from(dice.real(0.8..2.6)),
        turn_deg: side * f64::from(dice.real(38.0..62.0)),
    }
}

fn references(world: StreetWorld, options: &TownOptions) -> Vec<Shot> {
    let views =
        (0..options.places).flat_map(|place| (0..options.views).map(move |view| (place, view)));
    views
        .map(|(place, view)| {
            let viewpoint = reference_viewpoint(world, place, view);
            let capture = Capture::new(Condition::Day, seed_of(&[world.seed, 0xdb, place, view]));
            shot(world, "database", (place, view), viewpoint, capture)
        })
        .collect()
}

/// One query of every place, from elsewhere, in other light and more traffic; then some of places
/// that nobody mapped.
fn queries(world: StreetWorld, options: &TownOptions) -> Vec<Shot> {
    // Unmapped places lie on streets of their own, a street away from the last mapped one.
    let beyond = (options.places / PLACES_PER_STREET + 2) * PLACES_PER_STREET;
    let unmapped = (0..unmatched_count(options)).map(|i| beyond + i);
    (0..options.places)
        .chain(unmapped)
        .enumerate()
        .map(|(number, place)| {
            let mut dice = Dice::new(&[world.seed, 0x9e5, place]);
            let view = dice.whole(0..options.views as usize) as u64;
            let mapped = reference_viewpoint(world, place, view);
            let viewpoint = Viewpoint {
                along_m: mapped.along_m + f64::from(dice.real(-3.5..3.5)),
                across_m: mapped.across_m + f64::from(dice.real(-1.2..1.2)),
                turn_deg: mapped.turn_deg + f64::from(dice.real(-13.0..13.0)),
            };
            let condition = options.conditions[number % options.conditions.len()];
            let moment = seed_of(&[world.seed, 0x9e5, place, 1]);
            let capture = Capture {
                condition,
                traffic: dice.real(0.8..2.0),
                moment,
            };
            shot(world, "queries", (place, view), viewpoint, capture)
        })
        .collect()
}

fn shot(
    world: StreetWorld,
    folder: &'static str,
    (place, view): (u64, u64),
    viewpoint: Viewpoint,
    capture: Capture,
) -> Shot {
    let location = world.position(place, viewpoint);
    let heading = world.heading(viewpoint);
    let hour = if capture.condition == Condition::Dusk {
        10
    } else {
        0
    };
    let days = if folder == "queries" { 45 } else { 0 };
    let offset =
        Duration::days(days) + Duration::hours(hour) + Duration::seconds((place % 3600) as i64);
    // A fixed date in range plus at most 46 days.
    let captured_at = OffsetDateTime::from_unix_timestamp(FIRST_CAPTURE)
        .unwrap_or(OffsetDateTime::UNIX_EPOCH)
        + offset;
    let name = file_name(
        location,
        heading,
        captured_at,
        &format!("p{place:06}v{view}"),
        capture.condition,
    );
    Shot {
        folder,
        name,
        place,
        viewpoint,
        capture,
        location,
        heading,
        captured_at,
    }
}

/// The name of an image in the layout of the field: `@utm_east@utm_north@zone@band@lat@lon`, then
/// `@panorama@tile@heading@pitch@roll@height@timestamp@note@.jpg`.
fn file_name(
    location: GeoPoint,
    heading: Heading,
    at: OffsetDateTime,
    id: &str,
    condition: Condition,
) -> String {
    let lat = location.lat();
    let lon = location.lon();
    let (north, east, _) = utm::to_utm_wgs84_no_zone(lat, lon);
    let zone = utm::lat_lon_to_zone_number(lat, lon);
    let band = utm::lat_to_zone_letter(lat).unwrap_or('X');
    let stamp = format!("{:04}{:02}{:02}", at.year(), u8::from(at.month()), at.day());
    let heading = heading.degrees();
    format!(
        "@{east:.2}@{north:.2}@{zone}@{band}@{lat:.6}@{lon:.6}\
         @{id}@@{heading:.1}@@@@{stamp}@{condition}@.jpg"
    )
}

fn make_empty(folder: &Path) -> Result<(), SynthError> {
    let fail = |source| SynthError::Write {
        path: folder.to_owned(),
        source,
    };
    fs::create_dir_all(folder).map_err(fail)?;
    match fs::read_dir(folder).map_err(fail)?.next() {
        Some(_) => Err(SynthError::NotEmpty(folder.to_owned())),
        None => Ok(()),
    }
}

/// One accepted pair a row; a query without any has one row with an empty reference. Returns how
/// many have none.
fn write_ground_truth(
    path: &Path,
    queries: &[Shot],
    references: &[Shot],
) -> Result<usize, SynthError> {
    let mut rows = vec![["query".to_owned(), "reference".to_owned()]];
    let mut unmatched = 0;
    for query in queries {
        let matches = references
            .iter()
            .filter(|reference| shows_the_same(query, reference));
        let before = rows.len();
        rows.extend(matches.map(|reference| [query.name.clone(), reference.name.clone()]));
        if rows.len() == before {
            unmatched += 1;
            rows.push([query.name.clone(), String::new()]);
        }
    }
    write_table(path, rows)?;
    Ok(unmatched)
}

fn shows_the_same(query: &Shot, reference: &Shot) -> bool {
    let turn =
        (query.heading.degrees() - reference.heading.degrees() + 540.0).rem_euclid(360.0) - 180.0;
    turn.abs() <= MATCH_TURN_DEG && query.location.distance_m(reference.location) <= MATCH_RADIUS_M
}

fn write_positions<'a>(
    path: &Path,
    shots: impl Iterator<Item = &'a Shot>,
) -> Result<(), SynthError> {
    let header = ["file", "lat", "lon", "heading", "captured_at"].map(str::to_owned);
    let rows = shots.map(|shot| {
        [
            format!("{}/{}", shot.folder, shot.name),
            format!("{:.7}", shot.location.lat()),
            format!("{:.7}", shot.location.lon()),
            format!("{:.1}", shot.heading.degrees()),
            // Years 0 to 9999 always format.
            shot.captured_at.format(&Rfc3339).unwrap_or_default(),
        ]
    });
    write_table(path, std::iter::once(header).chain(rows))
}

fn write_table<const N: usize>(
    path: &Path,
    rows: impl IntoIterator<Item = [String; N]>,
) -> Result<(), SynthError> {
    let fail = |source| SynthError::Table {
        path: path.to_owned(),
        source,
    };
    let mut writer = csv::Writer::from_path(path).map_err(fail)?;
    rows.into_iter()
        .try_for_each(|row| writer.write_record(row))
        .map_err(fail)?;
    writer.flush().map_err(|source| SynthError::Write {
        path: path.to_owned(),
        source,
    })
}

#[cfg(test)]
mod tests;
