//! Fit or train the projection to the global descriptor.

use super::model_args::ModelOptions;
use crate::extract::{Covariance, ExtractConfig, Extractor, HeadChoice, hash_file};
use crate::image::{ImageConfig, load_tensor};
use anyhow::Context;
use clap::{Args, Subcommand, ValueEnum};
use indicatif::{ProgressBar, ProgressStyle};
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Arguments of this subcommand.
#[derive(Debug, Args)]
pub struct HeadArgs {
    /// What to do.
    #[command(subcommand)]
    command: HeadCommand,
}

#[derive(Debug, Subcommand)]
enum HeadCommand {
    /// Fit a head without labels: PCA to 256 components with half whitening.
    Fit(FitArgs),
}

#[derive(Debug, Args)]
struct FitArgs {
    /// Directories of images, searched to any depth; more than 256 images in all.
    #[arg(long, required = true, num_args = 1.., value_name = "DIR")]
    images: Vec<PathBuf>,
    /// Where the head goes.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// How patch tokens become one vector.
    #[arg(long, value_enum, default_value_t)]
    aggregate: Aggregate,
    #[command(flatten)]
    model: ModelOptions,
}

/// How patch tokens become one vector.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, ValueEnum)]
enum Aggregate {
    /// Their mean (the paper's).
    #[default]
    Mean,
}

/// Images decoded together while the transformer waits, and encoded together while the decoder does.
const BATCH: usize = 16;

/// Runs it.
pub fn run(args: HeadArgs) -> anyhow::Result<()> {
    match args.command {
        HeadCommand::Fit(args) => fit(args),
    }
}

fn fit(args: FitArgs) -> anyhow::Result<()> {
    let Aggregate::Mean = args.aggregate;
    let files = list_images(&args.images)?;
    let config = ExtractConfig { head: HeadChoice::None, ..args.model.extract_config()? };
    let extractor = args.model.open(&config)?;
    let mut covariance = Covariance::new(extractor.dim());
    let mut unreadable = Vec::new();
    let bar = ProgressBar::new(files.len() as u64)
        .with_style(ProgressStyle::with_template("describing images [{bar:40}] {pos}/{len} {per_sec} {eta} left")?);
    for batch in files.chunks(BATCH) {
        let decoded: Vec<_> = batch.par_iter().map(|path| (path, decode(path, &extractor))).collect();
        let mut tensors = Vec::with_capacity(batch.len());
        for (path, tensor) in decoded {
            match tensor {
                Ok(tensor) => tensors.push(tensor),
                Err(error) => unreadable.push(format!("{}: {error:#}", path.display())),
            }
        }
        extractor.pooled(&tensors)?.iter().for_each(|pooled| covariance.add(pooled));
        bar.inc(batch.len() as u64);
    }
    bar.finish_and_clear();
    unreadable.iter().for_each(|line| eprintln!("left out: {line}"));
    let notes = BTreeMap::from([
        ("method".to_owned(), "PCA with half whitening of L2-normalised mean tokens".to_owned()),
        ("images".to_owned(), covariance.count().to_string()),
        ("input_size".to_owned(), extractor.input_size().to_string()),
    ]);
    let head = covariance.half_whitened_head(extractor.backbone(), notes)?;
    if let Some(directory) = args.out.parent() {
        std::fs::create_dir_all(directory).with_context(|| directory.display().to_string())?;
    }
    head.save(&args.out)?;
    println!("{} from {} images for {}", args.out.display(), covariance.count(), head.backbone());
    println!("sha256 {}", hash_file(&args.out)?);
    Ok(())
}

fn decode(path: &Path, extractor: &Extractor) -> anyhow::Result<crate::types::ImageTensor> {
    let bytes = std::fs::read(path)?;
    Ok(load_tensor(&bytes, &ImageConfig::default(), extractor.input_size())?)
}

/// Every image below `directories`, sorted, so that a fit can be repeated.
fn list_images(directories: &[PathBuf]) -> anyhow::Result<Vec<PathBuf>> {
    let mut files = Vec::new();
    for directory in directories {
        for entry in walkdir::WalkDir::new(directory).follow_links(true).sort_by_file_name() {
            let path = entry?.into_path();
            let extension = path.extension().and_then(|e| e.to_str()).unwrap_or_default().to_ascii_lowercase();
            if path.is_file() && ["jpg", "jpeg", "png", "webp"].contains(&extension.as_str()) {
                files.push(path);
            }
        }
    }
    anyhow::ensure!(!files.is_empty(), "there are no images in the given directories");
    Ok(files)
}
