//! Mutual nearest neighbours of the key patches of two images (paper III-D, step 6).
//!
//! Descriptors are L2-normalised, so the nearest one by Euclidean distance is the one with the
//! largest dot product. Several of the configured combinations may contain the same pair of scales.
//! So the dot products of each pair of scales are computed only once
//! ([`placeformer_kernels::similarity`]), and a combination takes the best over its pairs of
//! scales.

use placeformer_core::types::{PackedPatches, SCALES, ScaleSet};
use placeformer_kernels::Simd;
use placeformer_kernels::similarity::{
    self, Best, BlockMaxima, Blocks, Int8Descriptors, PackedColumns,
};

/// A mutual pair: the row in the query's patches, and the row in the reference's.
pub(super) type Pair = (u32, u32);

/// The patches of a query, laid out once and compared with every candidate.
#[derive(Debug)]
pub(super) struct PreparedQuery {
    columns: PackedColumns,
    counts: [usize; SCALES],
    /// Value of one code unit of each descriptor.
    factors: Vec<f32>,
    /// Centres of the patches in pixels of the model's input.
    pub(super) centres: Vec<[f32; 2]>,
}

impl PreparedQuery {
    pub(super) fn new(simd: Simd) -> Self {
        Self {
            columns: PackedColumns::new(simd),
            counts: [0; SCALES],
            factors: Vec::new(),
            centres: Vec::new(),
        }
    }

    pub(super) fn simd(&self) -> Simd {
        self.columns.simd()
    }

    /// Replaces the query. The memory of the one before is used again.
    pub(super) fn prepare(&mut self, query: &PackedPatches) {
        self.columns.pack(quantised(query));
        self.counts = query.counts;
        self.factors.clone_from(&query.factor);
        centres_of(query, &mut self.centres);
    }
}

/// Replaces `out` by the centres of all patches, in pixels of the model's input.
pub(super) fn centres_of(patches: &PackedPatches, out: &mut Vec<[f32; 2]>) {
    out.clear();
    for scale in 1..=SCALES {
        for &index in &patches.index[patches.rows(scale)] {
            out.push(patches.grid.centre(scale, usize::from(index)));
        }
    }
}

fn quantised(patches: &PackedPatches) -> Int8Descriptors<'_> {
    Int8Descriptors {
        dim: patches.dim,
        counts: patches.counts,
        codes: &patches.codes,
        factors: &patches.factor,
    }
}

/// Working memory of one thread.
#[derive(Debug, Default)]
pub(super) struct Matcher {
    scratch: similarity::Scratch,
    maxima: BlockMaxima,
}

impl Matcher {
    /// Computes the best partner of every patch within every pair of scales that `combinations`
    /// need.
    pub(super) fn compare(
        &mut self,
        query: &PreparedQuery,
        reference: &PackedPatches,
        combinations: &[ScaleSet],
    ) {
        let needed = scale_pairs_of(combinations);
        similarity::block_maxima(
            &query.columns,
            quantised(reference),
            &needed,
            &mut self.scratch,
            &mut self.maxima,
        );
    }

    /// Replaces `pairs` by the mutual pairs of one combination, ascending by query row.
    ///
    /// They are those of the last [`Self::compare`], which must have been given this combination.
    pub(super) fn mutual_pairs(
        &self,
        query: &PreparedQuery,
        reference: &PackedPatches,
        scales: ScaleSet,
        pairs: &mut Vec<Pair>,
    ) {
        pairs.clear();
        for scale in scales.scales() {
            let start: usize = query.counts[..scale - 1].iter().sum();
            for row in start..start + query.counts[scale - 1] {
                let nearest = best_over(&self.maxima.columns, scales, row).index;
                if nearest as usize >= reference.len() {
                    // The reference has no patches of these scales.
                    continue;
                }
                let back = best_over(&self.maxima.rows, scales, nearest as usize).index;
                if back == row as u32 {
                    pairs.push((row as u32, nearest));
                }
            }
        }
    }
}

impl Matcher {
    /// The cosine of the descriptors of a pair that [`Self::mutual_pairs`] found for `scales`.
    pub(super) fn cosine(&self, query: &PreparedQuery, scales: ScaleSet, pair: Pair) -> f32 {
        let row = pair.0 as usize;
        // The maxima leave out the factor that all partners of a descriptor have in common: its
        // own.
        best_over(&self.maxima.columns, scales, row).value * query.factors[row]
    }
}

/// The pairs of scales that occur together in some combination.
fn scale_pairs_of(combinations: &[ScaleSet]) -> Blocks {
    let together = |a: usize, b: usize| {
        combinations
            .iter()
            .any(|set| set.contains(a) && set.contains(b))
    };
    std::array::from_fn(|a| std::array::from_fn(|b| together(a + 1, b + 1)))
}

/// The best partner of `row` among the scales of a combination. The scales ascend, so of equally
/// good partners the one with the lowest index wins.
fn best_over(bests: &[Vec<Best>; SCALES], scales: ScaleSet, row: usize) -> Best {
    let mut best = Best::NONE;
    for scale in scales.scales() {
        let Best { value, index } = bests[scale - 1][row];
        best.challenge(value, index);
    }
    best
}
