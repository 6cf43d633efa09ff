//! The correspondences of two images, and samples of them.

use super::{LANES, Sample};
use crate::greatest_common_divisor;

/// Correspondences `(x, y) -> (u, v)` in units of the inlier tolerance; the memory is kept when
/// they are replaced.
#[derive(Debug, Clone, Default)]
pub struct PointPairs {
    /// `[len]`, in the order given, which samples refer to.
    pairs: Vec<[f32; 4]>,
    /// The same by axis (x, y, u, v), for counting; filled up with NaN, which is never an inlier,
    /// to a multiple of [`LANES`]. The order differs: inliers are often neighbours, and this order
    /// spreads neighbours evenly, so that a bad homography shows early.
    coordinates: [Vec<f32>; 4],
}

impl PointPairs {
    /// Replaces the correspondences by `(x, y, u, v)`.
    pub fn fill(&mut self, pairs: impl IntoIterator<Item = [f32; 4]>) {
        self.pairs.clear();
        self.pairs.extend(pairs);
        let len = self.pairs.len();
        let padded = len.next_multiple_of(LANES);
        let stride = spreading_stride(len);
        for (axis, values) in self.coordinates.iter_mut().enumerate() {
            values.clear();
            let mut position = 0;
            for _ in 0..len {
                values.push(self.pairs[position][axis]);
                position += stride;
                if position >= len {
                    position -= len;
                }
            }
            values.resize(padded, f32::NAN);
        }
    }

    /// Number of correspondences.
    pub fn len(&self) -> usize {
        self.pairs.len()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.pairs.is_empty()
    }

    /// The correspondence `(x, y, u, v)` at `i`.
    ///
    /// # Panics
    /// If it does not exist.
    #[inline(always)]
    pub fn get(&self, i: usize) -> [f32; 4] {
        self.pairs[i]
    }

    /// All coordinates of one axis (x, y, u, v) in counting order, filled up with NaN.
    #[inline(always)]
    pub fn axis(&self, axis: usize) -> &[f32] {
        &self.coordinates[axis]
    }
}

/// A step with which a walk around `len` positions visits each once, and successive visits are far
/// apart: the largest up to about the golden section of `len` that has no divisor in common with
/// it.
fn spreading_stride(len: usize) -> usize {
    let mut strides = (1..=len * 5 / 8).rev();
    let coprime = |stride: &usize| greatest_common_divisor(*stride, len) == 1;
    strides.find(coprime).unwrap_or(1)
}

/// Samples of which every position is known to exist.
#[derive(Clone, Copy)]
pub(super) struct CheckedSamples<'a> {
    pairs: &'a [[f32; 4]],
    samples: &'a [Sample; LANES],
}

impl<'a> CheckedSamples<'a> {
    /// # Panics
    /// If a sample names a correspondence that does not exist.
    #[inline(always)]
    pub(super) fn new(pairs: &'a PointPairs, samples: &'a [Sample; LANES]) -> Self {
        // No early exit, so that the compiler can use vectors.
        let positions = samples.as_flattened().iter();
        let last = positions.fold(0, |last: u16, &position| last.max(position));
        assert!(
            usize::from(last) < pairs.len(),
            "a sample names a pair that is not there"
        );
        Self {
            pairs: &pairs.pairs,
            samples,
        }
    }

    /// The correspondence `(x, y, u, v)` at one corner of a sample.
    #[inline(always)]
    pub(super) fn pair(&self, sample: usize, corner: usize) -> &'a [f32; 4] {
        let position = usize::from(self.samples[sample][corner]);
        // SAFETY: `new` has compared every position of the samples with the number of pairs.
        unsafe { self.pairs.get_unchecked(position) }
    }
}
