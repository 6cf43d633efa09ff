//! Fit or train the projection to the global descriptor.

use super::model_args::ModelOptions;
use super::train::{HeadTrainArgs, train_head};
use crate::cli::output::say;
use crate::cli::progress::ProgressBars;
use anyhow::Context;
use clap::{Args, Subcommand, ValueEnum};
use indicatif::{ProgressBar, ProgressStyle};
use placeformer_core::files::hash_file;
use placeformer_core::folder::list_images as images_below;
use placeformer_core::types::ImageTensor;
use placeformer_models::open_extractor;
use placeformer_vision::extract::{
    Aggregate, Covariance, ExtractConfig, Extractor, Head, HeadChoice, VladWords,
    half_whitened_head_of_few, sample_tokens,
};
use placeformer_vision::image::{ImageConfig, load_tensor};
use rayon::prelude::*;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// Arguments of this subcommand.
#[derive(Debug, Args)]
pub struct HeadArgs {
    /// What to do.
    #[command(subcommand)]
    command: HeadCommand,
}

#[derive(Debug, Subcommand)]
#[allow(clippy::large_enum_variant, reason = "one value, parsed once")]
enum HeadCommand {
    /// Fit a head without labels: PCA to 256 components with half whitening.
    Fit(FitArgs),
    /// Train a head on places with triplets; the same as `train --trainable head`.
    ///
    /// Every image is encoded once and its pooled tokens are kept in the user's cache (--cache), so
    /// that a step costs a matrix product: minutes on a CPU. The head that --head names is where it
    /// starts, and says how tokens are pooled.
    Train(HeadTrainArgs),
}

#[derive(Debug, Args)]
struct FitArgs {
    /// Directories of images, searched to any depth; more than 256 images in all.
    #[arg(long, required = true, num_args = 1.., value_name = "DIR")]
    images: Vec<PathBuf>,
    /// Where the head goes.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// How patch tokens become one vector. It is carried by the head and becomes part of the
    /// model's identity.
    #[arg(long, value_enum, default_value_t)]
    aggregate: AggregateKind,
    /// Power of the generalised mean, 1 to 64; 1 is the mean.
    #[arg(long, default_value_t = 3.0, value_name = "P")]
    gem_p: f32,
    /// Visual words of a VLAD. Each makes a stored reference 0.8 kB larger with ViT-S.
    #[arg(long, default_value_t = 16, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=256))]
    words: u16,
    /// Seed of the draw of tokens that visual words are learnt from.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    #[command(flatten)]
    model: ModelOptions,
}

/// How patch tokens become one vector.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, ValueEnum)]
enum AggregateKind {
    /// Their mean (the paper's).
    #[default]
    Mean,
    /// Their generalised mean: strong activations weigh more.
    Gem,
    /// A sum of residuals for each of some visual words.
    Vlad,
}

/// Images decoded together while the transformer waits, and encoded together while the decoder
/// does.
const BATCH: usize = 16;
/// Images that visual words are learnt from, evenly spread over all, and tokens drawn from each.
const WORD_IMAGES: usize = 256;
const WORD_TOKENS: usize = 100;
/// Most images behind a PCA of vectors too long for a covariance matrix; the cost grows with its
/// cube.
const MOST_LONG_VECTORS: usize = 2048;

/// Runs it.
pub fn run(args: HeadArgs) -> anyhow::Result<()> {
    match args.command {
        HeadCommand::Fit(args) => fit(args),
        HeadCommand::Train(args) => train_head(args),
    }
}

fn fit(args: FitArgs) -> anyhow::Result<()> {
    let files = training_images(&args.images)?;
    let config = ExtractConfig {
        head: HeadChoice::None,
        ..args.model.extract_config()?
    };
    // A power that cannot be used is refused before the model is loaded.
    let gem = Aggregate::gem(args.gem_p).map_err(anyhow::Error::msg);
    let gem = if args.aggregate == AggregateKind::Gem {
        Some(gem?)
    } else {
        None
    };
    let mut reader = Reader {
        extractor: open_extractor(&config, &ProgressBars::default())?,
        unreadable: BTreeSet::new(),
    };
    let (aggregate, files) = match (args.aggregate, gem) {
        (AggregateKind::Vlad, _) => (
            Aggregate::Vlad(reader.visual_words(&files, &args)?),
            spread(&files, MOST_LONG_VECTORS),
        ),
        (_, Some(gem)) => (gem, files),
        (_, None) => (Aggregate::Mean, files),
    };
    let (head, images) = reader.fit(&files, aggregate)?;
    reader
        .unreadable
        .iter()
        .for_each(|line| eprintln!("left out: {line}"));
    if let Some(directory) = args.out.parent() {
        std::fs::create_dir_all(directory).with_context(|| directory.display().to_string())?;
    }
    head.save(&args.out)?;
    say!(
        "{} ({}) from {images} images for {}",
        args.out.display(),
        head.aggregate(),
        head.backbone()
    )?;
    say!("sha256 {}", hash_file(&args.out)?)?;
    Ok(())
}

