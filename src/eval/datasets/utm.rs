//! `images/{train,val,test}/{database,queries}` with `@utm_east@utm_north@...` names: Pitts30k, Tokyo 24/7,
//! St Lucia, SPED, MSLS and others after the common downloader.
//!
//! Coordinates of different zones are not comparable; where more than one zone occurs, everything is projected into
//! the first.

use super::files::{list_images, require};
use super::neighbours::truth_by_distance;
use super::utm_name::{UtmName, UtmZone};
use super::{Dataset, DatasetOptions, Item, Skipped, Split};
use crate::eval::EvalError;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

const EXPECTED: &str = "images/{train,val,test}/{database,queries} with @utm_east@utm_north@...@.jpg names";

/// Reads one split; positives by radius, and by view angle where the options ask for it and the names give it.
pub(super) fn load(name: &'static str, root: &Path, options: &DatasetOptions) -> Result<Dataset, EvalError> {
    let folder = split_folder(name, root, options.split.unwrap_or(Split::Test))?;
    let mut side = Side::default();
    let mut database = side.read(&require(name, folder.join("database"), EXPECTED)?)?;
    let mut queries = side.read(&require(name, folder.join("queries"), EXPECTED)?)?;
    let mut notes = Vec::new();
    if let Some(zone) = side.common_zone() {
        for item in database.iter_mut().chain(&mut queries) {
            reproject(item, zone);
        }
        notes.push(format!(
            "{} zones occur; all positions are projected into {}{}",
            side.zones.len(),
            zone.number,
            zone.band
        ));
    }
    let truth = truth_by_distance(&database, &queries, options.radius_m, options.max_angle_deg);
    Ok(Dataset { name: name.into(), database, queries, truth, skipped: side.skipped, notes })
}

/// The split's folder: below `images`, or the root itself where that already holds both sides.
pub(super) fn split_folder(name: &'static str, root: &Path, split: Split) -> Result<PathBuf, EvalError> {
    let nested = root.join("images").join(split.as_str());
    if !nested.exists() && root.join("database").exists() && root.join("queries").exists() {
        return Ok(root.to_owned());
    }
    require(name, nested, EXPECTED)
}

#[derive(Default)]
struct Side {
    skipped: Vec<Skipped>,
    zones: BTreeSet<(u8, char)>,
}

impl Side {
    fn read(&mut self, folder: &Path) -> Result<Vec<Item>, EvalError> {
        let mut items = Vec::new();
        for (name, path) in list_images(folder)? {
            match UtmName::parse(&name) {
                Ok(parsed) => {
                    self.zones.extend(parsed.zone.map(|zone| (zone.number, zone.band)));
                    let heading = parsed.heading.map(|heading| heading.degrees());
                    items.push(Item { position: Some(parsed.point), heading, ..Item::new(name, path) });
                }
                Err(error) => self.skipped.push(Skipped { name, reason: error.reason }),
            }
        }
        Ok(items)
    }

    /// The zone to project into, if more than one occurs. Bands of one zone share its coordinates within a
    /// hemisphere.
    fn common_zone(&self) -> Option<UtmZone> {
        let grids: BTreeSet<_> = self.zones.iter().map(|&(number, band)| (number, band >= 'N')).collect();
        let &(number, band) = self.zones.first()?;
        (grids.len() > 1).then_some(UtmZone { number, band })
    }
}

fn reproject(item: &mut Item, zone: UtmZone) {
    // The name was parsed before; one without a zone of its own is taken to lie in the common one.
    if let Ok(parsed) = UtmName::parse(&item.name)
        && let Some(geo) = parsed.location(None)
    {
        item.position = Some(zone.from_geo(geo));
    }
}

#[cfg(test)]
mod tests {
    use super::super::{DatasetKind, Truth, load as load_dataset};
    use super::*;

    fn write(root: &Path, names: &[&str]) {
        for name in names {
            let path = root.join(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, b"x").unwrap();
        }
    }

    #[test]
    fn radius_unreadable_names_and_same_names_in_two_folders() {
        let root = tempfile::tempdir().unwrap();
        write(
            root.path(),
            &[
                "images/test/database/2013/@0500000.00@4000000.00@17@T@@@p@00@@@@@@@.jpg",
                "images/test/database/2014/@0500000.00@4000000.00@17@T@@@p@00@@@@@@@.jpg",
                "images/test/database/@0500030.00@4000000.00@17@T@@@q@00@@@@@@@.jpg",
                "images/test/database/cover.jpg",
                "images/test/queries/@0500010.00@4000000.00@17@T@@@a@@@@@@@@.jpg",
                "images/test/queries/@0501000.00@4000000.00@17@T@@@b@@@@@@@@.jpg",
            ],
        );
        let dataset = load_dataset(DatasetKind::Pitts30k, root.path(), &DatasetOptions::default()).unwrap();
        assert_eq!((dataset.database.len(), dataset.queries.len()), (3, 2));
        assert_eq!(dataset.truth, [Truth::Positives(vec![0, 1, 2]), Truth::NoMatch]);
        assert_eq!(dataset.skipped.len(), 1);
        assert!(dataset.notes.is_empty());
    }

    #[test]
    fn images_on_both_sides_of_a_zone_border_are_neighbours() {
        let root = tempfile::tempdir().unwrap();
        // 6 degrees east is the border of zones 31 and 32; the points lie 7 m apart across it.
        let name = |zone: UtmZone, lon: f64| {
            let point = zone.from_geo(crate::types::GeoPoint::new(48.0, lon).unwrap());
            format!("@{:.2}@{:.2}@{}@U@@@@@@@@@@@.jpg", point.east, point.north, zone.number)
        };
        let west = name(UtmZone { number: 31, band: 'U' }, 5.99995);
        let east = name(UtmZone { number: 32, band: 'U' }, 6.00005);
        write(root.path(), &[&format!("images/test/database/{west}"), &format!("images/test/queries/{east}")]);
        let dataset = load_dataset(DatasetKind::Utm, root.path(), &DatasetOptions::default()).unwrap();
        assert_eq!(dataset.truth, [Truth::Positives(vec![0])]);
        assert_eq!(dataset.notes.len(), 1);
    }

    #[test]
    fn a_wrong_root_says_what_is_expected() {
        let root = tempfile::tempdir().unwrap();
        let error = load_dataset(DatasetKind::Tokyo247, root.path(), &DatasetOptions::default()).unwrap_err();
        assert!(error.to_string().contains("images/{train,val,test}"), "{error}");
    }
}
