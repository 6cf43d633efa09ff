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
use std::path::{Path, PathBuf};

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
    let mut reader = Reader::new(name, &options.subtask, split);
    let mut database = Vec::new();
    let mut queries = Vec::new();
    for city in cities(&folder, split, options)? {
        database.extend(reader.labelled_side(&folder, &city, "database")?);
        queries.extend(reader.labelled_side(&folder, &city, "query")?);
    }
    let truth = truth_by_distance(&database, &queries, options.radius_m, Some(angle));
    Ok(Dataset {
        name: name.into(),
        database,
        queries,
        truth,
        notes: reader.notes(options, angle),
        skipped: reader.skipped,
    })
}

/// Reads the test cities; their answers are withheld, so every truth is unknown.
pub(super) fn load_test(root: &Path, options: &DatasetOptions) -> Result<Dataset, DatasetError> {
    let name = "msls-test";
    let folder = require(name, root.join("test"), EXPECTED_TEST)?;
    let mut reader = Reader::new(name, &options.subtask, Split::Test);
    let mut database = Vec::new();
    let mut queries = Vec::new();
    for city in cities(&folder, Split::Test, options)? {
        database.extend(reader.test_side(&folder, &city, "database")?);
        queries.extend(reader.test_side(&folder, &city, "query")?);
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

/// Reads the sides of cities, and remembers what it leaves out.
struct Reader<'a> {
    dataset: &'static str,
    subtask: &'a str,
    split: Split,
    skipped: Vec<Skipped>,
    without_angle: usize,
}

/// One side of a city, and where its files are.
struct CitySide<'a> {
    city: &'a str,
    /// `database` or `query`.
    side: &'a str,
    folder: PathBuf,
}

impl CitySide<'_> {
    fn item(&self, key: &str) -> Item {
        let path = self.folder.join("images").join(format!("{key}.jpg"));
        Item {
            group: Some(self.city.to_owned()),
            ..Item::new(self.name_of(key), path)
        }
    }

    fn name_of(&self, key: &str) -> String {
        format!("{}/{}/{key}", self.city, self.side)
    }
}

impl<'a> Reader<'a> {
    fn new(dataset: &'static str, subtask: &'a str, split: Split) -> Self {
        Self {
            dataset,
            subtask,
            split,
            skipped: Vec::new(),
            without_angle: 0,
        }
    }

    fn skip(&mut self, side: &CitySide<'_>, key: &str, reason: &str) {
        self.skipped.push(Skipped {
            name: side.name_of(key),
            reason: reason.into(),
        });
    }

    /// What a reader of the results should know about labelled cities.
    fn notes(&self, options: &DatasetOptions, angle: f64) -> Vec<String> {
        let mut notes = vec![format!(
            "positives lie within {} m and {angle} degrees of view angle",
            options.radius_m
        )];
        if self.split == Split::Train && options.subtask != DatasetOptions::default().subtask {
            notes.push(format!(
                "subtask {:?} chooses among validation images only; training takes all",
                options.subtask
            ));
        }
        if self.without_angle > 0 {
            notes.push(format!(
                "{} images have no compass angle; for them only the distance counts",
                self.without_angle
            ));
        }
        notes
    }

    /// A side of a city that has positions.
    fn labelled_side(
        &mut self,
        root: &Path,
        city: &str,
        side: &str,
    ) -> Result<Vec<Item>, DatasetError> {
        let folder = require(self.dataset, root.join(city).join(side), EXPECTED)?;
        let raw_path = require(self.dataset, folder.join("raw.csv"), EXPECTED)?;
        let positions_path = require(self.dataset, folder.join("postprocessed.csv"), EXPECTED)?;
        let side = CitySide { city, side, folder };
        let raw = self.raw_rows(&raw_path, &side)?;
        let positions = self.positions(&positions_path, &side)?;
        let chosen = self.chosen_keys(&side)?;
        self.report_images_without_rows(&side, &positions)?;

        let mut items = Vec::new();
        for (key, position) in &positions {
            if chosen.as_ref().is_some_and(|keys| !keys.contains(key)) {
                continue;
            }
            match raw.get(key) {
                None => self.skip(&side, key, "no row in raw.csv"),
                Some(RawRow { panorama: true, .. }) => self.skip(&side, key, "panorama"),
                Some(RawRow { angle, .. }) => {
                    self.without_angle += usize::from(angle.is_none());
                    items.push(Item {
                        position: Some(*position),
                        heading: *angle,
                        ..side.item(key)
                    });
                }
            }
        }
        Ok(items)
    }

