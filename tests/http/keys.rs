//! What a key allows: where, how often it may be wrong, and how it is replaced.

use crate::process::Server;
use crate::support::{Answer, App, PATIENCE, picture, until};
use axum::body::Body;
use axum::http::Request;
use placeformer::http::authorise::Peer;
use placeformer::http::{ApiKey, AuthConfig, MapPattern, Role};
use serde_json::{Value, json};
use sha2::Digest;
use std::path::Path;
use std::time::{Duration, Instant};

/// A holder whose key is "key of NAME".
pub fn key(name: &str, role: Role) -> ApiKey {
    ApiKey {
        name: name.into(),
        sha256: hash_of(&format!("key of {name}")).into(),
        role,
        requests_per_second: None,
        maps: None,
    }
}

fn hash_of(key: &str) -> String {
    hex::encode(sha2::Sha256::digest(key))
}

/// The same, limited to maps.
fn limited(name: &str, role: Role, maps: &[&str]) -> ApiKey {
    let pattern = |text: &&str| MapPattern::try_from((*text).to_owned()).unwrap();
    ApiKey {
        maps: Some(maps.iter().map(pattern).collect()),
        ..key(name, role)
    }
}

/// A request with the key of `name`, and with a picture if it has a seed.
pub fn request_as(name: &str, method: &str, path: &str, seed: Option<u64>) -> Request<Body> {
    let request = Request::builder()
        .method(method)
        .uri(path)
        .header("authorization", format!("Bearer key of {name}"));
    match seed {
        Some(seed) => request
            .header("content-type", "image/png")
            .body(Body::from(picture(seed))),
        None => request.body(Body::empty()),
    }
    .unwrap()
}

pub async fn send_as(app: &App, name: &str, method: &str, path: &str, seed: Option<u64>) -> Answer {
    app.send(request_as(name, method, path, seed)).await
}

fn with_json(name: &str, method: &str, path: &str, body: &Value) -> Request<Body> {
    Request::builder()
        .method(method)
        .uri(path)
        .header("x-api-key", format!("key of {name}"))
        .header("content-type", "application/json")
        .body(Body::from(body.to_string()))
        .unwrap()
}

// ---------------------------------------------------------------- maps

/// Two maps of two builders, and who may see which.
async fn two_builders() -> (App, String, String) {
    let app = App::with(|config| {
        config.auth.keys = vec![
            key("all", Role::Write),
            limited("city", Role::Write, &["city-*"]),
            limited("harbour", Role::Write, &["harbour"]),
            limited("city scraper", Role::Metrics, &["city-*"]),
            key("scraper", Role::Metrics),
        ];
    });
    let add = async |name: &str, map: &str, seed: u64| {
        let path = format!("/references?map={map}&external_id={seed}");
        let answer = send_as(&app, name, "POST", &path, Some(seed)).await;
        answer.created()["id"].as_str().unwrap().to_owned()
    };
    let city = add("city", "city-1", 1).await;
    add("all", "city-2", 2).await;
    let harbour = add("harbour", "harbour", 3).await;
    (app, city, harbour)
}

#[tokio::test]
async fn a_limited_key_is_refused_on_every_route_that_names_another_map() {
    let (app, _, _) = two_builders().await;
    // Whether the map exists makes no difference to the answer.
    for map in ["harbour", "nowhere", "citx-1", "city"] {
        let calibration = placeformer::http::openapi::document();
        let calibration = &calibration["paths"]["/maps/{map}/calibration"]["put"]["requestBody"]["content"]
            ["application/json"]["example"];
        let requests = [
            request_as("city", "POST", &format!("/query?map={map}"), Some(3)),
            request_as("city", "POST", &format!("/references?map={map}"), Some(9)),
            request_as("city", "GET", &format!("/references?map={map}"), None),
            request_as(
                "city",
                "GET",
                &format!("/references?map={map}&external_id=3"),
                None,
            ),
            request_as("city", "GET", &format!("/maps/{map}"), None),
            request_as("city", "DELETE", &format!("/maps/{map}"), None),
            request_as("city", "DELETE", &format!("/maps/{map}/calibration"), None),
            request_as("city", "DELETE", &format!("/maps/{map}/head"), None),
            with_json(
                "city",
                "PUT",
                &format!("/maps/{map}/calibration"),
                calibration,
            ),
            Request::put(format!("/maps/{map}/head"))
                .header("x-api-key", "key of city")
                .header("content-type", "application/octet-stream")
                .body(Body::from("no head"))
                .unwrap(),
        ];
        for request in requests {
            let name = format!("{} {}", request.method(), request.uri());
            let answer = app.send(request).await;
            assert_eq!(answer.json["code"], "forbidden", "{name}: {}", answer.text);
        }
    }
    let mine = send_as(&app, "city", "POST", "/query?map=city-1", Some(1)).await;
    assert_eq!(mine.ok()["results"].as_array().unwrap().len(), 1);
    send_as(&app, "harbour", "POST", "/query?map=harbour", Some(3))
        .await
        .ok();
}

