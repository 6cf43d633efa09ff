//! Every route's happy path, through the router.

use crate::support::{App, multipart, picture};
use axum::body::Body;
use axum::http::Request;
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use serde_json::{Value, json};

#[tokio::test]
async fn a_reference_is_created_shown_changed_and_deleted() {
    let app = App::new();
    let created = app.post_png("/references?map=m&external_id=a&lat=51.5&lon=-0.1&heading=-90&captured_at=2026-05-17T09:30:00Z&metadata=%7B%22camera%22:%22left%22%7D", 1).await;
    let body = created.created();
    assert_eq!(
        body["location"],
        json!({"lat": 51.5, "lon": -0.1, "alt": null, "heading": 270.0})
    );
    assert_eq!(
        (&body["map"], &body["external_id"]),
        (&json!("m"), &json!("a"))
    );
    assert_eq!(
        (&body["captured_at"], &body["metadata"]),
        (&json!("2026-05-17T09:30:00Z"), &json!({"camera": "left"}))
    );
    let path = format!("/references/{}", body["id"].as_str().unwrap());
    assert_eq!(created.header("location"), path);
    assert!(created.header("server-timing").contains("extract;dur="));
    // Where the fields come from is known only now.
    let mut stored = app.get(&path).await.ok().clone();
    stored["sources"] = json!({
        "location": "request",
        "alt": null,
        "heading": "request",
        "captured_at": "request",
    });
    assert_eq!(&stored, body);

    let changed = app
        .patch(
            &path,
            &json!({"lat": null, "lon": null, "external_id": "b"}),
        )
        .await;
    assert_eq!(
        changed.ok()["location"],
        json!({"lat": null, "lon": null, "alt": null, "heading": 270.0})
    );
    assert_eq!(changed.json["external_id"], "b");
    assert_eq!(changed.json["metadata"], json!({"camera": "left"}));
    assert_eq!(
        app.patch(&path, &json!({"metadata": null, "heading": null}))
            .await
            .ok()["metadata"],
        Value::Null
    );
    assert_eq!(app.get(&path).await.ok()["location"], Value::Null);

    assert_eq!(app.delete(&path).await.status, 204);
    app.get(&path).await.problem("reference_not_found");
    app.delete(&path).await.problem("reference_not_found");
}

