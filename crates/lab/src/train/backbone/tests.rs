//! The differentiable transformer: the same numbers as the one that serves, right gradients, and a
//! run on drawn places.

mod streets;

use super::*;
use crate::synth::{Condition, StreetWorld, Viewpoint};
use crate::train::Schedule;
use crate::train::interruption::InterruptAfter;
use crate::train::loss::triplet_margin_loss;
use crate::train::model::Graph;
use crate::train::spots::in_groups;
use crate::train::triplets::Side;
use candle_core::{Device, Var};
use placeformer_core::types::GLOBAL_DIM;
use placeformer_core::types::ImageSize;
use placeformer_vision::extract::{
    Aggregate, BlockWeights, CandleEncoder, Encoder, Geometry, Linear, Norm, Preset,
};
use placeformer_vision::image::{RgbImage, encode_png};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::path::Path;

const GEOMETRY: Geometry = Geometry {
    depth: 3,
    dim: 8,
    heads: 2,
    patch: 4,
    mlp_dim: 16,
    layer_scale: true,
};
const SIZE: ImageSize = ImageSize {
    width: 16,
    height: 12,
};

fn spec(token_norm: bool) -> EncoderSpec {
    EncoderSpec {
        input_size: SIZE,
        exit_block: 1,
        token_norm,
        attention_block: 1,
    }
}

fn random(rng: &mut ChaCha8Rng, count: usize) -> Vec<f32> {
    (0..count).map(|_| rng.random_range(-0.6f32..0.6)).collect()
}

fn weights() -> VitWeights {
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    let rng = &mut rng;
    let Geometry {
        depth,
        dim,
        patch,
        mlp_dim,
        ..
    } = GEOMETRY;
    let linear = |rng: &mut _, out: usize, input: usize| Linear {
        weight: random(rng, out * input),
        bias: random(rng, out),
    };
    let norm = |rng: &mut _| Norm {
        weight: random(rng, dim),
        bias: random(rng, dim),
    };
    VitWeights {
        preset: Preset::Dinov2Vits14,
        geometry: GEOMETRY,
        position_grid: (5, 5),
        patch_embed: linear(rng, dim, 3 * patch * patch),
        cls_token: random(rng, dim),
        positions: random(rng, 26 * dim),
        blocks: (0..depth)
            .map(|_| BlockWeights {
                norm1: norm(rng),
                qkv: linear(rng, 3 * dim, dim),
                proj: linear(rng, dim, dim),
                layer_scale1: Some(random(rng, dim)),
                norm2: norm(rng),
                fc1: linear(rng, mlp_dim, dim),
                fc2: linear(rng, dim, mlp_dim),
                layer_scale2: Some(random(rng, dim)),
            })
            .collect(),
        norm: norm(rng),
        unused_parameters: 0,
        merged: None,
    }
}

fn model(blocks: TrainableBlocks, token_norm: bool) -> BackboneModel {
    varied_model(blocks, token_norm, Augmentation::NONE)
}

fn varied_model(
    blocks: TrainableBlocks,
    token_norm: bool,
    augmentation: Augmentation,
) -> BackboneModel {
    let mut rng = ChaCha8Rng::seed_from_u64(6);
    let weight = random(&mut rng, GLOBAL_DIM * GEOMETRY.dim);
    let bias = random(&mut rng, GLOBAL_DIM);
    let head = Head::new(Aggregate::Mean, weight, bias, "b", BTreeMap::new()).unwrap();
    let source = TokenSource::Images {
        limits: ImageConfig::default(),
        augmentation,
    };
    let trainable = Trainable {
        blocks,
        rank: None,
        seed: 0,
    };
    let finish = Finish::default();
    BackboneModel::new(
        weights(),
        spec(token_norm),
        &head,
        trainable,
        source,
        finish,
    )
    .unwrap()
}

fn pass(model: &BackboneModel) -> Pass<'_> {
    Pass {
        weights: &model.weights,
        graph: Graph::Recorded,
    }
}

