//! Training the head alone, on pooled tokens.

use super::{HeadTrainArgs, RunArgs, facts, finish, notes};
use crate::cli::output::note;
use crate::cli::progress::ProgressBars;
use anyhow::Context;
use placeformer_lab::train::{
    Augmentation, HeadModel, PooledCache, PooledTokens, Session, SetTokens, starting_head,
};
use placeformer_models::open_extractor;
use placeformer_vision::extract::{Extractor, HeadChoice};

/// Runs `head train`.
pub(in crate::cli) fn train_head(args: HeadTrainArgs) -> anyhow::Result<()> {
    train(&args.run)
}

pub(super) fn train(args: &RunArgs) -> anyhow::Result<()> {
    placeformer_kernels::self_check()?;
    let config = args.config(Augmentation::NONE)?;
    let sides = args.data.load(args.method.seed)?;
    note!("{}", sides.description);
    let extract = args.model.extract_config()?;
    let progress = ProgressBars::default();
    let extractor = open_extractor(&extract, &progress)?;
    let mut cache = open_cache(args, &extractor)?;
    let training = SetTokens::of(&sides.training, &extractor, &mut cache, &progress)?;
    let validation = SetTokens::of(&sides.validation, &extractor, &mut cache, &progress)?;
    // The cache holds every vector once more, and training needs the memory.
    drop(cache);
    let start = match extractor.head() {
        Some(head) => head.clone(),
        None => starting_head(&extractor, &sides.training, &training)?,
    };
    let dim = start.dim();
    let (weight, bias) = start.weights();
    let training = head_tokens(dim, training)?;
    let validation = head_tokens(dim, validation)?;
    let model = HeadModel::new(weight, bias, training, validation)?;
    let identity = [
        start.backbone(),
        // A run goes on bit for bit only from the same tokens, and another precision gives others.
        &extractor.encoder_name(),
        &extractor.input_size().to_string(),
        &start.content_hash(),
        &sides.training.fingerprint(),
        &sides.validation.fingerprint(),
    ]
    .join(" ");
    let session = Session {
        folder: args.out.clone(),
        identity,
        progress: &progress,
    };
    let outcome = model.train(&sides.training, &sides.validation, &config, session)?;
    let (weight, bias) = model.weights()?;
    let notes = notes(
        args,
        &extractor.input_size().to_string(),
        &sides.description,
        &outcome,
    );
    start
        .with_weights(weight, bias, notes)?
        .save(&args.out.join("head.safetensors"))?;
    let began = match extract.head {
        HeadChoice::None => "a half-whitened PCA of the training images".to_owned(),
        other => format!("head {other} ({})", start.aggregate()),
    };
    finish(
        &args.out,
        &facts(args, "head", &sides.description, &began),
        &config,
        &outcome,
    )
}

/// The cache of pooled tokens that `extractor` makes.
pub(super) fn open_cache(args: &RunArgs, extractor: &Extractor) -> anyhow::Result<PooledCache> {
    let folder = args.cache_folder()?;
    PooledCache::open(&folder, extractor).with_context(|| folder.display().to_string())
}

fn head_tokens(dim: usize, tokens: SetTokens) -> anyhow::Result<PooledTokens> {
    Ok(PooledTokens::new(dim, tokens.queries, tokens.database)?)
}
