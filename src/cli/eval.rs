//! Measure recall on a data set.

use super::model_args::ModelOptions;
use crate::eval::ablate::{Base, ablate};
use crate::eval::datasets::{self, Dataset, DatasetKind, DatasetOptions, Split};
use crate::eval::features::{Describe, FeatureCache, Features, GlobalKind, ModelDescriber};
use crate::eval::report::{Painter, gallery};
use crate::eval::run::{Answer, QuerySeconds, rerank_all, search_all};
use crate::eval::summary::{RunConfig, Summary, summarise};
use crate::eval::{EvalError, prediction, report};
use crate::extract::{ExtractConfig, Extractor, Preset};
use crate::image::ImageConfig;
use crate::rerank::{RerankConfig, Reranker};
use crate::types::ScaleSet;
use anyhow::{Context, bail, ensure};
use indicatif::{MultiProgress, ProgressBar, ProgressStyle};
use std::path::{Path, PathBuf};

/// Arguments of this subcommand.
#[derive(Debug, clap::Args)]
pub struct EvalArgs {
    #[command(flatten)]
    data: DataArgs,
    #[command(flatten)]
    model: ModelOptions,
    #[command(flatten)]
    method: MethodArgs,
    #[command(flatten)]
    output: OutputArgs,
}

/// Which images, and what is right.
#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Data set")]
struct DataArgs {
    /// Folder of reference images.
    #[arg(long, value_name = "DIR", requires = "queries", requires = "ground_truth", conflicts_with = "dataset")]
    database: Option<PathBuf>,
    /// Folder of query images.
    #[arg(long, value_name = "DIR", requires = "database")]
    queries: Option<PathBuf>,
    /// CSV `query,reference`, one accepted pair a row; an empty reference says that no match exists.
    #[arg(long, value_name = "CSV", requires = "database")]
    ground_truth: Option<PathBuf>,
    /// A data set in the layout in which it is distributed.
    #[arg(long, value_enum, requires = "root", required_unless_present = "database")]
    dataset: Option<DatasetKind>,
    /// Where that data set lies.
    #[arg(long, value_name = "DIR", requires = "dataset")]
    root: Option<PathBuf>,
    /// Part of the data set [default: test; val for MSLS; train for RobotCar, whose test poses are withheld].
    #[arg(long, value_enum)]
    split: Option<Split>,
    /// Greatest distance of a positive in metres.
    #[arg(long, default_value_t = 25.0, value_name = "METRES")]
    radius: f64,
    /// Greatest difference of view angles of a positive in degrees [default: 40 for MSLS, else no rule].
    #[arg(long, value_name = "DEGREES")]
    max_angle: Option<f64>,
    /// Greatest frame distance of a positive (Nordland).
    #[arg(long, default_value_t = 10, value_name = "FRAMES")]
    frame_tolerance: u64,
    /// Only these cities (MSLS).
    #[arg(long, value_delimiter = ',', value_name = "CITY,...")]
    cities: Vec<String>,
    /// Task of MSLS: all, s2w, w2s, o2n, n2o, d2n, n2d.
    #[arg(long, default_value = "all")]
    subtask: String,
}

/// What is done to the images.
#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Method")]
struct MethodArgs {
    /// What is searched: the head's output, or the mean patch token before it.
    #[arg(long, value_enum, default_value = "head")]
    global: GlobalKind,
    /// Candidates that are re-ranked.
    #[arg(long, default_value_t = 100, value_name = "N")]
    candidates: usize,
    /// Leave re-ranking out.
    #[arg(long)]
    no_rerank: bool,
    /// Scale combinations whose inliers add up to S.
    #[arg(long, value_delimiter = ',', default_value = "1,1+2,2+3", value_name = "SET,...")]
    scales: Vec<ScaleSet>,
    /// Repeat along the axes of the paper's ablation tables.
    #[arg(long)]
    ablate: bool,
    /// Backbones the ablation compares; their weights are pulled if they are missing.
    #[arg(long, value_delimiter = ',', value_name = "PRESET,...", requires = "ablate")]
    backbones: Vec<Preset>,
    /// Bootstrap resamples behind the 95% intervals.
    #[arg(long, default_value_t = 2000, value_name = "N")]
    bootstrap: usize,
    /// Seed of the bootstrap.
    #[arg(long, default_value_t = 0)]
    seed: u64,
}

