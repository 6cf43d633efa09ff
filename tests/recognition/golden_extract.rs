//! Extraction against stored outputs of the reference implementation, intermediate by intermediate.
//!
//! Tolerances: given `pixels`, tokens within 1e-3 (typically 3e-5), attention within 1e-5 of a
//! probability, cosine of every descriptor at least 0.99999, key patches identical but for swaps
//! between near-equal attentions. From the picture file, pixels within 0.02 and the global
//! descriptor's cosine at least 0.9999.

use crate::common::program::has_model;
use placeformer_core::types::{ImageSize, ImageTensor};
use placeformer_models::model_path;
use placeformer_vision::extract::{
    CandleEncoder, ExtractConfig, ExtractError, ExtractionTrace, Extractor, HeadChoice, Precision,
    Preset, TraceArray, TraceValues, VitWeights,
};
use placeformer_vision::image::{ImageConfig, load_tensor};
use safetensors::SafeTensors;
use std::collections::BTreeMap;
use std::sync::OnceLock;

const TOKENS: f32 = 1e-3;
const ATTENTION: f32 = 1e-5;
const POSITIONS: f32 = 2e-5;
const COSINE: f32 = 0.99999;
const SIZES: [(u32, u32); 3] = [(224, 224), (448, 336), (644, 476)];

/// The weights, or `None` where the environment says to do without.
fn weights() -> Option<&'static VitWeights> {
    static WEIGHTS: OnceLock<Option<VitWeights>> = OnceLock::new();
    let load = || {
        has_model().then(|| {
            let path = model_path(Preset::Dinov2Vits14).unwrap();
            VitWeights::load(&path, Preset::Dinov2Vits14, None).unwrap()
        })
    };
    WEIGHTS.get_or_init(load).as_ref()
}

fn extractor(size: (u32, u32), exit_block: usize, token_norm: bool) -> Option<Extractor> {
    extractor_at(Precision::F32, size, exit_block, token_norm)
}

fn extractor_at(
    precision: Precision,
    size: (u32, u32),
    exit_block: usize,
    token_norm: bool,
) -> Option<Extractor> {
    let config = ExtractConfig {
        precision,
        input_size: Some(ImageSize {
            width: size.0,
            height: size.1,
        }),
        exit_block: Some(exit_block),
        token_norm: Some(token_norm),
        ..ExtractConfig::default()
    };
    weights().map(|weights| Extractor::from_weights(&config, weights, &HeadChoice::None).unwrap())
}

/// One golden file's arrays by name.
struct Golden {
    floats: BTreeMap<String, Vec<f32>>,
    integers: BTreeMap<String, Vec<i64>>,
}

impl Golden {
    fn load(image: &str, size: (u32, u32)) -> Self {
        let path = format!("tests/golden/{image}_{}x{}.safetensors", size.0, size.1);
        let bytes = std::fs::read(&path).unwrap_or_else(|e| panic!("{path}: {e}"));
        let file = SafeTensors::deserialize(&bytes).unwrap();
        let mut golden = Self {
            floats: BTreeMap::new(),
            integers: BTreeMap::new(),
        };
        for (name, view) in file.iter() {
            let data = view.data();
            if view.dtype() == safetensors::Dtype::I64 {
                let values = data
                    .chunks_exact(8)
                    .map(|b| i64::from_le_bytes(b.try_into().unwrap()));
                golden.integers.insert(name.to_owned(), values.collect());
            } else {
                let values = data
                    .chunks_exact(4)
                    .map(|b| f32::from_le_bytes(b.try_into().unwrap()));
                golden.floats.insert(name.to_owned(), values.collect());
            }
        }
        golden
    }

    fn tensor(&self, size: (u32, u32)) -> ImageTensor {
        ImageTensor {
            size: ImageSize {
                width: size.0,
                height: size.1,
            },
            data: self.floats["pixels"].clone(),
        }
    }
}

/// Compares one trace with a golden file by array name; prints and checks the largest deviation of
/// each.
struct Comparison<'a> {
    golden: &'a Golden,
    label: String,
    compared: usize,
}

