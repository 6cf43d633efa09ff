//! What candidates are ranked by: S, S fused with the global distance, or a score that was learned
//! and comes with the calibration of the map.

use crate::support::App;
use placeformer_core::types::ScoreKind;
use placeformer_vision::rerank::{RerankConfig, feature_names};
use serde_json::{Value, json};

fn app(score: ScoreKind) -> App {
    App::with(|config| config.rerank.score = score)
}

/// A calibration of the fake model whose learned score is `weight` times the cosine of the global
/// descriptors, and which trusts scores above 0.
fn calibration(weight: f64) -> Value {
    let rerank = RerankConfig {
        score: ScoreKind::Learned,
        ..Default::default()
    };
    let term = |feature: String| {
        let weight = if feature == "global.cosine" {
            weight
        } else {
            0.0
        };
        json!({"feature": feature, "mean": 0.5, "deviation": 0.1, "weight": weight})
    };
    let terms: Vec<Value> = feature_names(&rerank.scales)
        .into_iter()
        .map(term)
        .collect();
    let curve = |score: f64| {
        json!({"weights": {"bias": 0.0, "score": score, "distance": 0.0}, "threshold": 0.5,
            "right": 8, "wrong": 6, "without_match": 5, "precision": 0.9, "recall": 0.9,
            "expected_calibration_error": 0.02})
    };
    json!({"format": 2, "model": "fake-1", "rerank": rerank.id(), "data": "made up",
        "target_precision": 0.9, "reranked": curve(1.0), "global": curve(0.0),
        "learned_score": {"bias": 0.25, "terms": terms}})
}

async fn put(app: &App, body: &Value) -> crate::support::Answer {
    let kind = "application/json";
    app.put("/maps/m/calibration", kind, body.to_string()).await
}

/// The distances of the results in their order.
fn distances(answer: &Value) -> Vec<f64> {
    let results = answer["results"].as_array().unwrap();
    let distances = results.iter().map(|it| it["global_distance"].as_f64());
    distances.map(Option::unwrap).collect()
}

#[tokio::test]
async fn every_answer_says_what_it_is_ranked_by() {
    for score in [ScoreKind::Paper, ScoreKind::Fused] {
        let app = app(score);
        for seed in 0..4 {
            app.post_png("/references?map=m", seed).await.created();
        }
        let answer = app.post_png("/query?map=m", 1).await;
        let best = &answer.ok()["results"][0];
        assert_eq!(answer.json["ranked_by"], score.as_str());
        let s = best["spatial_score"].as_f64().unwrap();
        // The photo itself: its distance is 0, and the cosine 1.
        let expected = match score {
            ScoreKind::Fused => (s + 10.0).ln() + 2.0,
            _ => s,
        };
        let value = best["score"].as_f64().unwrap();
        assert!((value - expected).abs() < 1e-3, "{value} {expected}");
        assert_eq!(app.get("/info").await.ok()["score"], score.as_str());

        let global = app.post_png("/query?map=m&rerank=false", 1).await;
        assert_eq!(global.ok()["ranked_by"], Value::Null);
        assert_eq!(global.json["results"][0]["score"], Value::Null);
    }
}

#[tokio::test]
async fn a_learned_score_comes_with_the_calibration_of_a_map() {
    let app = app(ScoreKind::Learned);
    for seed in 0..4 {
        app.post_png("/references?map=m", seed).await.created();
    }
    // Neither the map nor the model of this test has one: the answer is by S, and says so.
    let plain = app.post_png("/query?map=m", 1).await;
    assert_eq!(plain.ok()["ranked_by"], "paper");
    assert_eq!(plain.json["matched"], Value::Null);

    for (weight, nearest_first) in [(1.0, true), (-1.0, false)] {
        let stored = calibration(weight);
        assert_eq!(put(&app, &stored).await.ok(), &stored);
        let answer = app.post_png("/query?map=m", 1).await;
        assert_eq!(answer.ok()["ranked_by"], "learned");
        let distances = distances(&answer.json);
        let ordered = distances.is_sorted_by(|a, b| if nearest_first { a <= b } else { a >= b });
        assert!(ordered && distances.len() == 4, "{distances:?}");
        let best = &answer.json["results"][0];
        let cosine = 1.0 - distances[0].powi(2) / 2.0;
        let expected = 0.25 + weight * (cosine - 0.5) / 0.1;
        let value = best["score"].as_f64().unwrap();
        assert!((value - expected).abs() < 1e-3, "{value} {expected}");
        let confidence = answer.json["confidence"].as_f64().unwrap();
        assert!((confidence - 1.0 / (1.0 + (-value).exp())).abs() < 1e-9);
        assert_eq!(answer.json["matched"], value > 0.0);
    }
    let removed = app.delete("/maps/m/calibration").await;
    assert_eq!(removed.status, 204);
    let plain = app.post_png("/query?map=m", 1).await;
    assert_eq!(plain.ok()["ranked_by"], "paper");
}

#[tokio::test]
async fn scores_that_the_server_does_not_rank_by_are_refused() {
    let by_inliers = app(ScoreKind::Paper);
    by_inliers.post_png("/references?map=m", 1).await.created();
    let refused = put(&by_inliers, &calibration(1.0)).await;
    let detail = refused.problem("calibration_mismatch");
    assert!(detail.contains(":learned"), "{detail}");

    let learned = app(ScoreKind::Learned);
    learned.post_png("/references?map=m", 1).await.created();
    let mut other = calibration(1.0);
    other["learned_score"]["terms"][3]["feature"] = json!("s11.luck");
    let refused = put(&learned, &other).await;
    let detail = refused.problem("invalid_parameter");
    assert!(detail.contains("s11.luck"), "{detail}");
    let mut missing = calibration(1.0);
    missing.as_object_mut().unwrap().remove("learned_score");
    let refused = put(&learned, &missing).await;
    assert!(refused.status.is_client_error(), "{}", refused.text);
}
