//! The route table against the running service and the OpenAPI document: every path is called with
//! every method, and what the service does is what the table and the document say.

use crate::support::{Answer, App, multipart, picture};
use axum::body::Body;
use axum::http::{Method, Request};
use placeformer::http::openapi;
use placeformer::http::route::{AccessLog, Handler, RequestBody, Route, Scope};
use placeformer::http::routes::{ROUTES, routes_at};
use placeformer::http::{ApiKey, AuthConfig, Role};
use placeformer_core::error::ErrorCode;
use serde_json::{Value, json};
use sha2::Digest;
use std::collections::{BTreeMap, BTreeSet};
use std::io::Write;
use std::sync::{Arc, Mutex};
use std::time::Duration;

const METHODS: [Method; 7] = [
    Method::GET,
    Method::HEAD,
    Method::POST,
    Method::PUT,
    Method::PATCH,
    Method::DELETE,
    Method::OPTIONS,
];

/// An id that no reference has.
const UNKNOWN_ID: &str = "0197f3c2-7c1e-7d3a-9b1f-2f6f0c1d2e3f";

fn paths() -> BTreeSet<&'static str> {
    ROUTES.iter().map(|route| route.path).collect()
}

/// The path with its parameters filled in.
fn filled(path: &str, id: &str, map: &str) -> String {
    path.replace("{id}", id)
        .replace("{map}", map)
        .replace("{*rest}", "swagger-ui.css")
}

fn name_of(method: &Method, path: &str) -> String {
    format!("{method} {path}")
}

// ---------------------------------------------------------------- keys

fn api_key(name: &str, role: Role) -> ApiKey {
    let hash = sha2::Sha256::digest(format!("key of {name}"));
    ApiKey {
        name: name.into(),
        sha256: hex::encode(hash).into(),
        role,
        requests_per_second: None,
        maps: None,
    }
}

fn app_with_keys(protect_metrics: bool) -> App {
    App::with(|config| {
        config.auth = AuthConfig {
            keys: vec![
                api_key("reader", Role::Read),
                api_key("writer", Role::Write),
            ],
            protect_metrics,
            ..Default::default()
        }
    })
}

async fn status_with_key(app: &App, method: &Method, path: &str, key: Option<&str>) -> u16 {
    let mut request = Request::builder()
        .method(method)
        .uri(filled(path, UNKNOWN_ID, "none"));
    if let Some(name) = key {
        request = request.header("x-api-key", format!("key of {name}"));
    }
    let answer = app.send(request.body(Body::empty()).unwrap()).await;
    answer.status.as_u16()
}

#[tokio::test]
async fn every_route_asks_for_the_key_of_its_scope() {
    for protect_metrics in [false, true] {
        let app = app_with_keys(protect_metrics);
        for route in ROUTES {
            let name = name_of(&route.method, route.path);
            let expected = match (route.scope, protect_metrics) {
                (Scope::Public, _) | (Scope::Metrics, false) => [false, false, false],
                (Scope::Key(Role::Metrics | Role::Read), _) | (Scope::Metrics, true) => {
                    [true, false, false]
                }
                (Scope::Key(Role::Write), _) => [true, true, false],
            };
            let mut refused = [false; 3];
            for (at, key) in [None, Some("reader"), Some("writer")]
                .into_iter()
                .enumerate()
            {
                let status = status_with_key(&app, &route.method, route.path, key).await;
                refused[at] = status == if key.is_none() { 401 } else { 403 };
                assert!(refused[at] || (status != 401 && status != 403), "{name}");
            }
            assert_eq!(refused, expected, "{name}");
        }
    }
}

#[tokio::test]
async fn other_methods_show_which_there_are_only_to_those_who_may_use_the_path() {
    let app = app_with_keys(false);
    for path in paths() {
        for method in METHODS {
            if routes_at(path).any(|route| route.answers(&method)) {
                continue;
            }
            let name = name_of(&method, path);
            let needs_key = routes_at(path).all(|route| matches!(route.scope, Scope::Key(_)));
            let expected = if needs_key { 401 } else { 405 };
            assert_eq!(
                status_with_key(&app, &method, path, None).await,
                expected,
                "{name}"
            );
            let answer = status_with_key(&app, &method, path, Some("writer")).await;
            assert_eq!(answer, 405, "{name}");
        }
    }
}

