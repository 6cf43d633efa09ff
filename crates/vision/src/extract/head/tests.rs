//! Heads in memory and in files, intact and damaged.

use super::file::{GEM_P, VLAD_WORDS};
use super::projection::Head;
use crate::extract::aggregate::Aggregate;
use crate::extract::error::ExtractError;
use crate::extract::vlad::VladWords;
use placeformer_core::types::GLOBAL_DIM;
use safetensors::tensor::{Dtype, TensorView};
use std::collections::HashMap;
use std::path::Path;

fn head() -> Head {
    let weight = (0..GLOBAL_DIM * 8)
        .map(|i| ((i * 37) % 101) as f32 / 50.0 - 1.0)
        .collect();
    let notes = [("method".to_owned(), "test".to_owned())].into();
    Head::new(
        Aggregate::Mean,
        weight,
        vec![0.5; GLOBAL_DIM],
        "backbone-x",
        notes,
    )
    .unwrap()
}

#[test]
fn a_head_survives_its_file() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("h.safetensors");
    head().save(&path).unwrap();
    let back = Head::load(&path).unwrap();
    assert_eq!(back, head());
    assert_eq!(back.content_hash(), head().content_hash());
    assert_eq!(
        std::fs::read_dir(dir.path()).unwrap().count(),
        1,
        "no unfinished file is left"
    );
}

fn vlad(words: usize) -> Aggregate {
    Aggregate::Vlad(VladWords::new((0..words * 4).map(|i| i as f32 / 9.0).collect(), 4).unwrap())
}

/// The head of [`head`] behind another pooling.
fn with_aggregate(aggregate: Aggregate) -> Result<Head, ExtractError> {
    let head = head();
    let (weight, bias) = head.weights();
    let notes = head.notes().clone();
    Head::new(
        aggregate,
        weight.to_vec(),
        bias.to_vec(),
        "backbone-x",
        notes,
    )
}

#[test]
fn the_aggregate_is_part_of_the_file_and_of_the_hash() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("h.safetensors");
    let mut hashes = std::collections::BTreeSet::new();
    for aggregate in [
        Aggregate::Mean,
        Aggregate::gem(3.0).unwrap(),
        Aggregate::gem(4.0).unwrap(),
        vlad(2),
    ] {
        let made = with_aggregate(aggregate.clone()).unwrap();
        made.save(&path).unwrap();
        let back = Head::load(&path).unwrap();
        assert_eq!(
            (&back, back.aggregate(), back.content_hash()),
            (&made, &aggregate, made.content_hash())
        );
        assert_eq!(back.dim(), aggregate.pooled_dim(back.token_dim()));
        assert!(
            hashes.insert(back.content_hash()),
            "{aggregate} shares its hash with another"
        );
    }
    assert!(
        hashes.contains(&head().content_hash()),
        "a mean head keeps the hash it always had"
    );
    let wrong = with_aggregate(vlad(3)).unwrap_err().to_string();
    assert!(
        wrong.contains("takes 8 values, its 3 visual words make 12"),
        "{wrong}"
    );
}

