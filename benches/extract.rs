//! Extraction of one image at the default preset: the fused encoder at every level and precision of
//! this CPU, beside the candle one. Weights are random, which costs the same as learned ones.

use criterion::{Criterion, criterion_group, criterion_main};
use placeformer_core::types::ImageTensor;
use placeformer_kernels::Simd;
use placeformer_vision::extract::{
    BlockWeights, CandleEncoder, Encoder, EncoderSpec, FusedEncoder, Geometry, Linear, Norm,
    Precision, Preset, VitWeights,
};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

fn values(random: &mut ChaCha8Rng, len: usize, spread: f32) -> Vec<f32> {
    (0..len)
        .map(|_| spread * random.random_range(-1.0f32..1.0))
        .collect()
}

fn linear(random: &mut ChaCha8Rng, outputs: usize, inputs: usize) -> Linear {
    let spread = (inputs as f32).sqrt().recip();
    Linear {
        weight: values(random, outputs * inputs, spread),
        bias: values(random, outputs, 0.1),
    }
}

fn weights(preset: Preset) -> VitWeights {
    let geometry = preset.geometry();
    let Geometry { dim, mlp_dim, .. } = geometry;
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let norm = || Norm {
        weight: vec![1.0; dim],
        bias: vec![0.0; dim],
    };
    let block = |random: &mut ChaCha8Rng| BlockWeights {
        norm1: norm(),
        qkv: linear(random, 3 * dim, dim),
        proj: linear(random, dim, dim),
        layer_scale1: Some(vec![0.5; dim]),
        norm2: norm(),
        fc1: linear(random, mlp_dim, dim),
        fc2: linear(random, dim, mlp_dim),
        layer_scale2: Some(vec![0.5; dim]),
    };
    VitWeights {
        preset,
        unused_parameters: 0,
        geometry,
        position_grid: (37, 37),
        blocks: (0..geometry.depth).map(|_| block(&mut random)).collect(),
        patch_embed: linear(&mut random, dim, 3 * geometry.patch * geometry.patch),
        cls_token: values(&mut random, dim, 1.0),
        positions: values(&mut random, (1 + 37 * 37) * dim, 0.1),
        norm: norm(),
    }
}

fn extract(criterion: &mut Criterion) {
    let preset = Preset::Dinov2Vits14;
    let (weights, size, exit_block) = (weights(preset), preset.input_size(), preset.exit_block());
    let spec = EncoderSpec {
        input_size: size,
        exit_block,
        token_norm: false,
        attention_block: exit_block,
    };
    let pixels = values(
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
