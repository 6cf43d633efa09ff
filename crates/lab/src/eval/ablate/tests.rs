//! The cuts by hand, the axes, and the whole table on a made-up model.

use super::cuts::{coarsen, limit};
use super::variants::{ALL_PATCHES, SIZE_ROWS};
use super::*;
use crate::datasets::Item;
use half::f16;
use placeformer_core::progress::{Silent, Step};
use placeformer_core::types::{
    ContentHash, Descriptor, ImageSize, ImageTensor, KeyPatches, ModelId, PackedPatches, PatchGrid,
    PoolingStride, SCALES, ScaleKeyPatches,
};
use placeformer_vision::extract::{HeadChoice, Preset};
use placeformer_vision::rerank::RerankConfig;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Mutex;

/// The last state of every task.
#[derive(Default)]
struct Totals(Mutex<BTreeMap<String, (u64, Option<u64>)>>);

impl Progress for Totals {
    fn update(&self, step: Step<'_>) {
        let state = (step.done, step.total);
        self.0.lock().unwrap().insert(step.task.to_owned(), state);
    }

    fn end(&self, _task: &str) {}
}

fn patches() -> PackedPatches {
    PackedPatches {
        grid: PatchGrid {
            columns: 8,
            rows: 6,
            patch_px: 14,
            stride: PoolingStride::Kernel,
        },
        dim: 2,
        counts: [3, 2, 1],
        index: vec![9, 4, 7, 1, 0, 2],
        attention: [3.0, 2.0, 1.0, 1.5, 0.5, 0.2].map(f16::from_f32).to_vec(),
        factor: vec![0.1, 0.2, 0.3, 0.4, 0.5, 0.6],
        codes: vec![127, 1, 64, -127, 5, 127, 127, 0, -127, 9, 127, 11],
    }
}

#[test]
fn limits_cut_each_scale_for_itself() {
    let cut = limit(&patches(), 1.0, [400, 1, 50]);
    assert_eq!(
        (cut.counts, cut.index.as_slice()),
        ([2, 1, 0], &[9, 4, 1][..])
    );
    assert_eq!(cut.codes, [127, 1, 64, -127, 127, 0]);
    assert_eq!(cut.factor, [0.1, 0.2, 0.4]);
    assert_eq!(limit(&patches(), 0.0, [usize::MAX; SCALES]), patches());
}

#[test]
fn coarse_codes_stay_within_half_a_step() {
    assert_eq!(coarsen(&patches(), 8), patches());
    let fine = patches();
    let coarse = coarsen(&patches(), 4);
    for (row, (a, b)) in fine.codes.chunks(2).zip(coarse.codes.chunks(2)).enumerate() {
        assert!(b.iter().all(|code| code.abs() <= 7));
        for (a, b) in a.iter().zip(b) {
            let a = f32::from(*a) * fine.factor[row];
            let b = f32::from(*b) * coarse.factor[row];
            assert!((a - b).abs() <= coarse.factor[row] / 2.0 + 1e-5, "{a} {b}");
        }
    }
}

#[test]
fn each_axis_has_its_base_row_and_extractions_are_shared() {
    let extract = ExtractConfig::default();
    let rerank = RerankConfig::default();
    let base = Base {
        extract: &extract,
        rerank: &rerank,
        candidates: 100,
        backbones: &[Preset::Dinov2Vits14],
        cache: Path::new("."),
        memory_bytes: 0,
        radius_m: 25.0,
    };
    let variants = variants(&base).unwrap();
    for axis in [
        "scales",
        "score",
        "codec",
        "tau",
        "caps",
        "input size",
        "exit block",
        "backbone",
    ] {
        let stars = variants
            .iter()
            .filter(|v| v.axis == axis && v.setting.ends_with('*'))
            .count();
        assert_eq!(stars, 1, "{axis}");
    }
    let extractions = variants.chunk_by(|a, b| a.extract == b.extract).count();
    assert_eq!(extractions, 1 + 1 + SIZE_ROWS.len() + 6 + 1);
    assert!(variants.iter().all(|v| v.extract.encoder_spec().is_ok()));
}

#[test]
fn components_keep_what_varies_most() {
    // Three dimensions vary, the first two much: two components lose almost nothing.
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let rows: Vec<[f32; 3]> = (0..200)
        .map(|_| {
            [
                rng.random_range(-1.0..1.0),
                rng.random_range(-1.0..1.0),
                0.3 + rng.random_range(-0.001..0.001),
            ]
        })
        .collect();
    let components = Components::of(rows.as_flattened(), 3, 2);
    let packed = PackedPatches {
        dim: 3,
        codes: vec![127, 0, 38, 0, -127, 38],
        factor: vec![0.01; 2],
        ..patches()
    };
    let short = apply(&packed, Cut::Codec(Codec::Components(2)), Some(&components)).unwrap();
    let vectors: Vec<Vec<f32>> = unpack(&short).collect();
    assert_eq!((short.dim, vectors.len()), (2, 2));
    let dot: f32 = vectors[0].iter().zip(&vectors[1]).map(|(a, b)| a * b).sum();
    assert!(
        dot.abs() < 0.1,
        "the two were perpendicular but for what never varies: {vectors:?}"
    );
    assert!(
        vectors
            .iter()
            .all(|v| (v.iter().map(|x| x * x).sum::<f32>() - 1.0).abs() < 0.02),
        "{vectors:?}"
    );
    assert!(apply(&packed, Cut::Codec(Codec::Components(2)), None).is_err());
}

