//! Training blocks of the backbone together with the head and its aggregate.

use super::head::open_cache;
use super::method::{BlockArgs, Recipe, Written};
use super::{RunArgs, cache_folder, facts, finish, notes, write_settings};
use crate::cli::output::{note, say};
use crate::cli::progress::ProgressBars;
use crate::ops::disk;
use anyhow::{Context, ensure};
use placeformer_lab::train::{
    AggregateChoice, BackboneModel, Keep, Outcome, Session, SetTokens, TokenCache,
    TokenCacheConfig, TokenSource, TrainConfig, Trainable, TrainableBlocks, TripletSet,
    distinct_images, fit_head, starting_head,
};
use placeformer_models::{open_extractor, resolve_weights};
use placeformer_vision::extract::{
    Aggregate, ExtractConfig, Extractor, Head, HeadChoice, VitWeights, Whitening,
};
use placeformer_vision::image::ImageConfig;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// Note of a head that training starts from: what it was fitted to, and how.
const FITTED_TO: &str = "fitted_to";

/// A run from its flags to its files.
struct BlockRun<'a> {
    args: &'a RunArgs,
    flags: &'a BlockArgs,
    config: &'a TrainConfig,
    extract: ExtractConfig,
    progress: ProgressBars,
    training: TripletSet,
    validation: TripletSet,
}

pub(super) fn train(
    args: &RunArgs,
    flags: &BlockArgs,
    blocks: TrainableBlocks,
    config: &TrainConfig,
) -> anyhow::Result<()> {
    placeformer_kernels::self_check()?;
    let extract = args.model.extract_config()?;
    let spec = extract.encoder_spec()?;
    let first_block = blocks.first_of(spec.exit_block + 1)?;
    let sides = args.data.load(&args.method)?;
    note!("{}", sides.description);
    let run = BlockRun {
        args,
        flags,
        config,
        extract,
        progress: ProgressBars::default(),
        training: sides.training,
        validation: sides.validation,
    };
    let file = resolve_weights(&run.extract, &run.progress)?;
    let stock = VitWeights::load(&file, run.extract.preset, run.extract.heads)?;
    let base = run.extract.load_weights(&file)?;
    let source = run.source(&base, first_block)?;
    let start = run.head_to_start_from()?;
    let trainable = Trainable {
        blocks,
        rank: flags.rank.map(usize::from),
        seed: config.seed,
    };
    let model = BackboneModel::new(base, spec, &start, trainable, source, config.finish)?;
    let facts = facts(
        args,
        &describe(trainable, &model),
        &sides.description,
        &format!("{} with a head of {}", start.backbone(), start.aggregate()),
    );
    write_settings(&args.out, &facts, config)?;
    let identity = run.identity(trainable, &start)?;
    let session = Session {
        folder: args.out.clone(),
        identity,
        progress: &run.progress,
    };
    let outcome = model.train(&run.training, &run.validation, config, session)?;
    finish(&args.out, &facts, config, &outcome)?;
    let size = spec.input_size.to_string();
    let notes = notes(config, &size, &sides.description, &outcome);
    run.save(&model, &stock, &outcome, notes)
}

fn describe(trainable: Trainable, model: &BackboneModel) -> String {
    let blocks = match trainable.blocks {
        TrainableBlocks::Last(count) => format!("the last {count} computed blocks and the head"),
        TrainableBlocks::All => "all computed blocks and the head".to_owned(),
    };
    let adapters = match trainable.rank {
        Some(rank) => format!(", by adapters of rank {rank}"),
        None => String::new(),
    };
    format!("{blocks}{adapters}: {} values", model.trained_values())
}

