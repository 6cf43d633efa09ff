//! Nordland: one railway filmed in four seasons, aligned frame by frame; positives lie within some
//! frames.
//!
//! Two layouts: the downloader's (`images/test/{database,queries}`, the frame in the seventh field
//! of an `@utm_east@utm_north@...` name) and the films' own folders (`summer/` and `winter/`, the
//! frame at the end of the name, such as `images-00042.png`). Where `cleanImageNames.txt` lies
//! beside them, only the frames it lists take part: the usual evaluation leaves tunnels and
//! stations out.

use super::dataset::{Dataset, Item, Skipped, Truth};
use super::error::DatasetError;
use super::kind::Split;
use super::layout::require;
use super::options::DatasetOptions;
use super::utm::find_split;
use crate::choice::Choice;
use placeformer_core::folder::list_images;
use placeformer_core::geography::UtmName;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

const NAME: &str = "nordland";
/// Names of the frames that take part, one a line.
const CLEAN: &str = "cleanImageNames.txt";
const EXPECTED: &str =
    "images/test/{database,queries}, or summer/ (database) and winter/ (queries)";

/// Reads both sides and matches them by frame.
pub(super) fn load(root: &Path, options: &DatasetOptions) -> Result<Dataset, DatasetError> {
    let (mut database_dir, mut queries_dir) = folders(root, options.split.unwrap_or(Split::Test))?;
    if options.swap {
        std::mem::swap(&mut database_dir, &mut queries_dir);
    }
    let clean = clean_frames(root)?;
    let mut skipped = Vec::new();
    let database = read_side(&database_dir, clean.as_ref(), &mut skipped)?;
    let queries = read_side(&queries_dir, clean.as_ref(), &mut skipped)?;
    let frames = database.frames.iter().enumerate();
    let mut by_frame: Vec<(u64, usize)> = frames.map(|(i, &frame)| (frame, i)).collect();
    by_frame.sort_unstable();
    let tolerance = options.frame_tolerance;
    let truth = queries
        .frames
        .iter()
        .map(|&frame| truth_of(frame, tolerance, &by_frame))
        .collect();
    Ok(Dataset {
        name: NAME.into(),
        database: database.items,
        queries: queries.items,
        truth,
        skipped,
        notes: notes(options, clean.as_ref()),
    })
}

/// The images of one side with their frame numbers.
#[derive(Default)]
struct FilmSide {
    items: Vec<Item>,
    frames: Vec<u64>,
}

/// Reads the images of a folder that have a frame number and, where `clean` lists frames, are
/// among these.
fn read_side(
    folder: &Path,
    clean: Option<&BTreeSet<u64>>,
    skipped: &mut Vec<Skipped>,
) -> Result<FilmSide, DatasetError> {
    let mut side = FilmSide::default();
    for (name, path) in list_images(folder)? {
        let Some(frame) = frame_of(&name) else {
            skipped.push(Skipped {
                name,
                reason: "the name has no frame number".into(),
            });
            continue;
        };
        if clean.is_some_and(|clean| !clean.contains(&frame)) {
            skipped.push(Skipped {
                name,
                reason: format!("not in {CLEAN}"),
            });
            continue;
        }
        side.items.push(Item::new(name, path));
        side.frames.push(frame);
    }
    Ok(side)
}

/// What a reader of the results should know.
fn notes(options: &DatasetOptions, clean: Option<&BTreeSet<u64>>) -> Vec<String> {
    let mut notes = vec![format!(
        "positives lie within {} frames",
        options.frame_tolerance
    )];
    if let Some(clean) = clean {
        let count = clean.len();
        notes.push(format!("only the {count} frames of {CLEAN} take part"));
    }
    if options.swap {
        notes.push("the seasons are exchanged: what is usually asked is searched".into());
    }
    notes
}

/// The frames that take part, if the data set says so.
fn clean_frames(root: &Path) -> Result<Option<BTreeSet<u64>>, DatasetError> {
    let path = root.join(CLEAN);
    let text = match std::fs::read_to_string(&path) {
        Ok(text) => text,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(None),
        Err(error) => return Err(DatasetError::io(&path)(error)),
    };
    let mut frames = BTreeSet::new();
    for (line, name) in (1..).zip(text.lines().map(str::trim)) {
        if name.is_empty() {
            continue;
        }
        let frame = frame_of(name).ok_or_else(|| DatasetError::Record {
            path: path.clone(),
            line,
            reason: format!("{name:?} has no frame number"),
        })?;
        frames.insert(frame);
    }
    Ok(Some(frames))
}

/// The folders of the database and of the queries.
fn folders(root: &Path, split: Split) -> Result<(PathBuf, PathBuf), DatasetError> {
    let summer = root.join("summer");
    let winter = root.join("winter");
    if summer.exists() && winter.exists() {
        return Ok((summer, winter));
    }
    let nested = || root.join("images").join(split.as_str());
    let folder = find_split(root, split).unwrap_or_else(nested);
    let folder = require(NAME, folder, EXPECTED)?;
    let database = require(NAME, folder.join("database"), EXPECTED)?;
    let queries = require(NAME, folder.join("queries"), EXPECTED)?;
    Ok((database, queries))
}

