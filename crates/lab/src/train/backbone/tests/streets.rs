//! The recipe for streets: cached tokens, NetVLAD, losses over the batch in groups, averaging.

use super::*;
use crate::train::loss::Loss;
use crate::train::token_cache::{TokenCache, TokenCacheConfig, spec_before};
use placeformer_core::progress::Silent;
use placeformer_vision::extract::{NetVlad, NetVladParameters, Precision};
use std::path::PathBuf;

fn netvlad_head() -> Head {
    let mut rng = ChaCha8Rng::seed_from_u64(8);
    let (dim, width, words) = (GEOMETRY.dim, 4, 3);
    let parameters = NetVladParameters {
        mean: random(&mut rng, dim),
        projection: random(&mut rng, width * dim),
        words: random(&mut rng, words * width),
        assignment: random(&mut rng, words * width),
    };
    let aggregate = Aggregate::NetVlad(Box::new(NetVlad::new(parameters).unwrap()));
    let weight = random(&mut rng, GLOBAL_DIM * words * width);
    let bias = random(&mut rng, GLOBAL_DIM);
    Head::new(aggregate, weight, bias, "b", BTreeMap::new()).unwrap()
}

/// Eight places of two pictures each: a pattern of the place under noise of the picture.
fn noisy_places(folder: &Path) -> TripletSet {
    let bytes = |seed: u64| -> Vec<u8> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let count = 3 * SIZE.width * SIZE.height;
        (0..count).map(|_| rng.random()).collect()
    };
    eight_places(folder, |image| {
        let place = bytes(image / 2);
        let noise = bytes(100 + image);
        let mix = |(&place, &noise): (&u8, &u8)| place / 3 + noise / 3 * 2;
        RgbImage {
            size: SIZE,
            pixels: place.iter().zip(&noise).map(mix).collect(),
        }
    })
}

fn trainable(rank: Option<usize>) -> Trainable {
    Trainable {
        blocks: TrainableBlocks::Last(1),
        rank,
        seed: 3,
    }
}

fn from_images() -> TokenSource {
    TokenSource::Images {
        limits: ImageConfig::default(),
        augmentation: Augmentation::NONE,
    }
}

fn street_model(rank: Option<usize>, source: TokenSource, finish: Finish) -> BackboneModel {
    let head = netvlad_head();
    BackboneModel::new(
        weights(),
        spec(false),
        &head,
        trainable(rank),
        source,
        finish,
    )
    .unwrap()
}

/// The tokens before the last block, in `views` views.
fn cached(folder: &Path, set: &TripletSet, views: usize) -> TokenCache {
    let augmentation = if views > 1 {
        Augmentation::default()
    } else {
        Augmentation::NONE
    };
    let config = TokenCacheConfig {
        folder,
        first_block: 1,
        precision: Precision::F32,
        views,
        augmentation,
    };
    // Heads of four values are too narrow for the encoder that serves.
    let before = spec_before(1, &spec(false)).unwrap();
    let encoder = Box::new(CandleEncoder::new(&weights(), &before).unwrap());
    let mut cache = TokenCache::of_encoder(encoder, &weights(), &config).unwrap();
    cache.fill(&[(set, true)], &Silent).unwrap();
    cache
}

fn street_config(total: u64) -> TrainConfig {
    TrainConfig {
        loss: Loss::InfoNce { temperature: 0.1 },
        batch: 6,
        images_at_once: Some(3),
        weight_decay: 0.01,
        longest_gradient: Some(1.0),
        aggregate_rate: Some(0.02),
        negatives: 5,
        ..config(total)
    }
}

fn samples(range: std::ops::Range<usize>, variation: Option<u64>) -> Vec<Sample> {
    range
        .map(|index| Sample {
            side: Side::Query,
            index,
            variation,
        })
        .collect()
}

fn rows(tensor: &Tensor) -> Vec<Vec<f32>> {
    tensor.to_vec2().unwrap()
}

fn worst_difference(a: &[Vec<f32>], b: &[Vec<f32>]) -> f32 {
    let pairs = a.iter().flatten().zip(b.iter().flatten());
    pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
}

