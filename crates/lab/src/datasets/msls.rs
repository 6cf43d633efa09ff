//! Mapillary Street-Level Sequences as distributed: `train_val/<city>/{database,query}` and
//! `test/<city>/...`, each with `images/`, `raw.csv`, `postprocessed.csv`, `seq_info.csv` and
//! `subtask_index.csv`.
//!
//! Rows are joined by image key, never by line: the files need not be aligned. Panoramas are left
//! out, as in the official evaluation. Subtasks choose among the images of the validation and test
//! cities; training takes all, as the official code does, and needs no `subtask_index.csv`. The
//! 40-degree view-angle rule (paper IV) uses the compass angle `ca` of `raw.csv`; the official
//! image-to-image script for the validation cities measures the distance only (give 180 for that).

use super::dataset::{Dataset, Item, Skipped, Truth};
use super::error::DatasetError;
use super::kind::Split;
use super::layout::require;
use super::neighbours::truth_by_distance;
use super::options::DatasetOptions;
use super::table::Table;
use super::utm;
use placeformer_core::folder::list_images;
use placeformer_core::geography::MetricPoint;
use std::collections::hash_map::Entry;
use std::collections::{HashMap, HashSet};
use std::path::Path;

const EXPECTED: &str =
    "train_val/<city>/{database,query}/{images,raw.csv,postprocessed.csv,subtask_index.csv}";
const EXPECTED_TEST: &str = "test/<city>/{database,query}/{images,subtask_index.csv}";
const VIEW_ANGLE_DEG: f64 = 40.0;
const VAL_CITIES: [&str; 2] = ["cph", "sf"];
const TEST_CITIES: [&str; 6] = [
    "miami",
    "athens",
    "buenosaires",
    "stockholm",
    "bengaluru",
    "kampala",
];

/// Reads the validation cities, or those named, or all others for the training split.
pub(super) fn load_labelled(
    root: &Path,
    options: &DatasetOptions,
) -> Result<Dataset, DatasetError> {
    let name = "msls-val";
    let angle = options.max_angle_deg.unwrap_or(VIEW_ANGLE_DEG);
    let split = options.split.unwrap_or(Split::Val);
    if !root.join("train_val").exists() && utm::find_split(root, split).is_some() {
        let options = DatasetOptions {
            max_angle_deg: Some(angle),
            split: Some(split),
            ..options.clone()
        };
        return utm::load(name, root, &options);
    }
    let folder = require(name, root.join("train_val"), EXPECTED)?;
    let mut reader = Reader {
        subtask: &options.subtask,
        split,
        skipped: Vec::new(),
        without_angle: 0,
    };
    let (mut database, mut queries) = (Vec::new(), Vec::new());
    for city in cities(&folder, split, options)? {
        database.extend(reader.labelled_side(name, &folder, &city, "database")?);
        queries.extend(reader.labelled_side(name, &folder, &city, "query")?);
    }
    let truth = truth_by_distance(&database, &queries, options.radius_m, Some(angle));
    let mut notes = vec![format!(
        "positives lie within {} m and {angle} degrees of view angle",
        options.radius_m
    )];
    if split == Split::Train && options.subtask != DatasetOptions::default().subtask {
        notes.push(format!(
            "subtask {:?} chooses among validation images only; training takes all",
            options.subtask
        ));
    }
    if reader.without_angle > 0 {
        notes.push(format!(
            "{} images have no compass angle; for them only the distance counts",
            reader.without_angle
        ));
    }
    Ok(Dataset {
        name: name.into(),
        database,
        queries,
        truth,
        skipped: reader.skipped,
        notes,
    })
}