#[tokio::test]
async fn references_of_other_maps_do_not_exist_for_a_limited_key() {
    let (app, city, harbour) = two_builders().await;
    let absent = uuid::Uuid::now_v7().to_string();
    let path = |id: &str| format!("/references/{id}");
    let ask = |id: &str| {
        [
            request_as("city", "GET", &path(id), None),
            with_json("city", "PATCH", &path(id), &json!({"heading": 7})),
            request_as("city", "DELETE", &path(id), None),
            request_as(
                "city",
                "POST",
                &format!("/match?reference_id={id}"),
                Some(1),
            ),
        ]
    };
    for (hidden, absent_too) in ask(&harbour).into_iter().zip(ask(&absent)) {
        let hidden = app.send(hidden).await;
        let expected = app.send(absent_too).await;
        let detail = hidden
            .problem("reference_not_found")
            .replace(&harbour, "ID");
        let expected = expected
            .problem("reference_not_found")
            .replace(&absent, "ID");
        assert_eq!(detail, expected, "the answers differ in more than the id");
    }
    let there = send_as(&app, "harbour", "GET", &path(&harbour), None).await;
    assert_eq!(there.ok()["location"], Value::Null, "nothing was changed");
    for request in ask(&city) {
        let answer = app.send(request).await;
        // The last one comes after the deletion.
        assert!(
            answer.status.is_success() || answer.json["code"] == "reference_not_found",
            "{}",
            answer.text
        );
    }
    send_as(&app, "all", "GET", &path(&city), None)
        .await
        .problem("reference_not_found");
}

#[tokio::test]
async fn listings_show_a_limited_key_its_own_maps_and_miss_none() {
    let (app, _, _) = two_builders().await;
    for (name, expected) in [
        ("all", &["city-1", "city-2", "harbour"][..]),
        ("city", &["city-1", "city-2"]),
        ("harbour", &["harbour"]),
    ] {
        let maps = send_as(&app, name, "GET", "/maps", None).await;
        let maps = maps.ok()["maps"].as_array().unwrap().clone();
        let names: Vec<&str> = maps
            .iter()
            .map(|map| map["name"].as_str().unwrap())
            .collect();
        assert_eq!(names, expected);

        let mut listed = Vec::new();
        let mut path = "/references?limit=1".to_owned();
        loop {
            let page = send_as(&app, name, "GET", &path, None).await;
            let references = page.ok()["references"].as_array().unwrap().clone();
            listed.extend(
                references
                    .iter()
                    .map(|one| one["map"].as_str().unwrap().to_owned()),
            );
            let Some(next) = page.json["next"].as_str() else {
                break;
            };
            path = format!("/references?limit=1&cursor={next}");
        }
        assert_eq!(listed, expected);
    }
}

