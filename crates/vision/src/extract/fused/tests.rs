//! The fused encoder against the candle one, on small random transformers.

use super::encoder::FusedEncoder;
use super::formats::{Formats, choose_formats, mixed_int8_blocks};
use crate::extract::encoder::{Encoder, EncoderSpec, Precision};
use crate::extract::error::ExtractError;
use crate::extract::preset::{Geometry, Preset};
use crate::extract::vit::CandleEncoder;
use crate::extract::weights::{BlockWeights, Linear, Norm, VitWeights};
use placeformer_core::types::{ImageSize, ImageTensor};
use placeformer_kernels::operand::Format;
use placeformer_kernels::{Simd, SimdLevel};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

struct Random(ChaCha8Rng);

impl Random {
    fn around(&mut self, len: usize, centre: f32, spread: f32) -> Vec<f32> {
        (0..len)
            .map(|_| centre + spread * self.0.random_range(-1.0f32..1.0))
            .collect()
    }

    fn linear(&mut self, outputs: usize, inputs: usize) -> Linear {
        let spread = 2.0 / (inputs as f32).sqrt();
        Linear {
            weight: self.around(outputs * inputs, 0.0, spread),
            bias: self.around(outputs, 0.0, 0.3),
        }
    }

    fn norm(&mut self, dim: usize) -> Norm {
        Norm {
            weight: self.around(dim, 1.0, 0.5),
            bias: self.around(dim, 0.0, 0.3),
        }
    }

    fn block(&mut self, geometry: &Geometry) -> BlockWeights {
        let Geometry {
            dim,
            mlp_dim,
            layer_scale,
            ..
        } = *geometry;
        let scale = |random: &mut Self| layer_scale.then(|| random.around(dim, 0.5, 0.4));
        BlockWeights {
            norm1: self.norm(dim),
            qkv: self.linear(3 * dim, dim),
            proj: self.linear(dim, dim),
            layer_scale1: scale(self),
            norm2: self.norm(dim),
            fc1: self.linear(mlp_dim, dim),
            fc2: self.linear(dim, mlp_dim),
            layer_scale2: scale(self),
        }
    }
}

/// Three blocks, 64 wide, with an MLP that is not whole slices.
fn small(seed: u64, layer_scale: bool) -> VitWeights {
    let geometry = Geometry {
        depth: 3,
        dim: 64,
        heads: 2,
        patch: 14,
        mlp_dim: 416,
        layer_scale,
    };
    let mut random = Random(ChaCha8Rng::seed_from_u64(seed));
    VitWeights {
        preset: Preset::Dinov2Vits14,
        unused_parameters: 0,
        merged: None,
        geometry,
        position_grid: (5, 5),
        patch_embed: random.linear(64, 3 * 14 * 14),
        cls_token: random.around(64, 0.0, 1.0),
        positions: random.around(26 * 64, 0.0, 1.0),
        blocks: (0..3).map(|_| random.block(&geometry)).collect(),
        norm: random.norm(64),
    }
}

fn image(seed: u64, size: ImageSize) -> ImageTensor {
    let len = 3 * (size.width * size.height) as usize;
    ImageTensor {
        size,
        data: Random(ChaCha8Rng::seed_from_u64(seed)).around(len, 0.0, 2.0),
    }
}

fn spec(
    size: ImageSize,
    exit_block: usize,
    token_norm: bool,
    attention_block: usize,
) -> EncoderSpec {
    EncoderSpec {
        input_size: size,
        exit_block,
        token_norm,
        attention_block,
    }
}

fn largest_difference(a: &[f32], b: &[f32]) -> f32 {
    assert_eq!(a.len(), b.len());
    a.iter()
        .zip(b)
        .map(|(a, b)| (a - b).abs())
        .fold(0.0, f32::max)
}

fn cosine(a: &[f32], b: &[f32]) -> f64 {
    let dot = |a: &[f32], b: &[f32]| {
        a.iter()
            .zip(b)
            .map(|(&a, &b)| f64::from(a) * f64::from(b))
            .sum::<f64>()
    };
    dot(a, b) / (dot(a, a) * dot(b, b)).sqrt()
}