impl Comparison<'_> {
    fn report(&mut self, name: &str, what: &str, value: f32, right: bool) {
        println!("{:28} {name:32} {what:10} {value:.3e}", self.label);
        assert!(right, "{}: {name}: {what} {value:e}", self.label);
        self.compared += 1;
    }

    fn check(&mut self, array: &TraceArray) {
        let TraceValues::F32(values) = &array.values else {
            return;
        };
        let golden = self.golden;
        let name = array.name.as_str();
        if name.contains("_key") {
            return;
        }
        let Some(expected) = golden.floats.get(name) else {
            return;
        };
        let width = *array.shape.last().unwrap();
        let picked: Vec<f32> = match name.ends_with("_rows") {
            true => golden.integers["rows"]
                .iter()
                .flat_map(|&r| values[r as usize * width..][..width].to_vec())
                .collect(),
            false => values.clone(),
        };
        let worst = largest_difference(&picked, expected);
        match name {
            "pixels" => self.report(name, "max |d|", worst, worst == 0.0),
            "positions_rows" => self.report(name, "max |d|", worst, worst <= POSITIONS),
            _ if name.starts_with("cls_attention") => {
                self.report(name, "max |d|", worst, worst <= ATTENTION)
            }
            _ if name.starts_with("global") => {
                let away = 1.0 - cosine(&picked, expected);
                self.report(name, "1 - cos", away, away <= 1.0 - COSINE)
            }
            _ => self.report(name, "max |d|", worst, worst <= TOKENS),
        }
    }

    fn check_keys(&mut self, trace: &ExtractionTrace, tag: &str) {
        for (scale, keys) in (1..).zip(&trace.key_patches.scales) {
            let base = format!("{tag}_key{scale}");
            let expected_index = &self.golden.integers[&format!("{base}_index")];
            let expected_attention = &self.golden.floats[&format!("{base}_attention")];
            let centres = &self.golden.floats[&format!("{base}_centre_xy")];
            assert_eq!(
                keys.index.len(),
                expected_index.len(),
                "{}: {base}: count",
                self.label
            );
            // Attention here is in multiples of heads/n, so the tolerance on probabilities grows by
            // n/heads each head.
            let multiple = trace.encoded.grid.len() as f32;
            let mut swaps = 0;
            for (i, (&index, &expected)) in keys.index.iter().zip(expected_index).enumerate() {
                let gap = (keys.attention[i] - expected_attention[i]).abs();
                assert!(
                    gap <= ATTENTION * multiple,
                    "{}: {base}: attention {i} is off by {gap:e}",
                    self.label
                );
                swaps += usize::from(index as i64 != expected);
            }
            let mut all: Vec<_> = keys.index.iter().map(|&i| i as i64).collect();
            let mut all_expected = expected_index.clone();
            all.sort_unstable();
            all_expected.sort_unstable();
            assert_eq!(
                all, all_expected,
                "{}: {base}: not the same set of patches",
                self.label
            );
            self.report(
                &format!("{base}_index"),
                "swaps",
                swaps as f32,
                swaps <= keys.index.len() / 20,
            );
            let worst = largest_difference(&keys.attention, expected_attention);
            self.report(
                &format!("{base}_attention"),
                "max |d|",
                worst,
                worst <= ATTENTION * multiple,
            );
            self.check_places(trace, scale, expected_index, centres, &base);
            self.check_descriptors(trace, scale, expected_index, &base);
        }
    }

    fn check_places(
        &mut self,
        trace: &ExtractionTrace,
        scale: usize,
        index: &[i64],
        centres: &[f32],
        base: &str,
    ) {
        let grid = trace.key_patches.grid;
        let ours: Vec<f32> = index
            .iter()
            .flat_map(|&i| grid.centre(scale, i as usize))
            .collect();
        let worst = largest_difference(&ours, centres);
        self.report(&format!("{base}_centre_xy"), "max |d|", worst, worst == 0.0);
    }

    fn check_descriptors(
        &mut self,
        trace: &ExtractionTrace,
        scale: usize,
        index: &[i64],
        base: &str,
    ) {
        let full = format!("{base}_descriptor");
        let first = format!("{base}_descriptor_first32");
        let Some((name, expected)) = [full, first]
            .into_iter()
            .find_map(|n| Some((n.clone(), self.golden.floats.get(&n)?)))
        else {
            return;
        };
        let (keys, dim) = (&trace.key_patches.scales[scale - 1], trace.key_patches.dim);
        let mut lowest = 1f32;
        for (expected, &i) in expected.chunks_exact(dim).zip(index) {
            let row = keys.index.iter().position(|&own| own as i64 == i).unwrap();
            lowest = lowest.min(cosine(&keys.descriptors[row * dim..][..dim], expected));
        }
        self.report(&name, "1 - cos", 1.0 - lowest, lowest >= COSINE);
    }
}

