//! Mapillary Street-Level Sequences as distributed: `train_val/<city>/{database,query}` and
//! `test/<city>/...`, each with `images/`, `raw.csv`, `postprocessed.csv`, `seq_info.csv` and
//! `subtask_index.csv`.
//!
//! Rows are joined by image key, never by line: the files need not be aligned. Panoramas are left
//! out, as in the official evaluation. Subtasks choose among the images of the validation and test
//! cities; training takes all, as the official code does, and needs no `subtask_index.csv`. The
//! 40-degree view-angle rule (paper IV) uses the compass angle `ca` of `raw.csv`; the official
//! image-to-image script for the validation cities measures the distance only (give 180 for that).

use super::DatasetError;
use super::layout::require;
use super::neighbours::truth_by_distance;
use super::table::Table;
use super::{Dataset, DatasetOptions, Item, Skipped, Split, Truth, utm};
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
mod tests {
    use super::super::{DatasetKind, load};
    use super::*;

    /// (key, easting, northing or none for no postprocessed row, angle, panorama).
    type Photo = (&'static str, Option<(f64, f64)>, &'static str, &'static str);

    fn write_side(folder: &Path, photos: &[Photo], line_end: &str) {
        std::fs::create_dir_all(folder.join("images")).unwrap();
        let mut raw = format!(",key,lon,lat,ca,captured_at,pano{line_end}");
        let mut post = format!(
            ",key,easting,northing,night,control_panel,view_direction,unique_cluster{line_end}"
        );
        let mut subtask = format!(",key,all,s2w,w2s,o2n,n2o,d2n,n2d{line_end}");
        for (i, (key, position, angle, pano)) in photos.iter().enumerate() {
            std::fs::write(folder.join("images").join(format!("{key}.jpg")), b"x").unwrap();
            raw += &format!("{i},{key},12.5,55.6,{angle},2019-01-01,{pano}{line_end}");
            if let Some((east, north)) = position {
                post += &format!("{i},{key},{east},{north},False,False,Forward,0{line_end}");
            }
            subtask += &format!(
                "{i},{key},True,{},False,False,False,False,False{line_end}",
                i % 2 == 0
            );
        }
        std::fs::write(folder.join("raw.csv"), raw).unwrap();
        std::fs::write(folder.join("postprocessed.csv"), post).unwrap();
        std::fs::write(
            folder.join("subtask_index.csv"),
            subtask.replace("true", "True").replace("false", "False"),
        )
        .unwrap();
        std::fs::write(
            folder.join("seq_info.csv"),
            format!(",key,sequence_key,frame_number{line_end}"),
        )
        .unwrap();
    }

    fn sample() -> tempfile::TempDir {
        let root = tempfile::tempdir().unwrap();
        let city = |name: &str| root.path().join("train_val").join(name);
        let database: [Photo; 6] = [
            ("d0", Some((0.0, 0.0)), "10", "False"),
            ("d1", Some((5.0, 0.0)), "60", "False"),
            ("d2", Some((6.0, 0.0)), "10", "True"),
            ("d3", None, "10", "False"),
            ("d4", Some((7.0, 0.0)), "", "False"),
            ("d5", Some((900.0, 0.0)), "10", "False"),
        ];
        let queries: [Photo; 3] = [
            ("q0", Some((1.0, 1.0)), "350", "False"),
            ("q1", Some((500.0, 1.0)), "0", "False"),
            ("q2", Some((1.0, 1.0)), "0", "True"),
        ];
        write_side(&city("cph").join("database"), &database, "\r\n");
        write_side(&city("cph").join("query"), &queries, "\r\n");
        // The other city has the same coordinates: never a positive.
        write_side(
            &city("sf").join("database"),
            &[("d0", Some((0.0, 0.0)), "0", "False")],
            "\n",
        );
        write_side(
            &city("sf").join("query"),
            &[("q9", Some((1000.0, 0.0)), "0", "False")],
            "\n",
        );
        root
    }

    #[test]
    fn distance_angle_panoramas_and_missing_rows() {
        let root = sample();
        let dataset = load(
            DatasetKind::MslsVal,
            root.path(),
            &DatasetOptions::default(),
        )
        .unwrap();
        let names: Vec<_> = dataset
            .database
            .iter()
            .map(|item| item.name.as_str())
            .collect();
        let expected = [
            "cph/database/d0",
            "cph/database/d1",
            "cph/database/d4",
            "cph/database/d5",
            "sf/database/d0",
        ];
        assert_eq!(names, expected);
        // q0 looks 20 degrees from d0, 70 from d1; d4 has no angle.
        assert_eq!(
            dataset.truth,
            [Truth::Positives(vec![0, 2]), Truth::NoMatch, Truth::NoMatch]
        );
        let reasons: Vec<_> = dataset
            .skipped
            .iter()
            .map(|skipped| (skipped.name.as_str(), skipped.reason.as_str()))
            .collect();
        assert!(
            reasons.contains(&("cph/database/d3", "no row in postprocessed.csv")),
            "{reasons:?}"
        );
        assert!(
            reasons.contains(&("cph/database/d2", "panorama"))
                && reasons.contains(&("cph/query/q2", "panorama"))
        );
        assert_eq!(dataset.notes.len(), 2);
    }

    #[test]
    fn the_angle_rule_can_be_lifted_and_a_subtask_chosen() {
        let root = sample();
        let options = DatasetOptions {
            max_angle_deg: Some(180.0),
            ..Default::default()
        };
        let dataset = load(DatasetKind::MslsVal, root.path(), &options).unwrap();
        assert_eq!(dataset.truth[0], Truth::Positives(vec![0, 1, 2]));
        let options = DatasetOptions {
            subtask: "s2w".into(),
            cities: vec!["cph".into()],
            ..Default::default()
        };
        let dataset = load(DatasetKind::MslsVal, root.path(), &options).unwrap();
        assert_eq!((dataset.database.len(), dataset.queries.len()), (2, 1));
        let options = DatasetOptions {
            subtask: "dawn".into(),
            ..Default::default()
        };
        assert!(
            load(DatasetKind::MslsVal, root.path(), &options)
                .unwrap_err()
                .to_string()
                .contains("dawn")
        );
    }

    #[test]
    fn a_subtask_chooses_validation_images_but_never_training_images() {
        let root = sample();
        let index = root.path().join("train_val/cph/query/subtask_index.csv");
        let load = |split| {
            let cities = vec!["cph".into()];
            let options = DatasetOptions {
                subtask: "s2w".into(),
                cities,
                split: Some(split),
                ..Default::default()
            };
            load(DatasetKind::MslsVal, root.path(), &options)
        };
        assert_eq!(load(Split::Val).unwrap().queries.len(), 1);
        let training = load(Split::Train).unwrap();
        assert_eq!((training.database.len(), training.queries.len()), (4, 2));
        assert!(
            training.notes.iter().any(|note| note.contains("s2w")),
            "{:?}",
            training.notes
        );
        std::fs::remove_file(&index).unwrap();
        assert_eq!(load(Split::Train).unwrap(), training);
        assert!(
            load(Split::Val)
                .unwrap_err()
                .to_string()
                .contains("subtask_index.csv")
        );
    }

    #[test]
    fn rows_are_joined_by_key_and_second_rows_are_reported() {
        let root = sample();
        let folder = root.path().join("train_val/cph/database");
        // Another order than postprocessed.csv; d0 twice with another angle, d1 not at all.
        let raw = ",key,lon,lat,ca,captured_at,pano\n0,d5,1,1,10,x,False\n1,d4,1,1,,x,False\n2,d0,1,1,10,x,False\n\
                   3,d0,1,1,200,x,False\n4,d2,1,1,10,x,True\n";
        std::fs::write(folder.join("raw.csv"), raw).unwrap();
        // d0 a second time, far away.
        let path = folder.join("postprocessed.csv");
        let rows =
            std::fs::read_to_string(&path).unwrap() + "9,d0,5000,0,False,False,Forward,0\r\n";
        std::fs::write(&path, rows).unwrap();
        let options = DatasetOptions {
            cities: vec!["cph".into()],
            ..Default::default()
        };
        let dataset = load(DatasetKind::MslsVal, root.path(), &options).unwrap();
        let known: Vec<_> = dataset
            .database
            .iter()
            .map(|item| {
                (
                    item.name.as_str(),
                    item.position.unwrap().east,
                    item.heading,
                )
            })
            .collect();
        let expected = [
            ("cph/database/d0", 0.0, Some(10.0)),
            ("cph/database/d4", 7.0, None),
            ("cph/database/d5", 900.0, Some(10.0)),
        ];
        assert_eq!(known, expected);
        let mut reasons: Vec<_> = dataset
            .skipped
            .iter()
            .filter_map(|skipped| {
                Some((
                    skipped.name.strip_prefix("cph/database/")?,
                    skipped.reason.as_str(),
                ))
            })
            .collect();
        reasons.sort_unstable();
        let expected = [
            ("d0", "a second row with this key in postprocessed.csv"),
            ("d0", "a second row with this key in raw.csv"),
            ("d1", "no row in raw.csv"),
            ("d2", "panorama"),
            ("d3", "no row in postprocessed.csv"),
        ];
        assert_eq!(reasons, expected);
    }

    #[test]
    fn the_test_cities_have_no_answers_and_duplicate_keys_are_reported() {
        let root = tempfile::tempdir().unwrap();
        for city in TEST_CITIES {
            for (side, keys) in [("database", vec!["a", "b", "b"]), ("query", vec!["q"])] {
                let folder = root.path().join("test").join(city).join(side);
                std::fs::create_dir_all(folder.join("images")).unwrap();
                let rows: String = keys
                    .iter()
                    .enumerate()
                    .map(|(i, key)| format!("{i},{key},True,False\n"))
                    .collect();
                std::fs::write(
                    folder.join("subtask_index.csv"),
                    format!(",key,all,s2w\n{rows}"),
                )
                .unwrap();
            }
        }
        let dataset = load(
            DatasetKind::MslsTest,
            root.path(),
            &DatasetOptions::default(),
        )
        .unwrap();
        assert_eq!(
            (
                dataset.database.len(),
                dataset.queries.len(),
                dataset.skipped.len()
            ),
            (12, 6, 6)
        );
        assert!(dataset.truth.iter().all(|truth| *truth == Truth::Unknown));
        assert!(
            dataset.database[0]
                .path
                .ends_with("test/miami/database/images/a.jpg")
        );
    }

    #[test]
    fn the_downloaders_form_is_read_too() {
        let root = tempfile::tempdir().unwrap();
        for name in [
            "database/@0@0@@@@@a@@010@@@@@@.jpg",
            "database/@1@0@@@@@b@@090@@@@@@.jpg",
            "queries/@2@0@@@@@c@@000@@@@@@.jpg",
        ] {
            let path = root.path().join("images/val").join(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, b"x").unwrap();
        }
        let dataset = load(
            DatasetKind::MslsVal,
            root.path(),
            &DatasetOptions::default(),
        )
        .unwrap();
        assert_eq!(dataset.truth, [Truth::Positives(vec![0])]);
    }
}
