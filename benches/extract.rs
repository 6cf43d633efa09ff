//! Extraction of one image at the default preset: the fused encoder at every level and precision of
//! this CPU, compared with the candle one. Weights are random, which cost the same as learned ones.

#[path = "../tests/common/noise.rs"]
#[allow(dead_code, reason = "the tests use all of it")]
mod noise;
#[path = "../tests/common/weights.rs"]
mod weights;

use criterion::{Criterion, criterion_group, criterion_main};
use placeformer_core::types::ImageTensor;
use placeformer_kernels::Simd;
use placeformer_vision::extract::{
    CandleEncoder, Encoder, EncoderSpec, FusedEncoder, Precision, Preset,
};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use weights::made_up;

fn extract(criterion: &mut Criterion) {
    let preset = Preset::Dinov2Vits14;
    let weights = made_up(preset, preset.geometry(), (37, 37), 1);
    let size = preset.input_size();
    let exit_block = preset.exit_block();
    let spec = EncoderSpec {
        input_size: size,
        exit_block,
        token_norm: false,
        attention_block: exit_block,
    };
    let pixels = noise::values(
        &mut ChaCha8Rng::seed_from_u64(2),
        3 * (size.width * size.height) as usize,
        2.0,
    );
    let image = ImageTensor { size, data: pixels };
    let mut group = criterion.benchmark_group("extract");
    group.sample_size(10);
    let mut encoders: Vec<Box<dyn Encoder>> = Vec::new();
    for simd in Simd::all() {
        let of_level = |precision| FusedEncoder::new(&weights, spec, simd, precision).ok();
        let precisions = if simd == Simd::SCALAR {
            &[Precision::F32][..]
        } else {
            &[
                Precision::F32,
                Precision::Bf16,
                Precision::Mixed,
                Precision::Int8,
            ][..]
        };
        for encoder in precisions.iter().copied().filter_map(of_level) {
            encoders.push(Box::new(encoder));
        }
    }
    encoders.push(Box::new(
        CandleEncoder::new(&weights, &spec).expect("the default spec suits the weights"),
    ));
    for encoder in &encoders {
        group.bench_function(encoder.name(), |bencher| {
            bencher.iter(|| encoder.encode(std::slice::from_ref(&image)))
        });
    }
    let batch = vec![image; 8];
    let fused = &encoders[encoders.len() - 2];
    group.bench_function(format!("{}-batch8", fused.name()), |bencher| {
        bencher.iter(|| fused.encode(&batch))
    });
    group.finish();
}

criterion_group!(benches, extract);
criterion_main!(benches);
