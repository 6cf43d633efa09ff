//! Photos that show nothing by which a place could be known: refused as references unless allowed,
//! and never trusted as queries.

use crate::support::{App, picture};
use placeformer::config::Config;
use placeformer_vision::image::{RgbImage, encode_png};
use serde_json::{Value, json};

/// A PNG of 160 x 120 pixels whose brightness is `level` of column and row.
fn drawn(level: impl Fn(u32, u32) -> f64) -> Vec<u8> {
    let [width, height] = [160, 120];
    let mut pixels = Vec::new();
    for y in 0..height {
        for x in 0..width {
            pixels.extend([level(x, y).clamp(0.0, 255.0) as u8; 3]);
        }
    }
    let size = placeformer_core::types::ImageSize { width, height };
    encode_png(&RgbImage { size, pixels }).unwrap()
}

fn from_centre(x: u32, y: u32) -> f64 {
    (f64::from(x) - 80.0).hypot(f64::from(y) - 60.0) / 100.0
}

/// Frames of every kind that shows nothing, with their names.
fn frames() -> Vec<(&'static str, Vec<u8>)> {
    let grain = |x: u32, y: u32| f64::from((x * 7 + y * 13 + x * y) % 5);
    vec![
        ("black", drawn(|_, _| 0.0)),
        ("nearly black", drawn(grain)),
        ("white", drawn(|_, _| 255.0)),
        ("one colour", drawn(|_, _| 90.0)),
        (
            "covered lens",
            drawn(|x, y| 20.0 + 0.2 * f64::from(x) + grain(x, y)),
        ),
        (
            "vignette",
            drawn(|x, y| 230.0 - 180.0 * from_centre(x, y).powi(2)),
        ),
        (
            "rim",
            drawn(|x, y| if from_centre(x, y) < 0.55 { 140.0 } else { 0.0 }),
        ),
    ]
}

#[tokio::test]
async fn references_that_show_nothing_are_refused_unless_they_are_allowed() {
    let app = App::new();
    for (name, frame) in frames() {
        let refused = app
            .post("/references?map=m", "image/png", frame.clone())
            .await;
        let detail = refused.problem("image_uninformative");
        assert!(detail.contains("allow_uninformative"), "{name}: {detail}");
        assert_eq!(app.source.described(), 0, "{name} was described");
    }
    assert_eq!(app.count().await, 0);
    let series = "placeformer_uninformative_images_total{kind=\"reference\"}";
    assert_eq!(app.metric(series).await, frames().len() as f64);

    let allowed = "/references?map=m&allow_uninformative=true";
    for (_, frame) in frames() {
        app.post(allowed, "image/png", frame).await.created();
    }
    let disallowed = "/references?map=m&allow_uninformative=false";
    app.post_png(disallowed, 1).await.created();
    assert_eq!(app.count().await, frames().len() + 1);
    app.drained().await;
}

/// Trusts every answer.
fn gullible() -> Value {
    let rerank = Config::default().rerank.id();
    let curve = json!({"weights": {"bias": 9.0, "score": 0.0, "distance": 0.0}, "threshold": 0.5,
        "right": 8, "wrong": 6, "without_match": 5, "precision": 0.9, "recall": 0.9,
        "expected_calibration_error": 0.02});
    json!({"format": 1, "model": "fake-1", "rerank": rerank, "data": "made up",
        "target_precision": 0.9, "reranked": curve, "global": curve})
}

#[tokio::test]
async fn queries_that_show_nothing_are_not_trusted_whatever_the_calibration_says() {
    let app = App::new();
    let (_, black) = frames().swap_remove(0);
    let allowed = "/references?map=m&allow_uninformative=true";
    app.post(allowed, "image/png", black.clone())
        .await
        .created();
    app.post_png("/references?map=m", 1).await.created();
    for calibrated in [false, true] {
        if calibrated {
            let body = gullible().to_string();
            let stored = app.put("/maps/m/calibration", "application/json", body);
            stored.await.ok();
        }
        for (name, frame) in frames() {
            let answer = app.post("/query?map=m", "image/png", frame).await;
            let trust = ["matched", "confidence", "unmatched_reason"];
            let trust = trust.map(|field| answer.ok()[field].clone());
            let none = [json!(false), json!(0.0), json!("image_uninformative")];
            assert_eq!(trust, none, "{name}");
            assert_eq!(answer.json["results"].as_array().unwrap().len(), 2);
        }
    }
    let known = app.post_png("/query?map=m", 1).await;
    assert_eq!(known.ok()["matched"], true);
    assert_eq!(known.json["unmatched_reason"], Value::Null);
    let series = "placeformer_uninformative_images_total{kind=\"query\"}";
    assert_eq!(app.metric(series).await, 2.0 * frames().len() as f64);
    let unmatched = app.metric("placeformer_query_unmatched_total").await;
    assert_eq!(unmatched, 2.0 * frames().len() as f64);
}

#[tokio::test]
async fn other_answers_that_are_not_trusted_say_why_too() {
    let app = App::new();
    let located = "/references?map=m&lat=50&lon=8";
    app.post_png(located, 1).await.created();
    let plain = app.post_png("/query?map=m", 2).await;
    assert_eq!(plain.ok()["unmatched_reason"], Value::Null);
    let elsewhere = app.post_png("/query?map=m&near=0,0&radius_m=9", 1).await;
    assert_eq!(elsewhere.ok()["unmatched_reason"], "no_results");

    let mut strict = gullible();
    for curve in ["reranked", "global"] {
        strict[curve]["weights"]["bias"] = json!(-9.0);
    }
    let body = strict.to_string();
    let stored = app.put("/maps/m/calibration", "application/json", body);
    stored.await.ok();
    let doubted = app.post("/query?map=m", "image/png", picture(1)).await;
    assert_eq!(doubted.ok()["unmatched_reason"], "low_confidence");
}
