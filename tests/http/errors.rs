//! What goes wrong over HTTP, each with its code from the one table, and nothing stored.

use crate::support::{App, BREAKS_THE_DECODER, BREAKS_THE_MODEL, FakeSource, multipart, picture};
use axum::body::Body;
use axum::http::Request;
use serde_json::json;
use std::sync::Arc;

/// A PNG whose header promises `width` x `height` pixels.
fn png_header(width: u32, height: u32) -> Vec<u8> {
    let mut header = b"IHDR".to_vec();
    header.extend_from_slice(&width.to_be_bytes());
    header.extend_from_slice(&height.to_be_bytes());
    header.extend_from_slice(&[8, 2, 0, 0, 0]);
    let mut png = b"\x89PNG\r\n\x1a\n\x00\x00\x00\x0d".to_vec();
    png.extend_from_slice(&header);
    png.extend_from_slice(&crc32fast::hash(&header).to_be_bytes());
    png
}

fn jpeg(width: u32, height: u32) -> Vec<u8> {
    let mut bytes = std::io::Cursor::new(Vec::new());
    let pixels = image::RgbImage::from_fn(width, height, |x, y| {
        image::Rgb([x as u8, y as u8, (x * y) as u8])
    });
    pixels
        .write_to(&mut bytes, image::ImageFormat::Jpeg)
        .unwrap();
    bytes.into_inner()
}

/// The JPEG with its scan's header again and again before its end.
fn scan_bomb(jpeg: &[u8], scans: usize) -> Vec<u8> {
    let end = jpeg.len() - 2;
    let start = jpeg
        .windows(2)
        .rposition(|marker| marker == b"\xff\xda")
        .unwrap();
    let length = 2 + usize::from(u16::from_be_bytes([jpeg[start + 2], jpeg[start + 3]]));
    [
        &jpeg[..end],
        &jpeg[start..start + length].repeat(scans),
        &jpeg[end..],
    ]
    .concat()
}

#[tokio::test]
async fn what_breaks_inside_costs_one_request() {
    let app = App::new();
    app.post_png("/references?map=m", 1).await.created();
    for path in ["/references?map=m", "/query?map=m"] {
        app.post_bytes(path, BREAKS_THE_DECODER)
            .await
            .problem("image_undecodable");
        app.post_png("/query?map=m", 1).await.ok();
        let detail = app
            .post_bytes(path, BREAKS_THE_MODEL)
            .await
            .problem("internal")
            .to_owned();
        assert!(
            !detail.contains("planted"),
            "what broke inside is for the log: {detail}"
        );
        app.post_png("/query?map=m", 1).await.ok();
    }
    assert_eq!(app.count().await, 1);
    app.drained().await;
}

#[tokio::test]
async fn bad_images_are_refused_and_nothing_is_stored() {
    let app = App::with(|config| config.image.max_bytes = 64 << 10);
    let whole = jpeg(64, 48);
    let cases: [(&str, Vec<u8>, &str); 12] = [
        ("empty", vec![], "empty_image"),
        ("one byte", vec![0xff], "unsupported_media_type"),
        (
            "two bytes of a JPEG",
            whole[..2].to_vec(),
            "image_undecodable",
        ),
        ("truncated head", whole[..100].to_vec(), "image_undecodable"),
        (
            "cut in half",
            whole[..whole.len() / 2].to_vec(),
            "image_undecodable",
        ),
        (
            "without the data of its last blocks",
            whole[..whole.len() - 20].to_vec(),
            "image_undecodable",
        ),
        (
            "half a PNG",
            picture(1)[..picture(1).len() / 2].to_vec(),
            "image_undecodable",
        ),
        (
            "thousands of scans",
            scan_bomb(&whole, 3000),
            "image_undecodable",
        ),
        (
            "50,000 x 50,000",
            png_header(50_000, 50_000),
            "image_too_large",
        ),
        (
            "text",
            b"this is no picture, whatever its name says".to_vec(),
            "unsupported_media_type",
        ),
        ("no pixels", png_header(0, 0), "image_undecodable"),
        ("too many bytes", vec![0; (64 << 10) + 1], "body_too_large"),
    ];
    for (name, bytes, code) in cases {
        let answer = app.post_bytes("/references?map=m", &bytes).await;
        assert_eq!(answer.json["code"], code, "{name}: {}", answer.text);
        answer.problem(code);
    }
    assert_eq!(app.count().await, 0);
    assert_eq!(app.source.described(), 0);
    assert_eq!(app.get("/maps").await.ok()["maps"], json!([]));
}