#[tokio::test]
async fn metrics_name_maps_to_those_who_may_see_them() {
    let (app, _, _) = two_builders().await;
    let series = async |request: Request<Body>| {
        let answer = app.send(request).await;
        assert_eq!(answer.status, 200, "{}", answer.text);
        let lines = answer.text.lines().map(str::to_owned);
        let mut lines: Vec<String> = lines
            .filter_map(|line| {
                line.strip_prefix("placeformer_references")
                    .map(str::to_owned)
            })
            .collect();
        lines.sort();
        lines
    };
    let none = Request::get("/metrics").body(Body::empty()).unwrap();
    assert_eq!(series(none).await, ["{map=\"other\"} 3"]);
    let all = [
        "{map=\"city-1\"} 1",
        "{map=\"city-2\"} 1",
        "{map=\"harbour\"} 1",
        "{map=\"other\"} 0",
    ];
    for name in ["scraper", "all"] {
        assert_eq!(series(request_as(name, "GET", "/metrics", None)).await, all);
    }
    let own = [
        "{map=\"city-1\"} 1",
        "{map=\"city-2\"} 1",
        "{map=\"other\"} 1",
    ];
    for name in ["city scraper", "city"] {
        assert_eq!(series(request_as(name, "GET", "/metrics", None)).await, own);
    }
    send_as(&app, "nobody", "GET", "/metrics", None)
        .await
        .problem("unauthorized");
    for path in ["/maps", "/info", "/references"] {
        send_as(&app, "scraper", "GET", path, None)
            .await
            .problem("forbidden");
    }
}

// ---------------------------------------------------------------- wrong keys

fn presenting(key: Option<&str>, address: &str) -> Request<Body> {
    let mut request = Request::get("/maps");
    if let Some(key) = key {
        request = request.header("x-api-key", key);
    }
    let mut request = request.body(Body::empty()).unwrap();
    request
        .extensions_mut()
        .insert(Peer(address.parse().unwrap()));
    request
}

#[tokio::test]
async fn an_address_with_too_many_wrong_keys_is_refused_before_they_are_compared() {
    let app = App::with(|config| {
        config.auth = AuthConfig {
            keys: vec![key("fleet", Role::Read)],
            failed_keys_per_minute: 3,
            ..Default::default()
        }
    });
    const HERE: &str = "[2001:db8:1:2::7]:4000";
    for (attempt, code) in [
        "unauthorized",
        "unauthorized",
        "unauthorized",
        "rate_limited",
    ]
    .into_iter()
    .enumerate()
    {
        let wrong = format!("wrong {attempt}");
        let answer = app.send(presenting(Some(&wrong), HERE)).await;
        answer.problem(code);
        if code == "rate_limited" {
            let seconds: u64 = answer.header("retry-after").parse().unwrap();
            assert!((1..=60).contains(&seconds));
        }
    }
    // The right one would be a way to find out which it is.
    app.send(presenting(Some("key of fleet"), HERE))
        .await
        .problem("rate_limited");
    let neighbour = "[2001:db8:1:2:ffff::1]:4000";
    app.send(presenting(Some("key of fleet"), neighbour))
        .await
        .problem("rate_limited");
    for other in ["[2001:db8:1:3::7]:4000", "10.0.0.1:4000"] {
        app.send(presenting(Some("key of fleet"), other)).await.ok();
    }
    // A request without a key tries none.
    for _ in 0..10 {
        app.send(presenting(None, "10.0.0.2:4000"))
            .await
            .problem("unauthorized");
    }
    app.send(presenting(Some("key of fleet"), "10.0.0.2:4000"))
        .await
        .ok();
    let refused = "placeformer_rejected_total{reason=\"failed_keys\"}";
    assert_eq!(app.metric(refused).await, 3.0);
}

#[tokio::test]
async fn no_bound_on_wrong_keys_is_a_choice() {
    let app = App::with(|config| {
        config.auth = AuthConfig {
            keys: vec![key("fleet", Role::Read)],
            failed_keys_per_minute: 0,
            ..Default::default()
        }
    });
    for _ in 0..100 {
        app.send(presenting(Some("wrong"), "10.0.0.1:4000"))
            .await
            .problem("unauthorized");
    }
    app.send(presenting(Some("key of fleet"), "10.0.0.1:4000"))
        .await
        .ok();
}

// ---------------------------------------------------------------- replacing keys