/// A model whose patches follow from the first byte of an image; it keeps tau and caps as the real
/// one does.
struct Fake {
    model: ModelId,
    config: ExtractConfig,
}

const FAKE_DIM: usize = 16;
const FAKE_GRID: PatchGrid = PatchGrid {
    columns: 12,
    rows: 8,
    patch_px: 14,
    stride: PoolingStride::Kernel,
};

impl Describe for Fake {
    fn model(&self) -> &ModelId {
        &self.model
    }

    fn computed_by(&self) -> String {
        "a fake".into()
    }

    fn fingerprint(&self) -> Result<ContentHash, EvalError> {
        Ok(ContentHash::of(b"a fake"))
    }

    fn tensor(&self, bytes: &[u8]) -> Result<ImageTensor, String> {
        let size = ImageSize {
            width: 1,
            height: 1,
        };
        bytes
            .first()
            .map(|&byte| ImageTensor {
                size,
                data: vec![f32::from(byte)],
            })
            .ok_or_else(|| "empty".into())
    }

    fn describe(&self, images: &[ImageTensor]) -> Result<Vec<Descriptor>, EvalError> {
        Ok(images
            .iter()
            .map(|image| self.one(image.data[0] as u64))
            .collect())
    }

    fn key_patches(&self, image: &ImageTensor) -> Result<KeyPatches, EvalError> {
        let packed = self.one(image.data[0] as u64).patches;
        let mut vectors = unpack(&packed);
        let scale = |scale: usize| {
            let rows = packed.rows(scale);
            ScaleKeyPatches {
                index: packed.index[rows.clone()]
                    .iter()
                    .map(|&index| u32::from(index))
                    .collect(),
                attention: packed.attention[rows.clone()]
                    .iter()
                    .map(|attention| attention.to_f32())
                    .collect(),
                descriptors: vectors.by_ref().take(rows.len()).flatten().collect(),
            }
        };
        let scales = [1, 2, 3].map(scale);
        Ok(KeyPatches {
            grid: packed.grid,
            dim: packed.dim,
            scales,
        })
    }
}

impl Fake {
    /// Two images of one place have the same tens digit; their patches differ by a little noise.
    fn one(&self, image: u64) -> Descriptor {
        let mut place = ChaCha8Rng::seed_from_u64(image / 10);
        let mut noise = ChaCha8Rng::seed_from_u64(1000 + image);
        let counts = [60usize, 12, 4];
        let mut all = PackedPatches {
            grid: FAKE_GRID,
            dim: FAKE_DIM,
            counts,
            index: Vec::new(),
            attention: Vec::new(),
            factor: vec![0.01; 76],
            codes: Vec::new(),
        };
        for count in counts {
            all.index.extend((0..count as u16).rev());
            // Falling, from above the highest tau to below the lowest but one.
            all.attention.extend(
                (0..count).map(|rank| f16::from_f32(2.5 - 2.4 * rank as f32 / count as f32)),
            );
            for _ in 0..count * FAKE_DIM {
                all.codes
                    .push((place.random_range(-90..=90i16) + noise.random_range(-9..=9)) as i8);
            }
        }
        let pooled: Vec<f32> = (0..8).map(|_| place.random_range(-1.0f32..1.0)).collect();
        let patches = limit(&all, self.config.tau, self.config.caps);
        Descriptor {
            global: pooled.clone(),
            pooled,
            patches,
        }
    }
}

fn open(config: &ExtractConfig) -> Result<Box<dyn Describe>, EvalError> {
    // As in the real model, everything that changes a descriptor is in its identity.
    Ok(Box::new(Fake {
        model: ModelId::new(format!("{config:?}")),
        config: config.clone(),
    }))
}

fn bare(config: &ExtractConfig) -> ExtractConfig {
    ExtractConfig {
        head: HeadChoice::None,
        ..config.effective().unwrap()
    }
}

