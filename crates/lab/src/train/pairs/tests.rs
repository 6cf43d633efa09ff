//! What batches of pairs are made of.

use super::*;
use crate::train::Augmentation;
use crate::train::head::{HeadModel, PooledTokens};
use crate::train::spots::in_groups;
use placeformer_core::progress::Silent;
use std::path::PathBuf;

const PLACES: usize = 12;

/// Places of two images on each side. Descriptors lie on a circle, so that neighbouring places look
/// most alike.
fn set() -> TripletSet {
    let count = 2 * PLACES;
    let paths = |side: &str| -> Vec<PathBuf> {
        (0..count)
            .map(|i| PathBuf::from(format!("{side}{i}")))
            .collect()
    };
    let rows: Vec<Vec<u32>> = (0..count as u32)
        .map(|i| vec![i / 2 * 2, i / 2 * 2 + 1])
        .collect();
    TripletSet {
        queries: paths("q"),
        database: paths("d"),
        positives: rows.clone(),
        near: rows,
        spots: in_groups(count, 2),
    }
}

fn head() -> HeadModel {
    let angle = |image: usize| (image / 2) as f32 * 0.2;
    let tokens = || -> Vec<f32> {
        (0..2 * PLACES)
            .flat_map(|image| [angle(image).cos(), angle(image).sin()])
            .collect()
    };
    let tokens = || PooledTokens::new(2, tokens(), tokens()).unwrap();
    HeadModel::new(&[1.0, 0.0, 0.0, 1.0], &[0.0; 2], tokens(), tokens()).unwrap()
}

fn config() -> TrainConfig {
    TrainConfig {
        batch: 8,
        negatives: 4,
        augmentation: Augmentation::NONE,
        seed: 5,
        ..TrainConfig::default()
    }
}

fn batches(config: &TrainConfig, range: Range<u64>) -> Vec<Vec<Sample>> {
    let set = set();
    let head = head();
    let bound = head.bound(&set);
    let usable: Vec<usize> = set.usable().collect();
    let miner = PairMiner {
        model: &bound,
        set: &set,
        config,
        progress: &Silent,
    };
    miner.batches(&usable, range).unwrap()
}

#[test]
fn half_of_the_pairs_are_places_that_look_like_another_of_the_batch() {
    let place = |sample: &Sample| sample.index as i64 / 2;
    for batch in batches(&config(), 0..30) {
        let queries: Vec<&Sample> = batch.iter().filter(|s| s.side == Side::Query).collect();
        assert!(batch.len() <= 16 && queries.len() >= 2, "{}", batch.len());
        for query in &queries {
            let shown =
                |other: &&Sample| other.side == Side::Database && place(other) == place(query);
            assert!(
                batch.iter().any(|other| shown(&other)),
                "a query without its positive"
            );
        }
        // Of each drawn pair and its hard one, the places are at most two steps of the circle
        // apart: there lie the four most similar queries.
        let close = |a: &Sample, b: &Sample| (1..=2).contains(&(place(a) - place(b)).abs());
        let paired = queries
            .iter()
            .filter(|a| queries.iter().any(|b| close(a, b)))
            .count();
        assert!(2 * paired >= queries.len());
        let files: HashSet<(Side, usize)> = batch.iter().map(|s| (s.side, s.index)).collect();
        assert_eq!(files.len(), batch.len(), "an image twice");
    }
}

#[test]
fn what_a_step_draws_follows_from_its_number() {
    let all = batches(&config(), 3..8);
    assert_eq!(all[2..], batches(&config(), 5..8));
    assert_ne!(all[0], all[1]);
    let varied = TrainConfig {
        augmentation: Augmentation::default(),
        ..config()
    };
    let varied = batches(&varied, 3..5);
    let seeds: HashSet<Option<u64>> = varied.iter().flatten().map(|s| s.variation).collect();
    assert_eq!(seeds.len(), varied.iter().map(Vec::len).sum::<usize>());
    assert!(!seeds.contains(&None));
}

#[test]
fn without_hard_pairs_nothing_is_mined() {
    let plain = TrainConfig {
        hard_pairs: 0,
        ..config()
    };
    for batch in batches(&plain, 0..5) {
        assert!(batch.len() <= 16);
        assert!(batch.iter().filter(|s| s.side == Side::Query).count() <= 8);
    }
}