#[tokio::test]
async fn two_keys_of_a_holder_share_its_role_maps_and_rate() {
    let app = App::with(|config| {
        config.auth.keys = vec![ApiKey {
            sha256: [hash_of("old"), hash_of("new")].into_iter().collect(),
            requests_per_second: Some(1),
            ..limited("fleet", Role::Read, &["m"])
        }];
    });
    let ask = |key: &str, path: &str| {
        let request = Request::get(path).header("x-api-key", key);
        app.send(request.body(Body::empty()).unwrap())
    };
    ask("old", "/maps").await.ok();
    ask("new", "/maps").await.problem("rate_limited");
    tokio::time::sleep(Duration::from_millis(1100)).await;
    ask("new", "/maps/other").await.problem("forbidden");
    ask("older", "/maps").await.problem("unauthorized");
}

/// Writes the whole file under another name first, as operators should.
fn replace(path: &Path, text: &str) {
    let next = path.with_extension("next");
    std::fs::write(&next, text).unwrap();
    std::fs::rename(next, path).unwrap();
}

fn settings(keys: &[&str]) -> String {
    let mut text = "[auth]\nfailed_keys_per_minute = 0\n".to_owned();
    for (i, key) in keys.iter().enumerate() {
        let hash = hash_of(key);
        text += &format!(
            "[[auth.keys]]\nname = \"holder {i}\"\nsha256 = [\"{hash}\"]\nrole = \"read\"\n"
        );
    }
    text
}

#[test]
fn keys_are_replaced_while_the_server_runs_and_a_broken_file_changes_nothing() {
    let directory = tempfile::tempdir().unwrap();
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("placeformer.toml");
    let log = folder.path().join("log");
    replace(&file, &settings(&["first"]));
    let server = Server::start_configured(directory.path(), &log, &file);
    let status = |key: &str| server.get_with_key("/maps", key);
    let eventually = |what: &str, holds: &dyn Fn() -> bool| {
        let began = Instant::now();
        while !holds() {
            assert!(began.elapsed() < PATIENCE, "{what} never came about");
            std::thread::sleep(Duration::from_millis(50));
        }
    };
    assert_eq!((status("first"), status("second")), (200, 401));
    // Both for a while, then only the new one.
    replace(&file, &settings(&["first", "second"]));
    eventually("the second key", &|| status("second") == 200);
    assert_eq!(status("first"), 200);
    replace(&file, &settings(&["second"]));
    eventually("the end of the first key", &|| status("first") == 401);
    assert_eq!(status("second"), 200);

    let complaints = || {
        let text = std::fs::read_to_string(&log).unwrap();
        text.matches("the old ones stay in force").count()
    };
    // Without keys the service would be open to everyone; a file being written is empty.
    let twice = settings(&["a", "b"]).replace("holder 1", "holder 0");
    for (number, broken) in [
        "",
        "[[auth.keys]]\nname = \"a\"",
        "[http]\nmax_page = 0",
        &twice,
    ]
    .into_iter()
    .enumerate()
    {
        replace(&file, broken);
        eventually("a complaint", &|| complaints() == number + 1);
        assert_eq!(
            (status("second"), status("first"), status("")),
            (200, 401, 401)
        );
    }
    replace(&file, &settings(&["third"]));
    server.hang_up();
    eventually("the third key", &|| status("third") == 200);
    assert_eq!(status("second"), 401);
}

#[tokio::test]
async fn requests_under_way_are_not_disturbed_by_other_keys() {
    let app = std::sync::Arc::new(App::with(|config| {
        config.auth.keys = vec![key("fleet", Role::Write)];
    }));
    send_as(&app, "fleet", "POST", "/references?map=m", Some(1))
        .await
        .created();
    app.source.describing.gate.close();
    let asking = {
        let app = app.clone();
        tokio::spawn(async move { send_as(&app, "fleet", "POST", "/query?map=m", Some(1)).await })
    };
    until("an extraction", || app.source.describing.inside() > 0).await;
    let next = AuthConfig {
        keys: vec![key("next", Role::Write)],
        ..Default::default()
    };
    assert!(app.state.renew_auth(&next).unwrap());
    app.source.describing.gate.open();
    asking.await.unwrap().ok();
    send_as(&app, "fleet", "GET", "/maps", None)
        .await
        .problem("unauthorized");
    send_as(&app, "next", "GET", "/maps", None).await.ok();
}
