//! In the steady state, the stages of a query allocate their answers and little else: buffers are
//! kept, matrices of similarities and scores never exist.
#![cfg(feature = "lab")]

use placeformer_core::types::{ImageSize, ImageTensor, ReferenceFilter};
use placeformer_kernels::Simd;
use placeformer_lab::bench::scenes::{CANDIDATES, RerankScene, index_entry, unit_vector};
use placeformer_vision::extract::pack;
use placeformer_vision::extract::{
    BlockWeights, Encoder, EncoderSpec, FusedEncoder, Geometry, Linear, Norm, Precision, Preset,
    VitWeights,
};
use placeformer_vision::rerank::{RerankConfig, Reranker};
use placeformer_vision::search::MapIndex;
use stats_alloc::{INSTRUMENTED_SYSTEM, Region, StatsAlloc};
use std::alloc::System;
use std::sync::Mutex;

#[global_allocator]
static ALLOCATOR: &StatsAlloc<System> = &INSTRUMENTED_SYSTEM;

/// What the tests of this file allocate is counted together.
static ALONE: Mutex<()> = Mutex::new(());

/// The fewest bytes that one of several runs of `work` allocates: the first ones fill buffers and
/// start threads, and a later one may be the first in which all threads need a buffer at the same
/// moment.
fn steady_bytes<T>(mut work: impl FnMut() -> T) -> usize {
    let _alone = ALONE.lock().unwrap();
    let mut run = || {
        let region = Region::new(ALLOCATOR);
        let result = work();
        let bytes = region.change().bytes_allocated;
        drop(result);
        bytes
    };
    (0..10).map(|_| run()).min().unwrap()
}

fn linear(outputs: usize, inputs: usize) -> Linear {
    let weight = (0..outputs * inputs)
        .map(|i| ((i * 37) % 101) as f32 / 1000.0 - 0.05)
        .collect();
    Linear {
        weight,
        bias: vec![0.01; outputs],
    }
}

fn weights(geometry: Geometry) -> VitWeights {
    let Geometry { dim, mlp_dim, .. } = geometry;
    let norm = || Norm {
        weight: vec![1.0; dim],
        bias: vec![0.0; dim],
    };
    let block = || BlockWeights {
        norm1: norm(),
        qkv: linear(3 * dim, dim),
        proj: linear(dim, dim),
        layer_scale1: None,
        norm2: norm(),
        fc1: linear(mlp_dim, dim),
        fc2: linear(dim, mlp_dim),
        layer_scale2: None,
    };
    VitWeights {
        preset: Preset::Dinov2Vits14,
        unused_parameters: 0,
        geometry,
        position_grid: (5, 5),
        blocks: (0..geometry.depth).map(|_| block()).collect(),
        patch_embed: linear(dim, 3 * geometry.patch * geometry.patch),
        cls_token: vec![0.1; dim],
        positions: vec![0.1; 26 * dim],
        norm: norm(),
    }
}

#[test]
fn extraction_allocates_its_answer() {
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
    for precision in [
        Precision::F32,
        Precision::Bf16,
        Precision::Mixed,
        Precision::Int8,
    ] {
        let Ok(encoder) = FusedEncoder::new(&weights(geometry), spec, Simd::best(), precision)
        else {
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
    let index = MapIndex::build((0..50_000).map(index_entry).collect());
    let query = unit_vector(1 << 40);
    let bytes = steady_bytes(|| index.search(&query, 100, &ReferenceFilter::default()));
    assert!(bytes < 256 << 10, "{bytes} bytes to find 100 of 50,000");
}
