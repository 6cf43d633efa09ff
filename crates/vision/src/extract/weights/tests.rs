//! Files of the paper's geometry, intact and damaged, under both namings.

use super::vit_weights::VitWeights;
use crate::extract::error::ExtractError;
use crate::extract::preset::Preset;
use safetensors::tensor::{Dtype, TensorView, serialize};
use std::collections::BTreeMap;
use std::path::Path;

type File = BTreeMap<String, (Vec<usize>, Vec<f32>)>;

const PRESET: Preset = Preset::PlaceformerVits16;

/// A complete file in the fused naming; every tensor holds its own constant.
fn fused() -> File {
    let d = 384;
    let m = 1536;
    let mut shapes = vec![
        ("cls_token".to_owned(), vec![1, 1, d]),
        ("pos_embed".to_owned(), vec![1, 197, d]),
        ("patch_embed.proj.weight".to_owned(), vec![d, 3, 16, 16]),
        ("patch_embed.proj.bias".to_owned(), vec![d]),
        ("norm.weight".to_owned(), vec![d]),
        ("norm.bias".to_owned(), vec![d]),
    ];
    for i in 0..12 {
        for (name, out, input) in [
            ("attn.qkv", 3 * d, d),
            ("attn.proj", d, d),
            ("mlp.fc1", m, d),
            ("mlp.fc2", d, m),
        ] {
            shapes.push((format!("blocks.{i}.{name}.weight"), vec![out, input]));
            shapes.push((format!("blocks.{i}.{name}.bias"), vec![out]));
        }
        for name in ["norm1.weight", "norm1.bias", "norm2.weight", "norm2.bias"] {
            shapes.push((format!("blocks.{i}.{name}"), vec![d]));
        }
    }
    let filled = |(i, (name, shape)): (usize, (String, Vec<usize>))| {
        let count = shape.iter().product();
        (name, (shape, vec![i as f32 / 100.0; count]))
    };
    shapes.into_iter().enumerate().map(filled).collect()
}

fn load(file: &File) -> Result<VitWeights, ExtractError> {
    load_with(file, None, None)
}

fn load_with(
    file: &File,
    metadata: Option<&str>,
    heads: Option<usize>,
) -> Result<VitWeights, ExtractError> {
    let views = file.iter().map(|(name, (shape, values))| {
        (
            name,
            TensorView::new(Dtype::F32, shape.clone(), bytemuck::cast_slice(values)).unwrap(),
        )
    });
    let metadata = metadata.map(|heads| [("num_heads".to_owned(), heads.to_owned())].into());
    VitWeights::from_bytes(
        &serialize(views, metadata).unwrap(),
        Path::new("w.safetensors"),
        PRESET,
        heads,
    )
}

fn problems(file: &File) -> Vec<String> {
    match load(file) {
        Err(ExtractError::WrongTensors { problems, .. }) => problems,
        other => panic!("{other:?}"),
    }
}

#[test]
fn a_complete_file_loads_under_any_prefix_and_with_a_classifier() {
    let plain = load(&fused()).unwrap();
    assert_eq!(
        (
            plain.blocks.len(),
            plain.position_grid,
            plain.geometry.heads
        ),
        (12, (14, 14), 12)
    );
    assert_eq!(plain.parameters(), 21_665_664);
    let mut prefixed: File = fused()
        .into_iter()
        .map(|(name, t)| (format!("module.backbone.{name}"), t))
        .collect();
    prefixed.insert("head.weight".into(), (vec![1000, 384], vec![0.0; 384_000]));
    let prefixed = load(&prefixed).unwrap();
    assert_eq!(prefixed.content_hash(), plain.content_hash());
    assert_eq!(prefixed.unused_parameters, 384_000);
}

#[test]
fn hugging_faces_naming_gives_the_same_weights() {
    let mut renamed = File::new();
    for (name, (shape, values)) in fused() {
        if let Some(base) = name
            .find("attn.qkv")
            .map(|at| name[..at].replace("blocks", "encoder.layer"))
        {
            let kind = name.rsplit('.').next().unwrap();
            for (part, values) in ["query", "key", "value"]
                .iter()
                .zip(values.chunks(values.len() / 3))
            {
                let shape = std::iter::once(shape[0] / 3)
                    .chain(shape[1..].iter().copied())
                    .collect();
                renamed.insert(
                    format!("{base}attention.attention.{part}.{kind}"),
                    (shape, values.to_vec()),
                );
            }
            continue;
        }
        let name = match name.as_str() {
            "cls_token" => "embeddings.cls_token".into(),
            "pos_embed" => "embeddings.position_embeddings".into(),
            "norm.weight" | "norm.bias" => format!("layer{name}"),
            _ => name
                .replace("patch_embed.proj", "embeddings.patch_embeddings.projection")
                .replace("blocks", "encoder.layer")
                .replace("attn.proj", "attention.output.dense"),
        };
        renamed.insert(name, (shape, values));
    }
    assert_eq!(load(&renamed).unwrap(), load(&fused()).unwrap());
}

#[test]
fn every_fault_is_named_and_nothing_is_loaded() {
    let mut file = fused();
    file.remove("blocks.3.mlp.fc1.bias");
    file.insert("norm.weight".into(), (vec![768], vec![1.0; 768]));
    file.insert("blocks.12.norm1.bias".into(), (vec![384], vec![1.0; 384]));
    file.get_mut("cls_token").unwrap().1[7] = f32::NAN;
    let mut found = problems(&file);
    found.sort();
    assert_eq!(
        found,
        [
            "blocks.12.norm1.bias [384] is unexpected",
            "blocks.3.mlp.fc1.bias [1536] is missing",
            "cls_token holds values that are not finite",
            "norm.weight is [768], not [384]",
        ]
    );
}

#[test]
fn an_impossible_position_table_is_named() {
    let mut file = fused();
    file.insert(
        "pos_embed".into(),
        (vec![1, 200, 384], vec![0.0; 200 * 384]),
    );
    assert!(
        problems(&file)[0].contains("pos_embed is [1, 200, 384]"),
        "{:?}",
        problems(&file)
    );
}

#[test]
fn heads_come_from_the_settings_then_the_file_then_the_preset() {
    let heads = |metadata, setting| {
        load_with(&fused(), metadata, setting).map(|weights| weights.geometry.heads)
    };
    assert_eq!(heads(Some("6"), None).unwrap(), 6);
    assert_eq!(heads(Some("6"), Some(8)).unwrap(), 8);
    assert!(
        heads(Some("six"), None)
            .unwrap_err()
            .to_string()
            .contains("six")
    );
    assert!(
        heads(None, Some(7))
            .unwrap_err()
            .to_string()
            .contains("7 heads")
    );
}

#[test]
fn saved_weights_load_again_and_damage_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("w.safetensors");
    let weights = load_with(&fused(), Some("6"), None).unwrap();
    weights.save(&path).unwrap();
    assert_eq!(VitWeights::load(&path, PRESET, None).unwrap(), weights);
    let bytes = std::fs::read(&path).unwrap();
    let refused = |bytes: &[u8]| {
        VitWeights::from_bytes(bytes, &path, PRESET, None)
            .unwrap_err()
            .to_string()
    };
    assert!(refused(&bytes[..bytes.len() / 2]).contains("truncated"));
    assert!(refused(b"<html>404</html>").contains("not a safetensors file"));
    let other = VitWeights::from_bytes(&bytes, &path, Preset::Dinov2Vits14, None)
        .unwrap_err()
        .to_string();
    assert!(
        other.contains("does not hold dinov2-vits14") && other.contains("ls1.gamma"),
        "{other}"
    );
}
