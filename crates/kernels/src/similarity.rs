//! Best partners among int8 descriptors: for every row the most similar column, for every column
//! the most similar row.
//!
//! The mutual nearest neighbours of paper III-D need both maxima of the similarity matrix of two
//! images, and the sum s11 + s12 + s23 needs them for several pairs of scales. The matrix is cut
//! into blocks, one for each pair (scale of the rows, scale of the columns); each block is computed
//! once, tile by tile in registers, and only its running row and column maxima are kept. A union of
//! scales then takes the best over its blocks.
//!
//! A descriptor is `code * factor`. The similarity that decides a row's best column is `dot(codes)
//! as f32 * factor of the column`, and that of a column's best row `dot(codes) as f32 * factor of
//! the row`: the partner's own factor is common to all it is compared with. Integer dot products
//! are exact, so every level gives the same bits; ties go to the lowest index. Columns are packed
//! once per query, rows are another candidate each time.

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
#[cfg(target_arch = "x86_64")]
mod driver;

use super::simd::{Simd, SimdLevel};

/// Number of sections (patch scales) rows and columns are divided into.
pub const SECTIONS: usize = 3;

/// The largest length of a descriptor: beyond, an i32 could overflow while summing products.
pub const MAX_DIM: usize = 1 << 16;

/// Which blocks are wanted: `[section of the rows][section of the columns]`.
pub type Blocks = [[bool; SECTIONS]; SECTIONS];

/// Quantised descriptors of one image, sections one after another.
#[derive(Debug, Clone, Copy)]
pub struct Quantised<'a> {
    /// Length of a descriptor.
    pub dim: usize,
    /// Descriptors per section.
    pub counts: [usize; SECTIONS],
    /// `[sum(counts), dim]` row-major, each -127..=127.
    pub codes: &'a [i8],
    /// `[sum(counts)]`.
    pub factors: &'a [f32],
}

impl Quantised<'_> {
    /// Number of descriptors.
    pub fn len(&self) -> usize {
        self.counts.iter().sum()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// # Panics
    /// Where the parts contradict each other: the kernels index by them without further checks.
    fn validate(&self) {
        assert!(
            (1..=MAX_DIM).contains(&self.dim),
            "descriptors of {} values cannot be compared",
            self.dim
        );
        // Added up without wrapping, since the counts decide what is read.
        let total = self
            .counts
            .iter()
            .try_fold(0usize, |total, &count| total.checked_add(count));
        let values = total.and_then(|total| total.checked_mul(self.dim));
        assert_eq!(
            values,
            Some(self.codes.len()),
            "codes do not fill the descriptors announced"
        );
        assert_eq!(
            self.factors.len(),
            self.len(),
            "every descriptor needs one factor"
        );
    }

    fn start(&self, section: usize) -> usize {
        self.counts[..section].iter().sum()
    }
}

/// The best partner of a descriptor within one block.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Best {
    /// Similarity, comparable among the bests of the same descriptor only.
    pub value: f32,
    /// Index of the partner over all sections of its image.
    pub index: u32,
}

impl Best {
    /// No partner: loses against any.
    pub const NONE: Self = Self {
        value: f32::NEG_INFINITY,
        index: u32::MAX,
    };

    /// Takes the challenger if it is strictly better, so that the earlier wins a tie.
    #[inline(always)]
    pub fn challenge(&mut self, value: f32, index: u32) {
        if value > self.value {
            *self = Self { value, index };
        }
    }
}

/// Lanes of the longest vectors of f32.
const MOST_LANES: usize = 16;

/// The maxima of every wanted block; [`Best::NONE`] where a block was not wanted or is empty.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct BlockMaxima {
    /// By section of the columns: the best column of each row.
    pub rows: [Vec<Best>; SECTIONS],
    /// By section of the rows: the best row of each column.
    pub columns: [Vec<Best>; SECTIONS],
}