fn images(count: usize) -> Vec<ImageTensor> {
    let mut rng = ChaCha8Rng::seed_from_u64(7);
    (0..count)
        .map(|_| ImageTensor {
            size: SIZE,
            data: random(&mut rng, 3 * 16 * 12),
        })
        .collect()
}

#[test]
fn tokens_are_those_of_the_encoder_that_serves() {
    for token_norm in [false, true] {
        let model = model(TrainableBlocks::All, token_norm);
        let images = images(3);
        let trained = model.tokens(pass(&model), &images).unwrap();
        let served = CandleEncoder::new(&weights(), &spec(token_norm))
            .unwrap()
            .encode(&images)
            .unwrap();
        for (index, expected) in served.iter().enumerate() {
            let tokens = trained
                .get(index)
                .unwrap()
                .flatten_all()
                .unwrap()
                .to_vec1::<f32>()
                .unwrap();
            assert_eq!(tokens.len(), expected.tokens.len());
            let worst = tokens
                .iter()
                .zip(&expected.tokens)
                .map(|(a, b)| (a - b).abs())
                .fold(0.0, f32::max);
            assert!(worst < 2e-5, "image {index}: {worst}");
        }
    }
}

/// Loss used for checking gradients: anything that depends on every token unevenly.
fn loss(model: &BackboneModel, images: &[ImageTensor]) -> Tensor {
    let tokens = model.tokens(pass(model), images).unwrap();
    let count = tokens.elem_count();
    let uneven: Vec<f32> = (0..count)
        .map(|i| ((i * 7919 % 101) as f32 - 50.0) / 50.0)
        .collect();
    let uneven = Tensor::from_vec(uneven, tokens.shape(), &Device::Cpu).unwrap();
    (tokens * uneven).unwrap().sum_all().unwrap()
}

#[test]
fn gradients_of_every_kind_of_weight_agree_with_finite_differences() {
    let model = model(TrainableBlocks::All, true);
    let images = images(2);
    let gradients = loss(&model, &images).backward().unwrap();
    let names = [
        "patch_embed.proj.weight",
        "cls_token",
        "pos_embed",
        "blocks.0.attn.qkv.weight",
        "blocks.0.norm1.weight",
        "blocks.1.mlp.fc1.weight",
        "blocks.1.attn.proj.bias",
        "blocks.0.ls2.gamma",
        "norm.bias",
    ];
    for name in names {
        let variable = &model.weights.variables()[name];
        let analytic = gradients
            .get(variable.as_tensor())
            .unwrap_or_else(|| panic!("no gradient of {name}"));
        let analytic = analytic.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        let start = variable.as_tensor().copy().unwrap();
        // The entry with the largest gradient: there the difference quotient is farthest from
        // rounding noise.
        let at = (0..analytic.len())
            .max_by(|a, b| analytic[*a].abs().total_cmp(&analytic[*b].abs()))
            .unwrap();
        let value_at = |shift: f32| {
            let mut values = start.flatten_all().unwrap().to_vec1::<f32>().unwrap();
            values[at] += shift;
            variable
                .set(&Tensor::from_vec(values, start.shape(), &Device::Cpu).unwrap())
                .unwrap();
            f64::from(loss(&model, &images).to_scalar::<f32>().unwrap())
        };
        let step = 4e-3f32;
        let numeric = (value_at(step) - value_at(-step)) / f64::from(2.0 * step);
        variable.set(&start).unwrap();
        let analytic = f64::from(analytic[at]);
        let tolerance = 0.02 * numeric.abs() + 1e-2;
        assert!(
            (numeric - analytic).abs() < tolerance,
            "{name}[{at}]: {numeric} against {analytic}"
        );
    }
}

