//! Every level draws the sequence of the definition.

use super::*;
use proptest::prelude::*;

proptest! {
    #[test]
    fn every_level_draws_the_sequence_of_the_definition(
        seed: u64,
        points in prop_oneof![4usize..12, 4usize..2000, 60_000usize..80_000],
        parts in prop::collection::vec(0usize..150, 1..6),
    ) {
        for simd in Simd::all() {
            let mut sampler = Sampler::new(seed);
            let mut reference = OneByOne::new(seed);
            for &part in &parts {
                let mut samples = vec![[0; 4]; part];
                sampler.fill(simd, points, &mut samples);
                for sample in samples {
                    prop_assert_eq!(sample, reference.next(points));
                }
            }
        }
    }
}

#[test]
fn every_position_is_drawn_and_four_always_differ() {
    let mut sampler = Sampler::new(7);
    let mut samples = vec![[0; 4]; 4000];
    sampler.fill(Simd::best(), 37, &mut samples);
    assert!(
        samples
            .iter()
            .all(|four| (0..4).all(|i| four[i] < 37 && (0..i).all(|j| four[i] != four[j])))
    );
    assert!((0..37).all(|position| {
        (0..4).all(|corner| samples.iter().any(|four| four[corner] == position))
    }));
}

#[test]
#[should_panic(expected = "four different ones of 3")]
fn fewer_than_four_are_refused() {
    Sampler::new(1).fill(Simd::SCALAR, 3, &mut [[0; 4]]);
}