#[tokio::test]
async fn bad_parameters_are_named() {
    let app = App::new();
    app.post_png("/references?map=m", 1).await.created();
    let references = [
        ("", "map"),
        ("map=a/b", "map"),
        ("map=m&colour=red", "colour"),
        ("map=m&lat=95&lon=0", "lat"),
        ("map=m&lat=NaN&lon=0", "lat"),
        ("map=m&lat=1", "lon"),
        ("map=m&lat=north&lon=0", "lat"),
        ("map=m&heading=1e9", "heading"),
        ("map=m&captured_at=yesterday", "captured_at"),
        ("map=m&metadata=7", "metadata"),
        ("map=m&external_id=", "external_id"),
        ("map=m&map=n", "map"),
    ];
    for (query, named) in references {
        let answer = app.post_png(&format!("/references?{query}"), 2).await;
        let detail = answer.problem("invalid_parameter");
        assert!(
            detail.contains(named),
            "{query}: {detail:?} does not name {named}"
        );
    }
    let queries = [
        ("map=m&top_k=0", "top_k"),
        ("map=m&top_k=1000000000", "top_k"),
        ("map=m&top_k=-1", "top_k"),
        ("map=m&candidates=0", "candidates"),
        ("map=m&rerank=perhaps", "rerank"),
        ("map=m&near=1,2", "radius_m"),
        ("map=m&near=1&radius_m=5", "near"),
        ("map=m&near=1,2&radius_m=-5", "radius_m"),
        ("map=m&near=1,2&radius_m=NaN", "radius_m"),
        ("map=m&deadline_ms=0", "deadline_ms"),
        ("map=m&topk=3", "topk"),
    ];
    for (query, named) in queries {
        let answer = app.post_png(&format!("/query?{query}"), 1).await;
        let detail = answer.problem("invalid_parameter");
        assert!(
            detail.contains(named),
            "{query}: {detail:?} does not name {named}"
        );
    }
    for path in [
        "/references?limit=0",
        "/references?limit=1001",
        "/references?cursor=x",
        "/references?external_id=a",
    ] {
        app.get(path).await.problem("invalid_parameter");
    }
    assert_eq!(app.count().await, 1);
}

#[tokio::test]
async fn bad_json_is_told_from_bad_values() {
    let app = App::new();
    let deep = format!(
        "{{\"map\": \"m\", \"metadata\": {}{}}}",
        "[".repeat(100_000),
        "]".repeat(100_000)
    );
    let cases = [
        (deep, "malformed_request"),
        ("{\"map\": ".to_owned(), "malformed_request"),
        ("[1, 2]".to_owned(), "invalid_parameter"),
        (
            json!({"map": "m", "image": 7}).to_string(),
            "invalid_parameter",
        ),
        (
            json!({"map": "m", "image": "***"}).to_string(),
            "invalid_parameter",
        ),
        (json!({"map": "m"}).to_string(), "invalid_parameter"),
        (json!({"map": "m", "image": ""}).to_string(), "empty_image"),
        (
            json!({"map": "m", "image": "AAAA", "lat": "1", "lon": 2}).to_string(),
            "invalid_parameter",
        ),
        (
            json!({"map": "m", "image": "AAAA", "colour": "red"}).to_string(),
            "invalid_parameter",
        ),
    ];
    for (body, code) in cases {
        let shown: String = body.chars().take(60).collect();
        let answer = app.post("/references", "application/json", body).await;
        assert_eq!(answer.json["code"], code, "{shown}: {}", answer.text);
        answer.problem(code);
    }
    let both = app
        .post(
            "/references?map=m",
            "application/json",
            json!({"map": "m", "image": "AAAA"}).to_string(),
        )
        .await;
    both.problem("invalid_parameter");
    assert_eq!(app.count().await, 0);
}