#[test]
fn only_the_blocks_asked_for_move() {
    let names = |trainable| {
        model(trainable, false)
            .weights
            .variables()
            .keys()
            .cloned()
            .collect::<Vec<_>>()
    };
    let last = names(TrainableBlocks::Last(1));
    assert!(
        last.iter()
            .all(|name| name.starts_with("blocks.1.") || name.starts_with("head.")),
        "{last:?}"
    );
    assert_eq!(last.len(), 14 + 2);
    let all = names(TrainableBlocks::All);
    assert!(
        all.contains(&"pos_embed".to_owned())
            && !all.iter().any(|name| name.starts_with("blocks.2."))
    );
    // Without a norm behind the exit block its weights have no gradient, and are left alone.
    assert!(!all.iter().any(|name| name.starts_with("norm.")));
    assert!(TrainableBlocks::Last(3).first_of(2).is_err());
    assert!(TrainableBlocks::Last(0).first_of(2).is_err());
}

#[test]
fn every_tensor_can_be_written_back_by_name() {
    let mut copy = weights();
    let tensors: Vec<_> = weights()
        .tensors()
        .into_iter()
        .map(|(name, _, values)| (name, values.len()))
        .collect();
    for (name, length) in tensors {
        assert!(copy.replace(&name, &vec![0.25; length]), "{name}");
        assert!(!copy.replace(&name, &vec![0.25; length + 1]), "{name}");
    }
    assert!(
        copy.tensors()
            .iter()
            .all(|(_, _, values)| values.iter().all(|value| *value == 0.25))
    );
    assert!(!copy.replace("blocks.9.norm1.weight", &[0.0; 8]));
}

/// Eight places of a drawn town, two views of each.
fn drawn_places(folder: &Path) -> TripletSet {
    let town = StreetWorld::new(5);
    let picture = |image: u64| {
        let viewpoint = Viewpoint {
            along_m: (image % 2) as f64 * 0.6,
            across_m: 0.0,
            turn_deg: 0.0,
        };
        town.render(
            image / 2 * 3,
            viewpoint,
            Condition::Day,
            ImageSize {
                width: 32,
                height: 24,
            },
        )
    };
    eight_places(folder, picture)
}

/// Eight places of two pictures each.
fn eight_places(folder: &Path, picture: impl Fn(u64) -> RgbImage) -> TripletSet {
    let images: Vec<_> = (0..16)
        .map(|image| {
            let path = folder.join(format!("{image}.png"));
            std::fs::write(&path, encode_png(&picture(image)).unwrap()).unwrap();
            path
        })
        .collect();
    let group = |image: u32| (image / 2 * 2)..(image / 2 * 2 + 2);
    TripletSet {
        positives: (0..16)
            .map(|image| group(image).filter(|&other| other != image).collect())
            .collect(),
        near: (0..16).map(|image| group(image).collect()).collect(),
        spots: in_groups(16, 2),
        queries: images.clone(),
        database: images,
    }
}

fn config(total: u64) -> TrainConfig {
    TrainConfig {
        schedule: Schedule {
            peak: 0.01,
            warm_up: 10,
            total,
        },
        batch: 8,
        steps_per_cycle: 20,
        patience: 1000,
        augmentation: Augmentation::NONE,
        ..TrainConfig::default()
    }
}

/// Trains in `folder`, interrupted after `stop_after` steps if it gets so far.
fn train_in(
    folder: &Path,
    set: &TripletSet,
    config: &TrainConfig,
    stop_after: u64,
) -> Option<(BackboneModel, Outcome)> {
    let model = varied_model(TrainableBlocks::Last(1), false, config.augmentation);
    let interrupt = InterruptAfter(stop_after);
    let session = Session {
        folder: folder.to_owned(),
        identity: "drawn".into(),
        progress: &interrupt,
    };
    let run = std::panic::AssertUnwindSafe(|| model.train(set, set, config, session).unwrap());
    let outcome = std::panic::catch_unwind(run).ok()?;
    Some((model, outcome))
}

fn values(model: &BackboneModel) -> Vec<(String, Vec<f32>)> {
    let flat = |variable: &Var| variable.flatten_all().unwrap().to_vec1::<f32>().unwrap();
    model
        .weights
        .variables()
        .iter()
        .map(|(name, variable)| (name.clone(), flat(variable)))
        .collect()
}