#[test]
fn a_file_whose_aggregate_does_not_fit_is_refused() {
    let refusal = |kind: &str, extra: Option<(&str, Vec<usize>)>| {
        let head = head();
        let (weight, bias) = head.weights();
        let values = vec![1.5f32; 64];
        let view = |shape: Vec<usize>, values: &[f32]| {
            let bytes = bytemuck::cast_slice::<f32, u8>(&values[..shape.iter().product()]).to_vec();
            (shape, bytes)
        };
        let mut parts = vec![
            ("weight", view(vec![256, 8], weight)),
            ("bias", view(vec![256], bias)),
        ];
        parts.extend(extra.map(|(name, shape)| (name, view(shape, &values))));
        let tensors: Vec<_> = parts
            .iter()
            .map(|(name, (shape, bytes))| {
                (
                    *name,
                    TensorView::new(Dtype::F32, shape.clone(), bytes).unwrap(),
                )
            })
            .collect();
        let meta: HashMap<_, _> = [
            ("backbone".to_owned(), "x".to_owned()),
            ("aggregate".to_owned(), kind.to_owned()),
        ]
        .into();
        let bytes = safetensors::serialize(tensors, Some(meta)).unwrap();
        Head::from_bytes(&bytes, Path::new("h"))
            .err()
            .map(|error| error.to_string())
            .unwrap_or_default()
    };
    assert_eq!(refusal("gem", Some((GEM_P, vec![1]))), "");
    assert_eq!(refusal("vlad", Some((VLAD_WORDS, vec![2, 4]))), "");
    for (kind, extra, part) in [
        ("median", None, "\"median\" is not one of"),
        ("mean", Some((GEM_P, vec![1])), "unexpected tensor gem_p"),
        ("gem", None, "gem_p is missing"),
        (
            "gem",
            Some((GEM_P, vec![2])),
            "gem_p is F32 [2], not a float [1]",
        ),
        ("vlad", Some((VLAD_WORDS, vec![3, 4])), "make 12"),
        (
            "vlad",
            Some((VLAD_WORDS, vec![8])),
            "not a float [any, any]",
        ),
    ] {
        let refusal = refusal(kind, extra);
        assert!(refusal.contains(part), "{kind}: {refusal}");
    }
}

#[test]
fn a_damaged_head_is_refused_with_its_fault() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("h.safetensors");
    head().save(&path).unwrap();
    let bytes = std::fs::read(&path).unwrap();
    let truncated = Head::from_bytes(&bytes[..bytes.len() - 5], &path)
        .unwrap_err()
        .to_string();
    assert!(truncated.contains("truncated"), "{truncated}");
    let values = [0f32; 12];
    let view = || TensorView::new(Dtype::F32, vec![3, 4], bytemuck::cast_slice(&values)).unwrap();
    let meta: HashMap<_, _> = [("backbone".to_owned(), "x".to_owned())].into();
    let wrong =
        safetensors::serialize([("weight", view()), ("bias", view())], Some(meta.clone())).unwrap();
    assert!(
        Head::from_bytes(&wrong, &path)
            .unwrap_err()
            .to_string()
            .contains("weight is F32 [3, 4]")
    );
    let extra = safetensors::serialize([("mu", view())], Some(meta)).unwrap();
    assert!(
        Head::from_bytes(&extra, &path)
            .unwrap_err()
            .to_string()
            .contains("unexpected tensor mu")
    );
    let unbound = safetensors::serialize([("weight", view())], None).unwrap();
    assert!(
        Head::from_bytes(&unbound, &path)
            .unwrap_err()
            .to_string()
            .contains("backbone")
    );
}

#[test]
fn projection_is_affine_then_unit_length() {
    let global = head().project(&[0.25; 8]);
    assert_eq!(global.len(), GLOBAL_DIM);
    assert!((global.iter().map(|v| v * v).sum::<f32>() - 1.0).abs() < 1e-5);
    let head = head();
    let (weight, _) = head.weights();
    let raw: f32 = weight[..8].iter().sum::<f32>() * 0.25 + 0.5;
    let other: f32 = weight[8..16].iter().sum::<f32>() * 0.25 + 0.5;
    assert!((global[0] / global[1] - raw / other).abs() < 1e-4);
}

#[test]
fn a_stored_vector_of_another_length_is_refused() {
    let head = head();
    let pooled = [0.25; 8];
    assert_eq!(head.project_stored(&pooled).unwrap(), head.project(&pooled));
    for len in [0, 7, 9] {
        match head.project_stored(&vec![0.25; len]) {
            Err(ExtractError::WrongPooledLength { expected, actual }) => {
                assert_eq!((expected, actual), (8, len));
            }
            other => panic!("{other:?}"),
        }
    }
}

