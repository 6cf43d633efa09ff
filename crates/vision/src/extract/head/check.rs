//! What a head must be to be used, beyond being a file of the right shape.
//!
//! A head whose numbers overflow fails every request, and one that maps all images to one place
//! answers every query with confidence and without reason. Neither is seen in the types of its
//! tensors. So a head is refused when it is made or loaded, with the cause.

use super::projection::Head;
use crate::extract::aggregate::Aggregate;
use crate::extract::global::{l2_normalise, squared_distance};
use placeformer_core::types::GLOBAL_DIM;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Largest magnitude of a number. Sums of any length and their squares stay far within the range
/// of 32-bit floats, and heads of use have numbers below 100.
const LARGEST: f32 = 1e12;

/// Vectors that are projected to see whether the head tells them apart. Three would not do: a head
/// that keeps nothing but a sign puts two of them at least on different sides.
const PROBES: usize = 4;

/// Least distance between the global descriptors of two unrelated vectors. Those of heads of use
/// lie about 1.4 apart.
const LEAST_DISTANCE: f32 = 1e-3;

/// Says what is wrong with the shapes of the parts of a head, or with single numbers.
pub(super) fn shapes(aggregate: &Aggregate, weight: &[f32], bias: &[f32]) -> Result<(), String> {
    let dim = weight.len() / GLOBAL_DIM;
    let has_shapes = dim > 0 && weight.len() == dim * GLOBAL_DIM && bias.len() == GLOBAL_DIM;
    let is_finite = weight.iter().chain(bias).all(|value| value.is_finite());
    if !has_shapes || !is_finite {
        return Err(format!(
            "a head needs a finite [{GLOBAL_DIM}, d] weight and a [{GLOBAL_DIM}] bias"
        ));
    }
    if let Some((count, length)) = words_of(aggregate)
        && length != dim
    {
        return Err(format!(
            "weight takes {dim} values, its {count} visual words make {length}"
        ));
    }
    Ok(())
}

/// The number of visual words of an aggregate that has any, and the length of what they make.
fn words_of(aggregate: &Aggregate) -> Option<(usize, usize)> {
    match aggregate {
        Aggregate::Mean | Aggregate::Gem { .. } => None,
        Aggregate::Vlad(words) => Some((words.count(), words.values().len())),
        Aggregate::NetVlad(netvlad) => Some((netvlad.count(), netvlad.count() * netvlad.width())),
    }
}

/// Says which number cannot be computed with, or which row does not depend on the image. The
/// shapes are known to be right.
pub(super) fn magnitudes(weight: &[f32], bias: &[f32]) -> Result<(), String> {
    for (name, values) in [("weight", weight), ("bias", bias)] {
        if let Some(large) = values.iter().find(|value| value.abs() > LARGEST) {
            return Err(format!(
                "{name} holds {large:e}; numbers above {LARGEST:e} overflow when they are used"
            ));
        }
    }
    let dim = weight.len() / GLOBAL_DIM;
    let zero_row = weight
        .chunks_exact(dim)
        .position(|row| row.iter().all(|value| *value == 0.0));
    match zero_row {
        Some(row) => Err(format!(
            "row {row} of weight is all zeros, so that one value of every global descriptor would \
             be the same"
        )),
        None => Ok(()),
    }
}

/// Says that the head puts unrelated images at one place, or nowhere.
pub(super) fn tells_images_apart(head: &Head) -> Result<(), String> {
    let mut rng = ChaCha8Rng::seed_from_u64(0);
    let mut globals: Vec<Vec<f32>> = Vec::with_capacity(PROBES);
    for _ in 0..PROBES {
        let mut pooled: Vec<f32> = (0..head.dim())
            .map(|_| rng.random_range(-1.0..1.0))
            .collect();
        l2_normalise(&mut pooled);
        let global = head.project(&pooled);
        let square: f32 = global.iter().map(|value| value * value).sum();
        // NaN is outside of every range.
        if !(0.99..1.01).contains(&square) {
            return Err("it makes global descriptors that have no direction".to_owned());
        }
        let least = LEAST_DISTANCE * LEAST_DISTANCE;
        let is_apart = |other: &Vec<f32>| squared_distance(other, &global) >= least;
        if !globals.iter().all(is_apart) {
            let reason = "it gives unrelated images the same global descriptor";
            return Err(reason.to_owned());
        }
        globals.push(global);
    }
    Ok(())
}