#[test]
fn cached_tokens_give_the_descriptors_of_the_images() {
    let folder = tempfile::tempdir().unwrap();
    let set = noisy_places(folder.path());
    let cache = cached(&folder.path().join("cache"), &set, 3);
    let files = std::fs::read_dir(cache.folder()).unwrap().count();
    let bytes = cache.bytes_of(16);
    assert_eq!(files, 16 * 3 + 1, "three views of each image, and a note");
    assert_eq!(bytes, 16 * 3 * (13 * 8 * 2 + 4));
    let cached = street_model(
        None,
        TokenSource::Cached(Box::new(cache)),
        Finish::default(),
    );
    let direct = street_model(None, from_images(), Finish::default());
    let embed = |model: &BackboneModel, variation| {
        rows(
            &model
                .embed(&set, &samples(0..5, variation), Graph::Skipped)
                .unwrap(),
        )
    };
    let plain = embed(&cached, None);
    assert!(worst_difference(&plain, &embed(&direct, None)) < 5e-3);
    // The number of a variation chooses among the views, of which the first is the image itself.
    assert_eq!(plain, embed(&cached, Some(3)));
    assert!(worst_difference(&plain, &embed(&cached, Some(4))) > 5e-3);
    assert!(worst_difference(&embed(&cached, Some(5)), &embed(&cached, Some(4))) > 5e-3);
}

#[test]
fn a_damaged_file_of_tokens_is_computed_again_and_a_missing_image_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let set = noisy_places(folder.path());
    let root = folder.path().join("cache");
    let cache = cached(&root, &set, 1);
    let before = cache.tokens(&set, &samples(0..16, None)).unwrap();
    let files = |cache: &TokenCache| -> Vec<PathBuf> {
        let entries = std::fs::read_dir(cache.folder()).unwrap();
        let paths = entries.map(|entry| entry.unwrap().path());
        paths
            .filter(|path| path.extension().unwrap() == "tokens")
            .collect()
    };
    let damaged = files(&cache);
    let mut bytes = std::fs::read(&damaged[0]).unwrap();
    bytes[7] ^= 1;
    std::fs::write(&damaged[0], bytes).unwrap();
    std::fs::write(&damaged[1], b"torn").unwrap();
    let error = cache.tokens(&set, &samples(0..16, None)).unwrap_err();
    assert!(error.to_string().contains("not in the cache"), "{error}");
    let again = cached(&root, &set, 1)
        .tokens(&set, &samples(0..16, None))
        .unwrap();
    let flat = |tensor: &Tensor| tensor.flatten_all().unwrap().to_vec1::<f32>().unwrap();
    assert_eq!(flat(&again), flat(&before));
}

/// Trains on the noisy places in `folder`, interrupted after `stop_after` steps.
fn train_street(
    folder: &Path,
    set: &TripletSet,
    config: &TrainConfig,
    rank: Option<usize>,
    stop_after: u64,
) -> Option<(BackboneModel, Outcome)> {
    let cache = cached(&folder.join("tokens"), set, 1);
    let finish = config.finish;
    let model = street_model(rank, TokenSource::Cached(Box::new(cache)), finish);
    let interrupt = InterruptAfter(stop_after);
    let session = Session {
        folder: folder.to_owned(),
        identity: "noisy".into(),
        progress: &interrupt,
    };
    let run = std::panic::AssertUnwindSafe(|| model.train(set, set, config, session).unwrap());
    let outcome = std::panic::catch_unwind(run).ok()?;
    Some((model, outcome))
}

#[test]
fn places_are_learnt_by_either_loss_with_and_without_adapters() {
    let folder = tempfile::tempdir().unwrap();
    let set = noisy_places(folder.path());
    let losses = [Loss::InfoNce { temperature: 0.1 }, Loss::MultiSimilarity];
    for (number, loss) in losses.into_iter().enumerate() {
        for rank in [None, Some(2)] {
            let config = TrainConfig {
                loss,
                ..street_config(80)
            };
            let run = folder.path().join(format!("{number}-{rank:?}"));
            let (model, outcome) = train_street(&run, &set, &config, rank, u64::MAX).unwrap();
            assert!(outcome.initial.at_1 < 100.0, "{outcome:?}");
            assert!(
                outcome.kept.at_1 > outcome.initial.at_1,
                "{rank:?} {outcome:?}"
            );
            let head = 12 * GLOBAL_DIM + GLOBAL_DIM + 4 * 8 + 2 * 3 * 4;
            let block = match rank {
                None => 4 * 64 + 2 * 128 + 24 + 8 + 16 + 8 + 6 * 8,
                Some(rank) => rank * ((24 + 8) + (8 + 8) + 2 * (16 + 8)),
            };
            assert_eq!(model.trained_values(), head + block);
        }
    }
}