/// The formats that CPUs with int8 but without bf16 choose, which the CPU at hand may not be.
fn formats_without_bf16(blocks: usize) -> impl Iterator<Item = (Simd, Formats)> {
    let int8_levels = Simd::all().filter(|&simd| Format::Int8.is_available(simd));
    int8_levels.flat_map(move |simd| {
        let precisions = [
            (Precision::Int8, 0..blocks),
            (Precision::Mixed, mixed_int8_blocks(blocks)),
        ];
        precisions.map(|(precision, int8_blocks)| {
            let formats = Formats {
                precision,
                int8_blocks,
                other_layers: Format::F32,
                scores: Format::Int8,
                mix: Format::F32,
            };
            (simd, formats)
        })
    })
}

/// Every precision of every level of this CPU.
fn everything() -> impl Iterator<Item = (Simd, Precision)> {
    let precisions = [
        Precision::F32,
        Precision::Bf16,
        Precision::Mixed,
        Precision::Int8,
    ];
    let all = Simd::all().flat_map(move |simd| precisions.map(|precision| (simd, precision)));
    all.filter(|&(simd, precision)| choose_formats(simd, precision, 3).is_ok())
}

#[test]
fn equals_candle_at_every_level_size_and_exit() {
    let sizes = [(14, 14), (98, 70), (70, 126), (154, 98)]
        .map(|(width, height)| ImageSize { width, height });
    let exits = [(0, false, 0), (2, true, 2), (0, false, 2), (2, false, 1)];
    for (seed, (size, (exit, norm, attention))) in sizes.into_iter().zip(exits).enumerate() {
        let weights = small(seed as u64, seed % 2 == 0);
        let spec = spec(size, exit, norm, attention);
        let image = image(seed as u64, size);
        let expected = &CandleEncoder::new(&weights, &spec)
            .unwrap()
            .encode(std::slice::from_ref(&image))
            .unwrap()[0];
        let of_this_cpu = everything().map(|(simd, precision)| {
            (
                simd,
                choose_formats(simd, precision, spec.blocks()).unwrap(),
            )
        });
        for (simd, formats) in of_this_cpu.chain(formats_without_bf16(spec.blocks())) {
            let precision = formats.precision;
            let fused = FusedEncoder::with_formats(&weights, spec, simd, formats).unwrap();
            let actual = &fused.encode(std::slice::from_ref(&image)).unwrap()[0];
            assert_eq!(
                (actual.grid, actual.dim, actual.heads),
                (expected.grid, expected.dim, expected.heads)
            );
            let tokens = largest_difference(&actual.tokens, &expected.tokens)
                .max(largest_difference(&actual.cls_token, &expected.cls_token));
            let attention = largest_difference(&actual.cls_attention, &expected.cls_attention);
            // Random weights spread a rounding error over all tokens, so these bounds are wide.
            // What trained weights lose is measured with the real model elsewhere.
            let (least, of_tokens, of_attention) = match precision {
                Precision::Bf16 => (0.999, 0.3, 0.01),
                Precision::Mixed | Precision::Int8 => (0.995, 0.4, 0.02),
                _ => (0.999_999, 1e-4, 5e-6),
            };
            assert!(
                tokens < of_tokens,
                "{} at {size}, exit {exit}: tokens off by {tokens}",
                fused.name()
            );
            assert!(
                attention < of_attention,
                "{} at {size}, exit {exit}: attention off by {attention}",
                fused.name()
            );
            let cosine = cosine(&actual.tokens, &expected.tokens);
            assert!(
                cosine > least,
                "{} at {size}, exit {exit}: cosine {cosine}",
                fused.name()
            );
        }
    }
}

