//! Exact top-100 search: the index against a plain f32 scan on all threads, in the same run.
//!
//! `cargo bench --bench search`; with `PLACEFORMER_BENCH_LARGE=1` also a million references (3 GB of memory).
//! `benches/peers/search_faiss.py` measures faiss at the same sizes.

use criterion::{BatchSize, BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use placeformer::search::{IndexEntry, MapIndex};
use placeformer::types::{GLOBAL_DIM, GeoCircle, GeoPoint, ReferenceFilter, ReferenceId};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use std::hint::black_box;

const NEAREST: usize = 100;

/// Approximately normal values, scaled to unit length: directions without preference, the hardest case for bounds.
fn unit_vector(seed: u64) -> Vec<f32> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut normal = || (0..4).map(|_| random.random_range(-1f32..1.0)).sum::<f32>();
    let raw: Vec<f32> = (0..GLOBAL_DIM).map(|_| normal()).collect();
    let length = raw.iter().map(|v| v * v).sum::<f32>().sqrt();
    raw.iter().map(|v| v / length).collect()
}

fn entry(number: u64) -> IndexEntry {
    let location = GeoPoint::new(51.0 + number as f64 * 1e-6, 7.0).ok();
    let id = ReferenceId::from_bytes((u128::from(number) << 64).to_be_bytes());
    IndexEntry { id, global: unit_vector(number), location, captured_at: None }
}

/// What a straightforward server does: all distances in f32 on all threads, then a selection.
fn plain_scan(vectors: &[f32], query: &[f32], k: usize) -> Vec<(f32, u32)> {
    let nearest = |mut all: Vec<(f32, u32)>| {
        if all.len() > k {
            all.select_nth_unstable_by(k - 1, |a, b| a.0.total_cmp(&b.0));
            all.truncate(k);
        }
        all
    };
    let parts = vectors.par_chunks(4096 * GLOBAL_DIM).enumerate().map(|(number, chunk)| {
        let distance = |row: &[f32]| {
            let mut lanes = [0f32; 16];
            for (row, query) in row.as_chunks::<16>().0.iter().zip(query.as_chunks::<16>().0) {
                for lane in 0..16 {
                    let difference = row[lane] - query[lane];
                    lanes[lane] += difference * difference;
                }
            }
            lanes.iter().sum::<f32>()
        };
        let rows = chunk.chunks_exact(GLOBAL_DIM).enumerate();
        nearest(rows.map(|(row, vector)| (distance(vector), (number * 4096 + row) as u32)).collect())
    });
    let mut found = nearest(parts.reduce(Vec::new, |mut a, mut b| {
        a.append(&mut b);
        nearest(a)
    }));
    found.sort_by(|a, b| a.0.total_cmp(&b.0));
    found
}

fn sizes() -> Vec<u64> {
    let large = std::env::var_os("PLACEFORMER_BENCH_LARGE").is_some();
    if large { vec![10_000, 100_000, 1_000_000] } else { vec![10_000, 100_000] }
}

fn search(criterion: &mut Criterion) {
    for size in sizes() {
        let entries: Vec<IndexEntry> = (0..size).into_par_iter().map(entry).collect();
        let vectors: Vec<f32> = entries.iter().flat_map(|entry| entry.global.iter().copied()).collect();
        let index = MapIndex::build(entries);
        println!("{size} references: {} bytes each", index.memory_bytes() as u64 / size);
        let queries: Vec<Vec<f32>> = (0..32).map(|seed| unit_vector(u64::MAX - seed)).collect();
        let open = ReferenceFilter::default();
        for query in &queries[..4] {
            let ours: Vec<f32> = index.search(query, NEAREST, &open).iter().map(|n| n.distance).collect();
            let plain: Vec<f32> = plain_scan(&vectors, query, NEAREST).iter().map(|found| found.0.sqrt()).collect();
            assert!(ours.iter().zip(&plain).all(|(a, b)| (a - b).abs() < 1e-5), "recall is not 1");
        }
        let centre = GeoPoint::new(51.0 + size as f64 * 0.5e-6, 7.0).ok();
        let near = centre.and_then(|centre| GeoCircle::new(centre, size as f64 * 0.0055).ok());
        let tenth = ReferenceFilter { near, ..ReferenceFilter::default() };

        let mut group = criterion.benchmark_group("search");
        group.throughput(Throughput::Elements(size)).sample_size(if size > 100_000 { 30 } else { 60 });
        let mut turn = queries.iter().cycle();
        let mut next = || turn.next().map_or(&[][..], Vec::as_slice);
        group.bench_function(BenchmarkId::new("index", size), |bencher| {
            bencher.iter_batched(&mut next, |q| black_box(index.search(q, NEAREST, &open)), BatchSize::SmallInput);
        });
        group.bench_function(BenchmarkId::new("index within a tenth of the map", size), |bencher| {
            bencher.iter_batched(&mut next, |q| black_box(index.search(q, NEAREST, &tenth)), BatchSize::SmallInput);
        });
        group.bench_function(BenchmarkId::new("plain f32 scan", size), |bencher| {
            bencher.iter_batched(&mut next, |q| black_box(plain_scan(&vectors, q, NEAREST)), BatchSize::SmallInput);
        });
        group.finish();
    }
}

criterion_group!(benches, search);
criterion_main!(benches);
