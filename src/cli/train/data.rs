//! What is learnt from and what is held out, from the flags.

use crate::cli::data_args::ReadArgs;
use crate::eval::datasets::{self, Dataset, DatasetKind, Split, list_images};
use crate::train::{Holdout, TripletSet};
use anyhow::{Context, bail, ensure};
use std::path::{Path, PathBuf};

/// Images to learn from; several sets may be given at once.
#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Data")]
pub(super) struct TrainData {
    /// A data set whose images have positions, in the layout in which it is distributed; repeat with --root. Images of
    /// different sets are taken to show different places.
    #[arg(long, value_enum, requires = "root", required_unless_present = "drives")]
    dataset: Vec<DatasetKind>,
    /// Where that data set lies; one for each --dataset, in their order.
    #[arg(long, value_name = "DIR", requires = "dataset")]
    root: Vec<PathBuf>,
    #[command(flatten)]
    reading: ReadArgs,
    /// Folders of one drive each, whose frames follow each other by name and have no positions: neighbours show the
    /// same place.
    #[arg(long, num_args = 1.., value_name = "DIR")]
    drives: Vec<PathBuf>,
    /// Greatest distance of a positive (paper: 10).
    #[arg(long, default_value_t = 10.0, value_name = "METRES")]
    positive_m: f64,
    /// Distance beyond which an image is a negative (paper: 25).
    #[arg(long, default_value_t = 25.0, value_name = "METRES")]
    negative_m: f64,
    /// Greatest frame distance of a positive in a drive.
    #[arg(long, default_value_t = 2, value_name = "FRAMES")]
    positive_frames: usize,
    /// Frame distance beyond which an image of the same drive is a negative.
    #[arg(long, default_value_t = 15, value_name = "FRAMES")]
    negative_frames: usize,
    /// Share of the images held out for validation: whole blocks of ground, and the end of each drive. Images within
    /// the negative distance of a held-out one are not learnt from.
    #[arg(long, default_value_t = 0.2, value_name = "SHARE")]
    validation_share: f64,
    /// Side of a block of ground.
    #[arg(long, default_value_t = 100.0, value_name = "METRES")]
    validation_block: f64,
    /// A data set to validate on instead of a held-out share [split: val]; repeat with --validation-root.
    #[arg(long, value_enum, requires = "validation_root")]
    validation_dataset: Vec<DatasetKind>,
    /// Where that data set lies.
    #[arg(long, value_name = "DIR", requires = "validation_dataset")]
    validation_root: Vec<PathBuf>,
    /// Drives to validate on instead of a held-out share.
    #[arg(long, num_args = 1.., value_name = "DIR")]
    validation_drives: Vec<PathBuf>,
}

/// The two sides, and how they came about.
pub(super) struct Sides {
    pub(super) training: TripletSet,
    pub(super) validation: TripletSet,
    pub(super) description: String,
}

/// What is read before positives and negatives are told apart.
#[derive(Default)]
struct Sources {
    datasets: Vec<Dataset>,
    drives: Vec<Vec<PathBuf>>,
}

impl TrainData {
    /// Reads all sets and splits them by place.
    pub(super) fn load(&self, seed: u64) -> anyhow::Result<Sides> {
        let given = self.read(&self.dataset, &self.root, self.reading.split.unwrap_or(Split::Train), &self.drives)?;
        let explicit = !(self.validation_dataset.is_empty() && self.validation_drives.is_empty());
        let (training, validation) = if explicit {
            let (kinds, roots) = (&self.validation_dataset, &self.validation_root);
            (given, self.read(kinds, roots, Split::Val, &self.validation_drives)?)
        } else {
            self.hold_out(given, seed)?
        };
        let training = self.triplets(training).context("nothing to learn from")?;
        let validation = self.triplets(validation).context("nothing to validate on")?;
        let of = |set: &TripletSet| format!("{} queries, {} database images", set.queries.len(), set.database.len());
        let description = format!("training {}; validation {}", of(&training), of(&validation));
        Ok(Sides { training, validation, description })
    }

    /// The sets and drives as people would name them in a report.
    pub(super) fn names(&self) -> String {
        let paths = self.root.iter().chain(&self.drives).chain(&self.validation_root).chain(&self.validation_drives);
        paths.map(|path| path.display().to_string()).collect::<Vec<_>>().join(", ")
    }

    /// Which images count as positives and negatives, for a report.
    pub(super) fn distances(&self) -> String {
        let Self { positive_m, negative_m, positive_frames, negative_frames, .. } = self;
        format!(
            "positives within {positive_m} m or {positive_frames} frames, negatives beyond {negative_m} m or \
             {negative_frames} frames"
        )
    }

    fn read(
        &self,
        kinds: &[DatasetKind],
        roots: &[PathBuf],
        split: Split,
        drives: &[PathBuf],
    ) -> anyhow::Result<Sources> {
        ensure!(kinds.len() == roots.len(), "{} data sets are named, and {} roots", kinds.len(), roots.len());
        let mut sources = Sources::default();
        for (&kind, root) in kinds.iter().zip(roots) {
            let options = datasets::DatasetOptions { split: Some(split), ..self.reading.options() };
            let dataset = datasets::load(kind, root, &options)?;
            if !dataset.database.iter().any(|item| item.position.is_some()) {
                bail!("{}: no image has a position to tell places apart by", root.display());
            }
            sources.datasets.push(dataset);
        }
        sources.drives = drives.iter().map(|folder| frames(folder)).collect::<anyhow::Result<_>>()?;
        Ok(sources)
    }

    fn hold_out(&self, given: Sources, seed: u64) -> anyhow::Result<(Sources, Sources)> {
        let holdout = Holdout {
            share: self.validation_share,
            block_m: self.validation_block,
            gap_m: self.negative_m,
            gap_frames: self.negative_frames,
            seed,
        };
        let (mut training, mut validation) = (Sources::default(), Sources::default());
        for dataset in &given.datasets {
            let (learnt, kept) = holdout.by_blocks(dataset)?;
            training.datasets.push(learnt);
            validation.datasets.push(kept);
        }
        (training.drives, validation.drives) = holdout.by_tails(&given.drives)?;
        Ok((training, validation))
    }

    fn triplets(&self, sources: Sources) -> anyhow::Result<TripletSet> {
        let mut sets = Vec::new();
        for dataset in &sources.datasets {
            sets.push(TripletSet::by_position(dataset, self.positive_m, self.negative_m)?);
        }
        if !sources.drives.is_empty() {
            sets.push(TripletSet::by_order(&sources.drives, self.positive_frames, self.negative_frames)?);
        }
        Ok(TripletSet::merge(sets)?)
    }
}

fn frames(folder: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let images = list_images(folder)?;
    ensure!(!images.is_empty(), "{} holds no JPEG, PNG or WebP image", folder.display());
    Ok(images.into_iter().map(|(_, path)| path).collect())
}