#[test]
fn an_interrupted_street_run_continues_bit_for_bit() {
    let folder = tempfile::tempdir().unwrap();
    let set = noisy_places(folder.path());
    let config = TrainConfig {
        finish: Finish {
            average: 0.75,
            ..Finish::default()
        },
        ..street_config(60)
    };
    let whole = folder.path().join("whole");
    let broken = folder.path().join("broken");
    let (straight, expected) = train_street(&whole, &set, &config, None, u64::MAX).unwrap();
    assert!(train_street(&broken, &set, &config, None, 20).is_none());
    let (continued, outcome) = train_street(&broken, &set, &config, None, u64::MAX).unwrap();
    assert_eq!(outcome, expected);
    assert_eq!(values(&continued), values(&straight));
}

#[test]
fn the_difference_merges_to_the_backbone_that_comes_out() {
    let folder = tempfile::tempdir().unwrap();
    let set = noisy_places(folder.path());
    for rank in [None, Some(2)] {
        let config = TrainConfig {
            finish: Finish {
                average: 0.5,
                ..Finish::default()
            },
            ..street_config(20)
        };
        let run = folder.path().join(format!("{rank:?}"));
        let (model, _) = train_street(&run, &set, &config, rank, u64::MAX).unwrap();
        // Validation may have kept the start, from which nothing differs.
        for (name, variable) in model.weights.variables() {
            let moved = (variable.as_tensor() + 0.125).unwrap();
            let flat = moved.flatten_all().unwrap().to_vec1::<f32>().unwrap();
            model.weights.set(name, flat).unwrap();
        }
        let expected = model.backbone().unwrap();
        let difference = model.difference(&weights(), BTreeMap::new()).unwrap();
        let merged = difference.merge(&weights()).unwrap();
        for ((name, _, merged), (_, _, expected)) in merged.tensors().iter().zip(expected.tensors())
        {
            let pairs = merged.iter().zip(expected);
            let worst = pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            assert!(worst < 1e-3, "{rank:?} {name}: {worst}");
        }
        assert_ne!(expected.blocks[1], weights().blocks[1]);
        assert_eq!(expected.blocks[0], weights().blocks[0]);
        let head = model.head("b".into(), BTreeMap::new()).unwrap();
        assert_ne!(head.weights(), netvlad_head().weights());
    }
}

#[test]
fn what_is_watched_has_a_projection_fitted_to_the_averaged_weights() {
    let folder = tempfile::tempdir().unwrap();
    let noise = |seed| {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let pixels = (0..3 * SIZE.width * SIZE.height)
            .map(|_| rng.random())
            .collect();
        RgbImage { size: SIZE, pixels }
    };
    let images: Vec<PathBuf> = (0..260)
        .map(|image| {
            let path = folder.path().join(format!("{image}.png"));
            std::fs::write(&path, encode_png(&noise(image)).unwrap()).unwrap();
            path
        })
        .collect();
    let rows_of = |size: u32| -> Vec<Vec<u32>> {
        (0..260)
            .map(|i: u32| (i / size * size..i / size * size + size).collect())
            .collect()
    };
    let set = TripletSet {
        positives: rows_of(2),
        near: rows_of(2),
        spots: in_groups(260, 2),
        queries: images.clone(),
        database: images,
    };
    let finish = Finish {
        average: 0.5,
        whitening: Some(0.75),
        fit_images: 260,
    };
    let model = street_model(None, from_images(), finish);
    let watched = model.outcome(&set, &Silent).unwrap().unwrap();
    let descriptors = rows(
        &watched
            .embed(&set, &samples(0..260, None), Graph::Skipped)
            .unwrap(),
    );
    let start = rows(
        &model
            .embed(&set, &samples(0..260, None), Graph::Skipped)
            .unwrap(),
    );
    // A PCA centres what it was fitted to; the projection of the start does not.
    let mean_length = |rows: &[Vec<f32>]| {
        let sums = (0..GLOBAL_DIM).map(|i| rows.iter().map(|row| row[i]).sum::<f32>() / 260.0);
        sums.map(|mean| mean * mean).sum::<f32>().sqrt()
    };
    assert!(
        mean_length(&descriptors) < 0.3,
        "{}",
        mean_length(&descriptors)
    );
    assert!(mean_length(&start) > 0.5, "{}", mean_length(&start));
    assert_eq!(
        values(&model),
        values(&street_model(None, from_images(), finish))
    );
}