// ---------------------------------------------------------------- methods

#[tokio::test]
async fn requests_are_counted_under_the_path_of_their_route() {
    let app = App::new();
    for path in paths() {
        let series = format!("placeformer_http_request_duration_seconds_count{{route=\"{path}\"}}");
        let text = app.get("/metrics").await.text;
        let is_expected = operations().any(|route| route.path == path);
        assert_eq!(text.contains(&series), is_expected, "{path} at start");

        app.get(&filled(path, UNKNOWN_ID, "none")).await;
        assert!(app.metric(&series).await >= 1.0, "{path}");
    }
}

#[tokio::test]
async fn every_other_method_is_refused_with_those_of_the_table() {
    let app = App::new();
    for path in paths() {
        let mut expected = BTreeSet::new();
        for route in routes_at(path) {
            expected.insert(route.method.as_str());
            if route.method == Method::GET {
                expected.insert("HEAD");
            }
        }
        for method in METHODS {
            let name = name_of(&method, path);
            let request = Request::builder()
                .method(&method)
                .uri(filled(path, UNKNOWN_ID, "none"))
                .body(Body::empty())
                .unwrap();
            let answer = app.send(request).await;
            if expected.contains(method.as_str()) {
                assert_ne!(answer.status, 405, "{name}");
                continue;
            }
            assert_eq!(answer.status, 405, "{name}");
            if method != Method::HEAD {
                answer.problem("method_not_allowed");
            }
            let allowed: BTreeSet<&str> = answer.header("allow").split(',').collect();
            assert_eq!(allowed, expected, "{name}");
        }
    }
}

// ---------------------------------------------------------------- the log

/// Where the log of a test goes.
#[derive(Clone, Default)]
struct LogBuffer(Arc<Mutex<Vec<u8>>>);

impl Write for LogBuffer {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.0.lock().unwrap().write(bytes)
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

impl LogBuffer {
    /// The levels of the lines that say "answered", of which the buffer is emptied.
    fn take_levels(&self) -> Vec<String> {
        let bytes = std::mem::take(&mut *self.0.lock().unwrap());
        let lines = String::from_utf8(bytes).unwrap();
        let lines = lines
            .lines()
            .map(|line| serde_json::from_str::<Value>(line).unwrap());
        lines
            .filter(|line| line["fields"]["message"] == "answered")
            .map(|line| line["level"].as_str().unwrap().to_owned())
            .collect()
    }
}

#[tokio::test]
async fn answers_of_quiet_routes_are_not_in_the_log() {
    let log = LogBuffer::default();
    let writer = log.clone();
    let subscriber = tracing_subscriber::fmt()
        .json()
        .with_max_level(tracing::Level::DEBUG)
        .with_writer(move || writer.clone())
        .finish();
    let _guard = tracing::subscriber::set_default(subscriber);
    let app = App::new();
    for path in paths() {
        for method in METHODS {
            let request = Request::builder()
                .method(&method)
                .uri(filled(path, UNKNOWN_ID, "none"))
                .body(Body::empty())
                .unwrap();
            log.take_levels();
            app.send(request).await;
            let is_quiet = routes_at(path).all(|route| route.access_log == AccessLog::Quiet);
            let expected = if is_quiet { "DEBUG" } else { "INFO" };
            assert_eq!(log.take_levels(), [expected], "{method} {path}");
        }
    }
    app.get("/nowhere").await.problem("route_not_found");
    assert_eq!(log.take_levels(), ["INFO"]);
}

// ---------------------------------------------------------------- the document

fn operations() -> impl Iterator<Item = &'static Route> {
    let is_operation = |route: &&Route| matches!(route.handler, Handler::Operation(_));
    ROUTES.iter().filter(is_operation)
}

fn operation_of<'a>(document: &'a Value, route: &Route) -> &'a Value {
    &document["paths"][route.path][route.method.as_str().to_lowercase()]
}

