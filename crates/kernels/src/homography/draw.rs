//! Random samples of four different correspondences, many at a time.
//!
//! The generator is SplitMix64 (Steele, Lea, Flood 2014): its numbers are part of every score, so
//! they must never change with a library's version. Its state is a counter, so that the compiler
//! can turn the loop over successive numbers into vectors; each number gives four positions, and
//! samples that repeat one are passed over.

use super::Sample;
use crate::simd::Simd;
#[cfg(target_arch = "x86_64")]
use crate::simd::SimdLevel;

/// Numbers made at once.
const CHUNK: usize = 64;

/// What the counter advances by.
const STEP: u64 = 0x9e37_79b9_7f4a_7c15;

/// Positions beyond are never drawn. No model keeps that many patches.
pub const MOST_POSITIONS: usize = u16::MAX as usize;

/// An endless sequence of samples, determined by its seed.
#[derive(Debug, Clone)]
pub struct Sampler {
    counter: u64,
    /// Samples made and not yet given out start at `next`.
    ready: [Sample; CHUNK],
    next: usize,
    len: usize,
}

impl Sampler {
    /// The sequence of `seed`.
    pub fn new(seed: u64) -> Self {
        Self {
            counter: seed,
            ready: [[0; 4]; CHUNK],
            next: 0,
            len: 0,
        }
    }

    /// Fills `samples` with the next of the sequence, over `points` correspondences.
    ///
    /// # Panics
    /// If there are fewer than four, which cannot be told apart four at a time.
    pub fn fill(&mut self, simd: Simd, points: usize, samples: &mut [Sample]) {
        assert!(points >= 4, "four different ones of {points}");
        // Fits: at most `MOST_POSITIONS`.
        let points = points.min(MOST_POSITIONS) as u16;
        let mut filled = 0;
        while filled < samples.len() {
            if self.next == self.len {
                self.refill(simd, points);
            }
            let count = (samples.len() - filled).min(self.len - self.next);
            samples[filled..filled + count]
                .copy_from_slice(&self.ready[self.next..self.next + count]);
            filled += count;
            self.next += count;
        }
    }

    fn refill(&mut self, simd: Simd, points: u16) {
        let (mut positions, mut different) = ([0; CHUNK], [0; CHUNK]);
        match simd.level() {
            // SAFETY: the token proves that the CPU has the level's instructions.
            #[cfg(target_arch = "x86_64")]
            SimdLevel::Avx512 | SimdLevel::Amx => unsafe {
                raw_avx512(self.counter, points, &mut positions, &mut different)
            },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            SimdLevel::Avx2 => unsafe {
                raw_avx2(self.counter, points, &mut positions, &mut different)
            },
            _ => raw(self.counter, points, &mut positions, &mut different),
        }
        self.counter = self.counter.wrapping_add(STEP.wrapping_mul(CHUNK as u64));
        (self.next, self.len) = (0, 0);
        for (four, different) in positions.into_iter().zip(different) {
            // Written always and kept or not, since a branch would be mispredicted.
            self.ready[self.len] = fields(four);
            self.len += usize::from(different != 0);
        }
    }
}

/// The positions in a word, the first in its lowest bits.
#[inline(always)]
fn fields(four: u64) -> Sample {
    bytemuck::cast::<u64, Sample>(four.to_le()).map(u16::from_le)
}

/// Four positions below `points` from each of the next numbers, and whether they differ (not zero
/// if so).
#[inline(always)]
fn raw(counter: u64, points: u16, positions: &mut [u64; CHUNK], different: &mut [u64; CHUNK]) {
    for (i, four) in (1u64..).zip(positions.iter_mut()) {
        let state = counter.wrapping_add(STEP.wrapping_mul(i));
        let mixed = (state ^ (state >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        *four = mixed ^ (mixed >> 31);
    }
    // On a machine of the other byte order the fields come in another order; they are put back by
    // the same call.
    positions.iter_mut().for_each(|four| *four = four.to_le());
    for field in bytemuck::cast_slice_mut::<u64, u16>(positions) {
        *field = ((u32::from(*field) * u32::from(points)) >> 16) as u16;
    }
    positions
        .iter_mut()
        .for_each(|four| *four = u64::from_le(*four));
    for (different, four) in different.iter_mut().zip(positions.iter()) {
        // Turning by one and by two fields brings each of the six pairs together; a pair of equals
        // leaves a field of zeros. The borrow out of a field of zeros shows in its top bit; that it
        // may run on does not matter, as the first is enough.
        let zeros =
            |word: u64| word.wrapping_sub(0x0001_0001_0001_0001) & !word & 0x8000_8000_8000_8000;
        let equal = zeros(four ^ four.rotate_left(16)) | zeros(four ^ four.rotate_left(32));
        *different = u64::from(equal == 0);
    }
}

/// The same operations in wider registers.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn raw_avx2(counter: u64, points: u16, positions: &mut [u64; CHUNK], different: &mut [u64; CHUNK]) {
    raw(counter, points, positions, different);
}

/// The same again; DQ has the product of 64-bit words.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl")]
fn raw_avx512(
    counter: u64,
    points: u16,
    positions: &mut [u64; CHUNK],
    different: &mut [u64; CHUNK],
) {
    raw(counter, points, positions, different);
}

/// The definition: one number after another.
#[derive(Debug, Clone)]
pub(super) struct OneByOne(pub u64);

impl OneByOne {
    /// The next sample over `points` correspondences.
    pub(super) fn next(&mut self, points: usize) -> Sample {
        let points = points.min(MOST_POSITIONS) as u64;
        loop {
            self.0 = self.0.wrapping_add(STEP);
            let mixed = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
            let mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
            let bits = mixed ^ (mixed >> 31);
            let four =
                [0, 16, 32, 48].map(|shift| (((bits >> shift & 0xffff) * points) >> 16) as u16);
            if (0..4).all(|i| (0..i).all(|j| four[i] != four[j])) {
                return four;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn every_level_draws_the_sequence_of_the_definition(
            seed: u64, points in prop_oneof![4usize..12, 4usize..2000, 60_000usize..80_000],
            parts in prop::collection::vec(0usize..150, 1..6),
        ) {
            for simd in Simd::all() {
                let (mut sampler, mut twin) = (Sampler::new(seed), OneByOne(seed));
                for &part in &parts {
                    let mut samples = vec![[0; 4]; part];
                    sampler.fill(simd, points, &mut samples);
                    for sample in samples {
                        prop_assert_eq!(sample, twin.next(points));
                    }
                }
            }
        }
    }

    #[test]
    fn every_position_is_drawn_and_four_always_differ() {
        let (mut sampler, mut samples) = (Sampler::new(7), vec![[0; 4]; 4000]);
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
}
