//! The rows of exact search.

use super::baselines;
use super::context::{Bench, agree};
use super::error::BenchError;
use super::measure::paired;
use super::row::BenchRow;
use super::scenes::{index_entry, unit_vector};
use placeformer_core::types::ReferenceFilter;
use placeformer_kernels::scan::ROW_BYTES;
use placeformer_vision::search::{IndexEntry, MapIndex};
use rayon::prelude::*;

/// Neighbours asked for.
pub(super) const NEAREST: usize = 100;
/// Most vectors that the baseline has a copy of.
const MOST_COPIED: u64 = 1_000_000;
/// Maps beyond this many references are searched less often.
const LARGE: u64 = 100_000;

impl Bench<'_> {
    /// The nearest of `size` random references; the baseline scans them in f32.
    pub(super) fn search(&self, name: &'static str, size: u64) -> Result<BenchRow, BenchError> {
        // The baseline's own copy of ten million vectors would not fit beside ours: it scans a
        // tenth, ten times.
        let parts = size.div_ceil(MOST_COPIED);
        let (index, vectors) = random_index(size, size / parts);
        let queries: Vec<Vec<f32>> = (0..32).map(|seed| unit_vector(u64::MAX - seed)).collect();
        let everything = ReferenceFilter::default();
        if parts == 1 {
            let ours = index.search(&queries[0], NEAREST, &everything);
            let plain = baselines::nearest(&vectors, &queries[0], NEAREST);
            let same = ours
                .iter()
                .zip(&plain)
                .all(|(ours, plain)| (ours.distance - plain.0.sqrt()).abs() < 1e-5);
            agree(name, same, || "the distances differ".into())?;
        }

        let repeats = if size > LARGE { 3 } else { 20 };
        let mut our_queries = queries.iter().cycle();
        let mut plain_queries = queries.iter().cycle();
        let times = paired(
            repeats * self.rounds,
            || {
                let query = our_queries.next().map_or(&[][..], Vec::as_slice);
                index.search(query, NEAREST, &everything)
            },
            || {
                let query = plain_queries.next().map_or(&[][..], Vec::as_slice);
                (0..parts)
                    .map(|_| baselines::nearest(&vectors, query, NEAREST).len())
                    .sum::<usize>()
            },
        );
        BenchRow::new(name, "f32 scan", times, self.search_limit_ms(size))
    }

    /// Milliseconds of reading what a scan reads of each reference. Memory is the limit of large
    /// maps; one that fits the caches may beat it.
    pub(super) fn search_limit_ms(&self, references: u64) -> f64 {
        self.limits.memory_ms(references as f64 * ROW_BYTES as f64)
    }
}

/// An index of `size` random references, and the first `copied` vectors once more.
pub(super) fn random_index(size: u64, copied: u64) -> (MapIndex, Vec<f32>) {
    let entries: Vec<IndexEntry> = (0..size).into_par_iter().map(index_entry).collect();
    let vectors = entries[..copied as usize]
        .iter()
        .flat_map(|entry| entry.global.iter().copied())
        .collect();
    (MapIndex::build(entries), vectors)
}