/// Where results go.
#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Output")]
struct OutputArgs {
    /// Write everything measured as JSON.
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Write a self-contained report.
    #[arg(long, value_name = "FILE")]
    html: Option<PathBuf>,
    /// Queries of each kind (worst, best, without match) shown as pictures in the report.
    #[arg(long, default_value_t = 4, value_name = "N")]
    pictures: usize,
    /// Write the benchmark's prediction file (MSLS, RobotCar Seasons).
    #[arg(long, value_name = "FILE")]
    predictions: Option<PathBuf>,
    /// Folder where descriptors are kept between runs.
    #[arg(long, value_name = "DIR")]
    cache: Option<PathBuf>,
    /// Megabytes of key patches held in memory.
    #[arg(long, default_value_t = 1024, value_name = "MB")]
    patch_memory: u64,
}

/// Runs it.
pub fn run(args: EvalArgs) -> anyhow::Result<()> {
    crate::kernels::self_check()?;
    ensure!(args.method.candidates > 0, "--candidates must be at least 1");
    let dataset = args.data.load()?;
    eprintln!("{}: {} references, {} queries", dataset.name, dataset.database.len(), dataset.queries.len());
    let extract = args.model.extract_config()?;
    let measured = measure(&args, &dataset, &extract)?;
    print!("{}", report::text(&measured.summary));
    if let Some(path) = &args.output.predictions {
        write_predictions(path, &args, &dataset, &measured.answers)?;
    }
    let mut details = String::new();
    let mut json = serde_json::to_value(&measured.summary)?;
    if args.method.ablate {
        let rows = run_ablation(&args, &dataset, &extract)?;
        print!("\n{}", report::ablation_text(&rows));
        details += &report::ablation_html(&rows);
        json["ablation"] = serde_json::to_value(&rows)?;
    }
    if let Some(path) = &args.output.json {
        write(path, &(serde_json::to_string_pretty(&json)? + "\n"))?;
    }
    if let Some(path) = &args.output.html {
        let limits = ImageConfig::default();
        let reranker = Reranker::new(args.method.rerank_config());
        let painter = Painter { extractor: &measured.extractor, limits: &limits, reranker: &reranker };
        details += &gallery(&painter, &dataset, &measured.answers, args.output.pictures)?;
        write(path, &report::html(&measured.summary, &dataset, &measured.answers, &details))?;
    }
    Ok(())
}

fn write(path: &Path, text: &str) -> anyhow::Result<()> {
    std::fs::write(path, text).with_context(|| format!("cannot write {}", path.display()))?;
    eprintln!("wrote {}", path.display());
    Ok(())
}

impl DataArgs {
    fn load(&self) -> anyhow::Result<Dataset> {
        let options = DatasetOptions {
            split: self.split,
            radius_m: self.radius,
            max_angle_deg: self.max_angle,
            frame_tolerance: self.frame_tolerance,
            cities: self.cities.clone(),
            subtask: self.subtask.clone(),
        };
        Ok(match (&self.database, &self.queries, &self.ground_truth, self.dataset, &self.root) {
            (Some(database), Some(queries), Some(truth), ..) => datasets::load_pairs(database, queries, truth)?,
            (_, _, _, Some(kind), Some(root)) => datasets::load(kind, root, &options)?,
            _ => bail!("give --dataset and --root, or --database, --queries and --ground-truth"),
        })
    }
}

impl OutputArgs {
    fn cache_folder(&self) -> anyhow::Result<PathBuf> {
        match &self.cache {
            Some(folder) => Ok(folder.clone()),
            None => Ok(crate::extract::pull::cache_dir()?.join("eval")),
        }
    }
}

impl MethodArgs {
    fn rerank_config(&self) -> RerankConfig {
        RerankConfig { scales: self.scales.clone(), ..Default::default() }
    }
}

struct Measured {
    extractor: Extractor,
    answers: Vec<Answer>,
    summary: Summary,
}