/// The bytes of a file whose weight and bias these functions of row and column make.
fn file_of(weight: impl Fn(usize, usize) -> f32, bias: impl Fn(usize) -> f32) -> Vec<u8> {
    let weight: Vec<f32> = (0..GLOBAL_DIM * 8).map(|i| weight(i / 8, i % 8)).collect();
    let bias: Vec<f32> = (0..GLOBAL_DIM).map(bias).collect();
    let view = |shape: &[usize], values: &[f32]| {
        let bytes = bytemuck::cast_slice::<f32, u8>(values).to_vec();
        (shape.to_vec(), bytes)
    };
    let parts = [
        ("weight", view(&[GLOBAL_DIM, 8], &weight)),
        ("bias", view(&[GLOBAL_DIM], &bias)),
    ];
    let tensors = parts.iter().map(|(name, (shape, bytes))| {
        (
            *name,
            TensorView::new(Dtype::F32, shape.clone(), bytes).unwrap(),
        )
    });
    let meta: HashMap<_, _> = [("backbone".to_owned(), "x".to_owned())].into();
    safetensors::serialize(tensors, Some(meta)).unwrap()
}

/// Numbers without a pattern, from -1 to 1.
fn some(row: usize, column: usize) -> f32 {
    (((row * 8 + column) * 37) % 101) as f32 / 50.0 - 1.0
}

#[test]
fn a_head_that_cannot_tell_images_apart_is_refused_when_it_is_loaded() {
    let refusal = |file: Vec<u8>| {
        let loaded = Head::from_bytes(&file, Path::new("h.safetensors"));
        loaded
            .err()
            .map(|error| error.to_string())
            .unwrap_or_default()
    };
    assert_eq!(refusal(file_of(some, |_| 0.5)), "");
    assert_eq!(refusal(file_of(|r, c| 1e-6 * some(r, c), |_| 0.0)), "");
    assert_eq!(refusal(file_of(|r, c| 1e6 * some(r, c), |_| 1e3)), "");
    let largest = |r: usize, c: usize| {
        if (r, c) == (255, 7) {
            f32::MAX
        } else {
            some(r, c)
        }
    };
    let zero_row = |r: usize, c: usize| if r == 17 { -0.0 } else { some(r, c) };
    let one_direction = |row: usize, column: usize| some(0, column) * some(row, 3).max(0.1);
    for (file, part) in [
        (file_of(|_, _| 3e38, |_| 0.0), "overflow"),
        (file_of(largest, |_| 0.0), "overflow"),
        (
            file_of(some, |row| if row == 3 { -3e38 } else { 0.0 }),
            "overflow",
        ),
        (file_of(|_, _| f32::NAN, |_| 0.0), "not finite"),
        (file_of(some, |_| f32::INFINITY), "not finite"),
        (file_of(|_, _| 0.0, |_| 0.0), "all zeros"),
        (file_of(|_, _| 0.0, |_| 1.0), "all zeros"),
        (file_of(zero_row, |_| 0.5), "row 17"),
        (file_of(|_, _| 1.0, |_| 0.0), "same global descriptor"),
        (file_of(one_direction, |_| 0.0), "same global descriptor"),
        (
            file_of(|r, c| 1e-9 * some(r, c), |_| 1.0),
            "same global descriptor",
        ),
        (file_of(|_, _| 1e-45, |_| 0.0), "same global descriptor"),
    ] {
        let refusal = refusal(file);
        assert!(refusal.contains(part), "{part}: {refusal}");
    }
}

#[test]
fn visual_words_far_from_every_token_are_refused() {
    for length in [1e3, 3e38] {
        let error = VladWords::new(vec![0.0, 0.5, length, 0.0], 2).unwrap_err();
        assert!(error.contains("long"), "{error}");
    }
    VladWords::new(vec![0.0, 0.5, 1.0, 0.0], 2).unwrap();
}

#[test]
fn a_name_that_occurs_twice_in_the_header_is_refused() {
    let file = file_of(some, |_| 0.5);
    let length = u64::from_le_bytes(file[..8].try_into().unwrap()) as usize;
    let header = std::str::from_utf8(&file[8..8 + length]).unwrap();
    let twice = header.replace("\"backbone\":", "\"backbone\":\"y\",\"backbone\":");
    assert_ne!(twice, header);
    let mut forged = (twice.len() as u64).to_le_bytes().to_vec();
    forged.extend_from_slice(twice.as_bytes());
    forged.extend_from_slice(&file[8 + length..]);
    let error = Head::from_bytes(&forged, Path::new("h"))
        .unwrap_err()
        .to_string();
    assert!(error.contains("occurs twice"), "{error}");
}
