//! What is learnt from and what is held out, from the flags.

use crate::cli::data_args::ReadArgs;
use anyhow::{Context, bail, ensure};
use placeformer_core::folder::list_images;
use placeformer_lab::datasets::{self, Dataset, DatasetKind, DatasetOptions, Split};
use placeformer_lab::train::{Holdout, TripletSet};
use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};

/// Images to learn from; several sets may be given at once.
#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Data")]
pub(super) struct TrainData {
    /// A data set whose images have positions, in the layout in which it is distributed; repeat
    /// with --root. Images of different sets are taken to show different places.
    #[arg(
        long,
        value_enum,
        requires = "root",
        required_unless_present = "drives"
    )]
    dataset: Vec<DatasetKind>,
    /// Where that data set lies; one for each --dataset, in their order.
    #[arg(long, value_name = "DIR", requires = "dataset")]
    root: Vec<PathBuf>,
    #[command(flatten)]
    reading: ReadArgs,
    /// Folders of one drive each, whose frames follow each other by name and have no positions:
    /// neighbours show the same place.
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
    /// Share of the images held out for validation: whole blocks of ground, and the end of each
    /// drive. Images within the negative distance of a held-out one are not learnt from.
    #[arg(long, default_value_t = 0.2, value_name = "SHARE")]
    validation_share: f64,
    /// Side of a block of ground.
    #[arg(long, default_value_t = 100.0, value_name = "METRES")]
    validation_block: f64,
    /// A data set to validate on instead of a held-out share [split: val]; repeat with
    /// --validation-root.
    #[arg(long, value_enum, requires = "validation_root")]
    validation_dataset: Vec<DatasetKind>,
    /// Where that data set lies.
    #[arg(long, value_name = "DIR", requires = "validation_dataset")]
    validation_root: Vec<PathBuf>,
    /// Only these cities of the validation data set (MSLS) [default: the split's own]; --cities are
    /// those learnt from.
    #[arg(
        long,
        value_delimiter = ',',
        value_name = "CITY,...",
        requires = "validation_dataset"
    )]
    validation_cities: Vec<String>,
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
        let split = self.reading.split.unwrap_or(Split::Train);
        let options = DatasetOptions {
            split: Some(split),
            ..self.reading.options()
        };
        let given = read(&self.dataset, &self.root, &options, &self.drives)?;
        let explicit = !(self.validation_dataset.is_empty() && self.validation_drives.is_empty());
        let (training, validation) = if explicit {
            // The cities learnt from are never those judged on, so the flag for one side says
            // nothing about the other.
            let cities = self.validation_cities.clone();
            let options = DatasetOptions {
                split: Some(Split::Val),
                cities,
                ..self.reading.options()
            };
            (
                given,
                read(
                    &self.validation_dataset,
                    &self.validation_root,
                    &options,
                    &self.validation_drives,
                )?,
            )
        } else {
            self.hold_out(given, seed)?
        };
        let training = self.triplets(training).context("nothing to learn from")?;
        let validation = self
            .triplets(validation)
            .context("nothing to validate on")?;
        refuse_shared_images(&training, &validation)?;
        let of = |set: &TripletSet| {
            format!(
                "{} queries, {} database images",
                set.queries.len(),
                set.database.len()
            )
        };
        let description = format!("training {}; validation {}", of(&training), of(&validation));
        Ok(Sides {
            training,
            validation,
            description,
        })
    }

    /// The sets and drives as people would name them in a report.
    pub(super) fn names(&self) -> String {
        let paths = self
            .root
            .iter()
            .chain(&self.drives)
            .chain(&self.validation_root)
            .chain(&self.validation_drives);
        paths
            .map(|path| path.display().to_string())
            .collect::<Vec<_>>()
            .join(", ")
    }

    /// Which images count as positives and negatives, for a report.
    pub(super) fn distances(&self) -> String {
        let Self {
            positive_m,
            negative_m,
            positive_frames,
            negative_frames,
            ..
        } = self;
        format!(
            "positives within {positive_m} m or {positive_frames} frames, negatives beyond {negative_m} m or \
             {negative_frames} frames"
        )
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
            sets.push(TripletSet::by_position(
                dataset,
                self.positive_m,
                self.negative_m,
            )?);
        }
        if !sources.drives.is_empty() {
            sets.push(TripletSet::by_order(
                &sources.drives,
                self.positive_frames,
                self.negative_frames,
            )?);
        }
        Ok(TripletSet::merge(sets)?)
    }
}

fn read(
    kinds: &[DatasetKind],
    roots: &[PathBuf],
    options: &DatasetOptions,
    drives: &[PathBuf],
) -> anyhow::Result<Sources> {
    ensure!(
        kinds.len() == roots.len(),
        "{} data sets are named, and {} roots",
        kinds.len(),
        roots.len()
    );
    let mut sources = Sources::default();
    for (&kind, root) in kinds.iter().zip(roots) {
        let dataset = datasets::load(kind, root, options)?;
        if !dataset.database.iter().any(|item| item.position.is_some()) {
            bail!(
                "{}: no image has a position to tell places apart by",
                root.display()
            );
        }
        dataset
            .notes
            .iter()
            .for_each(|note| eprintln!("{}: {note}", dataset.name));
        sources.datasets.push(dataset);
    }
    sources.drives = drives
        .iter()
        .map(|folder| frames(folder))
        .collect::<anyhow::Result<_>>()?;
    Ok(sources)
}