impl BlockMaxima {
    fn reset(&mut self, rows: usize, columns: usize) {
        for (bests, len) in self
            .rows
            .iter_mut()
            .map(|b| (b, rows))
            .chain(self.columns.iter_mut().map(|b| (b, columns)))
        {
            bests.clear();
            bests.resize(len, Best::NONE);
        }
    }
}

/// 64 bytes on a cache line of their own.
#[derive(Debug, Clone, Copy)]
#[repr(C, align(64))]
struct Line<T: Copy, const N: usize>([T; N]);

/// The columns, laid out for one level; kept and packed anew to spare allocations.
#[derive(Debug, Clone)]
pub struct PackedColumns {
    simd: Simd,
    dim: usize,
    counts: [usize; SECTIONS],
    /// Scalar: the codes as given.
    codes: Vec<i8>,
    /// AVX2: panels of 16 columns, a line holding two successive values of each.
    pairs: Vec<Line<i16, 32>>,
    /// AVX-512: panels of 32 columns, two lines holding four successive values of each, offset by
    /// 128.
    quads: Vec<Line<u8, 64>>,
    /// One per column; sections padded to whole panels with NaN, which never wins a comparison.
    factors: Vec<f32>,
}

impl PackedColumns {
    /// Empty columns for `simd`.
    pub fn new(simd: Simd) -> Self {
        Self {
            simd,
            dim: 1,
            counts: [0; SECTIONS],
            codes: Vec::new(),
            pairs: Vec::new(),
            quads: Vec::new(),
            factors: Vec::new(),
        }
    }

    /// The level they are laid out for.
    pub fn simd(&self) -> Simd {
        self.simd
    }

    /// Replaces the columns.
    ///
    /// # Panics
    /// Where the lengths in `columns` contradict each other.
    pub fn pack(&mut self, columns: Quantised<'_>) {
        columns.validate();
        (self.dim, self.counts) = (columns.dim, columns.counts);
        match self.simd.level() {
            SimdLevel::Scalar => {
                self.codes.clear();
                self.codes.extend_from_slice(columns.codes);
                self.factors.clear();
                self.factors.extend_from_slice(columns.factors);
            }
            #[cfg(target_arch = "x86_64")]
            SimdLevel::Avx2 => avx2::pack(self, columns),
            #[cfg(target_arch = "x86_64")]
            SimdLevel::Avx512 | SimdLevel::Amx => avx512::pack(self, columns),
            #[cfg(not(target_arch = "x86_64"))]
            level => unreachable!("a token for {level} cannot exist on this architecture"),
        }
    }

    /// Length of a descriptor.
    pub fn dim(&self) -> usize {
        self.dim
    }

    /// Number of columns.
    pub fn len(&self) -> usize {
        self.counts.iter().sum()
    }

    /// Whether there is no column.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Fills `factors` with every section padded to a multiple of `panel`.
    fn pack_factors(&mut self, columns: Quantised<'_>, panel: usize) {
        self.factors.clear();
        for section in 0..SECTIONS {
            let start = columns.start(section);
            self.factors
                .extend_from_slice(&columns.factors[start..start + columns.counts[section]]);
            self.factors
                .resize(self.factors.len().next_multiple_of(panel), f32::NAN);
        }
    }
}

/// What a computation needs besides its input and output; kept to spare allocations.
#[derive(Debug, Default)]
pub struct Scratch {
    /// AVX2: rows widened to i16, each padded to whole pairs.
    wide: Vec<i16>,
    /// AVX-512: rows padded to whole fours, where they are not as given.
    padded: Vec<i8>,
    /// AVX-512: what the sums of each row start from.
    starts: Vec<i32>,
    /// Running maxima of each row, lane by lane.
    lane_values: Vec<f32>,
    /// Their columns.
    lane_indices: Vec<i32>,
}

impl Scratch {
    fn reset_lanes(&mut self, rows: usize, lanes: usize) {
        self.lane_values.clear();
        self.lane_values.resize(rows * lanes, f32::NEG_INFINITY);
        self.lane_indices.clear();
        self.lane_indices.resize(rows * lanes, -1);
    }

