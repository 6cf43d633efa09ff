//! A mirrored photo shows another place, though everything in it looks the same: no camera sees a
//! street so. Photos of the same street are matched all the same.

use crate::common::program::has_model;
use crate::golden::stored;
use placeformer_core::progress::Silent;
use placeformer_core::types::{Descriptor, ScoreKind};
use placeformer_models::{built_in_calibration, open_extractor};
use placeformer_vision::extract::{ExtractConfig, Extractor};
use placeformer_vision::image::{ImageConfig, RgbImage, decode, encode_png, load_tensor};
use placeformer_vision::rerank::{RerankConfig, Reranker};

fn describe(extractor: &Extractor, png: &[u8]) -> Descriptor {
    let config = ImageConfig::default();
    let tensor = load_tensor(png, &config, extractor.input_size()).unwrap();
    extractor.extract(&[tensor]).unwrap().remove(0)
}

/// The picture with left and right exchanged.
fn mirrored(png: &[u8]) -> Vec<u8> {
    let image = decode(png, &ImageConfig::default()).unwrap();
    let width = image.size.width as usize;
    let rows = image.pixels.chunks_exact(width * 3);
    let pixels = rows.flat_map(|row| row.chunks_exact(3).rev().flatten().copied());
    encode_png(&RgbImage {
        size: image.size,
        pixels: pixels.collect(),
    })
    .unwrap()
}

/// Whether the default model trusts that `query` shows what `reference` does, and S.
fn matched(extractor: &Extractor, query: &Descriptor, reference: &Descriptor) -> (bool, u32) {
    let reranker = Reranker::new(RerankConfig::default());
    let score = reranker.score(&query.patches, &reference.patches);
    let pairs = query.global.iter().zip(&reference.global);
    let distance = pairs.map(|(a, b)| (a - b).powi(2)).sum::<f32>().sqrt();
    let calibration = built_in_calibration(extractor.model_id()).expect("the default has one");
    let curve = calibration.curve(true);
    let evidence = ScoreKind::Paper.evidence(f64::from(score.spatial_score));
    let weights = curve.weights;
    let confidence = weights.confidence(Some(evidence), f64::from(distance));
    (curve.trusts(confidence), score.spatial_score)
}

#[test]
fn mirrored_streets_are_not_matched_and_the_street_at_dusk_is() {
    if !has_model() {
        return;
    }
    let extractor = open_extractor(&ExtractConfig::default(), &Silent).unwrap();
    let names = ["street_a.png", "street_a_dusk.png", "street_b.png"];
    let pictures = names.map(stored);
    let descriptors = pictures.each_ref().map(|it| describe(&extractor, it));
    let (is_matched, same_street) = matched(&extractor, &descriptors[1], &descriptors[0]);
    assert!(is_matched, "S = {same_street}");
    for ((name, picture), descriptor) in names.iter().zip(&pictures).zip(&descriptors) {
        let other = describe(&extractor, &mirrored(picture));
        let (is_matched, score) = matched(&extractor, &other, descriptor);
        assert!(!is_matched, "{name}: S = {score}");
        assert!(4 * score < same_street, "{name}: {score} of {same_street}");
    }
}
