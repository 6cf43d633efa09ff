//! The images that training and validation may draw on, before positives and negatives are found
//! among them.

use super::error::TrainError;
use super::holdout::Holdout;
use super::spots::Reach;
use super::triplets::TripletSet;
use crate::datasets::{self, Dataset, DatasetKind, DatasetOptions, GroundPart};
use placeformer_core::folder::list_images;
use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};

/// Data sets whose images have positions, and drives whose frames have an order only.
#[derive(Debug, Default)]
pub struct Sources {
    /// Images of different sets are taken to show different places.
    pub datasets: Vec<Dataset>,
    /// The frames of each drive, in their order.
    pub drives: Vec<Vec<PathBuf>>,
}

/// Which images count as positives and negatives of a query.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TripletRule {
    /// Reach of positives and negatives in metres.
    pub reach: Reach,
    /// Greatest frame distance of a positive in a drive.
    pub positive_frames: usize,
    /// Frame distance beyond which an image of the same drive is a negative.
    pub negative_frames: usize,
}

impl Sources {
    /// Reads the data sets of `kinds`, each at its root, and the drives, a folder each.
    ///
    /// # Errors
    /// A set or a folder cannot be read, no image of a set has a position, or a drive has no image.
    pub fn read(
        kinds: &[(DatasetKind, &Path)],
        options: &DatasetOptions,
        drives: &[PathBuf],
    ) -> Result<Self, TrainError> {
        let mut sources = Self::default();
        for &(kind, root) in kinds {
            let dataset = datasets::load(kind, root, options)?;
            if dataset.database.iter().all(|item| item.position.is_none()) {
                return Err(TrainError::Setting(format!(
                    "{}: no image has a position to tell places apart by",
                    root.display()
                )));
            }
            sources.datasets.push(dataset);
        }
        for folder in drives {
            sources.drives.push(frames(folder)?);
        }
        Ok(sources)
    }

    /// Splits into what is learnt from and what is held out: blocks of ground, and the end of each
    /// drive.
    ///
    /// # Errors
    /// A setting is out of range, or a set is too small to hold out any of it.
    pub fn hold_out(&self, holdout: &Holdout) -> Result<(Self, Self), TrainError> {
        let mut training = Self::default();
        let mut validation = Self::default();
        for dataset in &self.datasets {
            let (learnt, kept) = holdout.by_blocks(dataset)?;
            training.datasets.push(learnt);
            validation.datasets.push(kept);
        }
        (training.drives, validation.drives) = holdout.by_tails(&self.drives)?;
        Ok((training, validation))
    }

    /// The images of a named part of the ground, and the frames of that part of each drive, with
    /// `gap_frames` between two parts.
    ///
    /// # Errors
    /// A set cannot be split.
    pub fn part(&self, part: GroundPart, gap_frames: usize) -> Result<Self, TrainError> {
        let mut sources = Self::default();
        for dataset in &self.datasets {
            sources.datasets.push(part.of(dataset)?);
        }
        let of_drive = |drive: &Vec<PathBuf>| part.of_drive(drive, gap_frames);
        sources.drives = self.drives.iter().map(of_drive).collect();
        Ok(sources)
    }

    /// Finds the positives of every query, and what is too near to be a negative.
    ///
    /// # Errors
    /// The distances of `rule` are out of order, or no query has both a positive and a negative.
    pub fn triplets(&self, rule: &TripletRule) -> Result<TripletSet, TrainError> {
        let mut sets = Vec::new();
        for dataset in &self.datasets {
            sets.push(TripletSet::by_position(dataset, rule.reach)?);
        }
        if !self.drives.is_empty() {
            let positive = rule.positive_frames;
            let negative = rule.negative_frames;
            sets.push(TripletSet::by_order(&self.drives, positive, negative)?);
        }
        TripletSet::merge(sets)
    }
}

/// Refuses sets that share an image: recall on images that were learnt from says nothing.
///
/// # Errors
/// An image is on both sides, by whatever path, or a folder of one cannot be found.
pub fn refuse_shared_images(
    training: &TripletSet,
    validation: &TripletSet,
) -> Result<(), TrainError> {
    let mut names = CanonicalNames::default();
    let learnt = names.of_set(training)?;
    let validated = names.of_set(validation)?;
    match validated.iter().find(|path| learnt.contains(*path)) {
        None => Ok(()),
        Some(shared) => Err(TrainError::Setting(format!(
            "{} is among the images to learn from and among those to validate on",
            shared.display()
        ))),
    }
}

/// Gives the same path to the same file, by whatever path it was reached. Folders are looked up
/// once: data sets hold millions of files in few of them.
#[derive(Default)]
struct CanonicalNames {
    /// Folders as they were named, with their canonical paths.
    folders: HashMap<PathBuf, PathBuf>,
}

impl CanonicalNames {
    fn of_set(&mut self, set: &TripletSet) -> Result<HashSet<PathBuf>, TrainError> {
        let mut names = HashSet::new();
        for path in set.queries.iter().chain(&set.database) {
            names.insert(self.of(path)?);
        }
        Ok(names)
    }

    fn of(&mut self, path: &Path) -> Result<PathBuf, TrainError> {
        let (Some(parent), Some(name)) = (path.parent(), path.file_name()) else {
            return Ok(path.to_owned());
        };
        let parent = if parent.as_os_str().is_empty() {
            Path::new(".")
        } else {
            parent
        };
        if let Some(canonical) = self.folders.get(parent) {
            return Ok(canonical.join(name));
        }
        let canonical = parent.canonicalize().map_err(|source| TrainError::Io {
            path: parent.to_owned(),
            source,
        })?;
        let file = canonical.join(name);
        self.folders.insert(parent.to_owned(), canonical);
        Ok(file)
    }
}

/// The images below the folder of a drive, in the order of their names.
fn frames(folder: &Path) -> Result<Vec<PathBuf>, TrainError> {
    let images = list_images(folder).map_err(datasets::DatasetError::from)?;
    if images.is_empty() {
        return Err(TrainError::Setting(format!(
            "{} holds no JPEG, PNG or WebP image",
            folder.display()
        )));
    }
    Ok(images.into_iter().map(|(_, path)| path).collect())
}
