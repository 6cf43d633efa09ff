//! One query against blocks: int8 bounds first, full precision for the few that remain.
//!
//! # Why the result is exact
//!
//! Let q and x be the query and a reference, and q' and x' what their codes stand for (code times
//! scale, as real numbers). Let eq >= |q - q'| and ex >= |x - x'| be the stored errors. Then
//!
//! ```text
//! <q, x> - <q', x'>  =  <q, x - x'> + <q - q', x'>      so, by Cauchy-Schwarz,
//! |<q, x> - <q', x'>| <= |q| ex + eq |x'| =: E
//! |q - x|^2 = |q|^2 + |x|^2 - 2 <q, x>  lies within  |q|^2 + |x|^2 - 2 <q', x'>  -+  2E
//! ```
//!
//! `<q', x'>` is an integer dot product times two scales. The integer is exact in i32 and, being
//! below 2^24, exact in f32 too.
//!
//! What is compared in the end is not the real |q - x|^2 but D, the value that [`squared_distance`]
//! sums in f32. The 256 squares of rounded differences deviate from their real sum by at most 259 *
//! 2^-24 of it. With |q - x|^2 <= 2A, where A = |q|^2 + |x|^2, that is below 2^-14 A. And
//! evaluating the bound itself in f32 takes a dozen operations on numbers of at most about A, with
//! an error below 2^-19 A. Widening the bound by [`SLACK`] = 2^-13 of A on each side covers both,
//! so
//!
//! ```text
//! lower <= D <= upper    for every reference.
//! ```
//!
//! Suppose that k references that pass the filter have `upper <= t`. Then the k-th smallest D is at
//! most t, and a reference with `lower > t` is not among the k nearest, ties included. All others
//! are kept and compared by D. A threshold t that held once holds for the rest of the search, so
//! threads share the smallest one found so far. If a bound is not a number (for lengths beyond the
//! range of f32), the reference is kept. So recall is 1 by construction; the bounds only decide how
//! many references are compared by D.

use super::block::Block;
use super::filter::PreparedFilter;
use super::nearest::{Nearest, TotalF32, squared_distance};
use super::quantised::QuantisedVector;
use super::sealed::SealedBlock;
use placeformer_kernels::scan::{Bounds, GROUP, ScanQuery, bounds, dot_products, next_near};
use placeformer_kernels::{Simd, simd};
use std::cell::RefCell;
use std::collections::BinaryHeap;
use std::sync::atomic::{AtomicU32, Ordering};

/// Share of |q|^2 + |x|^2 by which bounds are widened against rounding.
const SLACK: f32 = 1.0 / 8192.0;

/// Candidates are not pruned before there are this many.
const LEAST_TO_PRUNE: usize = 1024;

/// A query, prepared once for all blocks and shared by all threads.
pub(super) struct Query<'a> {
    vector: &'a [f32],
    probe: ScanQuery,
    k: usize,
    filter: PreparedFilter,
    simd: Simd,
    /// Bits of the smallest threshold found so far. The bits of non-negative floats order like the
    /// floats.
    threshold: AtomicU32,
}

impl<'a> Query<'a> {
    pub(super) fn new(vector: &'a [f32], k: usize, filter: PreparedFilter) -> Self {
        let quantised = QuantisedVector::new(vector);
        let probe = ScanQuery {
            codes: quantised.codes,
            scale: quantised.scale,
            square: quantised.square,
            length: quantised.square.sqrt() * (1.0 + 1e-6),
            error: quantised.error,
            slack: SLACK,
        };
        Self {
            vector,
            probe,
            k,
            filter,
            simd: simd::selected(),
            threshold: AtomicU32::new(f32::INFINITY.to_bits()),
        }
    }

    fn threshold(&self) -> f32 {
        f32::from_bits(self.threshold.load(Ordering::Relaxed))
    }

    /// Lowers the threshold to `to`, unless it is lower already. There must be k references with
    /// squared distances of at most `to`.
    pub(super) fn lower_threshold(&self, to: f32) {
        let bits = to.max(0.0).to_bits();
        self.threshold.fetch_min(bits, Ordering::Relaxed);
    }
}

/// A row that may be among the nearest.
#[derive(Debug, Clone, Copy)]
struct Candidate {
    /// Lower bound of its squared distance.
    lower: f32,
    /// Number of its block.
    block: u32,
    row: u32,
}

/// What one thread has found: rows that may be among the nearest, and the k smallest upper bounds,
/// from which the threshold follows.
#[derive(Default)]
pub(super) struct Candidates {
    rows: Vec<Candidate>,
    /// The largest on top.
    smallest_uppers: BinaryHeap<TotalF32>,
    /// Number of rows at which they are pruned next.
    prune_at: usize,
}

thread_local! {
    /// The rows of one block that pass a filter.
    static PASSING: RefCell<Vec<u32>> = const { RefCell::new(Vec::new()) };
}

impl Candidates {
    /// Adds the rows of a sealed block that may be near; `number` is the block's number in its
    /// list.
    pub(super) fn scan(&mut self, query: &Query<'_>, sealed: &SealedBlock, number: usize) {
        let block = &sealed.block;
        if sealed.live == block.len() {
            self.scan_rows(query, block, number, |_| true);
        } else if sealed.live > 0 {
            self.scan_rows(query, block, number, |row| sealed.is_live(row));
        }
    }

