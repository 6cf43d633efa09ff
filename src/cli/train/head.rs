//! Training the head alone, on pooled tokens.

use super::{HeadTrainArgs, RunArgs, cache_folder, facts, finish, notes, write_settings};
use crate::cli::output::{note, say};
use crate::cli::progress::ProgressBars;
use anyhow::Context;
use placeformer_lab::train::{
    HeadModel, PooledCache, PooledTokens, Session, SetTokens, starting_head,
};
use placeformer_models::open_extractor;
use placeformer_vision::extract::{Extractor, HeadChoice};

/// Runs `head train`.
pub(in crate::cli) fn train_head(args: HeadTrainArgs) -> anyhow::Result<()> {
    train(&args.run)
}

pub(super) fn train(args: &RunArgs) -> anyhow::Result<()> {
    placeformer_kernels::self_check()?;
    let config = args.method.head_config()?;
    let sides = args.data.load(&args.method)?;
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
    let began = match extract.head {
        HeadChoice::None => "a partly whitened PCA of the training images".to_owned(),
        other => format!("head {other} ({})", start.aggregate()),
    };
    let facts = facts(args, "head", &sides.description, &began);
    write_settings(&args.out, &facts, &config)?;
    let session = Session {
        folder: args.out.clone(),
        identity,
        progress: &progress,
    };
    let outcome = model.train(&sides.training, &sides.validation, &config, session)?;
    let (weight, bias) = model.weights()?;
    let size = extractor.input_size().to_string();
    let notes = notes(&config, &size, &sides.description, &outcome);
    let path = args.out.join("head.safetensors");
    start.with_weights(weight, bias, notes)?.save(&path)?;
    finish(&args.out, &facts, &config, &outcome)?;
    say!("{}", path.display())?;
    Ok(())
}

/// The cache of pooled tokens that `extractor` makes.
pub(super) fn open_cache(args: &RunArgs, extractor: &Extractor) -> anyhow::Result<PooledCache> {
    let folder = cache_folder(args.cache.as_ref(), "pooled")?;
    PooledCache::open(&folder, extractor).with_context(|| folder.display().to_string())
}

fn head_tokens(dim: usize, tokens: SetTokens) -> anyhow::Result<PooledTokens> {
    Ok(PooledTokens::new(dim, tokens.queries, tokens.database)?)
}