#[test]
fn an_outlier_channel_leaves_int8_as_exact_as_before() {
    let size = ImageSize {
        width: 98,
        height: 70,
    };
    let spec = spec(size, 2, false, 2);
    let image = image(4, size);
    let [loss_without_outlier, loss_with_outlier] = [0.0, 40.0].map(|offset| {
        let mut weights = small(4, true);
        for block in &mut weights.blocks {
            // As in trained transformers: one channel lies far from zero, and its weights are
            // small.
            for (norm, layer) in [
                (&mut block.norm1, &mut block.qkv),
                (&mut block.norm2, &mut block.fc1),
            ] {
                norm.bias[7] += offset;
                layer
                    .weight
                    .iter_mut()
                    .skip(7)
                    .step_by(64)
                    .for_each(|weight| *weight *= 0.01);
            }
        }
        let expected = CandleEncoder::new(&weights, &spec)
            .unwrap()
            .encode(std::slice::from_ref(&image))
            .unwrap();
        let losses = Simd::all()
            .filter(|&simd| Format::Int8.is_available(simd))
            .map(|simd| {
                let fused = FusedEncoder::new(&weights, spec, simd, Precision::Int8).unwrap();
                let actual = fused.encode(std::slice::from_ref(&image)).unwrap();
                1.0 - cosine(&actual[0].tokens, &expected[0].tokens)
            });
        losses.fold(0.0, f64::max)
    });
    assert!(
        loss_with_outlier < 3.0 * loss_without_outlier + 1e-6,
        "loses {loss_with_outlier}, and {loss_without_outlier} without the outlier"
    );
}

#[test]
fn a_batch_gives_bit_for_bit_what_single_images_give() {
    let size = ImageSize {
        width: 112,
        height: 98,
    };
    let images: Vec<_> = (0..5).map(|seed| image(seed, size)).collect();
    for (simd, precision) in everything() {
        let fused =
            FusedEncoder::new(&small(9, true), spec(size, 2, false, 2), simd, precision).unwrap();
        let together = fused.encode(&images).unwrap();
        let singly: Vec<_> = images
            .iter()
            .flat_map(|image| fused.encode(std::slice::from_ref(image)).unwrap())
            .collect();
        assert_eq!(together, singly);
        assert_ne!(together[0].tokens, together[1].tokens);
    }
}

#[test]
fn neither_threads_nor_other_images_change_a_bit() {
    // More tokens than fit one chunk of any level, so that how they are cut depends on both.
    let size = ImageSize {
        width: 224,
        height: 210,
    };
    let images: Vec<_> = (0..3).map(|seed| image(seed, size)).collect();
    for (simd, precision) in everything() {
        let fused =
            FusedEncoder::new(&small(6, true), spec(size, 1, false, 1), simd, precision).unwrap();
        let expected = fused.encode(&images).unwrap();
        for threads in [1, 3, 16] {
            let pool = rayon::ThreadPoolBuilder::new()
                .num_threads(threads)
                .build()
                .unwrap();
            let alone = pool.install(|| fused.encode(&images[..1])).unwrap();
            assert!(
                alone[0] == expected[0],
                "{} with {threads} threads",
                fused.name()
            );
            assert!(
                pool.install(|| fused.encode(&images)).unwrap() == expected,
                "{} in a batch",
                fused.name()
            );
        }
    }
}

#[test]
fn as_an_operation_of_candle_it_gives_the_same() {
    use candle_core::{Device, Tensor};
    let size = ImageSize {
        width: 98,
        height: 70,
    };
    let fused = FusedEncoder::new(
        &small(5, true),
        spec(size, 1, false, 2),
        Simd::SCALAR,
        Precision::F32,
    )
    .unwrap();
    let images = [image(1, size), image(2, size)];
    let encoded = fused.encode(&images).unwrap();
    let pixels: Vec<f32> = images
        .iter()
        .flat_map(|image| image.data.iter().copied())
        .collect();
    let pixels = Tensor::from_vec(pixels, (2, 3, 70, 98), &Device::Cpu).unwrap();
    let out = pixels.apply_op1_no_bwd(&fused).unwrap();
    assert_eq!(out.dims(), [2, 1 + 35, 64 + 2]);
    for (number, image) in encoded.iter().enumerate() {
        let rows = out.get(number).unwrap().to_vec2::<f32>().unwrap();
        assert_eq!(
            (&rows[0][..64], &rows[0][64..]),
            (&image.cls_token[..], &[0.0, 0.0][..])
        );
        for (patch, row) in rows[1..].iter().enumerate() {
            assert_eq!(row[..64], image.tokens[patch * 64..][..64]);
            assert_eq!(
                row[64..],
                [image.cls_attention[patch], image.cls_attention[35 + patch]]
            );
        }
    }
    let refused = |pixels: &Tensor| pixels.apply_op1_no_bwd(&fused).unwrap_err().to_string();
    assert!(refused(&pixels.transpose(2, 3).unwrap()).contains("contiguous"));
    assert!(
        refused(&pixels.narrow(2, 0, 14).unwrap().contiguous().unwrap())
            .contains("[batch, 3, 70, 98]")
    );
    assert!(refused(&(pixels * f64::NAN).unwrap()).contains("not finite"));
}