fn largest_difference(a: &[f32], b: &[f32]) -> f32 {
    assert_eq!(a.len(), b.len());
    a.iter()
        .zip(b)
        .map(|(a, b)| (a - b).abs())
        .fold(0.0, f32::max)
}

fn cosine(a: &[f32], b: &[f32]) -> f32 {
    let dot = |a: &[f32], b: &[f32]| {
        a.iter()
            .zip(b)
            .map(|(&a, &b)| a as f64 * b as f64)
            .sum::<f64>()
    };
    (dot(a, b) / (dot(a, a) * dot(b, b)).sqrt()) as f32
}

/// Runs `street_a`'s golden pixels through one exit and compares everything that exit yields.
fn compare_exit(exit_block: usize, token_norm: bool, tag: Option<&str>, least: usize) {
    for size in SIZES {
        let (Some(weights), Some(fused)) = (weights(), extractor(size, exit_block, token_norm))
        else {
            return;
        };
        let golden = Golden::load("street_a", size);
        let fused_trace = fused.trace(&golden.tensor(size)).unwrap();
        // The plain implementation is what the fused one is tested against elsewhere, so it is held
        // to the same.
        let plain = CandleEncoder::new(weights, &fused_trace.spec).unwrap();
        let plain_trace = fused
            .with_encoder(Box::new(plain))
            .unwrap()
            .trace(&golden.tensor(size))
            .unwrap();
        for (encoder, trace) in [("fused", fused_trace), ("plain", plain_trace)] {
            let norm = if token_norm { " normed" } else { "" };
            let label = format!("{encoder} {}x{} exit {exit_block}{norm}", size.0, size.1);
            let mut comparison = Comparison {
                golden: &golden,
                label,
                compared: 0,
            };
            trace
                .arrays()
                .iter()
                .for_each(|array| comparison.check(array));
            if let Some(tag) = tag {
                comparison.check_keys(&trace, tag);
            }
            assert!(
                comparison.compared >= least,
                "only {} arrays were compared",
                comparison.compared
            );
        }
    }
}

#[test]
fn the_default_exit_equals_the_reference() {
    compare_exit(8, false, Some("exit8"), 5 + 12);
}

#[test]
fn the_last_block_before_the_final_norm_equals_the_reference() {
    compare_exit(11, false, None, 4);
}

#[test]
fn the_paper_path_equals_the_reference() {
    compare_exit(11, true, Some("last"), 5 + 12);
}

#[test]
fn attention_of_a_later_block_goes_with_tokens_of_an_earlier_one() {
    let Some(weights) = weights() else { return };
    let (size, image_size) = (
        (224, 224),
        ImageSize {
            width: 224,
            height: 224,
        },
    );
    let config = ExtractConfig {
        input_size: Some(image_size),
        attention_block: Some(11),
        precision: Precision::F32,
        ..ExtractConfig::default()
    };
    let extractor = Extractor::from_weights(&config, weights, &HeadChoice::None).unwrap();
    let golden = Golden::load("street_a", size);
    let trace = extractor.trace(&golden.tensor(size)).unwrap();
    let mut comparison = Comparison {
        golden: &golden,
        label: "224x224 8 + attention 11".into(),
        compared: 0,
    };
    trace
        .arrays()
        .iter()
        .for_each(|array| comparison.check(array));
    assert!(golden.floats.contains_key("cls_attention_last_heads") && comparison.compared >= 5);
    assert!(
        extractor.model_id().as_str().contains(":a11:"),
        "{}",
        extractor.model_id()
    );
}

