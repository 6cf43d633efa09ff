//! The k nearest references found so far, by exact distance.

use super::entry::Neighbour;
use placeformer_core::types::ReferenceId;
use std::cmp::Ordering;
use std::collections::BinaryHeap;

/// Lanes in which a distance is summed.
const LANES: usize = 32;

/// Squared Euclidean distance, summed in 32 lanes in a fixed order: the same bits on every machine.
pub(super) fn squared_distance(a: &[f32], b: &[f32]) -> f32 {
    let mut sums = [0f32; LANES];
    let (a, _) = a.as_chunks::<LANES>();
    let (b, _) = b.as_chunks::<LANES>();
    for (a, b) in a.iter().zip(b) {
        for lane in 0..LANES {
            let difference = a[lane] - b[lane];
            sums[lane] += difference * difference;
        }
    }
    let mut width = LANES / 2;
    while width > 0 {
        for lane in 0..width {
            sums[lane] += sums[lane + width];
        }
        width /= 2;
    }
    sums[0]
}

/// A float with a total order.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct TotalF32(pub f32);

impl Eq for TotalF32 {}

impl Ord for TotalF32 {
    fn cmp(&self, other: &Self) -> Ordering {
        self.0.total_cmp(&other.0)
    }
}

impl PartialOrd for TotalF32 {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

/// The k nearest references so far; of equally near ones those with the lowest ids.
pub(super) struct Nearest {
    k: usize,
    /// Squared distance and id, the farthest on top.
    heap: BinaryHeap<(TotalF32, ReferenceId)>,
}

impl Nearest {
    pub(super) fn new(k: usize) -> Self {
        Self {
            k,
            heap: BinaryHeap::new(),
        }
    }

    /// The k-th smallest squared distance; `None` while there are fewer than k.
    pub(super) fn worst(&self) -> Option<f32> {
        if self.heap.len() < self.k {
            return None;
        }
        self.heap.peek().map(|(worst, _)| worst.0)
    }

    /// Takes a reference in if it is among the k nearest.
    pub(super) fn offer(&mut self, square: f32, id: ReferenceId) {
        // A distance is NaN only if the query itself has NaN or infinite values. Such a reference
        // counts as infinitely far, so that it sorts after all others.
        let square = if square.is_nan() {
            f32::INFINITY
        } else {
            square
        };
        let new = (TotalF32(square), id);
        if self.heap.len() < self.k {
            self.heap.push(new);
        } else if self.heap.peek().is_some_and(|worst| new < *worst) {
            self.heap.pop();
            self.heap.push(new);
        }
    }

    /// Nearest first, equally near ones by ascending id.
    pub(super) fn into_neighbours(self) -> Vec<Neighbour> {
        let sorted = self.heap.into_sorted_vec();
        let neighbours = sorted.into_iter().map(|(square, id)| Neighbour {
            id,
            distance: square.0.sqrt(),
        });
        neighbours.collect()
    }
}