#[test]
fn eight_drawn_places_are_learnt_to_zero_loss() {
    let folder = tempfile::tempdir().unwrap();
    let set = drawn_places(folder.path());
    let (_, outcome) = train_in(&folder.path().join("run"), &set, &config(240), u64::MAX).unwrap();
    assert!(outcome.initial.at_1 < 100.0, "{outcome:?}");
    assert_eq!(
        (outcome.last_loss, outcome.kept.at_1),
        (0.0, 100.0),
        "{outcome:?}"
    );
}

#[test]
fn an_interrupted_run_of_blocks_continues_bit_for_bit() {
    let folder = tempfile::tempdir().unwrap();
    let set = drawn_places(folder.path());
    // Varied images too: their variations follow from the seed.
    let config = TrainConfig {
        augmentation: Augmentation::default(),
        ..config(60)
    };
    let whole = folder.path().join("whole");
    let broken = folder.path().join("broken");
    let (straight, expected) = train_in(&whole, &set, &config, u64::MAX).unwrap();
    assert!(train_in(&broken, &set, &config, 40).is_none());
    let (continued, outcome) = train_in(&broken, &set, &config, u64::MAX).unwrap();
    assert_eq!(outcome, expected);
    assert_eq!(values(&continued), values(&straight));
    assert_ne!(
        values(&straight),
        values(&model(TrainableBlocks::Last(1), false)),
        "nothing was learnt"
    );
}

#[test]
fn gradients_through_head_and_loss_agree_with_finite_differences() {
    let folder = tempfile::tempdir().unwrap();
    let noise = |seed| {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let pixels = (0..3 * SIZE.width * SIZE.height)
            .map(|_| rng.random())
            .collect();
        RgbImage { size: SIZE, pixels }
    };
    let set = eight_places(folder.path(), noise);
    let model = model(TrainableBlocks::All, true);
    let sample = |side, index| Sample {
        side,
        index,
        variation: None,
    };
    // Two triplets; the margin is so wide that both count.
    let samples = [0, 6, 1, 7, 12, 2].map(|index| sample(Side::Database, index));
    let value = || {
        let descriptors = model.embed(&set, &samples, Graph::Recorded).unwrap();
        let part = |role: usize| descriptors.narrow(0, role * 2, 2).unwrap();
        triplet_margin_loss(&part(0), &part(1), &part(2), 1.0).unwrap()
    };
    let gradients = value().backward().unwrap();
    let names = [
        pooling::WEIGHT,
        pooling::BIAS,
        "blocks.1.mlp.fc2.weight",
        "blocks.0.attn.qkv.weight",
        "patch_embed.proj.weight",
        "norm.weight",
    ];
    for name in names {
        let variable = &model.weights.variables()[name];
        let analytic = gradients
            .get(variable.as_tensor())
            .unwrap_or_else(|| panic!("no gradient of {name}"));
        let analytic = analytic.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        let at = (0..analytic.len())
            .max_by(|a, b| analytic[*a].abs().total_cmp(&analytic[*b].abs()))
            .unwrap();
        let start = variable.as_tensor().copy().unwrap();
        let shifted = |shift: f32| {
            let mut values = start.flatten_all().unwrap().to_vec1::<f32>().unwrap();
            values[at] += shift;
            variable
                .set(&Tensor::from_vec(values, start.shape(), &Device::Cpu).unwrap())
                .unwrap();
            f64::from(value().to_scalar::<f32>().unwrap())
        };
        let step = 4e-3f32;
        let numeric = (shifted(step) - shifted(-step)) / f64::from(2.0 * step);
        variable.set(&start).unwrap();
        let analytic = f64::from(analytic[at]);
        assert!(
            analytic.abs() > 5e-4,
            "{name}: no gradient to speak of, {analytic}"
        );
        assert!(
            (numeric - analytic).abs() < 0.03 * analytic.abs() + 5e-5,
            "{name}[{at}]: {numeric} against {analytic}"
        );
    }
}