#[test]
fn a_broken_image_is_refused_and_leaves_no_trace() {
    let size = ImageSize {
        width: 112,
        height: 98,
    };
    for (simd, precision) in everything() {
        let fused =
            FusedEncoder::new(&small(3, true), spec(size, 1, false, 1), simd, precision).unwrap();
        let good = [image(1, size)];
        let before = fused.encode(&good).unwrap();
        let mut broken = image(2, size);
        broken.data[5000] = f32::NAN;
        assert!(
            matches!(fused.encode(&[broken]), Err(ExtractError::NotFinite)),
            "{}",
            fused.name()
        );
        assert_eq!(fused.encode(&good).unwrap(), before);
        let wrong = ImageTensor {
            size,
            data: vec![0.0; 7],
        };
        assert!(matches!(
            fused.encode(&[wrong]),
            Err(ExtractError::WrongLength { .. })
        ));
        assert!(fused.encode(&[]).unwrap().is_empty());
    }
}

#[test]
fn a_precision_without_its_instructions_is_refused_by_name() {
    for simd in Simd::all() {
        let fastest = if simd.level() >= SimdLevel::Avx512 {
            Precision::Mixed
        } else {
            Precision::F32
        };
        let auto = choose_formats(simd, Precision::Auto, 9).unwrap();
        assert_eq!(auto.precision, fastest);
        if simd.level() == SimdLevel::Avx2 {
            for precision in [Precision::Bf16, Precision::Mixed, Precision::Int8] {
                let refused = choose_formats(simd, precision, 9).unwrap_err().to_string();
                assert!(
                    refused.contains(precision.name()) && refused.contains("level avx2"),
                    "{refused}"
                );
            }
        }
    }
}

#[test]
fn mixed_is_int8_from_the_second_block_to_the_middle() {
    assert_eq!(
        [1, 2, 3, 9, 12].map(mixed_int8_blocks),
        [1..1, 1..1, 1..2, 1..5, 1..6]
    );
    let weights = small(8, true);
    let size = ImageSize {
        width: 98,
        height: 70,
    };
    for simd in Simd::all().filter(|&simd| choose_formats(simd, Precision::Mixed, 3).is_ok()) {
        let bytes = [Precision::Int8, Precision::Mixed, Precision::F32]
            .map(|precision| {
                FusedEncoder::new(&weights, spec(size, 2, false, 2), simd, precision).unwrap()
            })
            .map(|encoder| encoder.weight_bytes());
        assert!(
            bytes[0] < bytes[1] && bytes[1] < bytes[2],
            "{}: {bytes:?}",
            simd.level()
        );
    }
}

#[test]
fn blocks_and_sizes_that_do_not_exist_are_refused() {
    let weights = small(4, true);
    let size = ImageSize {
        width: 28,
        height: 28,
    };
    let build = |spec| {
        FusedEncoder::new(&weights, spec, Simd::SCALAR, Precision::F32)
            .map(|_| ())
            .unwrap_err()
            .to_string()
    };
    assert!(build(spec(size, 3, false, 0)).contains("block 3"));
    assert!(
        build(spec(
            ImageSize {
                width: 30,
                height: 28
            },
            0,
            false,
            0
        ))
        .contains("30x28")
    );
}