#[test]
fn a_batch_gives_bit_for_bit_what_single_images_give() {
    let size = (224, 224);
    let Some(extractor) = extractor(size, 8, false) else {
        return;
    };
    let image = Golden::load("street_a", size).tensor(size);
    let mut other = image.clone();
    other.data.iter_mut().for_each(|value| *value = -*value);
    let batch = [image, other];
    let together = extractor.extract(&batch).unwrap();
    let alone: Vec<_> = batch
        .iter()
        .map(|image| {
            extractor
                .extract(std::slice::from_ref(image))
                .unwrap()
                .remove(0)
        })
        .collect();
    assert_eq!(together, alone);
    assert_ne!(alone[0].pooled, alone[1].pooled);
}

/// What reduced precision costs, stage by stage, where this CPU has it.
#[test]
fn reduced_precision_stays_close_to_the_reference() {
    let Some(weights) = weights() else { return };
    let bounds = [
        (Precision::Bf16, 0.9995, 0.95),
        (Precision::Mixed, 0.999, 0.96),
        (Precision::Int8, 0.995, 0.95),
    ];
    for (precision, least, least_common) in bounds {
        for size in SIZES {
            let input_size = Some(ImageSize {
                width: size.0,
                height: size.1,
            });
            let config = ExtractConfig {
                precision,
                input_size,
                ..ExtractConfig::default()
            };
            match Extractor::from_weights(&config, weights, &HeadChoice::None) {
                Ok(extractor) => compare_reduced(&extractor, size, least, least_common),
                Err(error @ ExtractError::Precision { .. }) => println!("left out here: {error}"),
                Err(error) => panic!("{error}"),
            }
        }
    }
}

/// The lowest cosine to the reference of any token, of the global descriptor and of any key patch
/// both sides have, and the share of key patches both sides have.
fn compare_reduced(extractor: &Extractor, size: (u32, u32), least: f32, least_common: f32) {
    let golden = Golden::load("street_a", size);
    let trace = extractor.trace(&golden.tensor(size)).unwrap();
    let arrays = trace.arrays();
    let tokens = arrays
        .iter()
        .find(|array| array.name == "block8_tokens_rows")
        .unwrap();
    let TraceValues::F32(tokens) = &tokens.values else {
        panic!("tokens are f32")
    };
    let expected = golden.floats["block8_tokens_rows"].chunks_exact(384);
    let rows = golden.integers["rows"]
        .iter()
        .map(|&row| &tokens[row as usize * 384..][..384]);
    let token = rows
        .zip(expected)
        .map(|(a, b)| cosine(a, b))
        .fold(1.0, f32::min);
    let global = cosine(&trace.global, &golden.floats["global_mean_block8_l2"]);
    let (mut patch, mut common, mut of) = (1.0f32, 0, 0);
    for (scale, keys) in (1..).zip(&trace.key_patches.scales) {
        let index = &golden.integers[&format!("exit8_key{scale}_index")];
        of += index.len();
        for (at, expected) in index.iter().enumerate() {
            let Some(own) = keys
                .index
                .iter()
                .position(|&own| i64::from(own) == *expected)
            else {
                continue;
            };
            common += 1;
            // All of them are stored, or the first 32.
            let base = format!("exit8_key{scale}_descriptor");
            let stored = golden
                .floats
                .get(&base)
                .unwrap_or_else(|| &golden.floats[&format!("{base}_first32")]);
            if let Some(expected) = stored.chunks_exact(384).nth(at) {
                patch = patch.min(cosine(&keys.descriptors[own * 384..][..384], expected));
            }
        }
    }
    let shared = common as f32 / of as f32;
    let name = extractor.encoder_name();
    println!(
        "{name} {size:?}: lowest cosine of tokens {token:.6}, global {global:.6}, key patches {patch:.6}; shared {shared:.3}"
    );
    assert!(
        token >= least && global >= least && patch >= least,
        "{name} {size:?}: {token} {global} {patch}"
    );
    assert!(
        shared >= least_common,
        "{name} {size:?}: only {shared} of the key patches are the reference's"
    );
}

