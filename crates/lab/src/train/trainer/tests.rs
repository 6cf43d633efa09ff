//! The loop on made-up tokens: learning, resuming, stopping, and what a cycle costs.

use super::*;
use crate::train::head::{HeadModel, PooledTokens};
use crate::train::interruption::InterruptAfter;
use crate::train::loss::Loss;
use crate::train::mining::draw_pool;
use crate::train::model::{Graph, Group, Sample, Variable};
use crate::train::spots::{Spots, in_groups};
use crate::train::{Augmentation, Schedule};
use candle_core::{Tensor, Var};
use placeformer_core::progress::{Silent, Step};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::ops::Range;
use std::sync::Mutex;

const DIM: usize = 16;

/// Eight places of three noisy images each; the noise has structure that hides the place at first.
fn eight_places() -> (TripletSet, Vec<f32>) {
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    let mut tokens = Vec::new();
    for place in 0..8 {
        for _ in 0..3 {
            for column in 0..DIM {
                let signal = if column == place { 0.5 } else { 0.0 };
                // The upper half of the columns is loud and says nothing about the place.
                let noise = if column >= 8 { 1.0 } else { 0.05 };
                tokens.push(signal + noise * rng.random_range(-1.0f32..1.0));
            }
        }
    }
    let images: Vec<PathBuf> = (0..24).map(|i| PathBuf::from(i.to_string())).collect();
    let group = |image: u32| (image / 3 * 3)..(image / 3 * 3 + 3);
    let set = TripletSet {
        positives: (0..24)
            .map(|image| group(image).filter(|&other| other != image).collect())
            .collect(),
        near: (0..24).map(|image| group(image).collect()).collect(),
        spots: in_groups(24, 3),
        queries: images.clone(),
        database: images,
    };
    (set, tokens)
}

fn head(tokens: &[f32]) -> HeadModel {
    let mut rng = ChaCha8Rng::seed_from_u64(4);
    let weight: Vec<f32> = (0..8 * DIM).map(|_| rng.random_range(-0.5..0.5)).collect();
    let cache = || PooledTokens::new(DIM, tokens.to_vec(), tokens.to_vec()).unwrap();
    HeadModel::new(&weight, &[0.0; 8], cache(), cache()).unwrap()
}

fn config(total: u64) -> TrainConfig {
    TrainConfig {
        schedule: Schedule {
            peak: 0.02,
            warm_up: 5,
            total,
        },
        batch: 24,
        steps_per_cycle: 20,
        patience: 1000,
        augmentation: Augmentation::NONE,
        loss: Loss::Triplet { margin: 0.2 },
        ..TrainConfig::default()
    }
}

fn train_in(
    folder: &std::path::Path,
    model: &HeadModel,
    set: &TripletSet,
    config: &TrainConfig,
    stop_after: u64,
) -> Option<Outcome> {
    let validation = set.clone();
    let interrupt = InterruptAfter(stop_after);
    let session = Session {
        folder: folder.to_owned(),
        identity: "test".into(),
        progress: &interrupt,
    };
    let run =
        std::panic::AssertUnwindSafe(|| model.train(set, &validation, config, session).unwrap());
    std::panic::catch_unwind(run).ok()
}

#[test]
fn eight_places_are_learnt_to_zero_loss() {
    let (set, tokens) = eight_places();
    let folder = tempfile::tempdir().unwrap();
    let outcome = train_in(folder.path(), &head(&tokens), &set, &config(600), u64::MAX).unwrap();
    assert!(outcome.initial.at_1 < 90.0, "{outcome:?}");
    assert_eq!(
        (outcome.last_loss, outcome.kept.at_1),
        (0.0, 100.0),
        "{outcome:?}"
    );
}

#[test]
fn an_interrupted_run_continues_bit_for_bit() {
    let (set, tokens) = eight_places();
    let whole = tempfile::tempdir().unwrap();
    let broken = tempfile::tempdir().unwrap();
    let config = config(100);
    let straight = head(&tokens);
    let expected = train_in(whole.path(), &straight, &set, &config, u64::MAX).unwrap();
    assert!(train_in(broken.path(), &head(&tokens), &set, &config, 40).is_none());
    let continued = head(&tokens);
    let outcome = train_in(broken.path(), &continued, &set, &config, u64::MAX).unwrap();
    assert_eq!(outcome, expected);
    assert_eq!(continued.weights().unwrap(), straight.weights().unwrap());
    let log = |folder: &tempfile::TempDir| -> Vec<_> {
        crate::train::read_log(folder.path())
            .unwrap()
            .into_iter()
            .map(|r| (r.step, r.loss, r.recall))
            .collect()
    };
    assert_eq!(log(&whole), log(&broken));
}