#[test]
fn a_cut_from_one_extraction_is_what_a_separate_one_gives() {
    let folder = tempfile::tempdir().unwrap();
    let items = |numbers: &[u8]| -> Vec<Item> {
        let item = |number: &u8| {
            let path = folder.path().join(number.to_string());
            std::fs::write(&path, [*number]).unwrap();
            Item::new(number.to_string(), path)
        };
        numbers.iter().map(item).collect()
    };
    let dataset = Dataset {
        name: "fake".into(),
        database: items(&[10, 20, 30]),
        queries: items(&[15, 25]),
        truth: vec![Truth::Positives(vec![0]), Truth::Positives(vec![1])],
        skipped: vec![],
        notes: vec![],
    };
    let extract = ExtractConfig::default();
    let rerank = RerankConfig::default();
    let cache = folder.path().join("cache");
    let backbones = &[Preset::Dinov2Vits14];
    let base = Base {
        extract: &extract,
        rerank: &rerank,
        candidates: 2,
        backbones,
        cache: &cache,
        memory_bytes: 1 << 20,
        radius_m: 25.0,
    };
    let totals = Totals::default();
    let Ablation { rows, left_out } = ablate(&dataset, &base, &open, &totals).unwrap();
    assert!(left_out.is_empty(), "{left_out:?}");
    let totals = totals.0.into_inner().unwrap();
    let expected = (rows.len() as u64, Some(rows.len() as u64));
    assert_eq!(
        (totals["settings"], totals["images"]),
        (expected, (5, Some(5)))
    );
    let hidden = &Silent;
    let row = |axis: &str, setting: &str| {
        rows.iter()
            .find(|row| row.axis == axis && row.setting == setting)
            .unwrap()
    };
    assert!(row("tau", "1.5").patch_bytes < row("tau", "1 *").patch_bytes);
    assert!(
        row("caps", "50 / 25 / 6").patch_bytes < row("caps", "200 / 100 / 25").patch_bytes + 1.0
    );
    let few = ExtractConfig {
        caps: [9, 3, 1],
        tau: 0.5,
        ..extract.clone()
    };
    let few_base = Base {
        extract: &few,
        ..base
    };
    let few_rows = variants(&few_base)
        .unwrap()
        .into_iter()
        .filter(|v| v.axis == "caps" || v.axis == "tau");
    let prepared = Prepared::new(
        &dataset,
        &few_base,
        &ExtractConfig {
            tau: 0.0,
            caps: ALL_PATCHES,
            ..bare(&few)
        },
        &open,
        hidden,
    );
    let prepared = prepared.unwrap();
    for variant in few_rows {
        let Cut::Limits { tau, caps } = variant.cut else {
            panic!("{}", variant.setting)
        };
        let cut = prepared.row(&dataset, &variant, hidden).unwrap().unwrap();
        let config = ExtractConfig {
            tau,
            caps: caps.map(|cap| cap.min(1 << 16)),
            ..bare(&few)
        };
        let own = Prepared::new(&dataset, &few_base, &config, &open, hidden).unwrap();
        let own = own
            .row(
                &dataset,
                &Variant {
                    cut: Cut::None,
                    ..variant
                },
                hidden,
            )
            .unwrap()
            .unwrap();
        assert_eq!(
            (&cut.recall, cut.patch_bytes),
            (&own.recall, own.patch_bytes),
            "{}",
            cut.setting
        );
    }
    // A codec of fewer bits or components is smaller; the base is the same on every axis.
    assert!(row("codec", "int4 simulated").patch_bytes < row("codec", "int8 *").patch_bytes);
    // Full precision recalls as much here, and is left out where it would not fit.
    let full = row("codec", "f32");
    let int8 = row("codec", "int8 *");
    assert_eq!(full.recall, int8.recall);
    assert!(full.patch_bytes > 2.0 * int8.patch_bytes);
    let small = ablate(
        &dataset,
        &Base {
            memory_bytes: 5000,
            ..base
        },
        &open,
        hidden,
    )
    .unwrap();
    assert_eq!(small.rows.len() + 1, rows.len());
    assert!(!small.rows.iter().any(|row| row.setting == "f32"));
    assert_eq!(
        small.left_out,
        ["codec f32: its descriptors need more memory than is allowed"]
    );
    let starred: Vec<_> = rows
        .iter()
        .filter(|row| row.setting.ends_with('*'))
        .collect();
    assert_eq!(starred.len(), 8);
    assert!(starred.iter().all(|row| row.recall == starred[0].recall && row.patch_bytes == starred[0].patch_bytes));
}

#[test]
fn a_base_that_is_no_row_of_its_axis_gets_one() {
    let extract = ExtractConfig {
        input_size: Some(ImageSize {
            width: 84,
            height: 84,
        }),
        exit_block: Some(3),
        tau: 0.75,
        caps: [9, 8, 7],
        ..Default::default()
    };
    let rerank = RerankConfig {
        scales: vec!["1+3".parse().unwrap(), "2".parse().unwrap()],
        ..Default::default()
    };
    let base = Base {
        extract: &extract,
        rerank: &rerank,
        candidates: 100,
        backbones: &[Preset::Dinov2Vits14],
        cache: Path::new("."),
        memory_bytes: 0,
        radius_m: 25.0,
    };
    let stars: Vec<String> = variants(&base)
        .unwrap()
        .into_iter()
        .filter(|v| v.setting.ends_with('*'))
        .map(|v| v.setting)
        .collect();
    assert_eq!(
        stars,
        [
            "1+3, 2 *",
            "paper *",
            "int8 *",
            "0.75 *",
            "9 / 8 / 7 *",
            "84x84 *",
            "3 *",
            "dinov2-vits14 *"
        ]
    );
}
