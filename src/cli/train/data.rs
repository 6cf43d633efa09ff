//! What is learnt from and what is held out, from the flags.

use super::method::{MethodArgs, Recipe};
use crate::cli::choice::choice;
use crate::cli::data_args::ReadArgs;
use crate::cli::output::note;
use anyhow::{Context, ensure};
use placeformer_lab::datasets::{DatasetKind, DatasetOptions, GroundPart, Split};
use placeformer_lab::train::{
    Holdout, Reach, Sources, TripletRule, TripletSet, refuse_shared_images,
};
use std::path::{Path, PathBuf};

/// Images to learn from; several sets may be given at once.
#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Data")]
pub(super) struct TrainData {
    /// A data set whose images have positions, in the layout in which it is distributed; repeat
    /// with --root. Images of different sets are taken to show different places.
    #[arg(
        long,
        value_parser = choice::<DatasetKind>(),
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
    /// Greatest distance of a positive (paper: 10) [default: 10; 15 with --recipe streets].
    #[arg(long, value_name = "METRES")]
    positive_metres: Option<f64>,
    /// Greatest difference of headings of a positive, where both are known [default: no rule; 40
    /// with --recipe streets].
    #[arg(long, value_name = "DEGREES")]
    positive_degrees: Option<f64>,
    /// Distance beyond which an image is a negative; what lies between is neither (paper: 25)
    /// [default: 25; 40 with --recipe streets].
    #[arg(long, value_name = "METRES")]
    negative_metres: Option<f64>,
    /// Greatest frame distance of a positive in a drive.
    #[arg(long, default_value_t = 2, value_name = "FRAMES")]
    positive_frames: usize,
    /// Frame distance beyond which an image of the same drive is a negative.
    #[arg(long, default_value_t = 15, value_name = "FRAMES")]
    negative_frames: usize,
    /// Learn from the part `train` of the ground and validate on the part `selection`, so that the
    /// part `report`, a quarter, is never seen; `eval --hold-out` names the same parts.
    #[arg(long, conflicts_with_all = ["validation_dataset", "validation_drives"])]
    by_parts: bool,
    /// Share of the images held out for validation: whole blocks of ground, and the end of each
    /// drive. Images within the negative distance of a held-out one are not learnt from.
    #[arg(long, default_value_t = 0.2, value_name = "SHARE")]
    validation_share: f64,
    /// Side of a block of ground.
    #[arg(long, default_value_t = 100.0, value_name = "METRES")]
    validation_block: f64,
    /// A data set to validate on instead of a held-out share [split: val]; repeat with
    /// --validation-root.
    #[arg(long, value_parser = choice::<DatasetKind>(), requires = "validation_root")]
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

impl TrainData {
    /// Reads all sets and splits them by place.
    pub(super) fn load(&self, method: &MethodArgs) -> anyhow::Result<Sides> {
        let split = self.reading.split.unwrap_or(Split::Train);
        let options = DatasetOptions {
            split: Some(split),
            ..self.reading.options()
        };
        let given = read(&self.dataset, &self.root, &options, &self.drives)?;
        let explicit = !(self.validation_dataset.is_empty() && self.validation_drives.is_empty());
        let rule = self.rule(method.recipe);
        let (training, validation) = if explicit {
            (given, self.read_validation()?)
        } else if self.by_parts {
            let part = |part| given.part(part, rule.negative_frames);
            (part(GroundPart::Train)?, part(GroundPart::Selection)?)
        } else {
            given.hold_out(&self.holdout(method.seed, &rule))?
        };
        let training = training.triplets(&rule).context("nothing to learn from")?;
        let validation = validation
            .triplets(&rule)
            .context("nothing to validate on")?;
        refuse_shared_images(&training, &validation)?;
        let description = format!(
            "training {}; validation {}",
            counts(&training),
            counts(&validation)
        );
        Ok(Sides {
            training,
            validation,
            description,
        })
    }

    /// The sets and drives as people would name them in a report.
    pub(super) fn names(&self) -> String {
        let learnt = self.root.iter().chain(&self.drives);
        let validated = self.validation_root.iter().chain(&self.validation_drives);
        let names = learnt
            .chain(validated)
            .map(|path| path.display().to_string());
        names.collect::<Vec<String>>().join(", ")
    }

    /// Which images count as positives and negatives, for a report.
    pub(super) fn distances(&self, recipe: Recipe) -> String {
        let TripletRule {
            reach,
            positive_frames,
            negative_frames,
        } = self.rule(recipe);
        let degrees = match reach.degrees {
            Some(degrees) => format!(" and {degrees} degrees"),
            None => String::new(),
        };
        format!(
            "positives within {} m{degrees} or {positive_frames} frames, negatives beyond {} m or \
             {negative_frames} frames",
            reach.positive, reach.negative
        )
    }

    /// What is validated on where it is named. The cities learnt from are never those judged on,
    /// so that the flag for one side says nothing about the other.
    fn read_validation(&self) -> anyhow::Result<Sources> {
        let options = DatasetOptions {
            split: Some(Split::Val),
            cities: self.validation_cities.clone(),
            ..self.reading.options()
        };
        read(
            &self.validation_dataset,
            &self.validation_root,
            &options,
            &self.validation_drives,
        )
    }

    fn holdout(&self, seed: u64, rule: &TripletRule) -> Holdout {
        Holdout {
            share: self.validation_share,
            block_m: self.validation_block,
            gap_m: rule.reach.negative,
            gap_frames: rule.negative_frames,
            seed,
        }
    }

    fn rule(&self, recipe: Recipe) -> TripletRule {
        let degrees = recipe.pick(None, Some(40.0));
        TripletRule {
            reach: Reach {
                positive: self.positive_metres.unwrap_or(recipe.pick(10.0, 15.0)),
                degrees: self.positive_degrees.or(degrees),
                negative: self.negative_metres.unwrap_or(recipe.pick(25.0, 40.0)),
            },
            positive_frames: self.positive_frames,
            negative_frames: self.negative_frames,
        }
    }
}

fn counts(set: &TripletSet) -> String {
    let queries = set.queries.len();
    let database = set.database.len();
    format!("{queries} queries, {database} database images")
}

/// Reads the sets that are named, and shows their notes.
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
    let roots = roots.iter().map(PathBuf::as_path);
    let named: Vec<(DatasetKind, &Path)> = kinds.iter().copied().zip(roots).collect();
    let sources = Sources::read(&named, options, drives)?;
    for dataset in &sources.datasets {
        for note in &dataset.notes {
            note!("{}: {note}", dataset.name);
        }
    }
    Ok(sources)
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[derive(Parser)]
    struct Command {
        #[command(flatten)]
        data: TrainData,
        #[command(flatten)]
        method: MethodArgs,
    }

    fn load(arguments: &[&str]) -> anyhow::Result<Sides> {
        let command = Command::try_parse_from([&["train"], arguments].concat())?;
        command.data.load(&command.method)
    }

    /// Cities of three places each, as MSLS is distributed; no city of training has a subtask
    /// index.
    fn msls() -> tempfile::TempDir {
        let root = tempfile::tempdir().unwrap();
        for city in ["london", "paris", "cph", "sf"] {
            for side in ["database", "query"] {
                let folder = root.path().join("train_val").join(city).join(side);
                std::fs::create_dir_all(folder.join("images")).unwrap();
                let mut raw = ",key,ca,pano\n".to_owned();
                let mut post = ",key,easting,northing\n".to_owned();
                let mut index = ",key,all\n".to_owned();
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
        let plain = root.path().to_owned();
        let detour = root.path().join("train_val/..");
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
