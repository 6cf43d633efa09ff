//! From a 1080p JPEG to the model's tensor, compared with the image crate alone.
//!
//! The picture is a rendered street, so that its entropy is that of a photo and nothing needs to be
//! shipped. Set `PLACEFORMER_BENCH_JPEG` to measure another file, for instance to compare with
//! another library on the same file.

use criterion::{Criterion, criterion_group, criterion_main};
use placeformer_core::types::ImageSize;
use placeformer_lab::bench::{baselines, scenes::photo};
use placeformer_vision::image::{ImageConfig, load_tensor};
use std::hint::black_box;

const TARGET: ImageSize = ImageSize {
    width: 448,
    height: 336,
};

fn jpeg() -> Vec<u8> {
    match std::env::var_os("PLACEFORMER_BENCH_JPEG") {
        Some(path) => std::fs::read(path).expect("PLACEFORMER_BENCH_JPEG names a readable file"),
        None => photo().expect("a rendered image encodes"),
    }
}

fn decode(criterion: &mut Criterion) {
    let bytes = jpeg();
    let mut group = criterion.benchmark_group("decode_resize_1080p");
    group.sample_size(30);
    group.bench_function("ours", |b| {
        b.iter(|| load_tensor(black_box(&bytes), &ImageConfig::default(), TARGET))
    });
    group.bench_function("image_crate", |b| {
        b.iter(|| baselines::load_tensor(black_box(&bytes), TARGET))
    });
    group.finish();
}

criterion_group!(benches, decode);
criterion_main!(benches);