#[tokio::test]
async fn bad_multipart_is_refused() {
    let app = App::new();
    let (kind, body) = multipart(&[("json", br#"{"map": "m"}"#)]);
    assert!(
        app.post("/references", &kind, body)
            .await
            .problem("invalid_parameter")
            .contains("image")
    );
    let (_, body) = multipart(&[("picture", &picture(1)), ("json", br#"{"map": "m"}"#)]);
    assert!(
        app.post("/references", &kind, body)
            .await
            .problem("invalid_parameter")
            .contains("picture")
    );
    let (_, body) = multipart(&[
        ("image", &picture(1)),
        ("image", &picture(1)),
        ("json", br#"{"map": "m"}"#),
    ]);
    assert!(
        app.post("/references", &kind, body)
            .await
            .problem("invalid_parameter")
            .contains("twice")
    );
    let (_, body) = multipart(&[("image", &picture(1)), ("json", b"{")]);
    app.post("/references", &kind, body.clone())
        .await
        .problem("malformed_request");
    app.post("/references", &kind, body[..body.len() / 2].to_vec())
        .await
        .problem("malformed_request");
    app.post("/references", "multipart/form-data", body)
        .await
        .problem("malformed_request");
    assert_eq!(app.count().await, 0);
}

#[tokio::test]
async fn wrong_paths_methods_and_types_are_problems_too() {
    let app = App::new();
    app.get("/nowhere").await.problem("route_not_found");
    app.get("/references/not-a-uuid")
        .await
        .problem("reference_not_found");
    app.get("/maps/none").await.problem("map_not_found");
    app.delete("/maps/none").await.problem("map_not_found");
    app.get("/references?map=none")
        .await
        .problem("map_not_found");
    let put = app
        .send(Request::put("/references").body(Body::empty()).unwrap())
        .await;
    put.problem("method_not_allowed");
    assert!(put.header("allow").contains("POST"), "{:?}", put.headers);
    app.post("/query?map=m", "image/gif", "GIF89a")
        .await
        .problem("unsupported_media_type");
    app.send(Request::post("/query?map=m").body(Body::from("x")).unwrap())
        .await
        .problem("unsupported_media_type");
    let id = app.post_png("/references?map=m", 1).await.created()["id"]
        .as_str()
        .unwrap()
        .to_owned();
    let path = format!("/references/{id}");
    let text = Request::patch(&path)
        .header("content-type", "text/plain")
        .body(Body::from("{}"))
        .unwrap();
    app.send(text).await.problem("unsupported_media_type");
    app.patch(&path, &json!({"lat": 1}))
        .await
        .problem("invalid_parameter");
    app.patch(&path, &json!({"map": "n"}))
        .await
        .problem("invalid_parameter");
    app.patch(&path, &json!([]))
        .await
        .problem("invalid_parameter");
    app.patch(&path, &json!({"lat": 91, "lon": 0}))
        .await
        .problem("invalid_parameter");
}

#[tokio::test]
async fn matches_need_two_sides() {
    let app = App::new();
    app.post_png("/match", 1).await.problem("invalid_parameter");
    app.post_png("/match?reference_id=x", 1)
        .await
        .problem("invalid_parameter");
    app.post_png(
        "/match?reference_id=0197f3c2-7c1e-7d3a-9b1f-2f6f0c1d2e3f",
        1,
    )
    .await
    .problem("reference_not_found");
    let (kind, body) = multipart(&[("reference", &picture(1))]);
    assert!(
        app.post("/match", &kind, body)
            .await
            .problem("invalid_parameter")
            .contains("query")
    );
}

#[tokio::test]
async fn an_external_id_names_one_image() {
    let app = App::new();
    let first = app.post_png("/references?map=m&external_id=a", 1).await;
    let again = app.post_png("/references?map=m&external_id=a", 1).await;
    assert_eq!(again.ok()["id"], first.created()["id"]);
    app.post_png("/references?map=m&external_id=a", 2)
        .await
        .problem("external_id_conflict");
    app.post_png("/references?map=n&external_id=a", 2)
        .await
        .created();
    let other = app.post_png("/references?map=m&external_id=b", 3).await;
    let path = format!("/references/{}", other.created()["id"].as_str().unwrap());
    app.patch(&path, &json!({"external_id": "a"}))
        .await
        .problem("external_id_conflict");
    assert_eq!(app.count().await, 3);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn concurrent_creates_of_one_external_id_make_one_reference() {
    let app = Arc::new(App::new());
    for round in 0..10 {
        let tasks: Vec<_> = (0..8u64)
            .map(|sender| {
                let app = app.clone();
                // Half send one image, half another.
                let path = format!("/references?map=m&external_id={round}");
                tokio::spawn(async move {
                    app.post_png(&path, round * 2 + sender % 2)
                        .await
                        .status
                        .as_u16()
                })
            })
            .collect();
        let mut statuses = Vec::new();
        for task in tasks {
            statuses.push(task.await.unwrap());
        }
        statuses.sort_unstable();
        assert_eq!(
            statuses,
            [200, 200, 200, 201, 409, 409, 409, 409],
            "round {round}"
        );
    }
    assert_eq!(app.count().await, 10);
    assert_eq!(app.get("/maps/m").await.ok()["references"], 10);
}

#[tokio::test]
async fn a_map_of_another_model_is_refused_with_both_names() {
    let app = App::new();
    let id = app.post_png("/references?map=m", 1).await.created()["id"]
        .as_str()
        .unwrap()
        .to_owned();
    let directory = app.directory.clone();
    drop(app);
    let app = App::open(directory, FakeSource::new("fake-2"), |_| {});
    for answer in [
        app.post_png("/query?map=m", 1).await,
        app.post_png("/references?map=m", 2).await,
        app.post_png(&format!("/match?reference_id={id}"), 2).await,
    ] {
        let detail = answer.problem("model_mismatch");
        assert!(
            detail.contains("fake-1") && detail.contains("fake-2"),
            "{detail}"
        );
    }
    assert_eq!(app.source.described(), 0);
    assert_eq!(app.delete(&format!("/references/{id}")).await.status, 204);
}

#[tokio::test]
async fn what_is_stored_is_served_after_a_restart() {
    let app = App::new();
    for seed in 0..3 {
        app.post_png(
            &format!("/references?map=m&external_id={seed}&lat=1&lon={seed}"),
            seed,
        )
        .await
        .created();
    }
    let before = app.post_png("/query?map=m", 1).await.ok()["results"].clone();
    let (directory, source) = (app.directory.clone(), app.source.clone());
    drop(app);
    let app = App::open(directory, source, |_| {});
    assert_eq!(
        app.post_png("/query?map=m", 1).await.ok()["results"],
        before
    );
    assert_eq!(
        app.post_png("/query?map=m&near=1,2&radius_m=9", 1)
            .await
            .ok()["results"]
            .as_array()
            .unwrap()
            .len(),
        1
    );
}

#[tokio::test]
async fn oversized_metadata_is_refused() {
    let app = App::with(|config| config.pipeline.max_metadata_bytes = 20);
    app.post_png("/references?map=m&metadata=%7B%22a%22:1%7D", 1)
        .await
        .created();
    let long = format!(
        "/references?map=m&metadata=%7B%22a%22:%22{}%22%7D",
        "x".repeat(20)
    );
    assert!(
        app.post_png(&long, 2)
            .await
            .problem("invalid_parameter")
            .contains("metadata")
    );
}
