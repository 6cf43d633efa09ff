//! In the steady state, the stages of a query allocate their answers and little else: buffers are
//! kept, matrices of similarities and scores never exist.
#![cfg(feature = "lab")]

use crate::common::weights::made_up;
use placeformer_core::types::{ImageSize, ImageTensor, ReferenceFilter};
use placeformer_kernels::Simd;
use placeformer_lab::bench::scenes::{CANDIDATES, RerankScene, index_entry, unit_vector};
use placeformer_vision::extract::pack;
use placeformer_vision::extract::{
    Encoder, EncoderSpec, FusedEncoder, Geometry, Precision, Preset,
};
use placeformer_vision::rerank::{RerankConfig, Reranker};
use placeformer_vision::search::MapIndex;
use stats_alloc::{INSTRUMENTED_SYSTEM, Region, StatsAlloc};
use std::alloc::System;
use std::process::Command;

#[global_allocator]
static ALLOCATOR: &StatsAlloc<System> = &INSTRUMENTED_SYSTEM;

/// Set in a process that runs one test of this file and no other.
const ALONE: &str = "PLACEFORMER_TEST_ALONE";

/// Runs `work` in a process of its own: the allocator counts what every thread of the process
/// allocates, so tests that run at the same time would be counted, too. `test` names the test that
/// calls this; the new process is this test binary, started on that test alone.
fn in_a_process_of_its_own(test: &str, work: impl FnOnce()) {
    if std::env::var_os(ALONE).is_some() {
        return work();
    }
    let child = Command::new(std::env::current_exe().unwrap())
        .args(["--exact", &format!("allocations::{test}"), "--nocapture"])
        .env(ALONE, "1")
        .output()
        .unwrap();
    let printed = String::from_utf8_lossy(&child.stdout);
    // A misspelt name would run no test and succeed.
    let passed = child.status.success() && printed.contains("1 passed");
    assert!(
        passed,
        "{printed}{}",
        String::from_utf8_lossy(&child.stderr)
    );
}

/// The fewest bytes that one of several runs of `work` allocates: the first ones fill buffers and
/// start threads, and a later one may be the first in which all threads need a buffer at the same
/// moment.
fn steady_bytes<T>(mut work: impl FnMut() -> T) -> usize {
    let mut run = || {
        let region = Region::new(ALLOCATOR);
        let result = work();
        let bytes = region.change().bytes_allocated;
        drop(result);
        bytes
    };
    (0..10).map(|_| run()).min().unwrap()
}

#[test]
fn extraction_allocates_its_answer() {
    in_a_process_of_its_own("extraction_allocates_its_answer", check_extraction);
}

fn check_extraction() {
    let geometry = Geometry {
        depth: 3,
        dim: 128,
        heads: 2,
        patch: 14,
        mlp_dim: 512,
        layer_scale: false,
    };
    let input_size = ImageSize {
        width: 280,
        height: 210,
    };
    let spec = EncoderSpec {
        input_size,
        exit_block: 2,
        token_norm: false,
        attention_block: 2,
    };
    let image = ImageTensor {
        size: input_size,
        data: vec![0.3; 3 * 280 * 210],
    };
    let weights = made_up(Preset::Dinov2Vits14, geometry, (5, 5), 1);
    for precision in [
        Precision::F32,
        Precision::Bf16,
        Precision::Mixed,
        Precision::Int8,
    ] {
        let Ok(encoder) = FusedEncoder::new(&weights, spec, Simd::best(), precision) else {
            println!("{precision} is not to be had on this CPU");
            assert_ne!(precision, Precision::F32);
            continue;
        };
        let answer = (1 + 20 * 15) * 128 * 4 + 2 * 20 * 15 * 4;
        let bytes = steady_bytes(|| encoder.encode(std::slice::from_ref(&image)).unwrap());
        assert!(
            bytes >= answer,
            "{bytes} bytes cannot hold the answer: the counter does not count"
        );
        assert!(
            bytes < answer + (16 << 10),
            "{}: {bytes} bytes for an answer of {answer}",
            encoder.name()
        );
    }
}

#[test]
fn reranking_allocates_no_matrices() {
    in_a_process_of_its_own("reranking_allocates_no_matrices", check_reranking);
}

fn check_reranking() {
    let scene = RerankScene::new(0.4);
    let query = pack(&scene.query);
    let candidates: Vec<_> = scene.candidates.iter().map(pack).collect();
    let reranker = Reranker::new(RerankConfig::default());
    let bytes = steady_bytes(|| {
        reranker.rerank(
            &query,
            candidates.len(),
            |i| Ok::<_, ()>(&candidates[i]),
            None,
        )
    });
    // One similarity matrix of the smallest combination is 640 kB of f32, for each candidate.
    let per_candidate = bytes / CANDIDATES;
    assert!(
        per_candidate < 64 << 10,
        "{per_candidate} bytes per candidate"
    );
}

#[test]
fn searching_allocates_in_proportion_to_what_it_finds() {
    in_a_process_of_its_own(
        "searching_allocates_in_proportion_to_what_it_finds",
        check_search,
    );
}

fn check_search() {
    let index = MapIndex::build((0..50_000).map(index_entry).collect());
    let query = unit_vector(1 << 40);
    let bytes = steady_bytes(|| index.search(&query, 100, &ReferenceFilter::default()));
    assert!(bytes < 256 << 10, "{bytes} bytes to find 100 of 50,000");
}