#[test]
fn a_checkpoint_of_other_settings_or_a_broken_one_is_refused() {
    let (set, tokens) = eight_places();
    let folder = tempfile::tempdir().unwrap();
    train_in(folder.path(), &head(&tokens), &set, &config(40), u64::MAX).unwrap();
    let validation = set.clone();
    let attempt = |config: &TrainConfig, identity: &str| {
        let session = Session {
            folder: folder.path().to_owned(),
            identity: identity.into(),
            progress: &Silent,
        };
        head(&tokens)
            .train(&set, &validation, config, session)
            .unwrap_err()
            .to_string()
    };
    assert!(attempt(&config(60), "test").contains("other settings"));
    assert!(attempt(&config(40), "other data").contains("other data"));
    std::fs::write(folder.path().join("checkpoint.safetensors"), b"torn").unwrap();
    assert!(attempt(&config(40), "test").contains("not readable"));
}

#[test]
fn training_stops_when_validation_no_longer_improves() {
    let (set, tokens) = eight_places();
    let folder = tempfile::tempdir().unwrap();
    let config = TrainConfig {
        patience: 2,
        ..config(100_000)
    };
    let outcome = train_in(folder.path(), &head(&tokens), &set, &config, u64::MAX).unwrap();
    assert!(
        outcome.stopped_early && outcome.steps < 2_000,
        "{outcome:?}"
    );
}

/// Remembers the steps of the run, and how many images the mining was to embed.
#[derive(Default)]
struct Recorder {
    steps: Mutex<Vec<u64>>,
    mined: Mutex<Option<usize>>,
}

impl Progress for Recorder {
    fn update(&self, step: Step<'_>) {
        match step.task {
            "training" => self.steps.lock().unwrap().push(step.done),
            "mining" => *self.mined.lock().unwrap() = step.total.map(|total| total as usize),
            other => panic!("{other}"),
        }
    }

    fn end(&self, _task: &str) {}
}

/// Gives every image the same descriptor, and counts the images it is asked for.
struct Counting {
    weight: Var,
    value: f32,
    described: Mutex<Vec<Sample>>,
}

impl Counting {
    fn new(value: f32) -> Self {
        let weight = Var::from_tensor(
            &Tensor::ones((1, 4), candle_core::DType::F32, &candle_core::Device::Cpu).unwrap(),
        );
        Self {
            weight: weight.unwrap(),
            value,
            described: Default::default(),
        }
    }
}

impl TripletModel for Counting {
    fn variables(&self) -> Vec<Variable> {
        vec![Variable {
            name: "weight".into(),
            variable: self.weight.clone(),
            group: Group::Projection,
        }]
    }

    fn embed(&self, _: &TripletSet, samples: &[Sample], _: Graph) -> Result<Tensor, TrainError> {
        self.described.lock().unwrap().extend_from_slice(samples);
        Ok((self.weight.broadcast_as((samples.len(), 4))? * f64::from(self.value))?)
    }

    fn embed_batch(&self) -> usize {
        64
    }
}

#[test]
fn a_collapsed_model_finds_nothing() {
    let (set, _) = eight_places();
    for value in [0.5, f32::NAN] {
        let recall = validate(&Counting::new(value), &set, &Silent).unwrap();
        // 21 images tie with the positives, so not even ten answers reach one.
        assert_eq!(
            recall,
            ValidationRecall {
                at_1: 0.0,
                at_5: 0.0,
                at_10: 0.0
            },
            "{value}"
        );
    }
    // The same set with a model that sees the places.
    let (_, tokens) = eight_places();
    let clean: Vec<f32> = tokens
        .chunks(DIM)
        .enumerate()
        .flat_map(|(i, _)| one_hot(i / 3))
        .collect();
    let cache = || PooledTokens::new(DIM, clean.clone(), clean.clone()).unwrap();
    let identity: Vec<f32> = (0..8).flat_map(one_hot).collect();
    let folder = tempfile::tempdir().unwrap();
    let model = HeadModel::new(&identity, &[0.0; 8], cache(), cache()).unwrap();
    assert_eq!(
        train_in(folder.path(), &model, &set, &config(20), u64::MAX)
            .unwrap()
            .initial
            .at_1,
        100.0
    );
}

