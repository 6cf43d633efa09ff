//! Calibrations as JSON, and what makes none.

use super::*;
use proptest::prelude::*;
use serde_json::{Value, json};

fn curve(score: f64) -> Value {
    json!({
        "weights": {"bias": -4.5, "score": score, "distance": -2.25},
        "threshold": 0.75,
        "right": 90,
        "wrong": 40,
        "without_match": 30,
        "precision": 0.99,
        "recall": 0.875,
        "expected_calibration_error": 0.02
    })
}

fn whole() -> Value {
    json!({
        "format": 1,
        "model": "m",
        "rerank": "r",
        "data": "town",
        "target_precision": 0.99,
        "reranked": curve(1.5),
        "global": curve(0.0)
    })
}

#[test]
fn json_survives_and_keeps_its_shape() {
    let read: Calibration = serde_json::from_value(whole()).unwrap();
    assert_eq!(serde_json::to_value(&read).unwrap(), whole());
    assert_eq!(
        (
            read.model().as_str(),
            read.rerank().as_str(),
            read.curve(true).right
        ),
        ("m", "r", 90)
    );
}

fn score() -> Value {
    json!({"bias": 0.5, "terms": [
        {"feature": "a", "mean": 2.0, "deviation": 0.5, "weight": 3.0},
    ]})
}

#[test]
fn a_learned_score_survives_and_belongs_to_its_re_ranking() {
    let mut learned = whole();
    learned["format"] = json!(2);
    learned["rerank"] = json!("r:learned");
    learned["learned_score"] = score();
    let read: Calibration = serde_json::from_value(learned.clone()).unwrap();
    assert_eq!(read.learned_score().unwrap().logit(&[2.0]), 0.5);
    assert_eq!(serde_json::to_value(&read).unwrap(), learned);
    learned["rerank"] = json!("r:fused");
    let error = serde_json::from_value::<Calibration>(learned).unwrap_err();
    assert!(error.to_string().contains("learned_score"), "{error}");
}

#[test]
fn values_out_of_range_are_refused_by_name() {
    for (pointer, value, named) in [
        ("/format", json!(3), "format"),
        ("/format", json!(2), "learned_score"),
        ("/rerank", json!("r:learned"), "learned_score"),
        ("/learned_score", score(), "learned_score"),
        ("/target_precision", json!(1.5), "target_precision"),
        ("/data", json!("x".repeat(201)), "data"),
        ("/reranked/threshold", json!(-0.1), "threshold"),
        ("/reranked/weights/score", json!(-1), "score"),
        ("/global/weights/distance", json!(0.5), "distance"),
        ("/global/weights/score", json!(0.5), "global"),
        ("/global/right", json!(-1), "-1"),
        ("/global/recall", Value::Null, "null"),
        ("/reranked/weights/bias", json!(1e308), "bias"),
        ("/reranked/weights/score", json!(1e308), "score"),
        ("/reranked/weights/distance", json!(-1e308), "distance"),
        ("/global/without_match", json!(41), "without_match"),
    ] {
        let mut changed = whole();
        let (parent, field) = pointer.rsplit_once('/').unwrap();
        changed.pointer_mut(parent).unwrap()[field] = value;
        let error = serde_json::from_value::<Calibration>(changed)
            .unwrap_err()
            .to_string();
        assert!(error.contains(named), "{pointer}: {error}");
    }
    let mut more = whole();
    more["reranked"]["comment"] = json!("x");
    assert!(
        serde_json::from_value::<Calibration>(more)
            .unwrap_err()
            .to_string()
            .contains("comment")
    );
    let endless = ConfidenceWeights {
        bias: f64::INFINITY,
        score: 0.0,
        distance: 0.0,
    };
    let read: Calibration = serde_json::from_value(whole()).unwrap();
    let broken = ConfidenceCurve {
        weights: endless,
        ..read.curve(false).clone()
    };
    let built = Calibration::new(
        ModelId::new("m"),
        RerankId::new("r"),
        "",
        0.9,
        [broken.clone(), broken],
    );
    assert!(built.unwrap_err().to_string().contains("bias"));
}

/// Two numbers below `end`, the smaller first.
fn ordered(end: f64) -> impl Strategy<Value = (f64, f64)> {
    (0.0..end, 0.0..end).prop_map(|(a, b)| (a.min(b), a.max(b)))
}

proptest! {
    #[test]
    fn confidence_is_a_probability_that_follows_the_evidence(
        bias in prop_oneof![-50.0..50.0f64, -LARGEST_WEIGHT..=LARGEST_WEIGHT],
        score in prop_oneof![0.0..10.0f64, 0.0..=LARGEST_WEIGHT],
        distance in prop_oneof![-20.0..0.0f64, -LARGEST_WEIGHT..=0.0],
        (fewer, more) in ordered(2000.0),
        (near, far) in ordered(2.0),
    ) {
        let weights = ConfidenceWeights { bias, score, distance };
        let confidence = weights.confidence(Some(fewer), far);
        prop_assert!((0.0..=1.0).contains(&confidence));
        prop_assert!(confidence <= weights.confidence(Some(more), far));
        prop_assert!(confidence <= weights.confidence(Some(fewer), near));
    }
}
