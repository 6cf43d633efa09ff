//! Another head for a map that is in use.

use crate::process::Server;
use crate::support::{App, BACKBONE, FakeSource, file_of, head, picture};
use axum::body::Body;
use axum::http::Request;
use placeformer::http::{ApiKey, Role};
use placeformer_store::crash_points;
use placeformer_vision::extract::{Aggregate, Head};
use serde_json::{Value, json};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

const FILE: &str = "application/octet-stream";
/// References that are there from the beginning; more than the store converts at a time.
const FIRST: u64 = 540;
/// A picture of nowhere, about as far from every reference.
const STRANGE: u64 = 1 << 40;

fn mean_head(seed: u64) -> Head {
    head(seed, BACKBONE, Aggregate::Mean)
}

fn open(directory: &Arc<tempfile::TempDir>, head_seed: u64) -> App {
    App::open(
        directory.clone(),
        FakeSource::with_head(mean_head(head_seed)),
        |config| {
            config.pipeline.max_candidates = 100_000;
            config.pipeline.max_wait_ms = 60_000;
        },
    )
}

async fn add(app: &App, map: &str, seed: u64) -> Value {
    app.post_png(&format!("/references?map={map}&external_id={seed}"), seed)
        .await
        .created()
        .clone()
}

/// The model that answered, and how far each reference was.
async fn distances(app: &App, map: &str) -> (String, BTreeMap<String, f64>) {
    let answer = app
        .post_png(
            &format!("/query?map={map}&top_k=50000&rerank=false"),
            STRANGE,
        )
        .await;
    let results = answer.ok()["results"].as_array().unwrap();
    let distance = |result: &Value| {
        (
            result["external_id"].as_str().unwrap().to_owned(),
            result["global_distance"].as_f64().unwrap(),
        )
    };
    (
        answer.json["model"].as_str().unwrap().to_owned(),
        results.iter().map(distance).collect(),
    )
}

/// All that `expected` has is there and as far, but for the half precision of what a store keeps.
#[track_caller]
fn assert_as_far(found: &BTreeMap<String, f64>, expected: &BTreeMap<String, f64>) {
    for (name, distance) in expected {
        let there = found
            .get(name)
            .unwrap_or_else(|| panic!("{name} is missing"));
        assert!(
            (there - distance).abs() < 2e-3,
            "{name}: {there} where {distance} was expected"
        );
    }
}

/// What a map of the first references answers on a server whose own head is this one.
async fn expected(
    head_seed: u64,
    seeds: impl Iterator<Item = u64>,
) -> (String, BTreeMap<String, f64>) {
    let app = open(&Arc::new(tempfile::tempdir().unwrap()), head_seed);
    for seed in seeds {
        add(&app, "m", seed).await;
    }
    distances(&app, "m").await
}

/// Counts the model that each answer names, and checks the answer against what that model says.
async fn keep_asking(
    app: &App,
    known: &BTreeMap<String, BTreeMap<String, f64>>,
    stop: &AtomicBool,
) -> BTreeSet<String> {
    let mut seen = BTreeSet::new();
    while !stop.load(Ordering::SeqCst) {
        let (model, found) = distances(app, "m").await;
        assert_as_far(
            &found,
            known
                .get(&model)
                .unwrap_or_else(|| panic!("{model} is neither")),
        );
        seen.insert(model);
    }
    seen
}

