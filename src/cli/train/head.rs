//! Training the head alone, on pooled tokens.

use super::{HeadTrainArgs, RunArgs, bar, facts, finish, notes, show};
use crate::cli::progress::ProgressBars;
use anyhow::Context;
use indicatif::{ProgressBar, ProgressStyle};
use placeformer_lab::train::{
    Augmentation, HeadModel, PooledCache, PooledTokens, Progress, Session, Side, TripletSet,
};
use placeformer_models::open_extractor;
use placeformer_vision::extract::{
    Covariance, Extractor, Head, HeadChoice, half_whitened_head_of_few,
};
use std::collections::HashSet;

/// Runs `head train`.
pub(in crate::cli) fn train_head(args: HeadTrainArgs) -> anyhow::Result<()> {
    train(&args.run)
}

pub(super) fn train(args: &RunArgs) -> anyhow::Result<()> {
    placeformer_kernels::self_check()?;
    let config = args.config(Augmentation::NONE)?;
    let sides = args.data.load(args.method.seed)?;
    eprintln!("{}", sides.description);
    let extract = args.model.extract_config()?;
    let extractor = open_extractor(&extract, &ProgressBars::default())?;
    let mut source = Source::open(args, &extractor)?;
    let training = source.tokens(&sides.training)?;
    let validation = source.tokens(&sides.validation)?;
    let start = match extractor.head() {
        Some(head) => head.clone(),
        None => fit(&extractor, &sides.training, &training)?,
    };
    drop(source);
    let dim = start.dim();
    let (weight, bias) = start.weights();
    let model = HeadModel::new(weight, bias, training.cache(dim)?, validation.cache(dim)?)?;
    let identity = [
        start.backbone(),
        // Tokens of another arithmetic are other tokens: the run would not go on bit for bit.
        &extractor.encoder_name(),
        &extractor.input_size().to_string(),
        &start.content_hash(),
        &sides.training.fingerprint(),
        &sides.validation.fingerprint(),
    ]
    .join(" ");
    let bar = bar(&config)?;
    let mut progress = |progress: Progress<'_>| show(&bar, progress);
    let session = Session {
        folder: args.out.clone(),
        identity,
        progress: &mut progress,
    };
    let outcome = model.train(&sides.training, &sides.validation, &config, session)?;
    bar.finish_and_clear();
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

/// Where pooled tokens come from.
pub(super) struct Source<'a> {
    extractor: &'a Extractor,
    cache: PooledCache,
}

/// Pooled tokens of both sides of a set, `[images, dim]`.
pub(super) struct Tokens {
    queries: Vec<f32>,
    database: Vec<f32>,
}

impl<'a> Source<'a> {
    pub(super) fn open(args: &RunArgs, extractor: &'a Extractor) -> anyhow::Result<Self> {
        let folder = args.cache_folder()?;
        let cache =
            PooledCache::open(&folder, extractor).with_context(|| folder.display().to_string())?;
        Ok(Self { extractor, cache })
    }

    pub(super) fn tokens(&mut self, set: &TripletSet) -> anyhow::Result<Tokens> {
        let style = ProgressStyle::with_template(
            "describing images {wide_bar} {pos}/{len} {per_sec} {eta}",
        )?;
        let bar =
            ProgressBar::new((set.queries.len() + set.database.len()) as u64).with_style(style);
        let mut side = |side| {
            self.cache
                .pool(self.extractor, set.images(side), &|images| bar.inc(images))
        };
        let tokens = Tokens {
            queries: side(Side::Query)?,
            database: side(Side::Database)?,
        };
        bar.finish_and_clear();
        Ok(tokens)
    }
}

impl Tokens {
    fn cache(self, dim: usize) -> anyhow::Result<PooledTokens> {
        Ok(PooledTokens::new(dim, self.queries, self.database)?)
    }
}

/// The head to start from where none is given: what `head fit` would make of the training images,
/// each of which counts once even if it both asks and answers.
pub(super) fn fit(
    extractor: &Extractor,
    set: &TripletSet,
    training: &Tokens,
) -> anyhow::Result<Head> {
    let (aggregate, backbone) = (extractor.aggregate().clone(), extractor.backbone());
    let dim = aggregate.pooled_dim(extractor.dim());
    let images = || {
        set.images(Side::Database)
            .iter()
            .chain(set.images(Side::Query))
    };
    let mut seen = HashSet::new();
    let is_first: Vec<bool> = images().map(|image| seen.insert(image)).collect();
    let all = || {
        training
            .database
            .chunks_exact(dim)
            .chain(training.queries.chunks_exact(dim))
    };
    let rows = || {
        all()
            .zip(&is_first)
            .filter(|(_, first)| **first)
            .map(|(row, _)| row)
    };
    if rows().count() <= dim {
        let rows: Vec<Vec<f32>> = rows().map(<[f32]>::to_vec).collect();
        return Ok(half_whitened_head_of_few(
            &rows,
            aggregate,
            backbone,
            Default::default(),
        )?);
    }
    let mut covariance = Covariance::new(dim);
    rows().for_each(|row| covariance.add(row));
    Ok(covariance.half_whitened_head(aggregate, backbone, Default::default())?)
}
