//! Random samples of four different correspondences, many at a time.
//!
//! The generator is SplitMix64 (Steele, Lea, Flood 2014), written here because its numbers are part
//! of every score: they must not change with a library's version. Its state is a counter, so that
//! successive numbers do not depend on each other and can be computed in vectors. Each number gives
//! four positions; samples in which a position occurs twice are dropped.

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
mod scalar;
#[cfg(test)]
mod tests;

use super::Sample;
use crate::Simd;
use crate::dispatch::dispatch;

/// Numbers that are generated at once.
const CHUNK: usize = 64;

/// What the generator's counter advances by.
const STEP: u64 = 0x9e37_79b9_7f4a_7c15;

/// Only the first so many correspondences are drawn from. No model keeps that many patches.
pub const MOST_POSITIONS: usize = u16::MAX as usize;

/// An endless sequence of samples, determined by its seed.
#[derive(Debug, Clone)]
pub struct Sampler {
    counter: u64,
    /// Generated samples; those from `next` up to `len` are not handed out yet.
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

    /// Fills `samples` with the next ones of the sequence, over `points` correspondences.
    ///
    /// # Panics
    /// If there are fewer than four correspondences, of which no sample can be made.
    pub fn fill(&mut self, simd: Simd, points: usize, samples: &mut [Sample]) {
        assert!(points >= 4, "four different ones of {points}");
        // The cast is exact, because the number is at most `MOST_POSITIONS`.
        let points = points.min(MOST_POSITIONS) as u16;
        let mut filled = 0;
        while filled < samples.len() {
            if self.next == self.len {
                self.refill(simd, points);
            }
            let count = (samples.len() - filled).min(self.len - self.next);
            let ready = &self.ready[self.next..self.next + count];
            samples[filled..filled + count].copy_from_slice(ready);
            filled += count;
            self.next += count;
        }
    }

    fn refill(&mut self, simd: Simd, points: u16) {
        let mut positions = [0; CHUNK];
        let mut distinct = [0; CHUNK];
        let counter = self.counter;
        let positions_out = &mut positions;
        let distinct_out = &mut distinct;
        dispatch!(simd, draw(counter, points, positions_out, distinct_out));

        self.counter = self.counter.wrapping_add(STEP.wrapping_mul(CHUNK as u64));
        self.next = 0;
        self.len = 0;
        for (four, distinct) in positions.into_iter().zip(distinct) {
            // Every sample is written, but only distinct ones advance the length. A branch instead
            // would often be mispredicted.
            self.ready[self.len] = unpack(four);
            self.len += usize::from(distinct != 0);
        }
    }
}

/// The four positions in a number, the first in the lowest bits.
#[inline(always)]
fn unpack(four: u64) -> Sample {
    bytemuck::cast::<u64, Sample>(four.to_le()).map(u16::from_le)
}

/// SplitMix64's function from a counter to a random number.
#[inline(always)]
fn mix(counter: u64) -> u64 {
    let mixed = (counter ^ (counter >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    mixed ^ (mixed >> 31)
}

/// The definition of the sequence, one sample after another: what every level is compared with.
#[derive(Debug, Clone)]
pub(super) struct OneByOne {
    counter: u64,
}

impl OneByOne {
    /// The sequence of `seed`.
    pub(super) fn new(seed: u64) -> Self {
        Self { counter: seed }
    }

    /// The next sample over `points` correspondences.
    pub(super) fn next(&mut self, points: usize) -> Sample {
        let points = points.min(MOST_POSITIONS) as u64;
        loop {
            self.counter = self.counter.wrapping_add(STEP);
            let bits = mix(self.counter);
            let position = |shift: u32| (((bits >> shift & 0xffff) * points) >> 16) as u16;
            let four = [0, 16, 32, 48].map(position);
            if (0..4).all(|i| (0..i).all(|j| four[i] != four[j])) {
                return four;
            }
        }
    }
}
