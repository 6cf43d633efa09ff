use super::*;
use crate::train::head::{HeadModel, PooledTokens};
use crate::train::{Augmentation, Schedule};

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
        positives: (0..24).map(|image| group(image).filter(|&other| other != image).collect()).collect(),
        near: (0..24).map(|image| group(image).collect()).collect(),
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
        schedule: Schedule { peak: 0.02, warm_up: 5, total },
        batch: 24,
        steps_per_cycle: 20,
        patience: 1000,
        augmentation: Augmentation::NONE,
        margin: 0.2,
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
    let mut progress = |record: &CycleRecord| {
        if record.step >= stop_after {
            std::panic::panic_any("interrupted");
        }
    };
    let session = Session { folder: folder.to_owned(), identity: "test".into(), progress: &mut progress };
    let run = std::panic::AssertUnwindSafe(|| model.train(set, &validation, config, session).unwrap());
    std::panic::catch_unwind(run).ok()
}

#[test]
fn eight_places_are_learnt_to_zero_loss() {
    let (set, tokens) = eight_places();
    let folder = tempfile::tempdir().unwrap();
    let outcome = train_in(folder.path(), &head(&tokens), &set, &config(600), u64::MAX).unwrap();
    assert!(outcome.initial.at_1 < 90.0, "{outcome:?}");
    assert_eq!((outcome.last_loss, outcome.best.at_1), (0.0, 100.0), "{outcome:?}");
}

#[test]
fn an_interrupted_run_continues_bit_for_bit() {
    let (set, tokens) = eight_places();
    let (whole, broken) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let config = config(100);
    let straight = head(&tokens);
    let expected = train_in(whole.path(), &straight, &set, &config, u64::MAX).unwrap();
    assert!(train_in(broken.path(), &head(&tokens), &set, &config, 40).is_none());
    let continued = head(&tokens);
    let outcome = train_in(broken.path(), &continued, &set, &config, u64::MAX).unwrap();
    assert_eq!(outcome, expected);
    assert_eq!(continued.weights().unwrap(), straight.weights().unwrap());
    let log = |folder: &tempfile::TempDir| -> Vec<_> {
        crate::train::read_log(folder.path()).unwrap().into_iter().map(|r| (r.step, r.loss, r.recall)).collect()
    };
    assert_eq!(log(&whole), log(&broken));
}

#[test]
fn a_checkpoint_of_other_settings_or_a_broken_one_is_refused() {
    let (set, tokens) = eight_places();
    let folder = tempfile::tempdir().unwrap();
    train_in(folder.path(), &head(&tokens), &set, &config(40), u64::MAX).unwrap();
    let mut progress = |_: &CycleRecord| {};
    let validation = set.clone();
    let mut attempt = |config: &TrainConfig, identity: &str| {
        let session = Session { folder: folder.path().to_owned(), identity: identity.into(), progress: &mut progress };
        head(&tokens).train(&set, &validation, config, session).unwrap_err().to_string()
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
    let config = TrainConfig { patience: 2, ..config(100_000) };
    let outcome = train_in(folder.path(), &head(&tokens), &set, &config, u64::MAX).unwrap();
    assert!(outcome.stopped_early && outcome.steps < 2_000, "{outcome:?}");
}
