//! Who is let in, and what happens when there is too much of everything.

use crate::support::{Answer, App, FakeSource, picture};
use axum::body::Body;
use axum::http::Request;
use placeformer::http::{ApiKey, AppState, AuthConfig, HttpConfig, Role, app};
use placeformer::ops::{Health, Metrics};
use placeformer_core::error::ErrorCode;
use sha2::Digest;
use std::sync::Arc;
use std::time::Duration;
use tower::ServiceExt;

fn key(name: &str, role: Role) -> ApiKey {
    let hash = sha2::Sha256::digest(format!("key of {name}"));
    let sha256 = hex::encode(hash);
    ApiKey {
        name: name.into(),
        sha256: sha256.into(),
        role,
        requests_per_second: None,
        maps: None,
    }
}

fn with_key(method: &str, path: &str, name: &str, body: Vec<u8>) -> Request<Body> {
    let request = Request::builder()
        .method(method)
        .uri(path)
        .header("content-type", "image/png");
    request
        .header("authorization", format!("Bearer key of {name}"))
        .body(Body::from(body))
        .unwrap()
}

#[tokio::test]
async fn keys_open_what_their_role_allows() {
    let app = App::with(|config| {
        config.auth.keys = vec![key("fleet", Role::Read), key("builder", Role::Write)]
    });
    for path in ["/livez", "/readyz", "/metrics", "/openapi.json", "/docs/"] {
        assert_eq!(app.get(path).await.status, 200, "{path}");
    }
    let refused = app.get("/maps").await;
    refused.problem("unauthorized");
    assert_eq!(refused.header("www-authenticate"), "Bearer");
    app.send(with_key("GET", "/maps", "nobody", vec![]))
        .await
        .problem("unauthorized");
    app.send(with_key("GET", "/maps", "fleet", vec![]))
        .await
        .ok();
    app.send(with_key("POST", "/references?map=m", "fleet", picture(1)))
        .await
        .problem("forbidden");
    app.send(with_key("POST", "/references?map=m", "builder", picture(1)))
        .await
        .created();
    app.send(with_key("POST", "/query?map=m", "fleet", picture(1)))
        .await
        .ok();
    app.send(with_key("DELETE", "/maps/m", "fleet", vec![]))
        .await
        .problem("forbidden");
    app.get("/nowhere").await.problem("route_not_found");
}