/// Reads the test cities; their answers are withheld, so every truth is unknown.
pub(super) fn load_test(root: &Path, options: &DatasetOptions) -> Result<Dataset, DatasetError> {
    let name = "msls-test";
    let folder = require(name, root.join("test"), EXPECTED_TEST)?;
    let mut reader = Reader {
        subtask: &options.subtask,
        split: Split::Test,
        skipped: Vec::new(),
        without_angle: 0,
    };
    let (mut database, mut queries) = (Vec::new(), Vec::new());
    for city in cities(&folder, Split::Test, options)? {
        database.extend(reader.test_side(name, &folder, &city, "database")?);
        queries.extend(reader.test_side(name, &folder, &city, "query")?);
    }
    let truth = vec![Truth::Unknown; queries.len()];
    let notes = vec!["answers are withheld: write a prediction file and submit it".to_owned()];
    Ok(Dataset {
        name: name.into(),
        database,
        queries,
        truth,
        skipped: reader.skipped,
        notes,
    })
}

fn cities(
    folder: &Path,
    split: Split,
    options: &DatasetOptions,
) -> Result<Vec<String>, DatasetError> {
    if !options.cities.is_empty() {
        return Ok(options.cities.clone());
    }
    match split {
        Split::Val => Ok(VAL_CITIES.map(str::to_owned).to_vec()),
        Split::Test => Ok(TEST_CITIES.map(str::to_owned).to_vec()),
        Split::Train => {
            let mut cities = Vec::new();
            for entry in std::fs::read_dir(folder).map_err(DatasetError::io(folder))? {
                let entry = entry.map_err(DatasetError::io(folder))?;
                let name = entry.file_name().to_string_lossy().into_owned();
                if entry.path().is_dir()
                    && !VAL_CITIES.contains(&name.as_str())
                    && !name.starts_with('.')
                {
                    cities.push(name);
                }
            }
            cities.sort_unstable();
            Ok(cities)
        }
    }
}

struct Reader<'a> {
    subtask: &'a str,
    split: Split,
    skipped: Vec<Skipped>,
    without_angle: usize,
}

