//! Screens random samples of four correspondences before homographies are computed from them.
//!
//! Among false matches, most samples cannot come from one plane that both images see from the same
//! side: three of the points are nearly on a line, or the quadrilateral changes its orientation. A
//! vector kernel rejects these at a small part of the cost of solving them. What is left is
//! gathered densely, so that the solver, which takes 16 samples at a time, has no idle lanes.

use placeformer_kernels::Simd;
use placeformer_kernels::homography::{self, LANES, PointPairs, Sample};

/// Number of samples that are drawn and screened at a time.
pub(super) const CHUNK: usize = 4 * LANES;

/// Least area of the triangles of a sample, twice the area, in squared tolerances.
///
/// Patches lie on a grid with a spacing of 2/3 of the tolerance, so the smallest proper triangle
/// has 0.44, or 0.11 between the grids of two scales, which are offset by half a patch.
const MIN_AREA: f32 = 0.05;

/// The proper samples of one chunk.
pub(super) struct ProperSamples {
    samples: [Sample; CHUNK],
    /// The number of each sample within its chunk.
    numbers: [u8; CHUNK],
    len: usize,
}

const _: () = assert!(CHUNK <= u8::MAX as usize + 1);

impl ProperSamples {
    pub(super) fn new() -> Self {
        Self {
            // The solver takes whole groups, so it also reads samples beyond `len`. They must name
            // correspondences that exist; the first one always does.
            samples: [[0; 4]; CHUNK],
            numbers: [0; CHUNK],
            len: 0,
        }
    }

    /// Replaces the content by the proper samples of another chunk.
    pub(super) fn gather(&mut self, simd: Simd, points: &PointPairs, chunk: &[Sample; CHUNK]) {
        self.len = 0;
        let (groups, _) = chunk.as_chunks::<LANES>();
        for (group, samples) in groups.iter().enumerate() {
            let mut is_proper = homography::proper(simd, points, samples, MIN_AREA);
            while is_proper != 0 {
                let lane = is_proper.trailing_zeros() as usize;
                // Clears the lowest bit that is set.
                is_proper &= is_proper - 1;
                self.samples[self.len] = samples[lane];
                self.numbers[self.len] = (group * LANES + lane) as u8;
                self.len += 1;
            }
        }
    }

    /// The samples in groups for the solver. With each group come the numbers of its samples within
    /// the chunk; the last group may have fewer numbers than samples.
    pub(super) fn groups(&self) -> impl Iterator<Item = (&[Sample; LANES], &[u8])> {
        let (groups, _) = self.samples.as_chunks::<LANES>();
        let numbers = self.numbers[..self.len].chunks(LANES);
        groups.iter().zip(numbers)
    }
}