    /// The best over the lanes of `row`, ties to the lowest column.
    #[inline(always)]
    fn reduce_lanes(&self, row: usize, lanes: usize) -> Best {
        let lane = row * lanes..(row + 1) * lanes;
        // As many as the longest vectors have; what is missing loses to everything.
        let (mut values, mut columns) = ([f32::NEG_INFINITY; MOST_LANES], [u32::MAX; MOST_LANES]);
        values[..lanes].copy_from_slice(&self.lane_values[lane.clone()]);
        for (column, &index) in columns.iter_mut().zip(&self.lane_indices[lane]) {
            *column = index as u32;
        }
        // By halves and without branches, so that the compiler makes vectors of it: which lane is
        // best is anyone's guess.
        let mut half = MOST_LANES / 2;
        while half > 0 {
            for lane in 0..half {
                let (value, column) = (values[lane + half], columns[lane + half]);
                let better =
                    (value > values[lane]) | ((value == values[lane]) & (column < columns[lane]));
                values[lane] = if better { value } else { values[lane] };
                columns[lane] = if better { column } else { columns[lane] };
            }
            half /= 2;
        }
        Best {
            value: values[0],
            index: columns[0],
        }
    }
}

/// Computes the maxima of the wanted blocks at the level `columns` were packed for.
///
/// # Panics
/// Where the lengths in `rows` contradict each other, or descriptors differ in length from the
/// columns'.
pub fn block_maxima(
    columns: &PackedColumns,
    rows: Quantised<'_>,
    wanted: &Blocks,
    scratch: &mut Scratch,
    out: &mut BlockMaxima,
) {
    rows.validate();
    assert_eq!(
        rows.dim, columns.dim,
        "descriptors of different lengths cannot be compared"
    );
    out.reset(rows.len(), columns.len());
    match columns.simd.level() {
        SimdLevel::Scalar => scalar(columns, rows, wanted, out),
        // SAFETY: the columns carry a token of this level, so the CPU has its instructions.
        #[cfg(target_arch = "x86_64")]
        SimdLevel::Avx2 => unsafe { avx2::block_maxima(columns, rows, wanted, scratch, out) },
        // SAFETY: as above.
        #[cfg(target_arch = "x86_64")]
        SimdLevel::Avx512 | SimdLevel::Amx => unsafe {
            avx512::block_maxima(columns, rows, wanted, scratch, out)
        },
        #[cfg(not(target_arch = "x86_64"))]
        level => {
            unreachable!("a token for {level} cannot exist on this architecture ({scratch:?})")
        }
    }
}

/// The definition, and the twin the other levels are compared with.
fn scalar(columns: &PackedColumns, rows: Quantised<'_>, wanted: &Blocks, out: &mut BlockMaxima) {
    let dim = rows.dim;
    let mut column_start = 0;
    for column_section in 0..SECTIONS {
        let column_range = column_start..column_start + columns.counts[column_section];
        column_start = column_range.end;
        for row_section in (0..SECTIONS).filter(|&section| wanted[section][column_section]) {
            let row_start = rows.start(row_section);
            for row in row_start..row_start + rows.counts[row_section] {
                let row_codes = &rows.codes[row * dim..][..dim];
                for column in column_range.clone() {
                    let dot = dot(row_codes, &columns.codes[column * dim..][..dim]) as f32;
                    out.rows[column_section][row]
                        .challenge(dot * columns.factors[column], column as u32);
                    out.columns[row_section][column].challenge(dot * rows.factors[row], row as u32);
                }
            }
        }
    }
}

/// Exact dot product of two code vectors.
fn dot(a: &[i8], b: &[i8]) -> i32 {
    a.iter()
        .zip(b)
        .map(|(&a, &b)| i32::from(a) * i32::from(b))
        .sum()
}

/// Codes and factors from a small generator: extremes, repeated descriptors and zeros among them.
struct Sample {
    counts: [usize; SECTIONS],
    codes: Vec<i8>,
    factors: Vec<f32>,
}