#[test]
fn pictures_come_close_to_the_reference_from_their_files() {
    // The default path, and the paper's.
    for (exit_block, token_norm, tag, global) in [
        (8, false, "exit8", "global_mean_block8_l2"),
        (11, true, "last", "global_mean_last_normed_l2"),
    ] {
        for size in SIZES {
            let Some(extractor) = extractor(size, exit_block, token_norm) else {
                return;
            };
            for name in ["street_a", "street_a_dusk", "street_b"] {
                let golden = Golden::load(name, size);
                let bytes = std::fs::read(format!("tests/golden/{name}.png")).unwrap();
                let image =
                    load_tensor(&bytes, &ImageConfig::default(), extractor.input_size()).unwrap();
                if let Some(expected) = golden.floats.get("pixels") {
                    let worst = largest_difference(&image.data, expected);
                    println!("{name} {size:?} pixels max |d| {worst:.3e}");
                    assert!(worst <= 0.02, "{name} {size:?}: pixels are off by {worst}");
                }
                let trace = extractor.trace(&image).unwrap();
                let similarity = cosine(&trace.global, &golden.floats[global]);
                println!(
                    "{name} {size:?} {tag} global 1 - cos {:.3e}",
                    1.0 - similarity
                );
                assert!(
                    similarity >= 0.9999,
                    "{name} {size:?} {tag}: cosine {similarity}"
                );
                compare_keys_from_file(&trace, &golden, tag, &format!("{name} {size:?}"));
            }
        }
    }
}

/// Key patches of a picture whose pixels differ from the reference's by up to one step of its
/// samples: nearly the same patches, with nearly the same attention and descriptors.
fn compare_keys_from_file(trace: &ExtractionTrace, golden: &Golden, tag: &str, what: &str) {
    let dim = trace.key_patches.dim;
    for (scale, keys) in (1..).zip(&trace.key_patches.scales) {
        let base = format!("{tag}_key{scale}");
        let (index, attention) = (
            &golden.integers[&format!("{base}_index")],
            &golden.floats[&format!("{base}_attention")],
        );
        let descriptors = golden.floats.get(&format!("{base}_descriptor"));
        let (mut common, mut off, mut worst, mut lowest) = (0, 0f32, 0f32, 1f32);
        for (at, (&expected, &level)) in index.iter().zip(attention).enumerate() {
            let Some(own) = keys
                .index
                .iter()
                .position(|&own| i64::from(own) == expected)
            else {
                continue;
            };
            common += 1;
            let deviation = (keys.attention[own] - level).abs() / level;
            (off, worst) = (off + deviation, worst.max(deviation));
            if let Some(descriptors) = descriptors {
                let (own, expected) = (
                    &keys.descriptors[own * dim..][..dim],
                    &descriptors[at * dim..][..dim],
                );
                lowest = lowest.min(cosine(own, expected));
            }
        }
        let mean = off / common as f32;
        println!(
            "{what} {base}: {common} of {}, attention {mean:.2e} (at most {worst:.2e}), descriptors {lowest:.6}",
            index.len()
        );
        assert!(
            common * 10 >= index.len() * 9,
            "{what} {base}: {common} of {}",
            index.len()
        );
        // Where attention peaks, one step of a sample sways it by some percent; on the whole it
        // must not.
        assert!(
            mean <= 0.02 && worst <= 0.2,
            "{what} {base}: attention is off by {mean} of itself, at most {worst}"
        );
        assert!(
            lowest >= 0.999,
            "{what} {base}: a descriptor has cosine {lowest}"
        );
    }
}

#[test]
fn broken_input_is_refused() {
    let size = (224, 224);
    let Some(extractor) = extractor(size, 8, false) else {
        return;
    };
    let image = Golden::load("street_a", size).tensor(size);
    let refused = |image: ImageTensor| extractor.extract(&[image]).unwrap_err().to_string();
    let wrong_size = ImageTensor {
        size: ImageSize {
            width: 448,
            height: 112,
        },
        ..image.clone()
    };
    assert!(refused(wrong_size).contains("448x112"));
    assert!(
        refused(ImageTensor {
            data: vec![0.0; 7],
            ..image.clone()
        })
        .contains("holds 7")
    );
    let mut poisoned = image;
    poisoned.data[1000] = f32::NAN;
    assert!(refused(poisoned).contains("not finite"));
}
