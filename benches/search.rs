//! Exact top-100 search: the index against a plain f32 scan on all threads, in the same run.
//!
//! `cargo bench --bench search`; with `PLACEFORMER_BENCH_LARGE=1` also a million references (3 GB
//! of memory). `benches/peers/search_faiss.py` measures faiss at the same sizes.

use criterion::{BatchSize, BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use placeformer_core::types::{GeoCircle, GeoPoint, ReferenceFilter};
use placeformer_lab::bench::baselines;
use placeformer_lab::bench::scenes::{index_entry, unit_vector};
use placeformer_vision::search::{IndexEntry, MapIndex};
use rayon::prelude::*;
use std::hint::black_box;

const NEAREST: usize = 100;

fn sizes() -> Vec<u64> {
    let large = std::env::var_os("PLACEFORMER_BENCH_LARGE").is_some();
    if large {
        vec![10_000, 100_000, 1_000_000]
    } else {
        vec![10_000, 100_000]
    }
}

fn search(criterion: &mut Criterion) {
    for size in sizes() {
        let entries: Vec<IndexEntry> = (0..size).into_par_iter().map(index_entry).collect();
        let vectors: Vec<f32> = entries
            .iter()
            .flat_map(|entry| entry.global.iter().copied())
            .collect();
        let index = MapIndex::build(entries);
        println!(
            "{size} references: {} bytes each",
            index.memory_bytes() as u64 / size
        );
        let queries: Vec<Vec<f32>> = (0..32).map(|seed| unit_vector(u64::MAX - seed)).collect();
        let open = ReferenceFilter::default();
        for query in &queries[..4] {
            let ours: Vec<f32> = index
                .search(query, NEAREST, &open)
                .iter()
                .map(|n| n.distance)
                .collect();
            let plain: Vec<f32> = baselines::nearest(&vectors, query, NEAREST)
                .iter()
                .map(|found| found.0.sqrt())
                .collect();
            assert!(
                ours.iter().zip(&plain).all(|(a, b)| (a - b).abs() < 1e-5),
                "recall is not 1"
            );
        }
        let centre = GeoPoint::new(51.0 + size as f64 * 0.5e-6, 7.0).ok();
        let near = centre.and_then(|centre| GeoCircle::new(centre, size as f64 * 0.0055).ok());
        let tenth = ReferenceFilter {
            near,
            ..ReferenceFilter::default()
        };

        let mut group = criterion.benchmark_group("search");
        group
            .throughput(Throughput::Elements(size))
            .sample_size(if size > 100_000 { 30 } else { 60 });
        let mut cycle = queries.iter().cycle();
        let mut next = || cycle.next().map_or(&[][..], Vec::as_slice);
        group.bench_function(BenchmarkId::new("index", size), |bencher| {
            bencher.iter_batched(
                &mut next,
                |q| black_box(index.search(q, NEAREST, &open)),
                BatchSize::SmallInput,
            );
        });
        group.bench_function(
            BenchmarkId::new("index within a tenth of the map", size),
            |bencher| {
                bencher.iter_batched(
                    &mut next,
                    |q| black_box(index.search(q, NEAREST, &tenth)),
                    BatchSize::SmallInput,
                );
            },
        );
        group.bench_function(BenchmarkId::new("plain f32 scan", size), |bencher| {
            bencher.iter_batched(
                &mut next,
                |q| black_box(baselines::nearest(&vectors, q, NEAREST)),
                BatchSize::SmallInput,
            );
        });
        group.finish();
    }
}

criterion_group!(benches, search);
criterion_main!(benches);
