//! Whatever is accepted can be read back by every route that shows it, and every answer is JSON.

use crate::support::{Answer, App, BACKBONE, FakeSource, file_of, head, multipart, picture};
use axum::body::Body;
use axum::http::{Method, Request};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use placeformer_vision::extract::Aggregate;
use proptest::prelude::*;
use serde_json::{Value, json};
use std::sync::Arc;

/// Every answer of the interface is JSON, whatever goes wrong, and errors are problems.
#[track_caller]
fn assert_json(answer: &Answer, what: &str) {
    let kind = answer.header("content-type");
    if answer.status == 204 {
        assert_eq!(answer.text, "", "{what}");
    } else if answer.status.is_success() {
        assert_eq!(kind, "application/json", "{what}: {}", answer.text);
        assert!(serde_json::from_str::<&serde_json::value::RawValue>(&answer.text).is_ok());
    } else {
        assert_eq!(kind, "application/problem+json", "{what}: {}", answer.text);
        let code = answer.json["code"].as_str().unwrap_or_default().to_owned();
        answer.problem(&code);
    }
}

// ---------------------------------------------------------------- any fields

/// The fields of a reference as JSON texts, each in range or out of it.
#[derive(Debug, Clone)]
struct Fields(Vec<(&'static str, String)>);

fn number() -> impl Strategy<Value = String> {
    prop_oneof![
        (-400.0..400.0f64).prop_map(|number| number.to_string()),
        any::<f64>().prop_filter_map("JSON", |number| {
            number.is_finite().then(|| format!("{number:e}"))
        }),
        Just("-0.0".to_owned()),
        Just("5e-324".to_owned()),
        Just("90".to_owned()),
        Just("-180".to_owned()),
        Just("360".to_owned()),
        Just("1e400".to_owned()),
        Just("\"12\"".to_owned()),
        Just("null".to_owned()),
    ]
}

fn time() -> impl Strategy<Value = String> {
    let of_edge = (
        prop_oneof![
            Just(0),
            Just(1),
            Just(1969),
            Just(2026),
            Just(9998),
            Just(9999)
        ],
        prop_oneof![Just("01-01"), Just("12-31"), Just("02-29")],
        prop_oneof![
            Just("00:00:00"),
            Just("23:59:59"),
            Just("23:59:60"),
            Just("12:00:00.123456789"),
            Just("23:59:59.9999999"),
        ],
        prop_oneof![
            Just("Z"),
            Just("+00:00"),
            Just("+23:59"),
            Just("-23:59"),
            Just("+00:01"),
            Just("-00:01"),
            Just("+24:00"),
        ],
    );
    prop_oneof![
        8 => of_edge.prop_map(|(year, day, clock, zone)| {
            format!("\"{year:04}-{day}T{clock}{zone}\"")
        }),
        1 => Just("\"yesterday\"".to_owned()),
        1 => Just("12".to_owned()),
        1 => Just("null".to_owned()),
    ]
}

fn text() -> impl Strategy<Value = String> {
    let of_characters = prop_oneof![
        "[ -~]{0,40}".boxed(),
        "\\PC{0,40}".boxed(),
        any::<String>().boxed(),
        Just("🏠".repeat(256)).boxed(),
        Just("é".repeat(257)).boxed(),
    ];
    of_characters.prop_map(|text| serde_json::to_string(&text).unwrap())
}

/// JSON texts, with numbers that no float holds.
fn json_value() -> impl Strategy<Value = String> {
    let leaf = prop_oneof![
        Just("12345678901234567890123".to_owned()),
        Just("1.0".to_owned()),
        Just("1".to_owned()),
        Just("-0".to_owned()),
        Just("1E-2".to_owned()),
        Just("true".to_owned()),
        Just("null".to_owned()),
        text(),
    ];
    leaf.prop_recursive(4, 24, 4, |inner| {
        prop_oneof![
            prop::collection::vec(inner.clone(), 0..4)
                .prop_map(|values| format!("[{}]", values.join(","))),
            prop::collection::vec(("[a-c]", inner), 0..3).prop_map(object),
        ]
    })
}

/// An object, in which keys may occur twice.
fn object(members: Vec<(String, String)>) -> String {
    let members = members
        .iter()
        .map(|(key, value)| format!("\"{key}\":{value}"));
    format!("{{{}}}", members.collect::<Vec<_>>().join(","))
}

fn metadata() -> impl Strategy<Value = String> {
    prop_oneof![
        6 => prop::collection::vec(("[a-f]", json_value()), 0..4).prop_map(object),
        1 => json_value(),
        1 => Just(format!("{{\"a\":{}{}}}", "[".repeat(200), "]".repeat(200))),
        1 => Just(format!("{{\"a\":\"{}\"}}", "x".repeat(20_000))),
    ]
}

fn fields() -> impl Strategy<Value = Fields> {
    let maybe = |values: BoxedStrategy<String>| prop::option::weighted(0.6, values);
    let place = prop_oneof![
        3 => (-90.0..=90.0f64, -180.0..=180.0f64)
            .prop_map(|(lat, lon)| vec![("lat", lat.to_string()), ("lon", lon.to_string())]),
        1 => (number(), number()).prop_map(|(lat, lon)| vec![("lat", lat), ("lon", lon)]),
        1 => number().prop_map(|lat| vec![("lat", lat)]),
        2 => Just(vec![]),
    ];
    (
        maybe(text().boxed()),
        place,
        maybe(number().boxed()),
        maybe(time().boxed()),
        maybe(metadata().boxed()),
    )
        .prop_map(|(external_id, place, heading, captured_at, metadata)| {
            let mut fields = place;
            fields.extend(external_id.map(|value| ("external_id", value)));
            fields.extend(heading.map(|value| ("heading", value)));
            fields.extend(captured_at.map(|value| ("captured_at", value)));
            fields.extend(metadata.map(|value| ("metadata", value)));
            Fields(fields)
        })
}

impl Fields {
    fn json(&self, more: &str) -> String {
        let members = self
            .0
            .iter()
            .map(|(name, value)| format!("\"{name}\":{value}"));
        let members: Vec<String> = members
            .chain((!more.is_empty()).then(|| more.to_owned()))
            .collect();
        format!("{{{}}}", members.join(","))
    }

    /// As a query string, in which a text has no quotes.
    fn query(&self) -> String {
        let mut pairs = form_urlencoded::Serializer::new(String::new());
        for (name, value) in &self.0 {
            let text = serde_json::from_str::<String>(value);
            pairs.append_pair(name, text.as_deref().unwrap_or(value));
        }
        pairs.finish()
    }

    fn get(&self, name: &str) -> Option<&str> {
        let found = self.0.iter().find(|(other, _)| *other == name);
        found.map(|(_, value)| value.as_str())
    }
}

/// Everything that shows a reference, asked after it was stored or changed.
async fn shows_everywhere(app: &App, id: &str, expected: &Value, metadata: Option<&str>) {
    let one = app.get(&format!("/references/{id}")).await;
    assert_json(&one, "GET /references/{id}");
    assert_eq!(one.ok(), expected);
    if let Some(metadata) = metadata {
        let kept = format!("\"metadata\":{metadata}");
        assert!(one.text.contains(&kept), "{} has not {kept}", one.text);
    }
    let page = app.get("/references?map=m&limit=1000").await;
    assert_json(&page, "GET /references");
    let listed = page.ok()["references"].as_array().unwrap();
    assert!(listed.contains(expected), "{}", page.text);
    if let Some(name) = expected["external_id"].as_str() {
        let mut query = form_urlencoded::Serializer::new(String::new());
        query
            .append_pair("map", "m")
            .append_pair("external_id", name);
        let found = app.get(&format!("/references?{}", query.finish())).await;
        assert_json(&found, "GET /references?external_id");
        assert_eq!(found.ok()["references"], json!([expected]));
    }
    for rerank in [true, false] {
        let path = format!("/query?map=m&top_k=1000&rerank={rerank}");
        let answer = app.post_png(&path, 1).await;
        assert_json(&answer, &path);
        let results = answer.ok()["results"].as_array().unwrap().clone();
        let result = results
            .iter()
            .find(|result| result["reference_id"] == id)
            .unwrap();
        for field in ["external_id", "location", "captured_at", "metadata"] {
            assert_eq!(result[field], expected[field], "{field}");
        }
    }
}

/// Sends the fields in one of the three ways.
async fn create(app: &App, fields: &Fields, way: u8, seed: u64) -> Answer {
    let image = picture(seed);
    match way % 3 {
        0 => {
            let path = format!("/references?map=m&{}", fields.query());
            app.post(&path, "image/png", image).await
        }
        1 => {
            let image = format!("\"map\":\"m\",\"image\":\"{}\"", STANDARD.encode(image));
            app.post("/references", "application/json", fields.json(&image))
                .await
        }
        _ => {
            let json = fields.json("\"map\":\"m\"");
            let (kind, body) = multipart(&[("image", &image), ("json", json.as_bytes())]);
            app.post("/references", &kind, body).await
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig {
        cases: 6,
        failure_persistence: None,
        max_shrink_iters: 200,
        ..ProptestConfig::default()
    })]
    #[test]
    fn what_is_accepted_can_be_read_back_everywhere(
        new in prop::collection::vec((fields(), any::<u8>()), 8),
        changes in prop::collection::vec(fields(), 8),
        filters in prop::collection::vec((time(), time(), number(), number(), number()), 8),
    ) {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(async {
            let app = App::new();
            app.post_png("/references?map=m", 1).await.created();
            for (seed, ((fields, way), change)) in new.iter().zip(&changes).enumerate() {
                let answer = create(&app, fields, *way, seed as u64 + 2).await;
                assert_json(&answer, "POST /references");
                assert!(matches!(answer.status.as_u16(), 201 | 400 | 409 | 414), "{}", answer.text);
                if answer.status != 201 {
                    continue;
                }
                let id = answer.json["id"].as_str().unwrap().to_owned();
                // A text in a query string is that of an object, too, so that both come back.
                let metadata = fields.get("metadata").filter(|text| *text != "null");
                let stored = app.get(&format!("/references/{id}")).await;
                assert_json(&stored, "GET");
                shows_everywhere(&app, &id, stored.ok(), metadata).await;

                let request = Request::patch(format!("/references/{id}"))
                    .header("content-type", "application/json")
                    .body(Body::from(change.json("")))
                    .unwrap();
                let changed = app.send(request).await;
                assert_json(&changed, "PATCH");
                assert!(matches!(changed.status.as_u16(), 200 | 400 | 409), "{}", changed.text);
                if changed.status == 200 {
                    let metadata = change.get("metadata").filter(|text| *text != "null");
                    let stored = app.get(&format!("/references/{id}")).await;
                    assert_eq!(stored.text, changed.text);
                    shows_everywhere(&app, &id, stored.ok(), metadata).await;
                }
            }
            for (after, before, lat, lon, radius) in &filters {
                let bare = |text: &str| text.trim_matches('"').to_owned();
                let mut query = form_urlencoded::Serializer::new(String::from("map=m&"));
                query.append_pair("captured_after", &bare(after));
                query.append_pair("captured_before", &bare(before));
                query.append_pair("near", &format!("{},{}", bare(lat), bare(lon)));
                query.append_pair("radius_m", &bare(radius));
                let answer = app.post_png(&format!("/query?{}", query.finish()), 1).await;
                assert_json(&answer, "POST /query");
                assert!(matches!(answer.status.as_u16(), 200 | 400), "{}", answer.text);
            }
        });
    }
}

/// Numbers that no float holds, which parsed values would change.
#[tokio::test]
async fn metadata_comes_back_as_it_came() {
    let app = App::new();
    let metadata =
        r#"{"z":12345678901234567890123,"a":1.0,"b":1,"c":-0,"d":1e400,"e":[{"y":0.10}]}"#;
    let kept = format!("\"metadata\":{metadata}");
    let image = STANDARD.encode(picture(1));
    let body = format!("{{\"map\":\"m\",\"metadata\":{metadata},\"image\":\"{image}\"}}");
    let created = app.post("/references", "application/json", body).await;
    assert_eq!(created.status, 201, "{}", created.text);
    let path = created.header("location").to_owned();
    for answer in [
        created,
        app.get(&path).await,
        app.get("/references?map=m").await,
        app.post_png("/query?map=m", 1).await,
        app.patch(&path, &json!({"heading": 7})).await,
    ] {
        assert!(answer.text.contains(&kept), "{}", answer.text);
    }
}

// ---------------------------------------------------------------- times

#[tokio::test]
async fn times_that_leave_the_years_in_utc_are_refused_and_filter_as_they_are_stored() {
    let app = App::new();
    app.post_png("/references?map=m", 1).await.created();
    for (time, accepted) in [
        ("0000-01-01T00:00:00%2B23:59", false),
        ("9999-12-31T23:59:59-23:59", false),
        ("0000-01-01T00:00:00Z", true),
        ("9999-12-31T23:59:59.9999999Z", true),
    ] {
        let expected = if accepted { 201 } else { 400 };
        let answer = app
            .post_png(&format!("/references?map=m&captured_at={time}"), 2)
            .await;
        assert_eq!(answer.status, expected, "{}", answer.text);
        assert_json(&answer, time);
        let expected = if accepted { 200 } else { 400 };
        for filter in ["captured_after", "captured_before"] {
            let answer = app
                .post_png(&format!("/query?map=m&{filter}={time}"), 1)
                .await;
            assert_eq!(answer.status, expected, "{}", answer.text);
            assert_json(&answer, time);
        }
        let listed = app.get("/references").await;
        assert_json(&listed, "GET /references");
        listed.ok();
    }
}

// ---------------------------------------------------------------- duplicate keys

#[tokio::test]
async fn a_key_that_occurs_twice_is_refused_wherever_json_is_read() {
    let app = App::new();
    let id = app.post_png("/references?map=m", 1).await.created()["id"]
        .as_str()
        .unwrap()
        .to_owned();
    let image = STANDARD.encode(picture(2));
    for fields in [
        r#""map":"m","map":"n""#,
        r#""map":"m","lat":1,"lon":2,"lat":3"#,
        r#""map":"m","metadata":{"a":1,"a":2}"#,
        r#""map":"m","metadata":{"b":[{"a":1,"a":2}]}"#,
        r#""map":"m","metadata":{},"metadata":{}"#,
        r#""map":"m","m\u0061p":"m""#,
    ] {
        let whole = format!("{{\"image\":\"{image}\",{fields}}}");
        let (kind, parts) = multipart(&[
            ("image", &picture(2)),
            ("json", format!("{{{fields}}}").as_bytes()),
        ]);
        for answer in [
            app.post("/references", "application/json", whole).await,
            app.post("/references", &kind, parts).await,
        ] {
            let detail = answer.problem("invalid_parameter");
            assert!(
                detail.contains("twice") || detail.contains("duplicate"),
                "{detail}"
            );
        }
    }
    let images_twice = format!("{{\"map\":\"m\",\"image\":\"{image}\",\"image\":\"{image}\"}}");
    let query_twice = format!("{{\"map\":\"m\",\"image\":\"{image}\",\"top_k\":1,\"top_k\":2}}");
    for (path, body) in [
        ("/references", &images_twice),
        ("/query", &images_twice),
        ("/query", &query_twice),
    ] {
        app.post(path, "application/json", body.clone())
            .await
            .problem("invalid_parameter");
    }
    let send = async |method: Method, path: String, body: String| {
        let request = Request::builder()
            .method(method)
            .uri(path)
            .header("content-type", "application/json");
        app.send(request.body(Body::from(body)).unwrap()).await
    };
    for body in [
        r#"{"heading":1,"heading":2}"#,
        r#"{"metadata":{"a":1,"a":2}}"#,
        r#"{"metadata":null,"metadata":null}"#,
    ] {
        send(Method::PATCH, format!("/references/{id}"), body.to_owned())
            .await
            .problem("invalid_parameter");
    }
    let document = placeformer::http::openapi::document();
    let calibration = &document["paths"]["/maps/{map}/calibration"]["put"]["requestBody"]["content"]
        ["application/json"]["example"];
    let calibration = calibration.to_string();
    for (once, twice) in [
        ("\"format\":", "\"format\":1,\"format\":"),
        ("\"bias\":", "\"bias\":1,\"bias\":"),
        ("\"threshold\":", "\"threshold\":0.5,\"threshold\":"),
    ] {
        let body = calibration.replacen(once, twice, 1);
        assert_ne!(body, calibration);
        let answer = send(Method::PUT, "/maps/m/calibration".into(), body).await;
        let detail = answer.problem("invalid_parameter");
        assert!(detail.contains("duplicate"), "{detail}");
    }
    assert_eq!(app.count().await, 1);
}

#[tokio::test]
async fn wrong_members_of_json_are_named() {
    let app = App::new();
    let image = STANDARD.encode(picture(2));
    for (fields, named) in [
        (r#""map":"m","lat":"north","lon":1"#, "lat"),
        (r#""map":"m","captured_at":"yesterday""#, "captured_at"),
        (r#""map":"m","external_id":7"#, "external_id"),
        (r#""map":"a/b""#, "map"),
        (r#""map":"m","metadata":[]"#, "metadata"),
        (r#""map":"m","colour":1"#, "colour"),
    ] {
        let body = format!("{{{fields},\"image\":\"{image}\"}}");
        let answer = app.post("/references", "application/json", body).await;
        let detail = answer.problem("invalid_parameter");
        assert!(detail.contains(named), "{named}: {detail}");
    }
}

// ---------------------------------------------------------------- what the framework refuses

#[tokio::test]
async fn what_no_handler_sees_is_a_problem_too() {
    let app = App::new();
    let send = async |method: &str, path: &str, kind: &str, body: Vec<u8>| {
        let request = Request::builder()
            .method(method)
            .uri(path)
            .header("content-type", kind);
        app.send(request.body(Body::from(body)).unwrap()).await
    };
    let large = vec![b' '; 300 << 10];
    for (method, path, kind, body, code) in [
        ("GET", "/nowhere", "", vec![], "route_not_found"),
        ("GET", "/docs/nowhere", "", vec![], "route_not_found"),
        ("BREW", "/query", "", vec![], "method_not_allowed"),
        ("PUT", "/query", "", vec![], "method_not_allowed"),
        ("GET", "/maps/%FF", "", vec![], "malformed_request"),
        ("GET", "/references/%FF", "", vec![], "malformed_request"),
        (
            "GET",
            "/references?limit=%FF",
            "",
            vec![],
            "invalid_parameter",
        ),
        (
            "GET",
            "/references?limit=1&limit=2",
            "",
            vec![],
            "invalid_parameter",
        ),
        (
            "POST",
            "/query?map=m",
            "text/plain",
            vec![1],
            "unsupported_media_type",
        ),
        (
            "POST",
            "/query?map=m",
            "application/x-www-form-urlencoded",
            b"image=photo.jpg".to_vec(),
            "unsupported_media_type",
        ),
        (
            "POST",
            "/query",
            "multipart/form-data",
            vec![1],
            "malformed_request",
        ),
        (
            "POST",
            "/query",
            "multipart/form-data; boundary=x",
            vec![1],
            "malformed_request",
        ),
        (
            "POST",
            "/query",
            "application/json",
            b"{".to_vec(),
            "malformed_request",
        ),
        (
            "POST",
            "/query",
            "application/json",
            b"{\"a\":\xff}".to_vec(),
            "malformed_request",
        ),
        (
            "POST",
            "/query",
            "application/json",
            b"[]".to_vec(),
            "invalid_parameter",
        ),
        (
            "PATCH",
            "/references/x",
            "application/json",
            large,
            "reference_not_found",
        ),
        (
            "PUT",
            "/maps/m/calibration",
            "application/json",
            vec![b' '; 300 << 10],
            "body_too_large",
        ),
        (
            "PUT",
            "/maps/m/calibration",
            "application/json",
            b"[1]".to_vec(),
            "invalid_parameter",
        ),
        (
            "PUT",
            "/maps/m/head",
            "application/octet-stream",
            vec![0; 64 << 20],
            "body_too_large",
        ),
    ] {
        let answer = send(method, path, kind, body).await;
        assert_eq!(
            answer.json["code"], code,
            "{method} {path}: {}",
            answer.text
        );
        assert_json(&answer, path);
    }
}

// ---------------------------------------------------------------- heads and calibrations

#[tokio::test]
async fn a_head_that_cannot_tell_images_apart_is_refused_and_the_map_stays_as_it_was() {
    let good = || head(1, BACKBONE, Aggregate::Mean);
    let source = FakeSource::with_head(good());
    let app = App::open(Arc::new(tempfile::tempdir().unwrap()), source, |_| {});
    for seed in 0..3 {
        app.post_png("/references?map=m", seed).await.created();
    }
    let before = app.post_png("/query?map=m", 1).await.ok()["results"].clone();
    let whole = file_of(&head(2, BACKBONE, Aggregate::Mean));
    // The tensors come after the header, the weight or the bias first.
    let header = u64::from_le_bytes(whole[..8].try_into().unwrap()) as usize + 8;
    let filled = |value: f32| {
        let mut bytes = whole.clone();
        for number in bytes[header..].chunks_exact_mut(4) {
            number.copy_from_slice(&value.to_le_bytes());
        }
        bytes
    };
    for value in [
        3e38,
        -3e38,
        0.0,
        1.0,
        f32::NAN,
        f32::INFINITY,
        f32::MIN_POSITIVE,
    ] {
        let answer = app
            .put("/maps/m/head", "application/octet-stream", filled(value))
            .await;
        answer.problem("head_unreadable");
    }
    assert_eq!(
        app.post_png("/query?map=m", 1).await.ok()["results"],
        before
    );
    app.put("/maps/m/head", "application/octet-stream", whole.clone())
        .await
        .ok();
    let after = app.post_png("/query?map=m", 1).await;
    assert!(after.ok()["results"][0]["global_distance"].is_number());
}

#[tokio::test]
async fn calibrations_whose_sums_overflow_are_refused() {
    let app = App::new();
    app.post_png("/references?map=m", 1).await.created();
    let document = placeformer::http::openapi::document();
    let example = &document["paths"]["/maps/{map}/calibration"]["put"]["requestBody"]["content"]["application/json"]
        ["example"];
    for (pointer, value) in [
        ("/reranked/weights/score", 1e308),
        ("/reranked/weights/bias", -1e308),
        ("/global/weights/distance", -1e300),
    ] {
        let mut calibration = example.clone();
        *calibration.pointer_mut(pointer).unwrap() = json!(value);
        let answer = app
            .put(
                "/maps/m/calibration",
                "application/json",
                calibration.to_string(),
            )
            .await;
        answer.problem("invalid_parameter");
    }
}