/// Recall on images that were learnt from says nothing.
fn refuse_shared_images(training: &TripletSet, validation: &TripletSet) -> anyhow::Result<()> {
    let mut folders = HashMap::new();
    let mut files = |set: &TripletSet| -> anyhow::Result<HashSet<PathBuf>> {
        set.queries
            .iter()
            .chain(&set.database)
            .map(|path| one_name(path, &mut folders))
            .collect()
    };
    let learnt = files(training)?;
    if let Some(shared) = files(validation)?
        .iter()
        .find(|path| learnt.contains(*path))
    {
        bail!(
            "{} is among the images to learn from and among those to validate on",
            shared.display()
        );
    }
    Ok(())
}

/// The same path for the same file, by whatever way it was reached. Folders are looked up once:
/// data sets hold millions of files in few of them.
fn one_name(path: &Path, folders: &mut HashMap<PathBuf, PathBuf>) -> anyhow::Result<PathBuf> {
    let (Some(parent), Some(name)) = (path.parent(), path.file_name()) else {
        return Ok(path.to_owned());
    };
    let parent = if parent.as_os_str().is_empty() {
        Path::new(".")
    } else {
        parent
    };
    if let Some(real) = folders.get(parent) {
        return Ok(real.join(name));
    }
    let real = parent
        .canonicalize()
        .with_context(|| parent.display().to_string())?;
    let file = real.join(name);
    folders.insert(parent.to_owned(), real);
    Ok(file)
}

fn frames(folder: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let images = list_images(folder)?;
    ensure!(
        !images.is_empty(),
        "{} holds no JPEG, PNG or WebP image",
        folder.display()
    );
    Ok(images.into_iter().map(|(_, path)| path).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[derive(Parser)]
    struct Command {
        #[command(flatten)]
        data: TrainData,
    }

    fn load(arguments: &[&str]) -> anyhow::Result<Sides> {
        let command = Command::try_parse_from([&["train"], arguments].concat())?;
        command.data.load(1)
    }

    /// Cities of three places each, as MSLS is distributed; no city of training has a subtask
    /// index.
    fn msls() -> tempfile::TempDir {
        let root = tempfile::tempdir().unwrap();
        for city in ["london", "paris", "cph", "sf"] {
            for side in ["database", "query"] {
                let folder = root.path().join("train_val").join(city).join(side);
                std::fs::create_dir_all(folder.join("images")).unwrap();
                let (mut raw, mut post, mut index) = (
                    ",key,ca,pano\n".to_owned(),
                    ",key,easting,northing\n".to_owned(),
                    ",key,all\n".to_owned(),
                );
                for place in 0..3 {
                    let key = format!("{city}-{side}-{place}");
                    std::fs::write(folder.join("images").join(format!("{key}.jpg")), b"x").unwrap();
                    raw += &format!("{place},{key},0,False\n");
                    post += &format!("{place},{key},{},0\n", 500 * place);
                    index += &format!("{place},{key},True\n");
                }
                std::fs::write(folder.join("raw.csv"), raw).unwrap();
                std::fs::write(folder.join("postprocessed.csv"), post).unwrap();
                if ["cph", "sf"].contains(&city) {
                    std::fs::write(folder.join("subtask_index.csv"), index).unwrap();
                }
            }
        }
        root
    }

    fn cities(set: &TripletSet) -> Vec<String> {
        let city = |path: &PathBuf| {
            path.file_name()?
                .to_str()?
                .split('-')
                .next()
                .map(str::to_owned)
        };
        let cities: std::collections::BTreeSet<String> =
            set.queries.iter().filter_map(city).collect();
        cities.into_iter().collect()
    }

    #[test]
    fn cities_to_learn_from_are_not_those_to_validate_on() {
        let root = msls();
        let root = root.path().to_str().unwrap();
        let base = [
            "--dataset",
            "msls-val",
            "--root",
            root,
            "--cities",
            "london",
        ];
        let validation = [
            "--validation-dataset",
            "msls-val",
            "--validation-root",
            root,
        ];
        let with = |more: &[&str]| load(&[&base[..], &validation, more].concat());
        let sides = with(&[]).unwrap();
        assert_eq!(
            (cities(&sides.training), cities(&sides.validation)),
            (vec!["london".into()], vec!["cph".into(), "sf".into()])
        );
        assert_eq!(
            cities(&with(&["--validation-cities", "sf"]).unwrap().validation),
            ["sf"]
        );
    }

    #[test]
    fn an_image_on_both_sides_is_refused_by_whatever_way_it_is_reached() {
        let root = msls();
        let (plain, detour) = (root.path().to_owned(), root.path().join("train_val/.."));
        let refused = load(&[
            "--dataset",
            "msls-val",
            "--root",
            plain.to_str().unwrap(),
            "--cities",
            "cph",
            "--validation-dataset",
            "msls-val",
            "--validation-root",
            detour.to_str().unwrap(),
        ]);
        let error = refused.err().expect("cph is on both sides").to_string();
        assert!(
            error.contains("cph-") && error.contains("among those to validate on"),
            "{error}"
        );
    }
}