/// Reads images for a fit, remembering those it cannot.
struct Reader {
    extractor: Extractor,
    unreadable: BTreeSet<String>,
}

impl Reader {
    fn visual_words(&mut self, files: &[PathBuf], args: &FitArgs) -> anyhow::Result<VladWords> {
        let (mut tokens, dim, mut number) = (Vec::new(), self.extractor.dim(), args.seed);
        self.each_batch(
            &spread(files, WORD_IMAGES),
            "sampling tokens",
            |extractor, tensors| {
                for encoded in extractor.encode(tensors)? {
                    tokens.extend(sample_tokens(&encoded.tokens, dim, WORD_TOKENS, number));
                    number = number.wrapping_add(1);
                }
                Ok(())
            },
        )?;
        Ok(VladWords::fit(
            &tokens,
            dim,
            usize::from(args.words),
            args.seed,
        )?)
    }

    /// The head, and from how many images.
    fn fit(&mut self, files: &[PathBuf], aggregate: Aggregate) -> anyhow::Result<(Head, usize)> {
        let method = format!(
            "PCA with half whitening of L2-normalised {} tokens",
            aggregate.kind()
        );
        let dim = aggregate.pooled_dim(self.extractor.dim());
        let mut notes = BTreeMap::from([
            ("method".to_owned(), method),
            (
                "input_size".to_owned(),
                self.extractor.input_size().to_string(),
            ),
        ]);
        let backbone = self.extractor.backbone().to_owned();
        if matches!(aggregate, Aggregate::Vlad(_)) {
            let mut vectors = Vec::new();
            self.each_batch(files, "describing images", |extractor, tensors| {
                vectors.extend(extractor.pooled_by(tensors, &aggregate)?);
                Ok(())
            })?;
            notes.insert("images".into(), vectors.len().to_string());
            return Ok((
                half_whitened_head_of_few(&vectors, aggregate, &backbone, notes)?,
                vectors.len(),
            ));
        }
        let mut covariance = Covariance::new(dim);
        self.each_batch(files, "describing images", |extractor, tensors| {
            extractor
                .pooled_by(tensors, &aggregate)?
                .iter()
                .for_each(|pooled| covariance.add(pooled));
            Ok(())
        })?;
        let images = covariance.count();
        notes.insert("images".into(), images.to_string());
        Ok((
            covariance.half_whitened_head(aggregate, &backbone, notes)?,
            images,
        ))
    }

    fn each_batch(
        &mut self,
        files: &[PathBuf],
        message: &'static str,
        mut visit: impl FnMut(&Extractor, &[ImageTensor]) -> anyhow::Result<()>,
    ) -> anyhow::Result<()> {
        let style =
            ProgressStyle::with_template("{msg} [{bar:40}] {pos}/{len} {per_sec} {eta} left")?;
        let bar = ProgressBar::new(files.len() as u64)
            .with_style(style)
            .with_message(message);
        for batch in files.chunks(BATCH) {
            let decoded: Vec<_> = batch
                .par_iter()
                .map(|path| (path, decode(path, &self.extractor)))
                .collect();
            let mut tensors = Vec::with_capacity(batch.len());
            for (path, tensor) in decoded {
                match tensor {
                    Ok(tensor) => tensors.push(tensor),
                    Err(error) => {
                        self.unreadable
                            .insert(format!("{}: {error:#}", path.display()));
                    }
                }
            }
            visit(&self.extractor, &tensors)?;
            bar.inc(batch.len() as u64);
        }
        bar.finish_and_clear();
        Ok(())
    }
}

fn decode(path: &Path, extractor: &Extractor) -> anyhow::Result<ImageTensor> {
    let bytes = std::fs::read(path)?;
    Ok(load_tensor(
        &bytes,
        &ImageConfig::default(),
        extractor.input_size(),
    )?)
}

/// At most `count` of `files`, evenly spread.
fn spread(files: &[PathBuf], count: usize) -> Vec<PathBuf> {
    let step = (files.len() as f64 / count as f64).max(1.0);
    (0..files.len().min(count))
        .map(|i| files[(i as f64 * step) as usize].clone())
        .collect()
}

/// Every image below `directories`, sorted, so that a fit can be repeated.
fn training_images(directories: &[PathBuf]) -> anyhow::Result<Vec<PathBuf>> {
    let mut files = Vec::new();
    for directory in directories {
        files.extend(images_below(directory)?.into_iter().map(|(_, path)| path));
    }
    anyhow::ensure!(
        !files.is_empty(),
        "there are no images in the given directories"
    );
    Ok(files)
}
