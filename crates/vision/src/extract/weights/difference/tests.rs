//! Differences in memory and in files, intact and damaged, and what they do to weights.

use super::*;
use crate::extract::preset::Geometry;
use crate::extract::weights::{BlockWeights, Linear, Norm};
use safetensors::tensor::{Dtype, TensorView};
use std::collections::HashMap;
use std::path::Path;

/// A backbone of one block whose values follow `scale`.
fn weights(scale: f32) -> VitWeights {
    let (dim, mlp_dim, patch) = (4, 8, 2);
    let values = |count: usize, from: usize| -> Vec<f32> {
        (0..count)
            .map(|i| (((i + from) * 37 % 101) as f32 / 50.0 - 1.0) * scale)
            .collect()
    };
    let linear = |out: usize, input: usize| Linear {
        weight: values(out * input, out),
        bias: values(out, input),
    };
    let norm = || Norm {
        weight: values(dim, 3),
        bias: values(dim, 5),
    };
    VitWeights {
        preset: Preset::Dinov2Vits14,
        geometry: Geometry {
            depth: 1,
            dim,
            heads: 2,
            patch,
            mlp_dim,
            layer_scale: false,
        },
        position_grid: (2, 2),
        patch_embed: linear(dim, 3 * patch * patch),
        cls_token: values(dim, 1),
        positions: values(5 * dim, 2),
        blocks: vec![BlockWeights {
            norm1: norm(),
            qkv: linear(3 * dim, dim),
            proj: linear(dim, dim),
            layer_scale1: None,
            norm2: norm(),
            fc1: linear(mlp_dim, dim),
            fc2: linear(dim, mlp_dim),
            layer_scale2: None,
        }],
        norm: norm(),
        unused_parameters: 0,
        merged: None,
    }
}

fn notes() -> BTreeMap<String, String> {
    BTreeMap::from([("steps".to_owned(), "150".to_owned())])
}

const PROJ: &str = "blocks.0.attn.proj.weight";

/// The block's output projection moved, in values that half floats hold exactly and others.
fn trained(base: &VitWeights) -> VitWeights {
    let mut trained = base.clone();
    for (i, value) in trained.blocks[0].proj.weight.iter_mut().enumerate() {
        *value += 1e-3 * i as f32;
    }
    trained.blocks[0].norm1.bias[2] += 0.25;
    trained
}

fn low_rank(base: &VitWeights) -> Difference {
    let factors = Factors {
        rank: 2,
        up: (0..8).map(|i| i as f32 / 8.0).collect(),
        down: (0..8).map(|i| 1.0 - i as f32 / 4.0).collect(),
    };
    Difference::of_factors(base, BTreeMap::from([(PROJ.to_owned(), factors)]), notes()).unwrap()
}

#[test]
fn merging_gives_the_trained_weights_back_to_half_precision() {
    let base = weights(1.0);
    let trained = trained(&base);
    let difference = Difference::between(&base, &trained, notes()).unwrap();
    assert_eq!(difference.changes.len(), 2);
    let merged = difference.merge(&base).unwrap();
    for ((name, _, merged), (_, _, trained)) in merged.tensors().iter().zip(trained.tensors()) {
        let worst = merged.iter().zip(trained).map(|(a, b)| (a - b).abs());
        assert!(worst.fold(0.0, f32::max) < 1e-5, "{name}");
    }
    assert_ne!(merged.content_hash(), base.content_hash());
    assert_eq!(
        merged.merged,
        Some(Merged {
            base: base.content_hash(),
            difference: difference.content_hash()
        })
    );
}

#[test]
fn a_low_rank_change_is_the_product_of_its_factors() {
    let base = weights(1.0);
    let merged = low_rank(&base).merge(&base).unwrap();
    for row in 0..4 {
        for column in 0..4 {
            let product: f32 = (0..2)
                .map(|r| (row * 2 + r) as f32 / 8.0 * (1.0 - (r * 4 + column) as f32 / 4.0))
                .sum();
            let at = row * 4 + column;
            let change = merged.blocks[0].proj.weight[at] - base.blocks[0].proj.weight[at];
            assert!((change - product).abs() < 1e-6, "{row} {column}");
        }
    }
    assert_eq!(merged.blocks[0].proj.bias, base.blocks[0].proj.bias);
}

#[test]
fn a_difference_survives_its_file_and_only_what_it_changes_is_its_identity() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("d.safetensors");
    let base = weights(1.0);
    let whole = Difference::between(&base, &trained(&base), notes()).unwrap();
    for difference in [whole.clone(), low_rank(&base)] {
        difference.save(&path).unwrap();
        let back = Difference::load(&path).unwrap();
        assert_eq!(back, difference);
        assert_eq!(back.content_hash(), difference.content_hash());
        assert_eq!(back.merge(&base).unwrap(), difference.merge(&base).unwrap());
    }
    let renamed = Difference {
        notes: BTreeMap::new(),
        ..whole.clone()
    };
    assert_eq!(renamed.content_hash(), whole.content_hash());
    assert_ne!(low_rank(&base).content_hash(), whole.content_hash());
}

