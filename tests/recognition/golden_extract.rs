//! Extraction against stored outputs of the reference implementation, intermediate by intermediate.
//!
//! Tolerances: given `pixels`, tokens within 1e-3 (typically 3e-5), attention within 1e-5 of a
//! probability, cosine of every descriptor at least 0.99999, key patches identical but for swaps
//! between near-equal attentions. From the picture file, pixels within 0.02 and the global
//! descriptor's cosine at least 0.9999.

use crate::common::program::has_model;
use crate::golden::{Comparison, Golden, cosine, largest_difference, stored};
use placeformer_core::types::{ImageSize, ImageTensor, ScaleKeyPatches};
use placeformer_models::model_path;
use placeformer_vision::extract::{
    CandleEncoder, ExtractConfig, ExtractError, ExtractionTrace, Extractor, HeadChoice, Precision,
    Preset, TraceValues, VitWeights,
};
use placeformer_vision::image::{ImageConfig, load_tensor};
use std::sync::OnceLock;

const SIZES: [(u32, u32); 3] = [(224, 224), (448, 336), (644, 476)];

/// The default model's weights, or `None` in a run that does without them.
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

/// Runs `street_a`'s golden pixels through one exit and compares everything that exit yields.
fn compare_exit(exit_block: usize, token_norm: bool, tag: Option<&str>, least: usize) {
    for size in SIZES {
        let (Some(weights), Some(fused)) = (weights(), extractor(size, exit_block, token_norm))
        else {
            return;
        };
        let golden = Golden::load("street_a", size);
        let fused_trace = fused.trace(&golden.tensor(size)).unwrap();
        // Other tests compare the fused implementation with the plain one, so the plain one must
        // keep to the same tolerances.
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
    let size = (224, 224);
    let config = ExtractConfig {
        input_size: Some(ImageSize {
            width: 224,
            height: 224,
        }),
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

/// Checks the lowest cosine to the reference of any token, of the global descriptor and of any key
/// patch that both sides have, and the share of key patches that both sides have.
fn compare_reduced(extractor: &Extractor, size: (u32, u32), least: f32, least_shared: f32) {
    let golden = Golden::load("street_a", size);
    let trace = extractor.trace(&golden.tensor(size)).unwrap();
    let token = lowest_token_cosine(&trace, &golden);
    let global = cosine(&trace.global, &golden.floats["global_mean_block8_l2"]);
    let mut patch = 1.0f32;
    let mut shared = 0;
    let mut expected = 0;
    for (scale, keys) in (1..).zip(&trace.key_patches.scales) {
        let index = &golden.integers[&format!("exit8_key{scale}_index")];
        // All descriptors are stored, or the first 32.
        let base = format!("exit8_key{scale}_descriptor");
        let descriptors = golden
            .floats
            .get(&base)
            .unwrap_or_else(|| &golden.floats[&format!("{base}_first32")]);
        let rows = shared_rows(keys, index);
        patch = patch.min(lowest_patch_cosine(keys, 384, descriptors, &rows));
        shared += rows.len();
        expected += index.len();
    }
    let shared = shared as f32 / expected as f32;
    let name = extractor.encoder_name();
    println!(
        "{name} {size:?}: lowest cosine of tokens {token:.6}, global {global:.6}, key patches \
         {patch:.6}; shared {shared:.3}"
    );
    assert!(
        token >= least && global >= least && patch >= least,
        "{name} {size:?}: {token} {global} {patch}"
    );
    assert!(
        shared >= least_shared,
        "{name} {size:?}: only {shared} of the key patches are the reference's"
    );
}

/// The lowest cosine of a stored token of block 8 to ours.
fn lowest_token_cosine(trace: &ExtractionTrace, golden: &Golden) -> f32 {
    let arrays = trace.arrays();
    let tokens = arrays
        .iter()
        .find(|array| array.name == "block8_tokens_rows")
        .unwrap();
    let TraceValues::F32(tokens) = &tokens.values else {
        panic!("tokens are f32")
    };
    let expected = golden.floats["block8_tokens_rows"].chunks_exact(384);
    golden.integers["rows"]
        .iter()
        .map(|&row| &tokens[row as usize * 384..][..384])
        .zip(expected)
        .map(|(own, expected)| cosine(own, expected))
        .fold(1.0, f32::min)
}

/// The key patches that are among ours and among the stored ones: their rows in either list.
fn shared_rows(keys: &ScaleKeyPatches, stored: &[i64]) -> Vec<(usize, usize)> {
    let row_of = |index: i64| keys.index.iter().position(|&own| i64::from(own) == index);
    stored
        .iter()
        .enumerate()
        .filter_map(|(at, &index)| Some((row_of(index)?, at)))
        .collect()
}

/// The lowest cosine between our descriptors and the stored ones, in the rows that both sides have.
/// Rows whose descriptor is not stored are left out.
fn lowest_patch_cosine(
    keys: &ScaleKeyPatches,
    dim: usize,
    stored: &[f32],
    rows: &[(usize, usize)],
) -> f32 {
    let mut lowest = 1f32;
    for &(own, at) in rows {
        if let Some(expected) = stored.chunks_exact(dim).nth(at) {
            lowest = lowest.min(cosine(&keys.descriptors[own * dim..][..dim], expected));
        }
    }
    lowest
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
                let bytes = stored(&format!("{name}.png"));
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

/// Checks the key patches of a picture that was decoded here, so that its samples differ from the
/// reference's by up to one step. They must be nearly the same patches, with nearly the same
/// attention and descriptors.
fn compare_keys_from_file(trace: &ExtractionTrace, golden: &Golden, tag: &str, what: &str) {
    let dim = trace.key_patches.dim;
    for (scale, keys) in (1..).zip(&trace.key_patches.scales) {
        let base = format!("{tag}_key{scale}");
        let index = &golden.integers[&format!("{base}_index")];
        let attention = &golden.floats[&format!("{base}_attention")];
        let rows = shared_rows(keys, index);
        let common = rows.len();
        let deviations = rows
            .iter()
            .map(|&(own, at)| (keys.attention[own] - attention[at]).abs() / attention[at]);
        let mean = deviations.clone().sum::<f32>() / common as f32;
        let worst = deviations.fold(0.0, f32::max);
        let lowest = golden
            .floats
            .get(&format!("{base}_descriptor"))
            .map_or(1.0, |stored| lowest_patch_cosine(keys, dim, stored, &rows));
        println!(
            "{what} {base}: {common} of {}, attention {mean:.2e} (at most {worst:.2e}), \
             descriptors {lowest:.6}",
            index.len()
        );
        assert!(
            common * 10 >= index.len() * 9,
            "{what} {base}: {common} of {}",
            index.len()
        );
        // Where attention peaks, one step of a sample changes it by some percent. Its mean must not
        // change by as much.
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