impl Reader<'_> {
    fn skip(&mut self, city: &str, side: &str, key: &str, reason: &str) {
        self.skipped.push(Skipped {
            name: format!("{city}/{side}/{key}"),
            reason: reason.into(),
        });
    }

    fn labelled_side(
        &mut self,
        dataset: &'static str,
        root: &Path,
        city: &str,
        side: &str,
    ) -> Result<Vec<Item>, DatasetError> {
        let folder = require(dataset, root.join(city).join(side), EXPECTED)?;
        let raw = self.raw_rows(
            &require(dataset, folder.join("raw.csv"), EXPECTED)?,
            city,
            side,
        )?;
        let positions = self.positions(
            &require(dataset, folder.join("postprocessed.csv"), EXPECTED)?,
            city,
            side,
        )?;
        let subtask = match self.split {
            Split::Train => None,
            Split::Val | Split::Test => Some(self.subtask_keys(&require(
                dataset,
                folder.join("subtask_index.csv"),
                EXPECTED,
            )?)?),
        };
        self.report_images_without_rows(&folder, city, side, &positions)?;
        let mut items = Vec::new();
        for (key, position) in &positions {
            if subtask
                .as_ref()
                .is_some_and(|keys| !keys.contains(key.as_str()))
            {
                continue;
            }
            match raw.get(key) {
                None => self.skip(city, side, key, "no row in raw.csv"),
                Some(RawRow { panorama: true, .. }) => self.skip(city, side, key, "panorama"),
                Some(RawRow { angle, .. }) => {
                    self.without_angle += usize::from(angle.is_none());
                    let item = image_item(&folder, city, side, key);
                    items.push(Item {
                        position: Some(*position),
                        heading: *angle,
                        ..item
                    });
                }
            }
        }
        Ok(items)
    }

    fn test_side(
        &mut self,
        dataset: &'static str,
        root: &Path,
        city: &str,
        side: &str,
    ) -> Result<Vec<Item>, DatasetError> {
        let folder = require(dataset, root.join(city).join(side), EXPECTED_TEST)?;
        let path = require(dataset, folder.join("subtask_index.csv"), EXPECTED_TEST)?;
        let table = Table::read(&path)?;
        let (key_column, subtask_column) = (table.column("key")?, table.column(self.subtask)?);
        let (mut items, mut seen) = (Vec::new(), HashSet::new());
        for row in table.rows() {
            let key = row.text(key_column);
            if !row.flag(subtask_column)? {
                continue;
            }
            if seen.insert(key) {
                items.push(image_item(&folder, city, side, key));
            } else {
                self.skip(
                    city,
                    side,
                    key,
                    "a second row with this key in subtask_index.csv",
                );
            }
        }
        Ok(items)
    }

    /// Positions by key, in the order of the file.
    fn positions(
        &mut self,
        path: &Path,
        city: &str,
        side: &str,
    ) -> Result<Vec<(String, MetricPoint)>, DatasetError> {
        let table = Table::read(path)?;
        let (key, east, north) = (
            table.column("key")?,
            table.column("easting")?,
            table.column("northing")?,
        );
        let (mut positions, mut seen) = (Vec::new(), HashSet::new());
        for row in table.rows() {
            let name = row.text(key);
            if seen.insert(name) {
                positions.push((
                    name.to_owned(),
                    MetricPoint {
                        east: row.number(east)?,
                        north: row.number(north)?,
                    },
                ));
            } else {
                self.skip(
                    city,
                    side,
                    name,
                    "a second row with this key in postprocessed.csv",
                );
            }
        }
        Ok(positions)
    }

    fn raw_rows(
        &mut self,
        path: &Path,
        city: &str,
        side: &str,
    ) -> Result<HashMap<String, RawRow>, DatasetError> {
        let table = Table::read(path)?;
        let (key, pano) = (table.column("key")?, table.column("pano")?);
        let angle = table.optional_column("ca");
        let mut rows = HashMap::new();
        for row in table.rows() {
            // Some cities lack the angle of some images: an empty field, or NaN.
            let angle = angle
                .and_then(|column| row.text(column).parse::<f64>().ok())
                .filter(|angle| angle.is_finite());
            let name = row.text(key);
            // The first row counts, as in postprocessed.csv.
            match rows.entry(name.to_owned()) {
                Entry::Occupied(_) => {
                    self.skip(city, side, name, "a second row with this key in raw.csv")
                }
                Entry::Vacant(place) => {
                    place.insert(RawRow {
                        angle,
                        panorama: row.flag(pano)?,
                    });
                }
            }
        }
        Ok(rows)
    }

    fn subtask_keys(&self, path: &Path) -> Result<HashSet<String>, DatasetError> {
        let table = Table::read(path)?;
        let (key, subtask) = (table.column("key")?, table.column(self.subtask)?);
        let mut keys = HashSet::new();
        for row in table.rows() {
            if row.flag(subtask)? {
                keys.insert(row.text(key).to_owned());
            }
        }
        Ok(keys)
    }

    fn report_images_without_rows(
        &mut self,
        folder: &Path,
        city: &str,
        side: &str,
        positions: &[(String, MetricPoint)],
    ) -> Result<(), DatasetError> {
        let known: HashSet<&str> = positions.iter().map(|(key, _)| key.as_str()).collect();
        for (name, _) in list_images(&folder.join("images"))? {
            let key = name
                .rsplit_once('.')
                .map_or(name.as_str(), |(stem, _)| stem);
            if !known.contains(key) {
                self.skip(city, side, key, "no row in postprocessed.csv");
            }
        }
        Ok(())
    }
}

fn image_item(folder: &Path, city: &str, side: &str, key: &str) -> Item {
    let path = folder.join("images").join(format!("{key}.jpg"));
    Item {
        group: Some(city.to_owned()),
        ..Item::new(format!("{city}/{side}/{key}"), path)
    }
}

struct RawRow {
    angle: Option<f64>,
    panorama: bool,
}

#[cfg(test)]
mod tests;
