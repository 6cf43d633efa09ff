//! Divides answers into the folds of a cross-validation, so that the answers of a place are in one
//! fold, and folds have about as many right and wrong answers as each other.

use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use std::collections::BTreeMap;

/// The fold of every answer, below `folds` (at least 2). Of an answer are given its place and
/// whether it is right. Answers of one place share their fold; right and wrong answers are spread
/// evenly.
pub fn folds_of(answers: &[(usize, bool)], folds: usize, seed: u64) -> Vec<usize> {
    let mut counts: BTreeMap<usize, [usize; 2]> = BTreeMap::new();
    for &(place, correct) in answers {
        counts.entry(place).or_default()[usize::from(correct)] += 1;
    }
    let mut places: Vec<(usize, [usize; 2])> = counts.into_iter().collect();
    places.shuffle(&mut ChaCha8Rng::seed_from_u64(seed));
    // Large places first: small ones then even out what these left uneven.
    places.sort_by_key(|(_, [wrong, right])| std::cmp::Reverse(wrong + right));
    let mut loads = vec![[0usize; 2]; folds.max(2)];
    let mut fold_of = BTreeMap::new();
    for (place, [wrong, right]) in places {
        let alike = |load: &[usize; 2]| wrong * load[0] + right * load[1];
        let fold = (0..loads.len())
            .min_by_key(|&fold| (alike(&loads[fold]), loads[fold].iter().sum::<usize>()));
        let fold = fold.unwrap_or(0);
        loads[fold][0] += wrong;
        loads[fold][1] += right;
        fold_of.insert(place, fold);
    }
    answers
        .iter()
        .map(|(place, _)| fold_of.get(place).copied().unwrap_or(0))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn places_stay_whole_and_folds_even(
            raw in prop::collection::vec((0usize..40, any::<bool>()), 40..200), seed: u64,
        ) {
            let folds = folds_of(&raw, 5, seed);
            prop_assert_eq!(&folds, &folds_of(&raw, 5, seed));
            let mut counts = [0usize; 5];
            for (a, fold) in raw.iter().zip(&folds) {
                counts[*fold] += 1;
                for (b, other) in raw.iter().zip(&folds) {
                    prop_assert!(a.0 != b.0 || fold == other);
                }
            }
            let largest = (0..40).map(|place| raw.iter().filter(|one| one.0 == place).count()).max().unwrap();
            prop_assert!(counts.iter().max().unwrap() - counts.iter().min().unwrap() <= 3 * largest, "{counts:?}");
        }
    }
}