#[test]
fn the_document_has_every_operation_and_no_other() {
    let document = openapi::document();
    let mut described = BTreeSet::new();
    for (path, item) in document["paths"].as_object().unwrap() {
        for method in item.as_object().unwrap().keys() {
            described.insert(format!("{} {path}", method.to_uppercase()));
        }
    }
    let expected: BTreeSet<String> = operations()
        .map(|route| name_of(&route.method, route.path))
        .collect();
    assert_eq!(described, expected);
}

#[test]
fn the_document_says_who_may_call() {
    let document = openapi::document();
    for route in operations() {
        let security = &operation_of(&document, route)["security"];
        let expected = match route.scope {
            Scope::Public => Value::Null,
            Scope::Metrics | Scope::Key(_) => json!([{}, {"bearer": []}, {"header": []}]),
        };
        assert_eq!(security, &expected, "{}", route.path);
    }
}

#[test]
fn the_document_has_the_errors_of_the_table_with_their_headers() {
    let document = openapi::document();
    for route in operations() {
        let name = name_of(&route.method, route.path);
        let mut by_status: BTreeMap<String, Vec<ErrorCode>> = BTreeMap::new();
        for code in route.error_codes() {
            let codes = by_status.entry(code.status().to_string()).or_default();
            codes.push(code);
        }
        let responses = &operation_of(&document, route)["responses"];
        for (status, response) in responses.as_object().unwrap() {
            let codes = by_status.remove(status).unwrap_or_default();
            let problems = &response["content"]["application/problem+json"]["examples"];
            let described: BTreeSet<&str> = problems
                .as_object()
                .into_iter()
                .flat_map(|problems| problems.keys().map(String::as_str))
                .collect();
            let expected = codes.iter().map(|code| code.as_str()).collect();
            assert_eq!(described, expected, "{name} {status}");

            let says_when = !response["headers"]["retry-after"].is_null();
            let sends_when = codes.iter().any(|code| code.retry_after().is_some());
            assert_eq!(says_when, sends_when, "{name} {status}: retry-after");
            let says_how = !response["headers"]["www-authenticate"].is_null();
            assert_eq!(says_how, status == "401", "{name} {status}");
        }
        assert!(by_status.is_empty(), "{name} lacks {by_status:?}");
    }
}

/// Compares an answer of `route` with what the document says about its status.
#[track_caller]
fn assert_documented(document: &Value, route: &Route, answer: &Answer) {
    let name = name_of(&route.method, route.path);
    let status = answer.status.as_str();
    let response = &operation_of(document, route)["responses"][status];
    assert!(response.is_object(), "{name}: {status} {}", answer.text);
    if let Some(code) = answer.json["code"].as_str() {
        let problems = &response["content"]["application/problem+json"]["examples"];
        assert!(problems[code].is_object(), "{name}: {status} {code}");
    }
    for header in [
        "retry-after",
        "www-authenticate",
        "location",
        "server-timing",
    ] {
        let is_described = !response["headers"][header].is_null();
        let is_sent = answer.headers.contains_key(header);
        assert_eq!(is_sent, is_described, "{name}: {status} {header}");
    }
}

/// A body with its content type.
type SentBody = (String, Vec<u8>);

/// Bodies for a route, sound and unsound.
fn bodies_for(route: &Route) -> Vec<SentBody> {
    let body = |kind: &str, bytes: &[u8]| (kind.to_owned(), bytes.to_vec());
    let mut bodies = match &route.body {
        RequestBody::None => return vec![body("text/plain", b"")],
        RequestBody::Json { example } => vec![
            body("application/json", example().to_string().as_bytes()),
            body("application/json", b"{"),
            body("application/json", b"[]"),
        ],
        RequestBody::File { .. } => vec![body("application/octet-stream", b"no head")],
        RequestBody::Images(upload) => {
            let mut parts = Vec::new();
            for name in upload.images {
                parts.push((*name, picture(1)));
            }
            let parts: Vec<(&str, &[u8])> = parts
                .iter()
                .map(|(name, image)| (*name, image.as_slice()))
                .collect();
            vec![
                multipart(&parts),
                body("image/png", &picture(1)),
                body("image/png", b"no image"),
                body("image/png", b""),
                body(
                    "application/json",
                    (upload.example)().to_string().as_bytes(),
                ),
                body("application/json", b"{"),
            ]
        }
    };
    bodies.push(body("text/plain", b"x"));
    bodies
}