    /// Adds the rows of a block that are live and may be near.
    pub(super) fn scan_rows(
        &mut self,
        query: &Query<'_>,
        block: &Block,
        number: usize,
        is_live: impl Fn(usize) -> bool,
    ) {
        if query.filter.accepts_all() {
            self.compare_all(query, block, number, is_live);
        } else if query.filter.may_accept(&block.extent) {
            self.compare_passing(query, block, number, is_live);
        }
    }

    /// Compares all rows, a group at a time.
    fn compare_all(
        &mut self,
        query: &Query<'_>,
        block: &Block,
        number: usize,
        is_live: impl Fn(usize) -> bool,
    ) {
        let rows = block.rows();
        let mut bounds = Bounds::NONE;
        let mut from = 0;
        loop {
            // The kernel skips groups in which no row is near enough, which are almost all.
            let threshold = query.threshold();
            let next = next_near(
                query.simd,
                &query.probe,
                &rows,
                from,
                threshold,
                &mut bounds,
            );
            let Some(group) = next else {
                break;
            };
            let of_rows = bounds.lower.iter().zip(&bounds.upper);
            for (row, (&lower, &upper)) in (group..).zip(of_rows) {
                if is_live(row) {
                    self.offer(query, number, row, lower, upper);
                }
            }
            from = group + GROUP;
        }
        let whole_groups = block.len() - block.len() % GROUP;
        for row in whole_groups..block.len() {
            if is_live(row) {
                self.compare_one(query, block, number, row);
            }
        }
    }

    /// Compares the rows that pass the filter. They are found first, in a loop of their own,
    /// because they are usually few.
    fn compare_passing(
        &mut self,
        query: &Query<'_>,
        block: &Block,
        number: usize,
        is_live: impl Fn(usize) -> bool,
    ) {
        PASSING.with_borrow_mut(|passing| {
            passing.clear();
            for (row, place) in block.places.iter().enumerate() {
                if is_live(row) && query.filter.accepts(place) {
                    passing.push(row as u32);
                }
            }
            for &row in passing.iter() {
                self.compare_one(query, block, number, row as usize);
            }
        });
    }

    fn compare_one(&mut self, query: &Query<'_>, block: &Block, number: usize, row: usize) {
        let mut dot = [0];
        let codes = &block.codes[row..=row];
        dot_products(query.simd, &query.probe.codes, codes, &mut dot);
        let (lower, upper) = bounds(&query.probe, &block.rows(), row, dot[0]);
        self.offer(query, number, row, lower, upper);
    }

    /// Keeps a row unless its lower bound is above the threshold.
    fn offer(&mut self, query: &Query<'_>, block: usize, row: usize, lower: f32, upper: f32) {
        if lower > query.threshold() {
            return;
        }
        // A bound that is not a number says nothing, like an infinite one.
        let lower = if lower.is_nan() {
            f32::NEG_INFINITY
        } else {
            lower
        };
        let upper = if upper.is_nan() { f32::INFINITY } else { upper };
        self.rows.push(Candidate {
            lower,
            block: block as u32,
            row: row as u32,
        });
        self.add_upper(TotalF32(upper), query.k);
        self.lower_threshold(query);
        if self.rows.len() >= self.prune_at.max(LEAST_TO_PRUNE) {
            self.prune(query.threshold());
        }
    }

    /// Keeps an upper bound if it is one of the k smallest.
    fn add_upper(&mut self, upper: TotalF32, k: usize) {
        if self.smallest_uppers.len() < k {
            self.smallest_uppers.push(upper);
        } else if self
            .smallest_uppers
            .peek()
            .is_some_and(|worst| upper < *worst)
        {
            self.smallest_uppers.pop();
            self.smallest_uppers.push(upper);
        }
    }

    /// Lowers the query's threshold to the k-th smallest upper bound, once there are k.
    fn lower_threshold(&self, query: &Query<'_>) {
        if self.smallest_uppers.len() == query.k
            && let Some(worst) = self.smallest_uppers.peek()
        {
            query.lower_threshold(worst.0);
        }
    }

    /// Drops the rows that a threshold found later excludes.
    fn prune(&mut self, threshold: f32) {
        self.rows.retain(|candidate| candidate.lower <= threshold);
        self.prune_at = self.rows.len() * 2;
    }

    /// Joins what two threads found.
    pub(super) fn joined(mut self, mut other: Self, query: &Query<'_>) -> Self {
        if self.smallest_uppers.len() < other.smallest_uppers.len() {
            std::mem::swap(&mut self.smallest_uppers, &mut other.smallest_uppers);
        }
        for upper in other.smallest_uppers {
            self.add_upper(upper, query.k);
        }
        self.lower_threshold(query);
        self.rows.extend(other.rows);
        self.prune(query.threshold());
        self
    }

    /// Compares the candidates in full precision and adds them to `nearest`. `block` gives the
    /// block of a number.
    pub(super) fn rank<'b>(
        mut self,
        query: &Query<'_>,
        block: impl Fn(usize) -> &'b Block,
        nearest: &mut Nearest,
    ) {
        self.prune(query.threshold());
        self.rows
            .sort_unstable_by(|a, b| a.lower.total_cmp(&b.lower));
        for candidate in self.rows {
            if nearest.worst().is_some_and(|worst| candidate.lower > worst) {
                // The candidates are sorted, so all that follow are farther still.
                return;
            }
            let block = block(candidate.block as usize);
            let row = candidate.row as usize;
            let square = squared_distance(query.vector, block.vector(row));
            nearest.offer(square, block.ids[row]);
        }
    }
}
