//! From a 1080p JPEG to the model's tensor: ours beside the image crate alone.
//!
//! The picture is a rendered street, so that its entropy is that of a photo and nothing needs to be shipped. Set
//! `PLACEFORMER_BENCH_JPEG` to measure another file, for instance beside another library on the same file.

use criterion::{Criterion, criterion_group, criterion_main};
use image::imageops::FilterType;
use placeformer::image::{ImageConfig, encode_jpeg, load_tensor};
use placeformer::synth::{Condition, StreetWorld, Viewpoint};
use placeformer::types::ImageSize;
use std::hint::black_box;

const TARGET: ImageSize = ImageSize { width: 448, height: 336 };

fn jpeg() -> Vec<u8> {
    if let Some(path) = std::env::var_os("PLACEFORMER_BENCH_JPEG") {
        return std::fs::read(path).expect("PLACEFORMER_BENCH_JPEG names a readable file");
    }
    let viewpoint = Viewpoint { along_m: 0.0, across_m: -1.5, turn_deg: 45.0 };
    let size = ImageSize { width: 1920, height: 1080 };
    let image = StreetWorld::new(1).render(0, viewpoint, Condition::Day, size);
    encode_jpeg(&image, 85).expect("a rendered image encodes")
}

/// The same tensor with nothing but the image crate: its decoder and its antialiased bilinear ("triangle") filter.
#[expect(clippy::disallowed_methods, reason = "the baseline is what the ban keeps out of the service")]
fn plain(bytes: &[u8]) -> Vec<f32> {
    let image = image::load_from_memory(bytes).expect("decodes");
    let small = image.resize_exact(TARGET.width, TARGET.height, FilterType::Triangle).to_rgb8();
    let statistics = [(0.485, 0.229), (0.456, 0.224), (0.406, 0.225)];
    let plane = |(channel, (mean, deviation)): (usize, (f32, f32))| {
        small.pixels().map(move |pixel| (f32::from(pixel[channel]) / 255.0 - mean) / deviation).collect::<Vec<_>>()
    };
    statistics.into_iter().enumerate().flat_map(plane).collect()
}

fn decode(criterion: &mut Criterion) {
    let bytes = jpeg();
    let mut group = criterion.benchmark_group("decode_resize_1080p");
    group.sample_size(30);
    group.bench_function("ours", |b| b.iter(|| load_tensor(black_box(&bytes), &ImageConfig::default(), TARGET)));
    group.bench_function("image_crate", |b| b.iter(|| plain(black_box(&bytes))));
    group.finish();
}

criterion_group!(benches, decode);
criterion_main!(benches);
