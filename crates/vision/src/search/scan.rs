//! One query against blocks: int8 bounds first, full precision for the few that remain.
//!
//! # Why the result is exact
//!
//! Let q and x be the query and a reference, q' and x' what their codes say (code times scale, as
//! real numbers), and eq >= |q - q'|, ex >= |x - x'| the stored errors. Then
//!
//! ```text
//! <q, x> - <q', x'>  =  <q, x - x'> + <q - q', x'>      so, by Cauchy-Schwarz,
//! |<q, x> - <q', x'>| <= |q| ex + eq |x'| =: E
//! |q - x|^2 = |q|^2 + |x|^2 - 2 <q, x>  lies within  |q|^2 + |x|^2 - 2 <q', x'>  -+  2E
//! ```
//!
//! `<q', x'>` is an integer dot product, exact in i32 and below 2^24 and hence exact in f32, times
//! two scales. What is finally compared is not the real |q - x|^2 but D, its value summed in f32 as
//! [`squared_distance`] does: 256 squares of rounded differences deviate from their real sum by at
//! most 259 * 2^-24 of it, which with |q - x|^2 <= 2A, A =
//! |q|^2 + |x|^2, is below 2^-14 A. Evaluating the bound itself in f32 takes a dozen operations on numbers of at most
//! about A: below 2^-19 A. Widening the bound by [`SLACK`] = 2^-13 of A on each side covers both,
//! so
//!
//! ```text
//! lower <= D <= upper    for every reference.
//! ```
//!
//! If k references that pass the filter have `upper <= t`, the k-th smallest D is at most t, and a
//! reference with `lower > t` is not among the k nearest, ties included. All others are kept and
//! compared by D. Any t that held once holds on, so threads share the smallest found so far. Where
//! a bound is not a number (lengths beyond f32), the comparison keeps the reference. Recall is 1 by
//! construction; the bounds only decide how many are compared by D.

use super::Neighbour;
use super::block::{Block, Quantised, Sealed};
use super::filter::Sieve;
use placeformer_core::types::ReferenceId;
use placeformer_kernels::scan::{Bounds, GROUP, ScanQuery, bounds, dot_products, next_near};
use placeformer_kernels::{Simd, simd};
use std::cell::RefCell;
use std::collections::BinaryHeap;
use std::sync::atomic::{AtomicU32, Ordering};

/// Share of |q|^2 + |x|^2 by which bounds are widened against rounding.
const SLACK: f32 = 1.0 / 8192.0;

/// Squared Euclidean distance, summed in 32 lanes: the same bits on every machine.
pub(super) fn squared_distance(a: &[f32], b: &[f32]) -> f32 {
    let mut lanes = [0f32; 32];
    let ((a, _), (b, _)) = (a.as_chunks::<32>(), b.as_chunks::<32>());
    for (a, b) in a.iter().zip(b) {
        for lane in 0..32 {
            let difference = a[lane] - b[lane];
            lanes[lane] += difference * difference;
        }
    }
    let mut width = 16;
    while width > 0 {
        for lane in 0..width {
            lanes[lane] += lanes[lane + width];
        }
        width /= 2;
    }
    lanes[0]
}

/// A query, prepared once.
pub(super) struct Query<'a> {
    vector: &'a [f32],
    probe: ScanQuery,
    k: usize,
    sieve: Sieve,
    simd: Simd,
    /// Bits of the smallest threshold found so far; as bits of positive floats they order like the
    /// floats.
    threshold: AtomicU32,
}

impl<'a> Query<'a> {
    pub(super) fn new(vector: &'a [f32], k: usize, sieve: Sieve) -> Self {
        let Quantised {
            codes,
            scale,
            error,
            square,
        } = Quantised::new(vector);
        let length = square.sqrt() * (1.0 + 1e-6);
        let probe = ScanQuery {
            codes,
            scale,
            square,
            length,
            error,
            slack: SLACK,
        };
        let threshold = AtomicU32::new(f32::INFINITY.to_bits());
        Self {
            vector,
            probe,
            k,
            sieve,
            simd: simd::selected(),
            threshold,
        }
    }

