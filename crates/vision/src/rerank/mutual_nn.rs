//! Mutual nearest neighbours of two images' key patches (paper III-D, step 6).
//!
//! Descriptors are L2-normalised, so the nearest by Euclidean distance is the one of the largest
//! dot product. The similarity of each pair of scales is computed once
//! ([`placeformer_kernels::similarity`]), however many of the configured unions contain it; a union then
//! takes the best over its blocks.

use placeformer_core::types::{PackedPatches, SCALES, ScaleSet};
use placeformer_kernels::Simd;
use placeformer_kernels::similarity::{
    self, Best, BlockMaxima, Blocks, Int8Descriptors, PackedColumns,
};

/// A mutual pair: row in the query's patches, row in the reference's.
pub(super) type Pair = (u32, u32);

/// The query's side, laid out once and compared with every candidate.
#[derive(Debug)]
pub(super) struct PreparedQuery {
    columns: PackedColumns,
    counts: [usize; SCALES],
    /// Centres of the patches, in pixels of the model's input.
    pub(super) centres: Vec<[f32; 2]>,
}

impl PreparedQuery {
    pub(super) fn new(simd: Simd) -> Self {
        Self {
            columns: PackedColumns::new(simd),
            counts: [0; SCALES],
            centres: Vec::new(),
        }
    }

    pub(super) fn simd(&self) -> Simd {
        self.columns.simd()
    }

    /// Replaces the query; the memory of the one before is used again.
    pub(super) fn prepare(&mut self, query: &PackedPatches) {
        self.columns.pack(quantised(query));
        self.counts = query.counts;
        centres_of(query, &mut self.centres);
    }
}

/// Centres of all patches, in pixels of the model's input.
pub(super) fn centres_of(patches: &PackedPatches, out: &mut Vec<[f32; 2]>) {
    out.clear();
    for scale in 1..=SCALES {
        out.extend(
            patches
                .rows(scale)
                .map(|row| patches.grid.centre(scale, patches.index[row] as usize)),
        );
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
    /// Computes the best partners within every pair of scales that `combinations` need.
    pub(super) fn compare(
        &mut self,
        query: &PreparedQuery,
        reference: &PackedPatches,
        combinations: &[ScaleSet],
    ) {
        let wanted = blocks_of(combinations);
        similarity::block_maxima(
            &query.columns,
            quantised(reference),
            &wanted,
            &mut self.scratch,
            &mut self.maxima,
        );
    }

    /// The mutual pairs of one union, ascending by query row, from the last comparison, which must
    /// have covered it.
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
                if (nearest as usize) < reference.len()
                    && best_over(&self.maxima.rows, scales, nearest as usize).index == row as u32
                {
                    pairs.push((row as u32, nearest));
                }
            }
        }
    }
}

/// The pairs of scales that occur together in some union.
fn blocks_of(combinations: &[ScaleSet]) -> Blocks {
    let together = |a: usize, b: usize| {
        combinations
            .iter()
            .any(|set| set.contains(a) && set.contains(b))
    };
    std::array::from_fn(|a| std::array::from_fn(|b| together(a + 1, b + 1)))
}

/// The best partner of `row` among the scales of a union; scales ascend, so a tie goes to the
/// lowest index.
fn best_over(bests: &[Vec<Best>; SCALES], scales: ScaleSet, row: usize) -> Best {
    let mut best = Best::NONE;
    for scale in scales.scales() {
        let Best { value, index } = bests[scale - 1][row];
        best.challenge(value, index);
    }
    best
}
