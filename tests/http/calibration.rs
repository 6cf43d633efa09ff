//! Whether answers are trusted: calibrations of maps over HTTP, and what queries make of them.

use crate::support::{Answer, App, FakeSource};
use axum::body::Body;
use axum::http::Request;
use placeformer::http::{ApiKey, Role};
use placeformer_vision::rerank::RerankConfig;
use serde_json::{Value, json};
use std::sync::Arc;

/// Trusts answers of about 50 inliers and more, or nearer than 0.5.
fn calibration() -> Value {
    let curve = |bias: f64, score: f64, distance: f64| {
        json!({"weights": {"bias": bias, "score": score, "distance": distance}, "threshold": 0.75, "right": 80,
            "wrong": 60, "without_match": 50, "precision": 0.99, "recall": 0.9, "expected_calibration_error": 0.02})
    };
    json!({"format": 1, "model": "fake-1", "rerank": RerankConfig::default().id(), "data": "made up",
        "target_precision": 0.99, "reranked": curve(-12.0, 3.5, -0.25), "global": curve(5.0, 0.0, -8.0)})
}

async fn put(app: &App, path: &str, body: &Value) -> Answer {
    let request = Request::put(path).header("content-type", "application/json");
    app.send(request.body(Body::from(body.to_string())).unwrap())
        .await
}

async fn unmatched(app: &App) -> u64 {
    let text = app.get("/metrics").await.text;
    let line = text
        .lines()
        .find_map(|line| line.strip_prefix("placeformer_query_unmatched_total "));
    line.unwrap().parse().unwrap()
}

#[tokio::test]
async fn answers_are_trusted_as_the_maps_calibration_says() {
    let app = App::new();
    for seed in 0..3 {
        app.post_png("/references?map=m", seed).await.created();
    }
    // The model of this test ships none: nothing is guessed.
    let plain = app.post_png("/query?map=m", 1).await;
    assert_eq!(
        (&plain.ok()["matched"], &plain.json["confidence"]),
        (&Value::Null, &Value::Null)
    );
    assert_eq!(app.get("/info").await.ok()["calibration"], Value::Null);
    assert_eq!(unmatched(&app).await, 0);

    assert_eq!(
        put(&app, "/maps/m/calibration", &calibration()).await.ok(),
        &calibration()
    );
    assert_eq!(app.get("/maps/m").await.ok()["calibration"], calibration());
    assert_eq!(
        app.get("/maps").await.ok()["maps"][0]["calibration"],
        calibration()
    );
    for (query, known) in [("map=m", true), ("map=m&rerank=false", true)] {
        let same = app.post_png(&format!("/query?{query}"), 1).await;
        assert_eq!(same.ok()["matched"], known, "{}", same.text);
        assert!(
            same.json["confidence"].as_f64().unwrap() >= 0.75,
            "{}",
            same.text
        );
        let strange = app.post_png(&format!("/query?{query}"), 77).await;
        assert_eq!(strange.ok()["matched"], false, "{}", strange.text);
        assert!(
            strange.json["confidence"].as_f64().unwrap() < 0.75,
            "{}",
            strange.text
        );
    }
    assert_eq!(unmatched(&app).await, 2);

    let removed = app.delete("/maps/m/calibration").await;
    assert_eq!((removed.status.as_u16(), removed.text.as_str()), (204, ""));
    assert_eq!(app.delete("/maps/m/calibration").await.status, 204);
    assert_eq!(app.get("/maps/m").await.ok()["calibration"], Value::Null);
    assert_eq!(
        app.post_png("/query?map=m", 77).await.ok()["matched"],
        Value::Null
    );
    assert_eq!(unmatched(&app).await, 2);
}

#[tokio::test]
async fn no_result_is_no_match_with_or_without_a_calibration() {
    let app = App::new();
    app.post_png("/references?map=m&lat=50&lon=8", 1)
        .await
        .created();
    for _ in 0..2 {
        let nowhere = app
            .post_png("/query?map=m&near=-50,100&radius_m=10", 1)
            .await;
        assert_eq!(
            (&nowhere.ok()["matched"], &nowhere.json["confidence"]),
            (&json!(false), &json!(0.0))
        );
        put(&app, "/maps/m/calibration", &calibration()).await.ok();
    }
    assert_eq!(unmatched(&app).await, 2);
}