impl Sample {
    fn new(dim: usize, counts: [usize; SECTIONS], seed: u64) -> Self {
        let mut state = seed;
        let mut next = || {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1_442_695_040_888_963_407);
            (state >> 33) as u32
        };
        let total: usize = counts.iter().sum();
        let (mut codes, mut factors) = (Vec::with_capacity(total * dim), Vec::with_capacity(total));
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

    fn quantised(&self, dim: usize) -> Quantised<'_> {
        Quantised {
            dim,
            counts: self.counts,
            codes: &self.codes,
            factors: &self.factors,
        }
    }
}

fn maxima_at(
    simd: Simd,
    columns: Quantised<'_>,
    rows: Quantised<'_>,
    wanted: &Blocks,
) -> BlockMaxima {
    let (mut packed, mut out) = (PackedColumns::new(simd), BlockMaxima::default());
    packed.pack(columns);
    block_maxima(&packed, rows, wanted, &mut Scratch::default(), &mut out);
    out
}

/// Compares `simd` with the scalar twin on small odd inputs.
pub(super) fn check(simd: Simd) -> Result<(), String> {
    let wanted = [[true, true, false], [true, true, true], [false, true, true]];
    let shapes = [
        (1, [1, 0, 1], [2, 1, 0]),
        (33, [7, 35, 2], [13, 1, 5]),
        (384, [17, 3, 9], [6, 12, 25]),
    ];
    for (seed, (dim, rows, columns)) in shapes.into_iter().enumerate() {
        let (r, c) = (
            Sample::new(dim, rows, seed as u64),
            Sample::new(dim, columns, seed as u64 + 99),
        );
        let ours = maxima_at(simd, c.quantised(dim), r.quantised(dim), &wanted);
        if ours != maxima_at(Simd::SCALAR, c.quantised(dim), r.quantised(dim), &wanted) {
            return Err(format!(
                "{rows:?} x {columns:?} descriptors of {dim} values"
            ));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// The maxima by the plainest loops, in f64: products of codes and small power-of-two factors
    /// are exact there.
    fn plain(
        columns: Quantised<'_>,
        rows: Quantised<'_>,
        wanted: &Blocks,
    ) -> (Vec<[u32; 3]>, Vec<[u32; 3]>) {
        let section_of =
            |q: &Quantised<'_>, i: usize| (0..3).find(|&s| i < q.start(s) + q.counts[s]).unwrap();
        let similarity = |r: usize, c: usize| {
            let values = |q: &Quantised<'_>, i: usize| -> Vec<f64> {
                q.codes[i * q.dim..][..q.dim]
                    .iter()
                    .map(|&v| f64::from(v) * f64::from(q.factors[i]))
                    .collect()
            };
            values(&rows, r)
                .iter()
                .zip(values(&columns, c))
                .map(|(a, b)| a * b)
                .sum::<f64>()
        };
        let mut best_column = vec![[u32::MAX; 3]; rows.len()];
        let mut best_row = vec![[u32::MAX; 3]; columns.len()];
        for r in 0..rows.len() {
            for c in 0..columns.len() {
                let (rs, cs) = (section_of(&rows, r), section_of(&columns, c));
                if !wanted[rs][cs] {
                    continue;
                }
                let held = &mut best_column[r][cs];
                if *held == u32::MAX || similarity(r, c) > similarity(r, *held as usize) {
                    *held = c as u32;
                }
                let held = &mut best_row[c][rs];
                if *held == u32::MAX || similarity(r, c) > similarity(*held as usize, c) {
                    *held = r as u32;
                }
            }
        }
        (best_column, best_row)
    }

    #[test]
    fn scalar_twin_follows_the_definition() {
        let wanted = [[true, true, false], [true, true, true], [false, true, true]];
        let (r, c) = (Sample::new(24, [5, 4, 3], 1), Sample::new(24, [6, 2, 4], 2));
        // Factors that differ only by powers of two keep the reference's f64 sums exact.
        let pow = |s: &Sample| Sample {
            factors: s
                .factors
                .iter()
                .enumerate()
                .map(|(i, _)| 0.5f32.powi(i as i32 % 3))
                .collect(),
            codes: s.codes.clone(),
            ..*s
        };
        let (r, c) = (pow(&r), pow(&c));
        let got = maxima_at(Simd::SCALAR, c.quantised(24), r.quantised(24), &wanted);
        let (best_column, best_row) = plain(c.quantised(24), r.quantised(24), &wanted);
        for section in 0..3 {
            assert!(
                got.rows[section]
                    .iter()
                    .zip(&best_column)
                    .all(|(g, w)| g.index == w[section])
            );
            assert!(
                got.columns[section]
                    .iter()
                    .zip(&best_row)
                    .all(|(g, w)| g.index == w[section])
            );
        }
    }

    #[test]
    fn extreme_codes_do_not_saturate() {
        for simd in Simd::all() {
            let dim = 1024;
            let (codes, factors) = (vec![-127i8; dim], [1.0f32]);
            let one = Quantised {
                dim,
                counts: [1, 0, 0],
                codes: &codes,
                factors: &factors,
            };
            let got = maxima_at(simd, one, one, &[[true; 3]; 3]);
            assert_eq!(
                got.rows[0][0],
                Best {
                    value: 127.0 * 127.0 * 1024.0,
                    index: 0
                },
                "{:?}",
                simd.level()
            );
        }
    }

    #[test]
    fn packing_again_forgets_the_columns_before() {
        for simd in Simd::all() {
            let (large, small, rows) = (
                Sample::new(40, [30, 20, 10], 5),
                Sample::new(7, [2, 1, 3], 6),
                Sample::new(7, [4, 4, 4], 7),
            );
            let wanted = [[true; 3]; 3];
            let (mut packed, mut out, mut scratch) = (
                PackedColumns::new(simd),
                BlockMaxima::default(),
                Scratch::default(),
            );
            packed.pack(large.quantised(40));
            block_maxima(
                &packed,
                large.quantised(40),
                &wanted,
                &mut scratch,
                &mut out,
            );
            packed.pack(small.quantised(7));
            block_maxima(&packed, rows.quantised(7), &wanted, &mut scratch, &mut out);
            assert_eq!(
                out,
                maxima_at(Simd::SCALAR, small.quantised(7), rows.quantised(7), &wanted)
            );
        }
    }

    #[test]
    #[should_panic(expected = "do not fill")]
    fn counts_that_wrap_around_are_refused() {
        let half = usize::MAX / 2 + 1;
        let wrapping = Quantised {
            dim: 2,
            counts: [half, half, 0],
            codes: &[],
            factors: &[],
        };
        PackedColumns::new(Simd::best()).pack(wrapping);
    }

    #[test]
    #[should_panic(expected = "different lengths")]
    fn descriptors_of_different_lengths_are_refused() {
        let (a, b) = (Sample::new(8, [1, 1, 1], 1), Sample::new(9, [1, 1, 1], 1));
        maxima_at(
            Simd::SCALAR,
            a.quantised(8),
            b.quantised(9),
            &[[true; 3]; 3],
        );
    }

    fn counts() -> impl Strategy<Value = [usize; 3]> {
        [0usize..40, 0usize..20, 0usize..10]
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]
        #[test]
        fn every_level_gives_the_bits_of_the_scalar_twin(
            dim in 1usize..140, rows in counts(), columns in counts(), seed: u64,
            wanted in proptest::array::uniform3(proptest::array::uniform3(any::<bool>())),
        ) {
            let (r, c) = (Sample::new(dim, rows, seed), Sample::new(dim, columns, !seed));
            let expected = maxima_at(Simd::SCALAR, c.quantised(dim), r.quantised(dim), &wanted);
            for simd in Simd::all() {
                let got = maxima_at(simd, c.quantised(dim), r.quantised(dim), &wanted);
                prop_assert_eq!(&got, &expected, "{:?}", simd.level());
            }
        }
    }
}