#[tokio::test]
async fn an_image_may_come_raw_as_multipart_or_as_base64() {
    let app = App::new();
    app.post_png("/references?map=m", 1).await.created();
    let (kind, body) = multipart(&[
        ("image", &picture(2)),
        ("json", br#"{"map": "m", "lat": 1, "lon": 2}"#),
    ]);
    assert_eq!(
        app.post("/references", &kind, body).await.created()["location"]["lon"],
        2.0
    );
    let (kind, body) = multipart(&[("image", &picture(3))]);
    app.post("/references?map=m", &kind, body).await.created();
    let json = json!({"image": STANDARD.encode(picture(4)), "map": "m", "metadata": {"n": [1, 2]}});
    let created = app
        .post("/references", "application/json", json.to_string())
        .await;
    assert_eq!(created.created()["metadata"], json!({"n": [1, 2]}));
    assert_eq!(app.get("/maps/m").await.ok()["references"], 4);

    let json = json!({"image": STANDARD.encode(picture(4)), "map": "m", "top_k": 1});
    let found = app
        .post(
            "/query",
            "application/json; charset=utf-8",
            json.to_string(),
        )
        .await;
    assert_eq!(found.ok()["results"][0]["reference_id"], created.json["id"]);
}

/// `curl --data-binary @photo.jpg` calls the photo a form, and others say nothing about it.
#[tokio::test]
async fn an_image_without_a_type_of_its_own_is_taken_for_one() {
    let app = App::new();
    let form = "application/x-www-form-urlencoded";
    let created = app.post("/references?map=m", form, picture(1)).await;
    created.created();
    let request = Request::post("/query?map=m").body(Body::from(picture(1)));
    let found = app.send(request.unwrap()).await;
    assert_eq!(found.ok()["results"][0]["reference_id"], created.json["id"]);
}

#[tokio::test]
async fn a_query_is_answered_with_ranked_evidence() {
    let app = App::new();
    for seed in 0..8 {
        app.post_png(
            &format!("/references?map=m&external_id={seed}&lat=50.{seed}&lon=8"),
            seed,
        )
        .await
        .created();
    }
    let answer = app.post_png("/query?map=m&top_k=3", 5).await;
    let body = answer.ok();
    assert_eq!(body["reranked"], true);
    assert_eq!(body["model"], "fake-1");
    let results = body["results"].as_array().unwrap();
    assert_eq!(results.len(), 3);
    assert_eq!(
        (&results[0]["external_id"], &results[0]["rank"]),
        (&json!("5"), &json!(1))
    );
    assert_eq!(
        results[0]["location"],
        json!({"lat": 50.5, "lon": 8.0, "alt": null, "heading": null})
    );
    let scores = results[0]["scores"].as_object().unwrap();
    assert_eq!(scores.keys().collect::<Vec<_>>(), ["s11", "s12", "s23"]);
    let inliers: u64 = scores
        .values()
        .map(|score| score["inliers"].as_u64().unwrap())
        .sum();
    assert_eq!(results[0]["spatial_score"], inliers);
    assert!(inliers > results[1]["spatial_score"].as_u64().unwrap());
    for stage in ["decode", "queue", "extract", "search", "load", "rerank"] {
        assert!(body["timings_ms"][stage].is_number(), "{stage}");
        assert!(
            answer
                .header("server-timing")
                .contains(&format!("{stage};dur=")),
            "{stage}"
        );
    }
}

#[tokio::test]
async fn filters_and_options_shape_the_answer() {
    let app = App::new();
    for seed in 0..4 {
        let fields = format!(
            "external_id={seed}&lat=50&lon={seed}&captured_at=2026-01-0{}T00:00:00Z",
            seed + 1
        );
        app.post_png(&format!("/references?map=m&{fields}"), seed)
            .await
            .created();
    }
    let names = |answer: &Value| -> Vec<String> {
        let results = answer["results"].as_array().unwrap();
        results
            .iter()
            .map(|result| result["external_id"].as_str().unwrap().to_owned())
            .collect()
    };
    let near = app
        .post_png("/query?map=m&near=50,3&radius_m=1000", 0)
        .await;
    assert_eq!(names(near.ok()), ["3"]);
    let mut timed = names(
        app.post_png(
            "/query?map=m&captured_after=2026-01-02T00:00:00Z&captured_before=2026-01-04T00:00:00Z",
            0,
        )
        .await
        .ok(),
    );
    timed.sort();
    assert_eq!(timed, ["1", "2"]);
    let global = app.post_png("/query?map=m&rerank=false&top_k=2", 2).await;
    assert_eq!(
        (&global.ok()["reranked"], names(&global.json)[0].as_str()),
        (&json!(false), "2")
    );
    assert_eq!(global.json["results"][0]["spatial_score"], Value::Null);
    assert_eq!(global.json["results"][0]["scores"], Value::Null);
    let few = app.post_png("/query?map=m&candidates=1&top_k=4", 1).await;
    assert_eq!(names(few.ok()).len(), 4);
    assert!(few.json["results"][0]["spatial_score"].is_number());
    assert_eq!(few.json["results"][1]["spatial_score"], Value::Null);
    let nowhere = app
        .post_png("/query?map=m&near=-50,100&radius_m=10", 0)
        .await;
    assert_eq!(names(nowhere.ok()), Vec::<String>::new());
}

#[tokio::test]
async fn a_moved_reference_is_found_at_its_new_place() {
    let app = App::new();
    let created = app.post_png("/references?map=m&lat=50&lon=8", 1).await;
    let path = format!("/references/{}", created.created()["id"].as_str().unwrap());
    app.patch(
        &path,
        &json!({"lat": 10, "lon": 20, "captured_at": "2020-01-01T00:00:00Z"}),
    )
    .await
    .ok();
    let found = |answer: Value| answer["results"].as_array().unwrap().len();
    assert_eq!(
        found(
            app.post_png("/query?map=m&near=50,8&radius_m=100", 1)
                .await
                .ok()
                .clone()
        ),
        0
    );
    assert_eq!(
        found(
            app.post_png("/query?map=m&near=10,20&radius_m=100", 1)
                .await
                .ok()
                .clone()
        ),
        1
    );
    assert_eq!(
        found(
            app.post_png("/query?map=m&captured_before=2020-01-02T00:00:00Z", 1)
                .await
                .ok()
                .clone()
        ),
        1
    );
}

#[tokio::test]
async fn a_deleted_reference_is_found_no_more() {
    let app = App::new();
    let id = app.post_png("/references?map=m", 1).await.created()["id"]
        .as_str()
        .unwrap()
        .to_owned();
    app.post_png("/references?map=m", 2).await.created();
    assert_eq!(
        app.post_png("/query?map=m", 1).await.ok()["results"][0]["reference_id"],
        id.as_str()
    );
    app.delete(&format!("/references/{id}")).await;
    let answer = app.post_png("/query?map=m", 1).await;
    let results = answer.ok()["results"].as_array().unwrap();
    assert!(results.len() == 1 && results[0]["reference_id"] != id.as_str());
}

#[tokio::test]
async fn listings_come_in_pages() {
    let app = App::new();
    for seed in 0..5 {
        app.post_png(&format!("/references?map=m&external_id={seed}"), seed)
            .await
            .created();
    }
    app.post_png("/references?map=other", 9).await.created();
    let (mut seen, mut path) = (Vec::new(), "/references?map=m&limit=2".to_owned());
    loop {
        let page = app.get(&path).await;
        let references = page.ok()["references"].as_array().unwrap();
        seen.extend(
            references
                .iter()
                .map(|one| one["external_id"].as_str().unwrap().to_owned()),
        );
        let Some(next) = page.json["next"].as_str() else {
            break;
        };
        path = format!("/references?map=m&limit=2&cursor={next}");
    }
    assert_eq!(seen, ["0", "1", "2", "3", "4"]);
    assert_eq!(app.count().await, 6);
    let one = app.get("/references?map=m&external_id=3").await;
    assert_eq!(one.ok()["references"].as_array().unwrap().len(), 1);
    assert_eq!(
        app.get("/references?map=m&external_id=x").await.ok()["references"],
        json!([])
    );
}

#[tokio::test]
async fn maps_are_listed_shown_and_deleted() {
    let app = App::new();
    for (map, seed) in [("b", 1), ("a", 2), ("b", 3)] {
        app.post_png(&format!("/references?map={map}"), seed)
            .await
            .created();
    }
    let list = app.get("/maps").await;
    let names: Vec<_> = list.ok()["maps"]
        .as_array()
        .unwrap()
        .iter()
        .map(|map| map["name"].clone())
        .collect();
    assert_eq!(names, [json!("a"), json!("b")]);
    assert_eq!(app.get("/maps/b").await.ok()["references"], 2);
    assert_eq!(app.delete("/maps/b").await.ok()["references_deleted"], 2);
    app.get("/maps/b").await.problem("map_not_found");
    app.post_png("/query?map=b", 1)
        .await
        .problem("map_not_found");
    app.post_png("/references?map=b", 1).await.created();
    assert_eq!(
        app.post_png("/query?map=b", 1).await.ok()["results"]
            .as_array()
            .unwrap()
            .len(),
        1
    );
}

#[tokio::test]
async fn two_images_or_an_image_and_a_reference_are_matched() {
    let app = App::new();
    let id = app.post_png("/references?map=m", 1).await.created()["id"]
        .as_str()
        .unwrap()
        .to_owned();
    let (kind, body) = multipart(&[("query", &picture(1)), ("reference", &picture(1))]);
    let pair = app.post("/match", &kind, body).await;
    let stored = app.post_png(&format!("/match?reference_id={id}"), 1).await;
    assert_eq!(pair.ok()["spatial_score"], stored.ok()["spatial_score"]);
    let s11 = &pair.json["combinations"]["s11"];
    assert_eq!(s11["matches"], 48);
    assert_eq!(s11["homography"].as_array().unwrap().len(), 9);
    let first = &s11["correspondences"][0];
    assert_eq!(
        (&first["query"], &first["query_scale"]),
        (&first["reference"], &json!(1))
    );
    assert_eq!(pair.json["input_size"], json!({"width": 112, "height": 84}));
    assert_eq!(pair.json["key_patches"], Value::Null);
    let json = json!({"query": STANDARD.encode(picture(1)), "reference_id": id}).to_string();
    app.post("/match", "application/json", json).await.ok();
}

#[tokio::test]
async fn a_match_lists_the_key_patches_of_both_images_where_it_is_asked_to() {
    let app = App::new();
    let images: [(&str, &[u8]); 2] = [("query", &picture(1)), ("reference", &picture(2))];
    let (kind, body) = multipart(&images);
    let answer = app.post("/match?key_patches=true", &kind, body).await;
    let size = &answer.ok()["input_size"];
    let patches = &answer.json["key_patches"];
    let side = patches["patch_size"].as_f64().unwrap();
    for image in ["query", "reference"] {
        let listed = patches[image].as_array().unwrap();
        assert!(!listed.is_empty(), "{image}");
        for patch in listed {
            let half = side * patch["scale"].as_f64().unwrap() / 2.0;
            for (axis, length) in [(0, "width"), (1, "height")] {
                let centre = patch["centre"][axis].as_f64().unwrap();
                let end = size[length].as_f64().unwrap();
                assert!(centre >= half && centre + half <= end, "{image}: {patch}");
            }
            assert!(patch["attention"].as_f64().unwrap() > 0.0, "{patch}");
        }
    }
    // What is matched is among the key patches.
    let pairs = &answer.json["combinations"]["s11"]["correspondences"];
    for pair in pairs.as_array().unwrap() {
        for image in ["query", "reference"] {
            let mut listed = patches[image].as_array().unwrap().iter();
            let found = listed.any(|patch| patch["scale"] == 1 && patch["centre"] == pair[image]);
            assert!(found, "{image}: {pair}");
        }
    }
}

#[tokio::test]
async fn the_service_describes_itself() {
    let app = App::new();
    assert_eq!(app.get("/livez").await.ok(), &json!({"status": "live"}));
    assert_eq!(app.get("/readyz").await.ok()["status"], "ready");
    let info = app.get("/info").await;
    assert_eq!(info.ok()["model"], "fake-1");
    assert_eq!(info.json["scales"], json!(["1", "1+2", "2+3"]));
    let openapi = app.get("/openapi.json").await;
    assert_eq!(openapi.ok()["openapi"], "3.1.0");
    let page = app.get("/docs/").await;
    assert!(page.status == 200 && page.text.contains("swagger"));
    assert!(app.get("/docs/swagger-ui-bundle.js").await.status == 200);
    let console = app.get("/").await;
    assert!(console.status == 200 && console.text.contains("/console/js/main.js"));
    let policy = console.header("content-security-policy");
    assert!(
        policy.starts_with("default-src 'none'; script-src 'self';"),
        "{policy}"
    );
    let script = app.get("/console/js/main.js").await;
    let kind = script.header("content-type");
    assert_eq!(
        (script.status.as_u16(), kind),
        (200, "text/javascript; charset=utf-8")
    );
    assert_eq!(script.header("content-security-policy"), policy);
    let missing = app.get("/console/js/../../Cargo.toml").await;
    missing.problem("route_not_found");
    let head = app
        .send(Request::head("/info").body(Body::empty()).unwrap())
        .await;
    assert_eq!((head.status.as_u16(), head.text.as_str()), (200, ""));
}

#[tokio::test]
async fn metrics_follow_what_happens() {
    let app = App::new();
    app.post_png("/references?map=m", 1).await.created();
    app.post_png("/query?map=m", 1).await.ok();
    app.post_png("/query?map=none", 1)
        .await
        .problem("map_not_found");
    let text = app.get("/metrics").await.text;
    for line in [
        "placeformer_http_requests_total{method=\"POST\",route=\"/references\",status=\"201\"} 1",
        "placeformer_http_requests_total{method=\"POST\",route=\"/query\",status=\"404\"} 1",
        "placeformer_http_requests_total{method=\"POST\",route=\"/query\",status=\"504\"} 0",
        "placeformer_http_request_duration_seconds_count{route=\"/query\"} 2",
        "placeformer_stage_duration_seconds_count{stage=\"extract\"} 2",
        "placeformer_stage_duration_seconds_count{stage=\"commit\"} 1",
        "placeformer_references{map=\"m\"} 1",
        "placeformer_query_top1_score_count 1",
        "placeformer_queue_depth 0",
    ] {
        assert!(
            text.lines().any(|have| have == line),
            "{line} is not in\n{text}"
        );
    }
}

#[tokio::test]
async fn request_ids_are_taken_over_or_minted() {
    let app = App::new();
    let with = |id: &str| {
        Request::get("/livez")
            .header("x-request-id", id)
            .body(Body::empty())
            .unwrap()
    };
    assert_eq!(
        app.send(with("drive7-42")).await.header("x-request-id"),
        "drive7-42"
    );
    for bad in ["a b", "x\"y", &"x".repeat(129)] {
        let minted = app.send(with(bad)).await.header("x-request-id").to_owned();
        assert!(minted != bad && minted.len() == 36, "{minted}");
    }
    let refused = app
        .send(
            Request::get("/nowhere")
                .header("x-request-id", "q1")
                .body(Body::empty())
                .unwrap(),
        )
        .await;
    refused.problem("route_not_found");
    assert_eq!(refused.json["request_id"], "q1");
}

/// As `placeformer openapi | head` does: the document is longer than a pipe holds, so its writer
/// meets the closed end.
#[test]
fn a_command_ends_quietly_when_the_reader_of_its_output_has_gone() {
    let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_placeformer"));
    command
        .arg("openapi")
        .stdout(std::process::Stdio::piped())
        .stderr(std::process::Stdio::piped());
    let mut child = command.spawn().unwrap();
    drop(child.stdout.take());
    let output = child.wait_with_output().unwrap();
    assert_eq!(
        (
            output.status.code(),
            String::from_utf8_lossy(&output.stderr).as_ref()
        ),
        (Some(141), "")
    );
}

#[test]
fn the_committed_openapi_document_is_current() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/openapi/openapi.json");
    let committed = std::fs::read_to_string(path).unwrap();
    let current = placeformer::http::openapi::document_text();
    assert!(
        committed == current,
        "renew it with: placeformer openapi --out openapi/openapi.json"
    );
}