#[tokio::test]
async fn a_calibration_outlives_a_restart_and_not_its_map() {
    let app = App::new();
    app.post_png("/references?map=m", 1).await.created();
    put(&app, "/maps/m/calibration", &calibration()).await.ok();
    let directory = app.directory.clone();
    drop(app);
    let app = App::open(directory, FakeSource::new("fake-1"), |_| {});
    assert_eq!(app.post_png("/query?map=m", 1).await.ok()["matched"], true);
    app.delete("/maps/m").await.ok();
    app.post_png("/references?map=m", 1).await.created();
    assert_eq!(
        app.post_png("/query?map=m", 1).await.ok()["matched"],
        Value::Null
    );
}

#[tokio::test]
async fn calibrations_for_something_else_are_refused_with_both_identities() {
    let app = App::new();
    app.post_png("/references?map=m", 1).await.created();
    let with = |field: &str, value: Value| {
        let mut changed = calibration();
        *changed.pointer_mut(field).unwrap() = value;
        changed
    };
    for (field, given, own) in [
        ("/model", "fake-2", "fake-1"),
        ("/rerank", "1:t2", "1,1+2,2+3:t1.5"),
    ] {
        let refused = put(&app, "/maps/m/calibration", &with(field, json!(given))).await;
        let detail = refused.problem("calibration_mismatch");
        assert!(detail.contains(given) && detail.contains(own), "{detail}");
    }
    for (field, value, named) in [
        ("/format", json!(7), "format"),
        ("/target_precision", json!(2), "target_precision"),
        ("/reranked/threshold", json!("high"), "high"),
        ("/reranked/weights/distance", json!(0.5), "distance"),
        ("/global/recall", json!(-0.5), "recall"),
    ] {
        let refused = put(&app, "/maps/m/calibration", &with(field, value)).await;
        let detail = refused.problem("invalid_parameter");
        assert!(detail.contains(named), "{field}: {detail}");
    }
    let endless = calibration().to_string().replacen("-12.0", "1e999", 1);
    assert!(endless.contains("1e999"));
    let request = Request::put("/maps/m/calibration").header("content-type", "application/json");
    app.send(request.body(Body::from(endless)).unwrap())
        .await
        .problem("malformed_request");
    put(&app, "/maps/none/calibration", &calibration())
        .await
        .problem("map_not_found");
    put(
        &app,
        "/maps/a b/calibration".replace(' ', "%20").as_str(),
        &calibration(),
    )
    .await
    .problem("map_not_found");
    app.delete("/maps/none/calibration")
        .await
        .problem("map_not_found");
    app.get("/maps/m/calibration")
        .await
        .problem("method_not_allowed");
    assert_eq!(app.get("/maps/m").await.ok()["calibration"], Value::Null);
}

#[tokio::test]
async fn scores_of_another_re_ranking_are_not_judged() {
    let directory = Arc::new(tempfile::tempdir().unwrap());
    let app = App::open(directory.clone(), FakeSource::new("fake-1"), |_| {});
    app.post_png("/references?map=m", 1).await.created();
    put(&app, "/maps/m/calibration", &calibration()).await.ok();
    drop(app);
    let app = App::open(directory, FakeSource::new("fake-1"), |config| {
        config.rerank.tolerance_patches = 3.0
    });
    assert_eq!(
        app.post_png("/query?map=m", 1).await.ok()["matched"],
        Value::Null
    );
    // Distances do not depend on the re-ranking.
    assert_eq!(
        app.post_png("/query?map=m&rerank=false", 1).await.ok()["matched"],
        true
    );
}

#[tokio::test]
async fn calibrating_needs_a_key_that_may_write() {
    let app = App::with(|config| {
        let key = |name: &str, sha256: &str, role| ApiKey {
            name: name.into(),
            sha256: sha256.to_owned().into(),
            role,
            requests_per_second: None,
            maps: None,
        };
        // SHA-256 of "secret".
        let hash = "2bb80d537b1da3e38bd30361aa855686bde0eacd7162fef6a25fe97bf527a25b";
        config.auth.keys = vec![key("fleet", hash, Role::Read)];
    });
    let send = |method: &str, key: Option<&str>| {
        let mut request = Request::builder().method(method).uri("/maps/m/calibration");
        request = request.header("content-type", "application/json");
        if let Some(key) = key {
            request = request.header("x-api-key", key);
        }
        app.send(request.body(Body::from(calibration().to_string())).unwrap())
    };
    for method in ["PUT", "DELETE"] {
        send(method, None).await.problem("unauthorized");
        send(method, Some("secret")).await.problem("forbidden");
    }
}
