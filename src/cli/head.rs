//! Fit or train the projection to the global descriptor.

use super::model_args::ModelOptions;
use super::train::{HeadTrainArgs, train_head};
use crate::cli::output::{note, say};
use crate::cli::progress::ProgressBars;
use anyhow::Context;
use clap::{Args, Subcommand, ValueEnum};
use placeformer_core::files::hash_file;
use placeformer_core::folder::list_images;
use placeformer_lab::train::{AggregateChoice, fit_head};
use placeformer_models::open_extractor;
use placeformer_vision::extract::{Aggregate, ExtractConfig, HeadChoice, NetVladShape, Whitening};
use std::path::PathBuf;

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
    /// Fit a head without labels: a partly whitened PCA to 256 components.
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
    /// Visual words [default: 16 of a VLAD, 64 of a NetVLAD]. Each makes a stored reference larger
    /// by the width of its tokens, 0.8 kB for a VLAD with ViT-S.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=256))]
    words: Option<u16>,
    /// Width to which a NetVLAD projects tokens.
    #[arg(long, default_value_t = NetVladShape::default().width, value_name = "N")]
    token_width: usize,
    /// How strongly tokens of a NetVLAD prefer the word that they are most alike.
    #[arg(long, default_value_t = NetVladShape::default().sharpness, value_name = "X")]
    sharpness: f32,
    /// Power of its standard deviation by which a component is divided: 0 is a plain PCA, 1 whitens
    /// fully.
    #[arg(long, default_value_t = Whitening::default().power(), value_name = "POWER")]
    whitening: f64,
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
    /// As a VLAD, of projected tokens that each take part in every word.
    Netvlad,
}

/// Visual words of a VLAD unless the user says otherwise.
const VLAD_WORDS: u16 = 16;

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
    // Powers that cannot be used are refused before the model is loaded.
    let choice = args.aggregate_choice()?;
    let whitening = Whitening::new(args.whitening).map_err(anyhow::Error::msg)?;
    let progress = ProgressBars::default();
    let extractor = open_extractor(&config, &progress)?;
    let fitted = fit_head(&extractor, &files, choice, whitening, &progress)?;
    for line in &fitted.unreadable {
        note!("left out: {line}");
    }
    if let Some(directory) = args.out.parent() {
        std::fs::create_dir_all(directory).with_context(|| directory.display().to_string())?;
    }
    let head = &fitted.head;
    head.save(&args.out)?;
    say!(
        "{} ({}) from {} images for {}",
        args.out.display(),
        head.aggregate(),
        fitted.images,
        head.backbone()
    )?;
    say!("sha256 {}", hash_file(&args.out)?)?;
    Ok(())
}

impl FitArgs {
    fn aggregate_choice(&self) -> anyhow::Result<AggregateChoice> {
        Ok(match self.aggregate {
            AggregateKind::Mean => AggregateChoice::Given(Aggregate::Mean),
            AggregateKind::Gem => {
                let gem = Aggregate::gem(self.gem_p).map_err(anyhow::Error::msg)?;
                AggregateChoice::Given(gem)
            }
            AggregateKind::Vlad => AggregateChoice::Vlad {
                words: usize::from(self.words.unwrap_or(VLAD_WORDS)),
                seed: self.seed,
            },
            AggregateKind::Netvlad => {
                let default = NetVladShape::default();
                let shape = NetVladShape {
                    words: self.words.map_or(default.words, usize::from),
                    width: self.token_width,
                    sharpness: self.sharpness,
                };
                AggregateChoice::NetVlad {
                    shape,
                    seed: self.seed,
                }
            }
        })
    }
}

/// Every image below `directories`, sorted, so that a fit can be repeated.
fn training_images(directories: &[PathBuf]) -> anyhow::Result<Vec<PathBuf>> {
    let mut files = Vec::new();
    for directory in directories {
        files.extend(list_images(directory)?.into_iter().map(|(_, path)| path));
    }
    anyhow::ensure!(
        !files.is_empty(),
        "there are no images in the given directories"
    );
    Ok(files)
}