#[test]
fn every_operation_is_described_with_its_errors() {
    let document = placeformer::http::openapi::document();
    let mut ids = std::collections::BTreeSet::new();
    for (path, item) in document["paths"].as_object().unwrap() {
        for (method, operation) in item.as_object().unwrap() {
            let name = format!("{method} {path}");
            assert!(
                operation["summary"]
                    .as_str()
                    .is_some_and(|summary| !summary.is_empty()),
                "{name}"
            );
            let id = operation["operationId"].as_str().unwrap_or_default();
            assert!(
                !id.is_empty() && ids.insert(id.to_owned()),
                "{name}: operationId {id:?} is missing or used twice"
            );
            for (status, response) in operation["responses"]
                .as_object()
                .unwrap()
                .iter()
                .filter(|(s, _)| s.as_str() < "300")
            {
                let content = response["content"].as_object().into_iter().flatten();
                content.for_each(|(_, content)| {
                    assert!(!content["example"].is_null(), "{name} {status}: no example")
                });
            }
            if let Some(content) = operation.pointer("/requestBody/content/application~1json") {
                assert!(
                    content["example"].is_object(),
                    "{name}: no example of a body"
                );
            }
            let failures = operation["responses"]
                .as_object()
                .unwrap()
                .iter()
                .filter(|(status, _)| status.as_str() >= "400");
            for (status, response) in failures.filter(|_| path != "/readyz") {
                let examples = &response["content"]["application/problem+json"]["examples"];
                assert!(
                    examples
                        .as_object()
                        .is_some_and(|examples| !examples.is_empty()),
                    "{name} {status}"
                );
            }
        }
    }
}