    /// A side of a city whose positions are withheld.
    fn test_side(
        &mut self,
        root: &Path,
        city: &str,
        side: &str,
    ) -> Result<Vec<Item>, DatasetError> {
        let folder = require(self.dataset, root.join(city).join(side), EXPECTED_TEST)?;
        let index = folder.join("subtask_index.csv");
        let path = require(self.dataset, index, EXPECTED_TEST)?;
        let side = CitySide { city, side, folder };
        let table = Table::read(&path)?;
        let key_column = table.column("key")?;
        let subtask_column = table.column(self.subtask)?;
        let mut items = Vec::new();
        let mut seen = HashSet::new();
        for row in table.rows() {
            let key = row.text(key_column);
            if !row.flag(subtask_column)? {
                continue;
            }
            if seen.insert(key) {
                items.push(side.item(key));
            } else {
                let reason = "a second row with this key in subtask_index.csv";
                self.skip(&side, key, reason);
            }
        }
        Ok(items)
    }

    /// Positions by key, in the order of the file.
    fn positions(
        &mut self,
        path: &Path,
        side: &CitySide<'_>,
    ) -> Result<Vec<(String, MetricPoint)>, DatasetError> {
        let table = Table::read(path)?;
        let key_column = table.column("key")?;
        let east = table.column("easting")?;
        let north = table.column("northing")?;
        let mut positions = Vec::new();
        let mut seen = HashSet::new();
        for row in table.rows() {
            let key = row.text(key_column);
            if seen.insert(key) {
                let position = MetricPoint {
                    east: row.number(east)?,
                    north: row.number(north)?,
                };
                positions.push((key.to_owned(), position));
            } else {
                let reason = "a second row with this key in postprocessed.csv";
                self.skip(side, key, reason);
            }
        }
        Ok(positions)
    }

    /// Rows of `raw.csv` by key; the first row of a key counts, as in `postprocessed.csv`.
    fn raw_rows(
        &mut self,
        path: &Path,
        side: &CitySide<'_>,
    ) -> Result<HashMap<String, RawRow>, DatasetError> {
        let table = Table::read(path)?;
        let key_column = table.column("key")?;
        let panorama_column = table.column("pano")?;
        let angle_column = table.optional_column("ca");
        let mut rows = HashMap::new();
        for row in table.rows() {
            // Some cities lack the angle of some images: an empty field, or NaN.
            let angle = angle_column
                .and_then(|column| row.text(column).parse::<f64>().ok())
                .filter(|angle| angle.is_finite());
            let key = row.text(key_column);
            match rows.entry(key.to_owned()) {
                Entry::Occupied(_) => {
                    self.skip(side, key, "a second row with this key in raw.csv");
                }
                Entry::Vacant(entry) => {
                    let panorama = row.flag(panorama_column)?;
                    entry.insert(RawRow { angle, panorama });
                }
            }
        }
        Ok(rows)
    }

    /// The images that the subtask chooses; `None` for training, which takes all.
    fn chosen_keys(&self, side: &CitySide<'_>) -> Result<Option<HashSet<String>>, DatasetError> {
        if self.split == Split::Train {
            return Ok(None);
        }
        let index = side.folder.join("subtask_index.csv");
        let path = require(self.dataset, index, EXPECTED)?;
        Ok(Some(self.subtask_keys(&path)?))
    }

    fn subtask_keys(&self, path: &Path) -> Result<HashSet<String>, DatasetError> {
        let table = Table::read(path)?;
        let key = table.column("key")?;
        let subtask = table.column(self.subtask)?;
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
        side: &CitySide<'_>,
        positions: &[(String, MetricPoint)],
    ) -> Result<(), DatasetError> {
        let known: HashSet<&str> = positions.iter().map(|(key, _)| key.as_str()).collect();
        for (name, _) in list_images(&side.folder.join("images"))? {
            let key = match name.rsplit_once('.') {
                Some((stem, _)) => stem,
                None => &name,
            };
            if !known.contains(key) {
                self.skip(side, key, "no row in postprocessed.csv");
            }
        }
        Ok(())
    }
}

/// What `raw.csv` says about an image.
struct RawRow {
    angle: Option<f64>,
    panorama: bool,
}

#[cfg(test)]
mod tests;