    fn threshold(&self) -> f32 {
        f32::from_bits(self.threshold.load(Ordering::Relaxed))
    }

    fn lower_threshold(&self, to: f32) {
        self.threshold
            .fetch_min(to.max(0.0).to_bits(), Ordering::Relaxed);
    }
}

/// A row that may be among the nearest.
#[derive(Debug, Clone, Copy)]
pub(super) struct Candidate {
    lower: f32,
    block: u32,
    row: u32,
}

/// What one thread has found: candidates, and the k smallest upper bounds.
#[derive(Default)]
pub(super) struct Part {
    candidates: Vec<Candidate>,
    uppers: BinaryHeap<Ordered>,
    prune_at: usize,
}

/// A float in the total order.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Ordered(f32);

impl Eq for Ordered {}

impl Ord for Ordered {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        self.0.total_cmp(&other.0)
    }
}

impl PartialOrd for Ordered {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

thread_local! {
    /// The rows of one block chosen by a filter.
    static CHOSEN: RefCell<Vec<u32>> = const { RefCell::new(Vec::new()) };
}

impl Part {
    /// Adds what may be near in a sealed block, `number` among all.
    pub(super) fn scan(&mut self, query: &Query<'_>, sealed: &Sealed, number: usize) {
        let block = &sealed.block;
        if sealed.live == block.len() {
            self.scan_rows(query, block, number, |_| true);
        } else if sealed.live > 0 {
            self.scan_rows(query, block, number, |row| sealed.is_live(row));
        }
    }

    /// Adds what may be near among the rows of a block that are `live`.
    pub(super) fn scan_rows(
        &mut self,
        query: &Query<'_>,
        block: &Block,
        number: usize,
        live: impl Fn(usize) -> bool,
    ) {
        if !query.sieve.is_open() && !query.sieve.may_pass(&block.extent) {
            return;
        }
        if query.sieve.is_open() {
            self.compare_all(query, block, number, live);
        } else {
            CHOSEN.with_borrow_mut(|chosen| {
                chosen.clear();
                let passing = (0..block.len())
                    .filter(|&row| live(row) && query.sieve.passes(&block.places[row]));
                chosen.extend(passing.map(|row| row as u32));
                chosen
                    .iter()
                    .for_each(|&row| self.compare_one(query, block, number, row as usize));
            });
        }
    }

    fn compare_all(
        &mut self,
        query: &Query<'_>,
        block: &Block,
        number: usize,
        live: impl Fn(usize) -> bool,
    ) {
        let rows = block.rows();
        let (mut from, mut found) = (0, Bounds::NONE);
        // Almost always no row of a group comes near.
        while let Some(group) = next_near(
            query.simd,
            &query.probe,
            &rows,
            from,
            query.threshold(),
            &mut found,
        ) {
            for (row, (&lower, &upper)) in (group..).zip(found.lower.iter().zip(&found.upper)) {
                if live(row) {
                    self.offer(query, number, row, lower, upper);
                }
            }
            from = group + GROUP;
        }
        let rest = block.len() - block.len() % GROUP..block.len();
        rest.filter(|&row| live(row))
            .for_each(|row| self.compare_one(query, block, number, row));
    }

    fn compare_one(&mut self, query: &Query<'_>, block: &Block, number: usize, row: usize) {
        let mut dot = [0];
        dot_products(
            query.simd,
            &query.probe.codes,
            &block.codes[row..=row],
            &mut dot,
        );
        let (lower, upper) = bounds(&query.probe, &block.rows(), row, dot[0]);
        self.offer(query, number, row, lower, upper);
    }

