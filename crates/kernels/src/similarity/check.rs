//! The self-check: maxima of a level against those of the scalar reference.

use super::{BlockMaxima, Blocks, Int8Descriptors, PackedColumns, SECTIONS, Scratch, block_maxima};
use crate::Simd;

/// Codes and factors from a small generator: extremes, repeated descriptors and zeros among them.
pub(super) struct RandomDescriptors {
    pub(super) counts: [usize; SECTIONS],
    pub(super) codes: Vec<i8>,
    pub(super) factors: Vec<f32>,
}

impl RandomDescriptors {
    pub(super) fn new(dim: usize, counts: [usize; SECTIONS], seed: u64) -> Self {
        let mut state = seed;
        let mut next = || {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1_442_695_040_888_963_407);
            (state >> 33) as u32
        };
        let total: usize = counts.iter().sum();
        let mut codes = Vec::with_capacity(total * dim);
        let mut factors = Vec::with_capacity(total);
        for row in 0..total {
            let kind = next() % 8;
            for i in 0..dim {
                codes.push(match kind {
                    0 => 0,
                    1 => [127, -127][i % 2],
                    2 => -127,
                    3 if row > 0 => codes[(row - 1) * dim + i],
                    _ => (i64::from(next() % 255) - 127) as i8,
                });
            }
            factors.push(if kind == 3 && row > 0 {
                factors[row - 1]
            } else {
                (1 + next() % 7) as f32 / 1024.0
            });
        }
        Self {
            counts,
            codes,
            factors,
        }
    }

    pub(super) fn quantised(&self, dim: usize) -> Int8Descriptors<'_> {
        Int8Descriptors {
            dim,
            counts: self.counts,
            codes: &self.codes,
            factors: &self.factors,
        }
    }
}

/// The maxima of the wanted blocks at one level.
pub(super) fn maxima_at(
    simd: Simd,
    columns: Int8Descriptors<'_>,
    rows: Int8Descriptors<'_>,
    wanted: &Blocks,
) -> BlockMaxima {
    let mut packed = PackedColumns::new(simd);
    let mut out = BlockMaxima::default();
    packed.pack(columns);
    block_maxima(&packed, rows, wanted, &mut Scratch::default(), &mut out);
    out
}

/// Compares a level with the scalar reference on small odd inputs, bit for bit.
pub(crate) fn check(simd: Simd) -> Result<(), String> {
    let wanted = [[true, true, false], [true, true, true], [false, true, true]];
    let shapes = [
        (1, [1, 0, 1], [2, 1, 0]),
        (33, [7, 35, 2], [13, 1, 5]),
        (384, [17, 3, 9], [6, 12, 25]),
    ];
    for (seed, (dim, rows, columns)) in shapes.into_iter().enumerate() {
        let r = RandomDescriptors::new(dim, rows, seed as u64);
        let c = RandomDescriptors::new(dim, columns, seed as u64 + 99);
        let ours = maxima_at(simd, c.quantised(dim), r.quantised(dim), &wanted);
        if ours != maxima_at(Simd::SCALAR, c.quantised(dim), r.quantised(dim), &wanted) {
            return Err(format!(
                "{rows:?} x {columns:?} descriptors of {dim} values"
            ));
        }
    }
    Ok(())
}