fn request(route: &Route, path: &str, (kind, bytes): SentBody) -> Request<Body> {
    Request::builder()
        .method(&route.method)
        .uri(path)
        .header("content-type", kind)
        .body(Body::from(bytes))
        .unwrap()
}

/// Where to send a request of `route`, the existing target last.
fn targets(route: &Route, id: &str) -> Vec<String> {
    let known = filled(route.path, id, "m");
    if known == route.path {
        let queries = ["?map=none", "?colour=red", "", "?map=m"];
        return queries.map(|query| format!("{known}{query}")).to_vec();
    }
    vec![filled(route.path, UNKNOWN_ID, "none"), known]
}

#[tokio::test]
async fn every_answer_is_one_that_the_document_describes() {
    let document = openapi::document();
    for route in operations() {
        let app = App::new();
        let created = app.post_png("/references?map=m", 1).await;
        let id = created.created()["id"].as_str().unwrap();
        for path in targets(route, id) {
            for body in bodies_for(route) {
                let answer = app.send(request(route, &path, body)).await;
                assert_documented(&document, route, &answer);
            }
        }
    }
}

#[tokio::test]
async fn every_body_is_bounded_as_the_table_says() {
    const IMAGE_BYTES: usize = 64 << 10;
    let app = App::with(|config| config.image.max_bytes = IMAGE_BYTES);
    for route in operations() {
        let (kind, limit) = match &route.body {
            RequestBody::None => continue,
            RequestBody::Json { .. } => ("application/json", 256 << 10),
            RequestBody::File { max_bytes, .. } => ("application/octet-stream", *max_bytes),
            RequestBody::Images(_) => ("image/png", IMAGE_BYTES),
        };
        let query = if route.path == "/match" { "" } else { "?map=m" };
        let path = filled(route.path, UNKNOWN_ID, "m");
        let path = if path == route.path {
            path + query
        } else {
            path
        };
        let too_long = request(route, &path, (kind.to_owned(), vec![b' '; limit + 1]));
        app.send(too_long).await.problem("body_too_large");
        let longest = request(route, &path, (kind.to_owned(), vec![b' '; limit]));
        assert_ne!(app.send(longest).await.status, 413, "{}", route.path);
        let other = request(route, &path, ("text/plain".to_owned(), b"x".to_vec()));
        app.send(other).await.problem("unsupported_media_type");
    }
}

#[tokio::test]
async fn a_query_beyond_its_deadline_says_when_to_come_back_as_documented() {
    let document = openapi::document();
    let app = App::new();
    app.post_png("/references?map=m", 1).await.created();
    app.source.slow_down(Duration::from_millis(80));
    let late = app.post_png("/query?map=m&deadline_ms=20", 1).await;
    late.problem("deadline_exceeded");
    let query = routes_at("/query").next().unwrap();
    assert_documented(&document, query, &late);
    let expected = ErrorCode::DeadlineExceeded.retry_after().unwrap();
    assert_eq!(late.header("retry-after"), expected.to_string());
}

#[tokio::test]
async fn answers_without_a_ready_service_are_documented() {
    let document = openapi::document();
    let app = App::new();
    app.state.health.draining();
    let readyz = routes_at("/readyz").next().unwrap();
    let answer = app.get("/readyz").await;
    assert_eq!(answer.status, 503);
    assert_documented(&document, readyz, &answer);

    let keyed = app_with_keys(false);
    for route in operations().filter(|route| matches!(route.scope, Scope::Key(_))) {
        let path = filled(route.path, UNKNOWN_ID, "none");
        let answer = keyed
            .send(request(route, &path, ("text/plain".to_owned(), vec![])))
            .await;
        answer.problem("unauthorized");
        assert_documented(&document, route, &answer);
    }
}