#[tokio::test]
async fn each_key_has_its_own_rate() {
    let app = App::with(|config| {
        let slow = ApiKey {
            requests_per_second: Some(1),
            ..key("slow", Role::Read)
        };
        config.auth = AuthConfig {
            keys: vec![slow, key("free", Role::Read)],
            ..Default::default()
        };
    });
    app.send(with_key("GET", "/maps", "slow", vec![]))
        .await
        .ok();
    app.send(with_key("GET", "/maps", "slow", vec![]))
        .await
        .problem("rate_limited");
    for _ in 0..5 {
        app.send(with_key("GET", "/maps", "free", vec![]))
            .await
            .ok();
    }
    assert_eq!(app.get("/livez").await.status, 200);
    let metrics = app.get("/metrics").await.text;
    assert!(
        metrics.contains("placeformer_rejected_total{reason=\"rate_limited\"} 1"),
        "{metrics}"
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_full_queue_refuses_at_once_and_recovers() {
    let app = Arc::new(App::with(|config| config.pipeline.queue_capacity = 2));
    app.post_png("/references?map=m", 0).await.created();
    app.source.slow_down(Duration::from_millis(300));
    let tasks: Vec<_> = (0..6u64)
        .map(|seed| {
            let app = app.clone();
            tokio::spawn(async move { app.post_png("/query?map=m", seed).await })
        })
        .collect();
    let mut answers = Vec::new();
    for task in tasks {
        answers.push(task.await.unwrap());
    }
    let refused: Vec<&Answer> = answers
        .iter()
        .filter(|answer| answer.status != 200)
        .collect();
    assert_eq!(refused.len(), 4);
    refused.iter().for_each(|answer| {
        answer.problem("overloaded");
    });
    app.source.slow_down(Duration::ZERO);
    app.post_png("/query?map=m", 1).await.ok();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_query_overtakes_a_bulk_import() {
    let app = Arc::new(App::new());
    app.post_png("/references?map=m", 100).await.created();
    app.source.slow_down(Duration::from_millis(200));
    let references: Vec<_> = (0..8u64)
        .map(|seed| {
            let app = app.clone();
            tokio::spawn(async move { app.post_png("/references?map=m", seed).await })
        })
        .collect();
    while app.source.described() < 3 {
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    app.post_png("/query?map=m", 1).await.ok();
    let described = app.source.described();
    assert!(
        described <= 5,
        "{described} images were described before the answer to a query sent after the third"
    );
    for reference in references {
        reference.await.unwrap().created();
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn nobody_waits_longer_than_allowed() {
    let app = Arc::new(App::with(|config| config.pipeline.max_wait_ms = 350));
    app.post_png("/references?map=m", 0).await.created();
    app.source.slow_down(Duration::from_millis(200));
    app.post_png("/query?map=m", 1).await.ok();
    let queries: Vec<_> = (0..12u64)
        .map(|seed| {
            let app = app.clone();
            tokio::spawn(async move { app.post_png("/query?map=m", seed).await })
        })
        .collect();
    let (mut answered, mut refused) = (0, 0);
    for query in queries {
        let answer = query.await.unwrap();
        match answer.status.as_u16() {
            200 => answered += 1,
            _ => {
                answer.problem("overloaded");
                assert!(answer.header("retry-after").parse::<u64>().unwrap() >= 1);
                refused += 1;
            }
        }
    }
    // A turn every 200 ms: the third would come after 400.
    assert!(
        (1..=3).contains(&answered),
        "{answered} answered, {refused} refused"
    );
    let metrics = app.get("/metrics").await.text;
    assert!(metrics.contains("placeformer_queue_depth 0"), "{metrics}");
}

#[tokio::test]
async fn the_deadline_decides_between_reranked_global_and_none() {
    let app = App::with(|config| config.pipeline.answer_reserve_ms = 60_000);
    app.post_png("/references?map=m", 1).await.created();
    // More is kept back for the answer than the query has: the global ranking it is.
    let global = app.post_png("/query?map=m&deadline_ms=20000", 1).await;
    assert_eq!(global.ok()["reranked"], false);
    assert_eq!(global.json["results"].as_array().unwrap().len(), 1);
    app.source.slow_down(Duration::from_millis(80));
    let late = app.post_png("/query?map=m&deadline_ms=20", 1).await;
    late.problem("deadline_exceeded");
    assert_eq!(late.header("retry-after"), "1");
    let metrics = app.get("/metrics").await.text;
    assert!(
        metrics.contains("placeformer_rejected_total{reason=\"deadline\"} 1"),
        "{metrics}"
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn work_whose_client_has_gone_is_not_computed() {
    let app = Arc::new(App::new());
    app.post_png("/references?map=m", 0).await.created();
    app.source.slow_down(Duration::from_millis(300));
    let send = |seed: u64| {
        let app = app.clone();
        tokio::spawn(async move { app.post_png("/query?map=m", seed).await })
    };
    let staying = send(1);
    tokio::time::sleep(Duration::from_millis(100)).await;
    let leaving: Vec<_> = (2..6).map(send).collect();
    tokio::time::sleep(Duration::from_millis(50)).await;
    leaving.iter().for_each(|task| task.abort());
    staying.await.unwrap().ok();
    app.source.slow_down(Duration::ZERO);
    app.post_png("/query?map=m", 7).await.ok();
    assert_eq!(
        app.source.described(),
        3,
        "the first reference, the query that stayed, and the last one"
    );
    let metrics = app.get("/metrics").await.text;
    assert!(
        metrics.contains("placeformer_rejected_total{reason=\"client_gone\"} 4"),
        "{metrics}"
    );
    assert!(metrics.contains("placeformer_queue_depth 0"), "{metrics}");
}

#[tokio::test]
async fn short_memory_refuses_ingest_and_nothing_else() {
    let app = App::new();
    let id = app.post_png("/references?map=m", 1).await.created()["id"]
        .as_str()
        .unwrap()
        .to_owned();
    let (directory, source) = (app.directory.clone(), app.source.clone());
    drop(app);
    let app = App::open(directory, source, |config| {
        config.pipeline.memory_watermark_bytes = 1
    });
    app.post_png("/references?map=m", 2)
        .await
        .problem("memory_pressure");
    app.post_png("/query?map=m", 1).await.ok();
    assert_eq!(app.delete(&format!("/references/{id}")).await.status, 204);
}

#[tokio::test]
async fn a_full_disk_refuses_ingest_and_shows_in_readiness() {
    let app = App::new();
    let id = app.post_png("/references?map=m", 1).await.created()["id"]
        .as_str()
        .unwrap()
        .to_owned();
    app.state.health.set_disk_full(true);
    app.post_png("/references?map=m", 2)
        .await
        .problem("disk_full");
    app.post_png("/query?map=m", 1).await.ok();
    let ready = app.get("/readyz").await;
    assert_eq!(
        (ready.status.as_u16(), ready.json["status"].as_str()),
        (503, Some("disk_full"))
    );
    assert_eq!(app.get("/readyz?for=query").await.ok()["status"], "ready");
    assert_eq!(app.metric("placeformer_ready").await, 1.0);
    app.get("/readyz?for=lunch")
        .await
        .problem("invalid_parameter");
    app.get("/readyz?far=query")
        .await
        .problem("invalid_parameter");
    assert_eq!(app.delete(&format!("/references/{id}")).await.status, 204);
    app.state.health.set_disk_full(false);
    app.post_png("/references?map=m", 2).await.created();
}

#[tokio::test]
async fn too_many_bytes_under_way_are_refused() {
    let app = App::with(|config| config.http.max_buffered_bytes = 128 << 10);
    app.post("/query?map=m", "image/png", vec![0; 256 << 10])
        .await
        .problem("overloaded");
    app.post_png("/references?map=m", 1).await.created();
}

#[tokio::test]
async fn before_the_service_is_loaded_it_says_so() {
    let (metrics, health) = (
        Arc::new(Metrics::new().unwrap()),
        Arc::new(Health::default()),
    );
    let state = AppState::new(
        HttpConfig::default(),
        &AuthConfig::default(),
        1 << 20,
        metrics,
        health.clone(),
    )
    .unwrap();
    let router = app(state);
    let get = |path: &str| {
        let (router, request) = (
            router.clone(),
            Request::get(path).body(Body::empty()).unwrap(),
        );
        async move { Answer::of(router.oneshot(request).await.unwrap()).await }
    };
    assert_eq!(get("/livez").await.status, 200);
    assert!(
        get("/info")
            .await
            .problem("not_ready")
            .contains("loading_model")
    );
    assert_eq!(get("/readyz").await.json["status"], "loading_model");
    assert_eq!(
        get("/readyz?for=query").await.json["status"],
        "loading_model"
    );
    assert!(get("/metrics").await.text.contains("placeformer_ready 0"));
    health.migrating();
    assert_eq!(get("/readyz").await.json["status"], "migrating");
    health.building_index(7);
    health.indexed(3);
    let building = get("/readyz").await;
    assert_eq!(building.json["status"], "building_index");
    assert_eq!(
        building.json["progress"],
        serde_json::json!({"done": 3, "total": 7})
    );
    assert_eq!(building.status.as_u16(), ErrorCode::NotReady.status());
    assert_eq!(get("/metrics").await.status, 200);
}

#[tokio::test]
async fn models_of_two_servers_do_not_mix() {
    let source = FakeSource::new("fake-9");
    let app = App::open(Arc::new(tempfile::tempdir().unwrap()), source, |_| {});
    assert_eq!(
        app.post_png("/references?map=m", 1).await.created()["model"],
        "fake-9"
    );
}