/// Adds and deletes until told to stop; the seeds of what stays and of what went.
async fn keep_changing(
    app: &App,
    models: &BTreeSet<String>,
    stop: &AtomicBool,
) -> (Vec<u64>, Vec<u64>) {
    let (mut stay, mut gone) = (Vec::new(), Vec::new());
    for seed in 10_000..10_100 {
        if stop.load(Ordering::SeqCst) {
            break;
        }
        let added = add(app, "m", seed).await;
        assert!(models.contains(added["model"].as_str().unwrap()), "{added}");
        if seed % 3 == 0 {
            let path = format!("/references/{}", added["id"].as_str().unwrap());
            assert_eq!(app.delete(&path).await.status, 204);
            gone.push(seed);
        } else {
            stay.push(seed);
        }
    }
    (stay, gone)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn queries_are_answered_throughout_and_never_with_a_mixture() {
    let directory = Arc::new(tempfile::tempdir().unwrap());
    let app = open(&directory, 1);
    for seed in 0..FIRST {
        add(&app, "m", seed).await;
    }
    let (old, new) = (distances(&app, "m").await, expected(2, 0..FIRST).await);
    let (old_model, new_model) = (old.0.clone(), new.0.clone());
    assert_ne!(old_model, new_model);
    let apart = old
        .1
        .iter()
        .filter(|(name, distance)| (*distance - new.1[*name]).abs() > 4e-3)
        .count();
    assert!(
        apart > FIRST as usize / 2,
        "the heads hardly differ, so a mixture would not be noticed"
    );
    let known = BTreeMap::from([old, new]);
    let models = known.keys().cloned().collect();

    let stop = AtomicBool::new(false);
    let exchange = async {
        let file = file_of(&mean_head(2));
        for round in 0..2 {
            let answer = app.put("/maps/m/head", FILE, file.clone()).await;
            assert_eq!(answer.ok()["model"], new_model, "round {round}");
            assert_eq!(distances(&app, "m").await.0, new_model, "round {round}");
            if round == 0 {
                assert_eq!(
                    app.delete("/maps/m/head").await.ok()["model"],
                    old_model,
                    "round {round}"
                );
            }
        }
        stop.store(true, Ordering::SeqCst);
    };
    let ((), first, second, (stay, gone)) = tokio::join!(
        exchange,
        keep_asking(&app, &known, &stop),
        keep_asking(&app, &known, &stop),
        keep_changing(&app, &models, &stop)
    );
    assert_eq!(
        first.union(&second).count(),
        2,
        "only one head was ever seen"
    );
    assert!(!stay.is_empty() && !gone.is_empty());

    // What came meanwhile and what comes now is as far as with the new head, and what went is gone;
    // also after a restart.
    add(&app, "m", 77_777).await;
    let all = expected(2, (0..FIRST).chain(stay).chain([77_777])).await;
    check_all(&app, &all, &gone).await;
    drop(app);
    check_all(&open(&directory, 1), &all, &gone).await;
}

async fn check_all(app: &App, (model, expected): &(String, BTreeMap<String, f64>), gone: &[u64]) {
    let found = distances(app, "m").await;
    assert_eq!(found.0, *model);
    assert_as_far(&found.1, expected);
    assert_eq!(found.1.len(), expected.len());
    assert!(
        gone.iter()
            .all(|seed| !found.1.contains_key(&seed.to_string()))
    );
}

#[tokio::test]
async fn a_map_keeps_its_head_and_comes_back_to_the_servers() {
    let directory = Arc::new(tempfile::tempdir().unwrap());
    let app = open(&directory, 1);
    for map in ["kept", "along"] {
        for seed in 0..5 {
            add(&app, map, seed).await;
        }
    }
    app.put("/maps/kept/head", FILE, file_of(&mean_head(2)))
        .await
        .ok();
    drop(app);
    // A release with another head of its own: the map that has one goes on, the other is brought
    // over.
    let app = open(&directory, 3);
    let (with_second, with_third) = (expected(2, 0..5).await, expected(3, 0..5).await);
    let there = distances(&app, "kept").await;
    assert_eq!(there.0, with_second.0);
    assert_as_far(&there.1, &with_second.1);
    app.post_png("/query?map=along", 1)
        .await
        .problem("model_mismatch");
    app.post_png("/references?map=along", 9)
        .await
        .problem("model_mismatch");
    assert_eq!(
        app.delete("/maps/along/head").await.ok()["model"],
        with_third.0
    );
    let there = distances(&app, "along").await;
    assert_eq!(there.0, with_third.0);
    assert_as_far(&there.1, &with_third.1);
    // Re-ranking and matching do not depend on the head.
    let best = app.post_png("/query?map=kept", 3).await;
    assert_eq!(best.ok()["results"][0]["external_id"], "3");
    assert!(
        best.json["results"][0]["spatial_score"].as_u64().unwrap() > 100,
        "{}",
        best.text
    );
    // A map made anew after its deletion has the server's head again.
    app.delete("/maps/kept").await.ok();
    assert_eq!(add(&app, "kept", 1).await["model"], with_third.0);
}

#[tokio::test]
async fn a_calibration_does_not_outlive_the_head_it_was_fitted_for() {
    let app = open(&Arc::new(tempfile::tempdir().unwrap()), 1);
    let old = add(&app, "m", 1).await["model"].clone();
    let curve = json!({"weights": {"bias": 5.0, "score": 0.0, "distance": -8.0}, "threshold": 0.75, "right": 80,
        "wrong": 60, "without_match": 50, "precision": 0.99, "recall": 0.9, "expected_calibration_error": 0.02});
    let calibration = json!({"format": 1, "model": old, "rerank": placeformer_vision::rerank::RerankConfig::default().id(),
        "data": "made up", "target_precision": 0.99, "reranked": curve, "global": curve});
    let put = || {
        app.put(
            "/maps/m/calibration",
            "application/json",
            calibration.to_string(),
        )
    };
    put().await.ok();
    assert_eq!(app.post_png("/query?map=m", 1).await.ok()["matched"], true);
    app.put("/maps/m/head", FILE, file_of(&mean_head(2)))
        .await
        .ok();
    assert_eq!(
        app.post_png("/query?map=m", 1).await.ok()["matched"],
        Value::Null
    );
    assert_eq!(app.get("/maps/m").await.ok()["calibration"], Value::Null);
    put().await.problem("calibration_mismatch");
}

#[tokio::test]
async fn heads_that_do_not_fit_are_refused_by_name_and_change_nothing() {
    let app = open(&Arc::new(tempfile::tempdir().unwrap()), 1);
    for seed in 0..3 {
        add(&app, "m", seed).await;
    }
    let before = distances(&app, "m").await;
    let put = async |file: Vec<u8>| app.put("/maps/m/head", FILE, file).await;
    let other_backbone = put(file_of(&head(2, "fake:ffffffffffff:b8", Aggregate::Mean))).await;
    let detail = other_backbone.problem("head_mismatch");
    assert!(
        detail.contains("fake:ffffffffffff:b8") && detail.contains(&before.0),
        "{detail}"
    );
    let other_pooling = put(file_of(&head(2, BACKBONE, Aggregate::gem(3.0).unwrap()))).await;
    let detail = other_pooling.problem("head_mismatch");
    assert!(
        detail.contains("made by mean") && detail.contains("those of gem3"),
        "{detail}"
    );
    let whole = file_of(&mean_head(2));
    let detail = put(whole[..whole.len() / 2].to_vec()).await;
    assert!(
        detail.problem("head_unreadable").contains("truncated"),
        "{}",
        detail.text
    );
    put(Vec::new()).await.problem("head_unreadable");
    put(vec![0; (32 << 20) + 1]).await.problem("body_too_large");
    app.put("/maps/m/head", "application/json", whole.clone())
        .await
        .problem("unsupported_media_type");
    app.put("/maps/none/head", FILE, whole.clone())
        .await
        .problem("map_not_found");
    app.delete("/maps/none/head").await.problem("map_not_found");
    app.get("/maps/m/head").await.problem("method_not_allowed");
    assert_eq!(distances(&app, "m").await, before);

    // A server without a head has none to give, but a map there takes one.
    let headless = App::new();
    headless.post_png("/references?map=m", 1).await.created();
    headless
        .delete("/maps/m/head")
        .await
        .problem("head_mismatch");
}

#[tokio::test]
async fn giving_a_head_needs_a_key_that_may_write() {
    let app = App::with(|config| {
        // SHA-256 of "secret".
        let sha256 = "2bb80d537b1da3e38bd30361aa855686bde0eacd7162fef6a25fe97bf527a25b".to_owned();
        config.auth.keys = vec![ApiKey {
            name: "fleet".into(),
            sha256: sha256.into(),
            role: Role::Read,
            requests_per_second: None,
            maps: None,
        }];
    });
    for method in ["PUT", "DELETE"] {
        for (key, problem) in [(None, "unauthorized"), (Some("secret"), "forbidden")] {
            let mut request = Request::builder()
                .method(method)
                .uri("/maps/m/head")
                .header("content-type", FILE);
            if let Some(key) = key {
                request = request.header("x-api-key", key);
            }
            app.send(request.body(Body::from(file_of(&mean_head(2)))).unwrap())
                .await
                .problem(problem);
        }
    }
}

#[test]
fn a_server_killed_over_an_exchange_has_the_old_head_or_the_new_one() {
    let file = file_of(&mean_head(2));
    // Six references are six commits; then the version begins, its vectors are written, and the map
    // changes over.
    for (point, changed) in [
        (format!("{}:7", crash_points::AFTER_COMMIT), false),
        (format!("{}:1", crash_points::MID_REHEAD), false),
        (format!("{}:9", crash_points::BEFORE_COMMIT), false),
        (format!("{}:9", crash_points::AFTER_COMMIT), true),
        (format!("{}:1", crash_points::MID_PURGE), true),
    ] {
        let directory = tempfile::tempdir().unwrap();
        let server = Server::start(directory.path(), Some(point.clone()));
        for seed in 0..6 {
            assert_eq!(
                server
                    .post(
                        &format!("/references?map=m&external_id={seed}"),
                        picture(seed)
                    )
                    .unwrap()
                    .0,
                201
            );
        }
        let old = server.get("/maps/m").unwrap().1["model"].clone();
        if let Some((status, answer)) = server.put("/maps/m/head", file.clone()) {
            // Removing the old vectors begins when the map has changed over, so the answer may win.
            assert!(changed && status == 200, "{point}: {answer}");
        }
        server.kill();
        let server = Server::start(directory.path(), None);
        let now = server.get("/maps/m").unwrap().1;
        assert_eq!(
            (now["model"] != old, &now["references"]),
            (changed, &json!(6)),
            "{point}"
        );
        for seed in 0..6 {
            let (status, answer) = server.post("/query?map=m&top_k=1", picture(seed)).unwrap();
            assert_eq!(
                (status, &answer["model"]),
                (200, &now["model"]),
                "{point}: {answer}"
            );
            assert_eq!(
                answer["results"][0]["external_id"],
                seed.to_string(),
                "{point}: {answer}"
            );
            assert!(
                answer["results"][0]["global_distance"].as_f64().unwrap() < 0.02,
                "{point}: {answer}"
            );
        }
        // And it can be done again.
        let (status, answer) = server.put("/maps/m/head", file.clone()).unwrap();
        assert_eq!(
            (status, answer["model"] != old),
            (200, true),
            "{point}: {answer}"
        );
        assert_eq!(
            server.post("/references?map=m", picture(99)).unwrap().0,
            201,
            "{point}"
        );
        server.kill();
    }
}
