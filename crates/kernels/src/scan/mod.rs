//! The inner loop of the search: one int8 vector against many.
//!
//! The search wants to know which global descriptors of the map may be near a query without
//! computing every distance in full. Descriptors are stored as 256 int8 codes with a factor; the
//! exact dot product of two code vectors bounds the true distance from below and above. This
//! module computes those dot products and bounds, and stops at the first group of rows in which
//! one may be near enough.
//!
//! Reading a large map is limited by memory bandwidth, so a row must cost little else: sixteen
//! rows are multiplied, summed across their registers together, bounded and compared at once. Rows
//! are not prefetched by instruction, because they are read in order, which the CPU's own
//! prefetcher recognises; one prefetch instruction for each cache line made the scan a third
//! slower.

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
mod check;
mod scalar;
#[cfg(test)]
mod tests;

use crate::Simd;
use crate::dispatch::dispatch;
pub(crate) use check::check;

/// Length of a vector.
pub const LENGTH: usize = 256;

/// One vector's codes, each in -127..=127, aligned to a cache line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(C, align(64))]
pub struct Codes([i8; LENGTH]);

impl Codes {
    /// All zero.
    pub const ZERO: Self = Self([0; LENGTH]);

    /// Takes codes over; -128, which the kernels exclude, becomes -127.
    pub fn new(codes: [i8; LENGTH]) -> Self {
        Self(codes.map(|code| code.max(-127)))
    }

    /// The codes.
    pub fn as_array(&self) -> &[i8; LENGTH] {
        &self.0
    }
}

/// Rows of which the bounds are computed at once.
pub const GROUP: usize = 16;

/// The query: its codes, and what is needed of its vector to bound distances from it.
#[derive(Debug, Clone, Copy)]
pub struct ScanQuery {
    /// The quantised vector.
    pub codes: Codes,
    /// Value of one code unit.
    pub scale: f32,
    /// Squared length of the vector.
    pub square: f32,
    /// An upper bound on the length of the vector.
    pub length: f32,
    /// An upper bound on the length of the quantisation error.
    pub error: f32,
    /// Share of the squared lengths by which bounds are widened to cover rounding.
    pub slack: f32,
}

/// The map's vectors, one array for each attribute; all have the length `n`, the number of rows.
#[derive(Debug, Clone, Copy)]
pub struct ScanRows<'a> {
    /// `[n]`: quantised vectors.
    pub codes: &'a [Codes],
    /// `[n]`: value of one code unit of each row.
    pub scales: &'a [f32],
    /// `[n]`: upper bounds on the lengths of the quantisation errors.
    pub errors: &'a [f32],
    /// `[n]`: squared lengths of the vectors.
    pub squares: &'a [f32],
    /// An upper bound on the length of every quantised vector.
    pub longest: f32,
}

/// Bytes of a row that a scan reads.
pub const ROW_BYTES: usize = size_of::<Codes>() + 3 * size_of::<f32>();

/// Bounds on the squared distances of [`GROUP`] rows from the query.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bounds {
    /// No squared distance is smaller.
    pub lower: [f32; GROUP],
    /// No squared distance is larger.
    pub upper: [f32; GROUP],
}

impl Bounds {
    /// NaN everywhere: room for [`next_near`] to write to.
    pub const NONE: Self = Self {
        lower: [f32::NAN; GROUP],
        upper: [f32::NAN; GROUP],
    };
}

/// Lower and upper bound on the squared distance between the query and row `row`, given the dot
/// product of their codes.
///
/// With q the query, x the row, q' and x' what their codes stand for, and eq and ex the lengths of
/// the errors q - q' and x - x', the bounds are
/// `|q|^2 + |x|^2 - 2 <q', x'> -+ (2 (|q| ex + eq |x'|) + slack (|q|^2 + |x|^2))`.
#[inline(always)]
pub fn bounds(query: &ScanQuery, rows: &ScanRows<'_>, row: usize, dot: i32) -> (f32, f32) {
    let squares = query.square + rows.squares[row];
    let similarity = dot as f32 * (query.scale * rows.scales[row]);
    let error = query.length * rows.errors[row] + query.error * rows.longest;
    let middle = squares - 2.0 * similarity;
    let half = 2.0 * error + query.slack * squares;
    (middle - half, middle + half)
}

/// Finds the next group of [`GROUP`] rows, from row `from` (a multiple of [`GROUP`]) on, in which
/// some lower bound does not exceed `threshold` or is NaN. Returns the group's first row and writes
/// its bounds to `found`. Rows after the last whole group are not looked at.
///
/// # Panics
/// If the arrays of `rows` differ in length.
pub fn next_near(
    simd: Simd,
    query: &ScanQuery,
    rows: &ScanRows<'_>,
    from: usize,
    threshold: f32,
    found: &mut Bounds,
) -> Option<usize> {
    let len = rows.codes.len();
    assert!(
        rows.scales.len() == len && rows.errors.len() == len && rows.squares.len() == len,
        "columns of one length"
    );
    dispatch!(simd, next_near(query, rows, from, threshold, found))
}

/// Writes the dot product of `query` with each of the `n` rows to `dots`, `[n]`.
///
/// # Panics
/// If `rows` and `dots` differ in length.
pub fn dot_products(simd: Simd, query: &Codes, rows: &[Codes], dots: &mut [i32]) {
    assert_eq!(rows.len(), dots.len(), "one product per row");
    dispatch!(simd, dot_products(query, rows, dots))
}

/// The rest of [`next_near`] once `dots_of` computes the dot products of a group of rows with the
/// query.
#[inline(always)]
fn find_near(
    query: &ScanQuery,
    rows: &ScanRows<'_>,
    from: usize,
    threshold: f32,
    found: &mut Bounds,
    dots_of: impl Fn(&[Codes; GROUP]) -> [i32; GROUP],
) -> Option<usize> {
    let mut start = from;
    while let Some(group) = rows.codes.get(start..).and_then(<[Codes]>::first_chunk) {
        let dots = dots_of(group);
        if is_near(query, rows, start, &dots, threshold, found) {
            return Some(start);
        }
        start += GROUP;
    }
    None
}

/// Fills `found` with the bounds of the group at `start` and tells whether one of its rows may be
/// near.
#[inline(always)]
#[expect(
    clippy::neg_cmp_op_on_partial_ord,
    reason = "a row with a bound of NaN must not be dropped"
)]
fn is_near(
    query: &ScanQuery,
    rows: &ScanRows<'_>,
    start: usize,
    dots: &[i32; GROUP],
    threshold: f32,
    found: &mut Bounds,
) -> bool {
    // Arrays of known length, so that the loop below needs no bounds checks.
    let group_of = |values: &[f32]| -> [f32; GROUP] {
        std::array::from_fn(|lane| values[start..start + GROUP][lane])
    };
    let scales = group_of(rows.scales);
    let errors = group_of(rows.errors);
    let squares = group_of(rows.squares);
    let group = ScanRows {
        codes: &[],
        scales: &scales,
        errors: &errors,
        squares: &squares,
        longest: rows.longest,
    };

    // Comparisons are combined without branches, so that the compiler can use vectors.
    let mut near = false;
    for (lane, &dot) in dots.iter().enumerate() {
        let (lower, upper) = bounds(query, &group, lane, dot);
        found.lower[lane] = lower;
        found.upper[lane] = upper;
        near |= !(lower > threshold);
    }
    near
}