impl BlockRun<'_> {
    fn recipe(&self) -> Recipe {
        self.args.method.recipe
    }

    /// Everything that a run depends on besides its settings.
    fn identity(&self, trainable: Trainable, start: &Head) -> anyhow::Result<String> {
        Ok(format!(
            "{trainable:?} {} {} {:?} {} {} {} {}",
            start.backbone(),
            self.extract.encoder_spec()?.input_size,
            self.extract.precision,
            self.flags.cached_views(self.recipe()),
            start.content_hash(),
            self.training.fingerprint(),
            self.validation.fingerprint()
        ))
    }

    /// Where the tokens before the first trained block come from. What a cache costs is said before
    /// it is paid.
    fn source(&self, base: &VitWeights, first_block: usize) -> anyhow::Result<TokenSource> {
        let views = self.flags.cached_views(self.recipe());
        if views == 0 {
            return Ok(TokenSource::Images {
                limits: ImageConfig::default(),
                augmentation: self.config.augmentation,
            });
        }
        let folder = cache_folder(self.flags.token_cache.as_ref(), "tokens")?;
        let config = TokenCacheConfig {
            folder: &folder,
            first_block,
            precision: self.extract.precision,
            views,
            augmentation: self.config.augmentation,
        };
        let mut cache = TokenCache::new(base, &self.extract.encoder_spec()?, &config)?;
        let images = distinct_images(&[&self.training, &self.validation]);
        let bytes = cache.bytes_of(images);
        let free = disk::space(cache.folder())
            .with_context(|| folder.display().to_string())?
            .free;
        let gigabytes = |bytes: u64| bytes as f64 / 1e9;
        note!(
            "tokens of {images} images take up to {:.1} GB in {}, where {:.1} GB are free",
            gigabytes(bytes),
            cache.folder().display(),
            gigabytes(free)
        );
        let held = cache.bytes_held()?;
        ensure!(
            bytes.saturating_sub(held) < free,
            "the tokens do not fit on the disk: choose another --token-cache, or a smaller \
             --input-size"
        );
        cache.fill(
            &[(&self.training, true), (&self.validation, false)],
            &self.progress,
        )?;
        Ok(TokenSource::Cached(Box::new(cache)))
    }

    /// The head given; else what the recipe starts from, which is fitted to the training images.
    fn head_to_start_from(&self) -> anyhow::Result<Head> {
        let given = &self.extract.head;
        if self.recipe() == Recipe::Streets && !matches!(given, HeadChoice::File(_)) {
            return self.fitted_netvlad();
        }
        // The encoder that describes the images is dropped before training needs the memory.
        let extractor = open_extractor(&self.extract, &self.progress)?;
        match extractor.head() {
            Some(head) => Ok(head.clone()),
            None => {
                let mut cache = open_cache(self.args, &extractor)?;
                let tokens = SetTokens::of(&self.training, &extractor, &mut cache, &self.progress)?;
                Ok(starting_head(&extractor, &self.training, &tokens)?)
            }
        }
    }

    /// A NetVLAD of the training images, kept in the run's folder for when the run is continued.
    fn fitted_netvlad(&self) -> anyhow::Result<Head> {
        let extract = ExtractConfig {
            head: HeadChoice::None,
            ..self.extract.clone()
        };
        let extractor = open_extractor(&extract, &self.progress)?;
        let shape = self.flags.starting_shape();
        let seed = self.config.seed;
        let fitted_to = format!(
            "{} {} {shape:?} {seed}",
            self.training.fingerprint(),
            extractor.input_size()
        );
        let path = self.args.out.join("start.safetensors");
        if path.exists() {
            let head = Head::load(&path)?;
            let same = head.notes().get(FITTED_TO) == Some(&fitted_to);
            if same && head.backbone() == extractor.backbone() {
                return Ok(head);
            }
        }
        let choice = AggregateChoice::NetVlad { shape, seed };
        let fitted = self.fit(&extractor, choice, Whitening::default())?;
        let (weight, bias) = fitted.weights();
        let mut notes = fitted.notes().clone();
        notes.insert(FITTED_TO.to_owned(), fitted_to);
        let head = fitted.with_weights(weight.to_vec(), bias.to_vec(), notes)?;
        std::fs::create_dir_all(&self.args.out)?;
        head.save(&path)?;
        Ok(head)
    }

    /// A head fitted to the training images.
    fn fit(
        &self,
        extractor: &Extractor,
        choice: AggregateChoice,
        whitening: Whitening,
    ) -> anyhow::Result<Head> {
        let sides = self.training.queries.iter().chain(&self.training.database);
        let files: BTreeSet<PathBuf> = sides.cloned().collect();
        let files: Vec<PathBuf> = files.into_iter().collect();
        let fitted = fit_head(extractor, &files, choice, whitening, &self.progress)?;
        for line in &fitted.unreadable {
            note!("left out: {line}");
        }
        Ok(fitted.head)
    }

    /// Writes what came out: the backbone or its difference, and the head that is bound to it.
    fn save(
        &self,
        model: &BackboneModel,
        stock: &VitWeights,
        outcome: &Outcome,
        notes: BTreeMap<String, String>,
    ) -> anyhow::Result<()> {
        let folder = &self.args.out;
        let mut extract = ExtractConfig {
            head: HeadChoice::None,
            ..self.extract.clone()
        };
        let written = match self.flags.written(self.recipe()) {
            Written::Weights => {
                let path = folder.join("weights.safetensors");
                model.backbone()?.save(&path)?;
                extract.weights = Some(path.clone());
                extract.difference = None;
                path
            }
            Written::Difference => {
                let is_start = self.config.keep == Keep::Best && outcome.kept == outcome.initial;
                ensure!(
                    !is_start,
                    "validation never improved, so there is no difference to write; {} has the \
                     curves",
                    folder.join("report.html").display()
                );
                let path = folder.join("difference.safetensors");
                model.difference(stock, notes.clone())?.save(&path)?;
                extract.difference = Some(path.clone());
                path
            }
        };
        let extractor = open_extractor(&extract, &self.progress)?;
        let head = self.final_head(model, &extractor, notes)?;
        let path = folder.join("head.safetensors");
        head.save(&path)?;
        say_file(&written)?;
        say_file(&path)
    }

    /// The trained head; fitted again to the training images as the service will describe them, if
    /// the run is to end so.
    fn final_head(
        &self,
        model: &BackboneModel,
        extractor: &Extractor,
        notes: BTreeMap<String, String>,
    ) -> anyhow::Result<Head> {
        let trained = model.head(extractor.backbone().to_owned(), notes.clone())?;
        let Some(power) = self.config.finish.whitening else {
            return Ok(trained);
        };
        let aggregate: Aggregate = trained.aggregate().clone();
        let whitening = Whitening::new(power).map_err(anyhow::Error::msg)?;
        let fitted = self.fit(extractor, AggregateChoice::Given(aggregate), whitening)?;
        let (weight, bias) = fitted.weights();
        Ok(fitted.with_weights(weight.to_vec(), bias.to_vec(), notes)?)
    }
}

fn say_file(path: &Path) -> anyhow::Result<()> {
    let megabytes = std::fs::metadata(path)?.len() as f64 / 1e6;
    say!("{} ({megabytes:.1} MB)", path.display())?;
    Ok(())
}