fn one_hot(place: usize) -> [f32; DIM] {
    std::array::from_fn(|column| f32::from(u8::from(column == place)))
}

#[test]
fn a_cycle_costs_its_queries_their_positives_and_the_pool_however_large_the_data() {
    let paths = |side: &str, n: usize| -> Vec<PathBuf> {
        (0..n)
            .map(|i| PathBuf::from(format!("{side}{i}")))
            .collect()
    };
    let asking = 3000usize;
    let answering = 9000usize;
    let positives: Vec<Vec<u32>> = (0..asking as u32)
        .map(|query| vec![3 * query, 3 * query + 1])
        .collect();
    let set = TripletSet {
        queries: paths("q", asking),
        database: paths("d", answering),
        spots: Spots::default(),
        near: positives.clone(),
        positives,
    };
    let config = TrainConfig {
        batch: 4,
        mining_pool: 100,
        negatives: 3,
        ..config(1000)
    };
    let model = Counting::new(1.0);
    let mut adam = Adam::new(model.variables(), 0.0).unwrap();
    let usable: Vec<usize> = set.usable().collect();
    let recorder = Recorder::default();
    let steps = Task::begin(&recorder, "training", 1000);
    steps.set_done(40);
    let cycle = Cycle {
        model: &model,
        set: &set,
        config: &config,
        progress: &recorder,
        steps: &steps,
    };
    let loss = cycle.run(&usable, &mut adam, 40..45).unwrap().loss;
    let mut shown = recorder.steps.lock().unwrap().clone();
    shown.dedup();
    let announced = recorder.mined.lock().unwrap().unwrap();
    // All descriptors coincide, so every triplet costs the margin.
    assert!((f64::from(loss) - 0.2).abs() < 1e-6, "{loss}");
    assert_eq!(shown, [0, 40, 41, 42, 43, 44, 45]);
    let asked = 5 * 4;
    let trained = 5 * 3 * 4;
    let described = model.described.lock().unwrap().len();
    assert_eq!(described, announced + trained);
    assert!(
        (100..=asked + 2 * asked + 100).contains(&announced),
        "{announced}"
    );
    // What was drawn follows from seed and step alone.
    let triplets = |range: Range<u64>| -> Vec<Vec<u32>> {
        let draws = cycle
            .draw(&usable, &draw_pool(answering, 100, 1), range)
            .unwrap();
        draws
            .iter()
            .map(|step| step.iter().map(|draw| draw.query).collect())
            .collect()
    };
    assert_eq!(triplets(40..45)[2..], triplets(42..45));
}

#[test]
fn queries_without_a_negative_in_the_pool_are_not_asked() {
    let (set, _) = eight_places();
    let model = Counting::new(1.0);
    let cycle = Cycle {
        model: &model,
        set: &set,
        config: &config(20),
        progress: &Silent,
        steps: &Task::begin(&Silent, "training", 20),
    };
    let usable: Vec<usize> = set.usable().collect();
    // Images 0 to 2 are near to each other, so only the other places can be asked against them.
    let draws = cycle.draw(&usable, &[0, 2], 0..10).unwrap();
    assert!(draws.iter().flatten().all(|draw| draw.query > 2));
    assert!(matches!(
        cycle.draw(&usable[..3], &[0, 2], 0..1),
        Err(TrainError::NoTriplets(_))
    ));
}

#[test]
fn the_last_weights_come_out_where_they_are_asked_for() {
    let (set, tokens) = eight_places();
    // So large a step that validation gets worse at once.
    let config = |keep: Keep| TrainConfig {
        keep,
        schedule: Schedule {
            peak: 50.0,
            warm_up: 0,
            total: 20,
        },
        ..config(20)
    };
    let run = |keep: Keep| {
        let folder = tempfile::tempdir().unwrap();
        let model = head(&tokens);
        let outcome = train_in(folder.path(), &model, &set, &config(keep), u64::MAX).unwrap();
        let last = crate::train::read_log(folder.path())
            .unwrap()
            .pop()
            .unwrap();
        (outcome, last.recall, model.weights().unwrap())
    };
    let (best, _, kept) = run(Keep::Best);
    let (outcome, last, moved) = run(Keep::Last);
    assert_eq!(outcome.kept, last);
    assert!(best.kept.criterion() >= last.criterion());
    assert_eq!(kept == moved, best.kept == last, "{:?} {last:?}", best.kept);
    assert_ne!(moved, head(&tokens).weights().unwrap());
}