fn describer(model: &ModelOptions, config: &ExtractConfig) -> anyhow::Result<ModelDescriber> {
    Ok(ModelDescriber { extractor: model.open(config)?, limits: ImageConfig::default() })
}

fn measure(args: &EvalArgs, dataset: &Dataset, extract: &ExtractConfig) -> anyhow::Result<Measured> {
    let describer = describer(&args.model, extract)?;
    let cache = FeatureCache::open(&args.output.cache_folder()?, describer.model(), args.output.patch_memory << 20)?;
    let images = (dataset.database.len() + dataset.queries.len()) as u64;
    let bar = bar(images, "describing");
    let side = |items, name| cache.describe_all(&describer, items, name, args.method.global, &bar);
    let (database, queries) = (side(&dataset.database, "database")?, side(&dataset.queries, "query")?);
    bar.finish_and_clear();
    let cached = dataset.database.len() + dataset.queries.len() - database.fresh - queries.fresh;
    eprintln!("described {} images, {cached} more were cached or unreadable", database.fresh + queries.fresh);
    let (answers, seconds) = answer_all(args, &cache, &database, &queries)?;
    let config = RunConfig {
        model: describer.model().clone(),
        global: args.method.global,
        candidates: args.method.candidates,
        extract: describer.extractor.config().clone(),
        rerank: (!args.method.no_rerank).then(|| args.method.rerank_config()),
        bootstrap: args.method.bootstrap,
        seed: args.method.seed,
    };
    let summary = summarise(dataset, &database, &queries, &answers, seconds, config)?;
    Ok(Measured { extractor: describer.extractor, answers, summary })
}

fn answer_all(
    args: &EvalArgs,
    cache: &FeatureCache,
    database: &Features,
    queries: &Features,
) -> anyhow::Result<(Vec<Answer>, QuerySeconds)> {
    let (answers, search) = search_all(database, queries, args.method.candidates);
    if args.method.no_rerank {
        return Ok((answers, QuerySeconds { search, ..Default::default() }));
    }
    let bar = bar(answers.len() as u64, "re-ranking");
    let patches = |features: &Features, index| cache.patches(features, index);
    let (answers, seconds) = rerank_all(&patches, database, queries, answers, &args.method.rerank_config(), &bar)?;
    bar.finish_and_clear();
    Ok((answers, QuerySeconds { search, ..seconds }))
}

fn write_predictions(path: &Path, args: &EvalArgs, dataset: &Dataset, answers: &[Answer]) -> anyhow::Result<()> {
    match args.data.dataset {
        Some(DatasetKind::MslsTest | DatasetKind::MslsVal) => prediction::write_msls(path, dataset, answers)?,
        Some(DatasetKind::RobotcarSeasonsV2) => prediction::write_robotcar(path, dataset, answers)?,
        _ => bail!("only MSLS and RobotCar Seasons have a prediction file"),
    }
    eprintln!("wrote {}", path.display());
    Ok(())
}

fn run_ablation(
    args: &EvalArgs,
    dataset: &Dataset,
    extract: &ExtractConfig,
) -> anyhow::Result<Vec<crate::eval::ablate::AblationRow>> {
    let rerank = args.method.rerank_config();
    let mut backbones = vec![extract.preset];
    backbones.extend(args.method.backbones.iter().filter(|&&preset| preset != extract.preset));
    let base = Base {
        extract,
        rerank: &rerank,
        candidates: args.method.candidates,
        backbones: &backbones,
        cache: &args.output.cache_folder()?,
        memory_bytes: args.output.patch_memory << 20,
    };
    let open = |config: &ExtractConfig| -> Result<Box<dyn Describe>, EvalError> {
        let describer = describer(&args.model, config).map_err(|error| EvalError::Setting(format!("{error:#}")))?;
        Ok(Box::new(describer))
    };
    Ok(ablate(dataset, &base, &open, &MultiProgress::new())?)
}

fn bar(length: u64, message: &'static str) -> ProgressBar {
    let style = ProgressStyle::with_template("{msg} {wide_bar} {pos}/{len} {eta}")
        .unwrap_or_else(|_| ProgressStyle::default_bar());
    ProgressBar::new(length).with_style(style).with_message(message)
}