#[test]
fn other_weights_are_refused_and_so_is_a_second_merge() {
    let base = weights(1.0);
    let difference = low_rank(&base);
    let merged = difference.merge(&base).unwrap();
    for other in [weights(0.5), merged] {
        let error = difference.merge(&other).unwrap_err();
        assert!(
            matches!(error, ExtractError::DifferenceMismatch { .. }),
            "{error}"
        );
        assert!(
            error.to_string().contains(&other.content_hash()[..12]),
            "{error}"
        );
    }
}

#[test]
fn what_changes_nothing_or_cannot_be_half_floats_is_refused() {
    let base = weights(1.0);
    let error = Difference::between(&base, &base, notes()).unwrap_err();
    assert!(error.to_string().contains("changes nothing"), "{error}");
    for value in [f32::NAN, 1e6] {
        let mut broken = base.clone();
        broken.blocks[0].fc1.bias[1] = value;
        let error = Difference::between(&base, &broken, notes()).unwrap_err();
        assert!(error.to_string().contains("mlp.fc1.bias"), "{error}");
    }
    let factors = |name: &str, up: usize| {
        let factors = Factors {
            rank: 1,
            up: vec![0.5; up],
            down: vec![0.5; 4],
        };
        let error =
            Difference::of_factors(&base, BTreeMap::from([(name.to_owned(), factors)]), notes());
        error.unwrap_err().to_string()
    };
    assert!(factors(PROJ, 5).contains("does not fit [4, 4]"));
    assert!(factors("blocks.7.attn.proj.weight", 4).contains("no tensor"));
}

#[test]
fn a_damaged_file_is_refused_with_its_fault() {
    let base = weights(1.0);
    let refusal = |tensors: &[(&str, &[usize], Dtype)], metadata: &[(&str, &str)]| {
        let bytes = vec![0x11u8; 4 * 64];
        let views = tensors.iter().map(|(name, shape, dtype)| {
            let width = if *dtype == Dtype::F16 { 2 } else { 4 };
            let length = width * shape.iter().product::<usize>();
            let view = TensorView::new(*dtype, shape.to_vec(), &bytes[..length]).unwrap();
            (name.to_string(), view)
        });
        let metadata: HashMap<String, String> = metadata
            .iter()
            .map(|(key, value)| (key.to_string(), value.to_string()))
            .collect();
        let file = safetensors::serialize(views, Some(metadata)).unwrap();
        let loaded = Difference::from_bytes(&file, Path::new("d.safetensors"));
        match loaded.and_then(|difference| difference.merge(&base)) {
            Ok(_) => String::new(),
            Err(error) => error.to_string(),
        }
    };
    let hash = base.content_hash();
    let sound = [
        ("difference_of", hash.as_str()),
        ("preset", "dinov2-vits14"),
    ];
    let whole = (PROJ, &[16][..], Dtype::F16);
    assert_eq!(refusal(&[whole], &sound), "");
    for (tensors, metadata, part) in [
        (vec![whole], &sound[1..], "which weights"),
        (vec![whole], &sound[..1], "is not one of"),
        (vec![], &sound[..], "changes nothing"),
        (
            vec![(PROJ, &[16][..], Dtype::F32)],
            &sound[..],
            "not half floats",
        ),
        (
            vec![(PROJ, &[15][..], Dtype::F16)],
            &sound[..],
            "does not fit",
        ),
        (
            vec![("blocks.9.x", &[16][..], Dtype::F16)],
            &sound[..],
            "no tensor",
        ),
        (
            vec![("blocks.0.attn.proj.weight.up", &[4, 2][..], Dtype::F16)],
            &sound[..],
            "down is missing",
        ),
        (
            vec![("blocks.0.attn.proj.weight.down", &[2, 4][..], Dtype::F16)],
            &sound[..],
            "up is missing",
        ),
        (
            vec![
                ("blocks.0.attn.proj.weight.up", &[4, 2][..], Dtype::F16),
                ("blocks.0.attn.proj.weight.down", &[1, 4][..], Dtype::F16),
            ],
            &sound[..],
            "no common rank",
        ),
    ] {
        let refusal = refusal(&tensors, metadata);
        assert!(refusal.contains(part), "{part}: {refusal}");
    }
    let error = Difference::from_bytes(&[7; 9], Path::new("d")).unwrap_err();
    assert!(
        error.to_string().contains("not a safetensors file"),
        "{error}"
    );
}
