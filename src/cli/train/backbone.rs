//! Training blocks of the backbone together with the head, on images.

use super::head::open_cache;
use super::{RunArgs, facts, finish, notes};
use crate::cli::output::{note, say};
use crate::cli::progress::ProgressBars;
use anyhow::ensure;
use placeformer_lab::train::{
    Augmentation, BackboneModel, Session, SetTokens, TrainError, TrainableBlocks, TripletSet,
    starting_head,
};
use placeformer_models::open_extractor;
use placeformer_models::resolve_weights;
use placeformer_vision::extract::{
    Aggregate, ExtractConfig, Extractor, Head, HeadChoice, VitWeights,
};
use placeformer_vision::image::ImageConfig;

pub(super) fn train(
    args: &RunArgs,
    blocks: TrainableBlocks,
    augmentation: Augmentation,
) -> anyhow::Result<()> {
    placeformer_kernels::self_check()?;
    let config = args.config(augmentation)?;
    let sides = args.data.load(args.method.seed)?;
    note!("{}", sides.description);
    let extract = args.model.extract_config()?;
    let progress = ProgressBars::default();
    let start = head_to_start_from(args, &extract, &sides.training, &progress)?;
    ensure!(
        *start.aggregate() == Aggregate::Mean,
        "blocks are trained under the mean of the tokens, and this head takes {}",
        start.aggregate()
    );
    let file = resolve_weights(&extract, &progress)?;
    let weights = VitWeights::load(&file, extract.preset, extract.heads)?;
    let spec = extract.encoder_spec()?;
    let images = ImageConfig::default();
    let model = BackboneModel::new(weights, spec, start.weights(), blocks, images, augmentation)?;
    let identity = format!(
        "{blocks:?} {} {} {} {} {}",
        start.backbone(),
        spec.input_size,
        start.content_hash(),
        sides.training.fingerprint(),
        sides.validation.fingerprint()
    );
    let session = Session {
        folder: args.out.clone(),
        identity,
        progress: &progress,
    };
    let outcome = model.train(&sides.training, &sides.validation, &config, session)?;
    let path = args.out.join("weights.safetensors");
    let head = args.out.join("head.safetensors");
    let backbone = || -> Result<String, TrainError> {
        let config = ExtractConfig {
            head: HeadChoice::None,
            ..extract.clone()
        };
        Ok(Extractor::load(&config, &path)?.backbone().to_owned())
    };
    let notes = notes(
        args,
        &spec.input_size.to_string(),
        &sides.description,
        &outcome,
    );
    model.save(&path, &head, backbone, notes)?;
    let trained = match blocks {
        TrainableBlocks::Last(count) => format!("the last {count} computed blocks and the head"),
        TrainableBlocks::All => "all computed blocks and the head".to_owned(),
    };
    let began = format!("{} with head {}", start.backbone(), extract.head);
    finish(
        &args.out,
        &facts(args, &trained, &sides.description, &began),
        &config,
        &outcome,
    )?;
    say!("{}", path.display())?;
    Ok(())
}

/// The head given, or a PCA of the training images. The encoder that describes them is dropped
/// before training needs the memory.
fn head_to_start_from(
    args: &RunArgs,
    extract: &ExtractConfig,
    training: &TripletSet,
    progress: &ProgressBars,
) -> anyhow::Result<Head> {
    let extractor = open_extractor(extract, progress)?;
    match extractor.head() {
        Some(head) => Ok(head.clone()),
        None => {
            let mut cache = open_cache(args, &extractor)?;
            let tokens = SetTokens::of(training, &extractor, &mut cache, progress)?;
            Ok(starting_head(&extractor, training, &tokens)?)
        }
    }
}
