//! `images/{train,val,test}/{database,queries}` with `@utm_east@utm_north@...` names: Pitts30k,
//! Tokyo 24/7, St Lucia, SPED, MSLS and others after the common downloader, which leaves `images/`
//! out for MSLS.
//!
//! Zones that touch are projected into one; zones that do not (MSLS has San Francisco and
//! Copenhagen) are kept apart as groups, see `zones`.

use super::dataset::{Dataset, Item, Skipped};
use super::error::DatasetError;
use super::kind::Split;
use super::layout::require;
use super::neighbours::truth_by_distance;
use super::options::DatasetOptions;
use super::zones::Zones;
use crate::choice::Choice;
use placeformer_core::folder::list_images;
use placeformer_core::geography::MetricPoint;
use placeformer_core::geography::{UtmName, UtmZone};
use std::path::{Path, PathBuf};

const EXPECTED: &str =
    "images/{train,val,test}/{database,queries} with @utm_east@utm_north@...@.jpg names";

/// The group of images that name no zone, where other images are of several regions.
const NO_ZONE: &str = "zone unknown";

/// Reads one split; positives by radius, and by view angle where the options ask for it and the
/// names give it.
pub(super) fn load(
    name: &'static str,
    root: &Path,
    options: &DatasetOptions,
) -> Result<Dataset, DatasetError> {
    let split = options.split.unwrap_or(Split::Test);
    let folder = find_split(root, split).ok_or_else(|| DatasetError::Layout {
        dataset: name,
        path: root.join("images").join(split.as_str()),
        expected: EXPECTED,
    })?;
    let database_dir = require(name, folder.join("database"), EXPECTED)?;
    let queries_dir = require(name, folder.join("queries"), EXPECTED)?;
    let mut skipped = Vec::new();
    let mut database = read(&database_dir, &mut skipped)?;
    let mut queries = read(&queries_dir, &mut skipped)?;
    let mut notes = project([&mut database, &mut queries]);
    let database = items(database);
    let queries = items(queries);
    if let Some(angle) = options.max_angle_deg {
        notes.push(format!(
            "positives lie within {} m and {angle} degrees of view angle",
            options.radius_m
        ));
        let all = database.iter().chain(&queries);
        let without = all.filter(|item| item.heading.is_none()).count();
        if without > 0 {
            notes.push(format!(
                "{without} images have no view angle; for them only the distance counts"
            ));
        }
    }
    let truth = truth_by_distance(&database, &queries, options.radius_m, options.max_angle_deg);
    Ok(Dataset {
        name: name.into(),
        database,
        queries,
        truth,
        skipped,
        notes,
    })
}

/// The split's folder: below `images`, below the root, or the root itself where that already holds
/// both sides.
pub(super) fn find_split(root: &Path, split: Split) -> Option<PathBuf> {
    let both =
        |folder: &PathBuf| folder.join("database").exists() && folder.join("queries").exists();
    // Below `images` the layout is named so clearly that a missing side is worth its own message.
    let nested = root.join("images").join(split.as_str());
    if nested.exists() {
        return Some(nested);
    }
    [root.join(split.as_str()), root.to_owned()]
        .into_iter()
        .find(both)
}

/// An image and the grid its coordinates refer to.
struct GridImage {
    item: Item,
    point: MetricPoint,
    zone: Option<UtmZone>,
}

fn read(folder: &Path, skipped: &mut Vec<Skipped>) -> Result<Vec<GridImage>, DatasetError> {
    let mut images = Vec::new();
    for (name, path) in list_images(folder)? {
        match UtmName::parse(&name) {
            Ok(parsed) => {
                let heading = parsed.heading.map(|heading| heading.degrees());
                let item = Item {
                    position: Some(parsed.point),
                    heading,
                    ..Item::new(name, path)
                };
                images.push(GridImage {
                    item,
                    point: parsed.point,
                    zone: parsed.zone,
                });
            }
            Err(error) => skipped.push(Skipped {
                name,
                reason: error.reason,
            }),
        }
    }
    Ok(images)
}

/// Brings all positions into the plane of their cluster of zones, and tells clusters apart by the
/// items' group.
fn project(mut sides: [&mut Vec<GridImage>; 2]) -> Vec<String> {
    let images = sides.iter().flat_map(|side| side.iter());
    let zones = Zones::of(images.filter_map(|image| image.zone));
    let mut without_zone = 0;
    let mut off_the_grid = 0;
    for image in sides.iter_mut().flat_map(|side| side.iter_mut()) {
        match image.zone {
            Some(zone) => {
                image.item.position = zones.project(zone, image.point);
                image.item.group = zones.group(zone);
                off_the_grid += usize::from(image.item.position.is_none());
            }
            // Where there is only one plane, a name that leaves the zone out is taken to mean it.
            None if zones.are_apart() => {
                image.item.group = Some(NO_ZONE.to_owned());
                without_zone += 1;
            }
            None => {}
        }
    }
    let mut notes = zones.notes();
    if without_zone > 0 {
        notes.push(format!(
            "{without_zone} images name no zone; they are compared with each other only"
        ));
    }
    if off_the_grid > 0 {
        notes.push(format!(
            "{off_the_grid} images have coordinates outside their zone; their position is not used"
        ));
    }
    notes
}

fn items(side: Vec<GridImage>) -> Vec<Item> {
    side.into_iter().map(|image| image.item).collect()
}

#[cfg(test)]
mod tests;
