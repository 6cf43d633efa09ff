//! Recall on places that are not learnt from.

use super::config::ValidationRecall;
use super::embed::embed;
use super::error::TrainError;
use super::model::TripletModel;
use super::triplets::{Side, TripletSet};
use placeformer_core::progress::Progress;
use placeformer_vision::extract::squared_distance;
use rayon::prelude::*;

/// Recall over the usable queries. Images that are near without being positives are passed over:
/// otherwise a frame of a drive would find itself.
///
/// The rank is the worst that the distances allow: whatever is not farther than the nearest
/// positive comes before it. Otherwise a model that describes all images alike, or by no number at
/// all, would look perfect and be kept.
pub(super) fn validate(
    model: &dyn TripletModel,
    set: &TripletSet,
    progress: &dyn Progress,
) -> Result<ValidationRecall, TrainError> {
    let usable: Vec<usize> = set.usable().collect();
    let everything: Vec<u32> = (0..set.database.len() as u32).collect();
    let queries = usable.iter().map(|&query| (Side::Query, query as u32));
    let database = everything.iter().map(|&index| (Side::Database, index));
    let embeddings = embed(model, set, queries.chain(database), "validation", progress)?;

    let database = embeddings.of_database(&everything)?;
    let rank_of = |&query: &usize| -> Result<usize, TrainError> {
        let descriptor = embeddings.of(Side::Query, query as u32)?;
        let distance = |index: u32| squared_distance(descriptor, database[index as usize].1);
        // `f32::min` passes over NaN, so a positive without a distance is not found.
        let nearest = set.positives[query]
            .iter()
            .map(|&index| distance(index))
            .fold(f32::INFINITY, f32::min);
        let comes_before = |index: &u32| {
            let is_farther = distance(*index) > nearest;
            set.near[query].binary_search(index).is_err() && !is_farther
        };
        Ok(everything
            .iter()
            .filter(|index| comes_before(index))
            .count())
    };
    let ranks: Vec<usize> = usable.par_iter().map(rank_of).collect::<Result<_, _>>()?;

    let recall = |k: usize| {
        let found = ranks.iter().filter(|&&rank| rank < k).count();
        100.0 * found as f64 / usable.len() as f64
    };
    Ok(ValidationRecall {
        at_1: recall(1),
        at_5: recall(5),
        at_10: recall(10),
    })
}