/// The frame number in the name of an image.
fn frame_of(name: &str) -> Option<u64> {
    if let Ok(parsed) = UtmName::parse(name) {
        return parsed.pano_id.parse().ok();
    }
    let file = name.rsplit('/').next()?;
    let stem = file.rsplit_once('.').map_or(file, |(stem, _)| stem);
    let digits = stem.bytes().rev().take_while(u8::is_ascii_digit).count();
    stem[stem.len() - digits..].parse().ok()
}

/// The images at most `tolerance` frames away; `by_frame` is sorted.
fn truth_of(frame: u64, tolerance: u64, by_frame: &[(u64, usize)]) -> Truth {
    let start = by_frame.partition_point(|&(other, _)| other < frame.saturating_sub(tolerance));
    let within = by_frame[start..]
        .iter()
        .take_while(|&&(other, _)| other <= frame.saturating_add(tolerance));
    Truth::from_positives(within.map(|&(_, index)| index).collect())
}

#[cfg(test)]
mod tests {
    use super::super::{DatasetKind, load as load_dataset};
    use super::*;

    fn write(root: &Path, names: &[String]) {
        for name in names {
            let path = root.join(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, b"x").unwrap();
        }
    }

    #[test]
    fn downloader_names_match_by_frame_not_by_text_order() {
        let root = tempfile::tempdir().unwrap();
        // Sorted as text, frame 100 comes before frame 20.
        let database = [0, 9, 20, 31, 100].map(|f| {
            format!(
                "images/test/database/@0@{:.1}@@@@@{f}@@@@@@@@.jpg",
                f as f64 * 2.4
            )
        });
        let queries = [10, 50].map(|f| {
            format!(
                "images/test/queries/@0@{:.1}@@@@@{f}@@@@@@@@.jpg",
                f as f64 * 2.4
            )
        });
        write(root.path(), &database);
        write(root.path(), &queries);
        write(
            root.path(),
            &["images/test/queries/@0@1@@@@@@@@@@@@@@.jpg".to_owned()],
        );
        let dataset = load_dataset(
            DatasetKind::Nordland,
            root.path(),
            &DatasetOptions::default(),
        )
        .unwrap();
        let frames: Vec<_> = dataset
            .database
            .iter()
            .map(|item| frame_of(&item.name).unwrap())
            .collect();
        let positives = |frame| {
            let query = dataset
                .queries
                .iter()
                .position(|query| frame_of(&query.name) == Some(frame))
                .unwrap();
            let mut found: Vec<u64> = dataset.truth[query]
                .positives()
                .iter()
                .map(|&i| frames[i])
                .collect();
            found.sort_unstable();
            found
        };
        assert_eq!((positives(10), positives(50)), (vec![0, 9, 20], vec![]));
        assert_eq!((dataset.queries.len(), dataset.skipped.len()), (2, 1));
    }

    #[test]
    fn film_folders_match_by_the_number_at_the_end() {
        let root = tempfile::tempdir().unwrap();
        let film = |season: &str| {
            (0..30)
                .map(|i| format!("{season}/images-{i:05}.png"))
                .collect::<Vec<_>>()
        };
        write(root.path(), &film("summer"));
        write(root.path(), &film("winter"));
        let options = DatasetOptions {
            frame_tolerance: 1,
            ..Default::default()
        };
        let dataset = load_dataset(DatasetKind::Nordland, root.path(), &options).unwrap();
        assert_eq!(dataset.truth[0], Truth::Positives(vec![0, 1]));
        assert_eq!(dataset.truth[17], Truth::Positives(vec![16, 17, 18]));
    }

    #[test]
    fn only_clean_frames_take_part_and_the_seasons_can_be_exchanged() {
        let root = tempfile::tempdir().unwrap();
        write(
            root.path(),
            &(0..8)
                .map(|i| format!("summer/images-{i:05}.png"))
                .collect::<Vec<_>>(),
        );
        write(
            root.path(),
            &(0..6)
                .map(|i| format!("winter/images-{i:05}.png"))
                .collect::<Vec<_>>(),
        );
        let options = |swap| DatasetOptions {
            frame_tolerance: 1,
            swap,
            ..Default::default()
        };
        let load = |swap| load_dataset(DatasetKind::Nordland, root.path(), &options(swap));
        let sides = |dataset: &Dataset| (dataset.database.len(), dataset.queries.len());
        assert_eq!(sides(&load(false).unwrap()), (8, 6));
        assert_eq!(sides(&load(true).unwrap()), (6, 8));
        let list = root.path().join(CLEAN);
        std::fs::write(
            &list,
            "images-00000.png\r\nimages-00003.png\r\nimages-00004.png\r\nimages-00007.png\r\n",
        )
        .unwrap();
        let clean = load(false).unwrap();
        assert_eq!((sides(&clean), clean.skipped.len()), ((4, 3), 4 + 3));
        assert_eq!(clean.truth[0], Truth::Positives(vec![0]));
        assert_eq!(clean.truth[1], Truth::Positives(vec![1, 2]));
        let swapped = load(true).unwrap();
        assert_eq!(swapped.truth[3], Truth::NoMatch);
        std::fs::write(&list, "images-00000.png\ntunnel.png\n").unwrap();
        assert!(
            load(false)
                .unwrap_err()
                .to_string()
                .contains("line 2: \"tunnel.png\"")
        );
    }
}