    fn offer(&mut self, query: &Query<'_>, block: usize, row: usize, lower: f32, upper: f32) {
        if lower > query.threshold() {
            return;
        }
        // Bounds that are not numbers bound nothing.
        let lower = if lower.is_nan() {
            f32::NEG_INFINITY
        } else {
            lower
        };
        let upper = if upper.is_nan() { f32::INFINITY } else { upper };
        self.candidates.push(Candidate {
            lower,
            block: block as u32,
            row: row as u32,
        });
        if self.uppers.len() < query.k {
            self.uppers.push(Ordered(upper));
        } else if self
            .uppers
            .peek()
            .is_some_and(|worst| Ordered(upper) < *worst)
        {
            self.uppers.pop();
            self.uppers.push(Ordered(upper));
        }
        self.announce(query);
        if self.candidates.len() >= self.prune_at.max(1024) {
            self.prune(query.threshold());
        }
    }

    /// Lowers the threshold to the k-th smallest upper bound, once there are k.
    fn announce(&self, query: &Query<'_>) {
        if self.uppers.len() == query.k
            && let Some(worst) = self.uppers.peek()
        {
            query.lower_threshold(worst.0);
        }
    }

    /// Forgets candidates that a threshold found since excludes.
    fn prune(&mut self, threshold: f32) {
        self.candidates
            .retain(|candidate| candidate.lower <= threshold);
        self.prune_at = self.candidates.len() * 2;
    }

    /// Joins what two threads found.
    pub(super) fn joined(mut self, mut other: Self, query: &Query<'_>) -> Self {
        if self.uppers.len() < other.uppers.len() {
            std::mem::swap(&mut self.uppers, &mut other.uppers);
        }
        for upper in other.uppers {
            self.uppers.push(upper);
            if self.uppers.len() > query.k {
                self.uppers.pop();
            }
        }
        self.announce(query);
        self.candidates.extend(other.candidates);
        self.prune(query.threshold());
        self
    }

    /// Compares the candidates in full precision and puts the nearest into `top`.
    pub(super) fn settle<'b>(
        mut self,
        query: &Query<'_>,
        block: impl Fn(u32) -> &'b Block,
        top: &mut Top,
    ) {
        self.prune(query.threshold());
        self.candidates
            .sort_unstable_by(|a, b| a.lower.total_cmp(&b.lower));
        for candidate in self.candidates {
            if top.worst().is_some_and(|worst| candidate.lower > worst) {
                // All that follow are farther still.
                return;
            }
            let (block, row) = (block(candidate.block), candidate.row as usize);
            top.offer(
                squared_distance(query.vector, block.vector(row)),
                block.ids[row],
            );
        }
    }
}

/// The k nearest so far.
pub(super) struct Top {
    k: usize,
    heap: BinaryHeap<(Ordered, ReferenceId)>,
}

impl Top {
    pub(super) fn new(k: usize) -> Self {
        Self {
            k,
            heap: BinaryHeap::new(),
        }
    }

    /// The k-th smallest squared distance, once there are k.
    fn worst(&self) -> Option<f32> {
        if self.heap.len() < self.k {
            None
        } else {
            self.heap.peek().map(|(worst, _)| worst.0)
        }
    }

    fn offer(&mut self, square: f32, id: ReferenceId) {
        // Only a query that is not made of numbers gets here with one.
        let new = (
            Ordered(if square.is_nan() {
                f32::INFINITY
            } else {
                square
            }),
            id,
        );
        if self.heap.len() < self.k {
            self.heap.push(new);
        } else if self.heap.peek().is_some_and(|worst| new < *worst) {
            self.heap.pop();
            self.heap.push(new);
        }
    }

    /// Tells the query how far its nearest can be at most.
    pub(super) fn announce(&self, query: &Query<'_>) {
        if let Some(worst) = self.worst() {
            query.lower_threshold(worst);
        }
    }

    /// Nearest first, ties by ascending id.
    pub(super) fn into_neighbours(self) -> Vec<Neighbour> {
        let sorted = self.heap.into_sorted_vec();
        sorted
            .into_iter()
            .map(|(square, id)| Neighbour {
                id,
                distance: square.0.sqrt(),
            })
            .collect()
    }
}
