//! Homographies from four correspondences, many at a time, and counting the inliers of one.
//!
//! RANSAC (paper III-D) spends its time in three loops. It draws random samples of four
//! correspondences and rejects those that cannot be the corners of one plane seen twice (of false
//! matches one in eight passes); it solves the others for a homography; and it counts the inliers
//! of each homography.
//!
//! Coordinates are in units of the inlier tolerance. So a pair `(x, y) -> (u, v)` is an inlier of
//! the homography H with rows `a b c`, `d e f` and `g h i` if `w = g x + h y + i` is strictly
//! positive and `(a x + b y + c - u w)^2 + (d x + e y + f - v w)^2 <= w^2`: the transfer error in
//! one direction, without a division.
//!
//! Multiplications and additions are never fused, so that every level gives the same bits and a
//! pair of images the same score on every machine.

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
mod check;
mod pairs;
mod sampler;
mod scalar;
#[cfg(test)]
mod tests;
#[cfg(target_arch = "x86_64")]
mod vectors;

use crate::Simd;
use crate::dispatch::dispatch;
pub(crate) use check::check;
pub use pairs::PointPairs;
pub use sampler::{MOST_POSITIONS, Sampler};

/// Samples that are tested or solved by one call.
pub const LANES: usize = 16;

/// The positions of four correspondences among all: the corners of two quadrilaterals.
pub type Sample = [u16; 4];

/// Correspondences between two looks at whether counting inliers can still succeed.
const COUNTING_STRIDE: usize = 2 * LANES;

/// The homographies of [`LANES`] samples, each up to a positive scale.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hypotheses {
    /// `[entry, row-major][lane]`.
    entries: [[f32; LANES]; 9],
}

impl Hypotheses {
    /// The homography of one lane, row-major.
    #[inline(always)]
    pub fn get(&self, lane: usize) -> [f32; 9] {
        std::array::from_fn(|entry| self.entries[entry][lane])
    }
}

/// Tells which of `samples` are proper: bit `i` of the result is set if sample `i` is.
///
/// A sample is proper if all four triangles of its corners have the same orientation in both
/// images, and twice their area is more than `min_area` (in squared tolerances) in both. The first
/// condition rejects quadrilaterals that no view of a plane maps to each other (twisted ones, and
/// mirrored ones, as if seen from behind) and makes `w` positive at the corners; the second rejects
/// collinear and repeated corners.
///
/// # Panics
/// If a sample names a correspondence that does not exist, or `min_area` is negative.
pub fn proper(simd: Simd, pairs: &PointPairs, samples: &[Sample; LANES], min_area: f32) -> u32 {
    assert!(min_area >= 0.0, "twice an area is at least {min_area}");
    dispatch!(simd, proper(pairs, samples, min_area))
}

/// The homography of each sample. That of a sample that is not proper is meaningless, and may
/// differ from level to level.
///
/// # Panics
/// If a sample names a correspondence that does not exist.
pub fn solve(simd: Simd, pairs: &PointPairs, samples: &[Sample; LANES]) -> Hypotheses {
    dispatch!(simd, solve(pairs, samples))
}

/// Counts the inliers of `homography`, row-major. As soon as the count cannot exceed `floor` any
/// more, counting may stop; the result is then some number not above `floor`, the same at every
/// level.
pub fn count_inliers(simd: Simd, pairs: &PointPairs, homography: &[f32; 9], floor: usize) -> usize {
    dispatch!(simd, count_inliers(pairs, homography, floor))
}
