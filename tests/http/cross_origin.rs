//! What foreign web pages make a browser send, and names that lead to the service.

use crate::listener::{Server, exchange};
use crate::support::App;
use axum::body::Body;
use axum::http::{Method, Request, StatusCode};
use placeformer::config::Config;
use placeformer::http::connection_info::ConnectionInfo;
use placeformer::http::{ApiKey, Role};

const LOOPBACK: ConnectionInfo = ConnectionInfo {
    is_reserved: false,
    is_loopback: true,
    is_tls: false,
};

/// A request for `path` over such a connection, with these headers.
fn request(
    method: Method,
    path: &str,
    info: ConnectionInfo,
    headers: &[(&str, &str)],
) -> Request<Body> {
    let mut request = Request::builder().method(method).uri(path).extension(info);
    for (name, value) in headers {
        request = request.header(*name, *value);
    }
    request.body(Body::empty()).unwrap()
}

/// The code that a GET of `path` with these headers is refused with; nothing if it is answered.
async fn refusal(app: &App, info: ConnectionInfo, path: &str, headers: &[(&str, &str)]) -> String {
    let answer = app.send(request(Method::GET, path, info, headers)).await;
    if answer.status == StatusCode::OK {
        return String::new();
    }
    let code = answer.json["code"].as_str().unwrap_or_default().to_owned();
    answer.problem(&code);
    code
}

#[tokio::test]
async fn a_service_without_keys_answers_on_loopback_only_to_names_of_its_machine() {
    let app = App::with(|config| config.http.allowed_hosts = vec!["Vpr.Example".into()]);
    for host in [
        "localhost",
        "LOCALHOST:8080",
        "localhost.:1",
        "127.0.0.1",
        "127.0.0.1:8080",
        "127.9.9.9:80",
        "[::1]",
        "[::1]:8080",
        "vpr.example",
        "vpr.example:443",
    ] {
        assert_eq!(
            refusal(&app, LOOPBACK, "/maps", &[("host", host)]).await,
            "",
            "{host}"
        );
    }
    for host in [
        "evil.example",
        "evil.example:8080",
        "localhost.evil.example",
        "notlocalhost",
        "127.0.0.1.evil.example",
        "10.0.0.1",
        "192.168.1.1:8080",
        "0.0.0.0:8080",
        "[::]:8080",
        "[2001:db8::1]",
        "localhost@evil.example",
        "localhost:8080:1",
        "localhost:x",
        "vpr.example.evil.example",
        "",
    ] {
        let code = refusal(&app, LOOPBACK, "/maps", &[("host", host)]).await;
        assert_eq!(code, "host_not_allowed", "{host:?}");
    }
    let none = refusal(&app, LOOPBACK, "/maps", &[]).await;
    assert_eq!(none, "host_not_allowed");
    let two = [("host", "localhost"), ("host", "evil.example")];
    assert_eq!(
        refusal(&app, LOOPBACK, "/maps", &two).await,
        "host_not_allowed"
    );
    let target = "http://evil.example/maps";
    let code = refusal(&app, LOOPBACK, target, &[("host", "localhost")]).await;
    assert_eq!(code, "host_not_allowed");
}

#[tokio::test]
async fn every_route_but_health_is_kept_from_foreign_names_and_pages() {
    let app = App::new();
    let foreign: [&[(&str, &str)]; 2] = [
        &[("host", "evil.example")],
        &[("host", "localhost"), ("origin", "http://evil.example")],
    ];
    for headers in foreign {
        for path in ["/livez", "/readyz", "/readyz?for=query"] {
            assert_eq!(refusal(&app, LOOPBACK, path, headers).await, "", "{path}");
        }
        for route in placeformer::http::routes::ROUTES {
            if matches!(route.path, "/livez" | "/readyz") {
                continue;
            }
            let path = route.path.replace(['{', '}', '*'], "");
            let request = request(route.method.clone(), &path, LOOPBACK, headers);
            let answer = app.send(request).await;
            assert_eq!(answer.status, StatusCode::FORBIDDEN, "{path}");
        }
        let request = request(Method::GET, "/nowhere", LOOPBACK, headers);
        assert_eq!(app.send(request).await.status, StatusCode::FORBIDDEN);
    }
}

fn with_key(config: &mut Config) {
    config.auth.keys = vec![ApiKey {
        name: "fleet".into(),
        // SHA-256 of "secret".
        sha256: "2bb80d537b1da3e38bd30361aa855686bde0eacd7162fef6a25fe97bf527a25b"
            .to_owned()
            .into(),
        maps: None,
        role: Role::Write,
        requests_per_second: None,
    }];
}

#[tokio::test]
async fn with_keys_or_beyond_loopback_names_count_only_if_the_settings_have_some() {
    let anywhere = ConnectionInfo {
        is_loopback: false,
        ..LOOPBACK
    };
    let key = ("x-api-key", "secret");
    let foreign = ("host", "vpr.example");
    let keyed = App::with(with_key);
    assert_eq!(
        refusal(&keyed, LOOPBACK, "/maps", &[key, foreign]).await,
        ""
    );
    let open = App::new();
    assert_eq!(refusal(&open, anywhere, "/maps", &[foreign]).await, "");
    let named = App::with(|config| {
        with_key(config);
        config.http.allowed_hosts = vec!["other.example".into()];
    });
    for info in [LOOPBACK, anywhere] {
        let code = refusal(&named, info, "/maps", &[key, foreign]).await;
        assert_eq!(code, "host_not_allowed");
        let own = [key, ("host", "other.example:8080")];
        assert_eq!(refusal(&named, info, "/maps", &own).await, "");
    }
}

#[tokio::test]
async fn pages_of_other_origins_are_refused() {
    let app = App::with(|config| {
        config.http.allowed_origins = vec!["https://Console.example".into()];
    });
    let info = ConnectionInfo {
        is_loopback: false,
        ..LOOPBACK
    };
    let encrypted = ConnectionInfo {
        is_tls: true,
        ..info
    };
    let cases = [
        (info, "vpr.example:8080", "http://vpr.example:8080", ""),
        (info, "vpr.example:8080", "HTTP://VPR.example:8080", ""),
        (info, "vpr.example", "http://vpr.example", ""),
        (info, "vpr.example:80", "http://vpr.example", ""),
        // A proxy took the encryption off.
        (info, "vpr.example", "https://vpr.example", ""),
        (encrypted, "vpr.example", "https://vpr.example", ""),
        (encrypted, "vpr.example", "https://vpr.example:443", ""),
        (
            encrypted,
            "vpr.example",
            "http://vpr.example",
            "cross_origin",
        ),
        (info, "[::1]:8080", "http://[::1]:8080", ""),
        (info, "vpr.example:8080", "https://console.example", ""),
        (info, "vpr.example:8080", "https://console.example:443", ""),
        (
            info,
            "vpr.example:8080",
            "http://console.example",
            "cross_origin",
        ),
        (
            info,
            "vpr.example:8080",
            "https://console.example:8443",
            "cross_origin",
        ),
        (
            info,
            "vpr.example:8080",
            "http://vpr.example:8081",
            "cross_origin",
        ),
        (
            info,
            "vpr.example:8080",
            "http://vpr.example",
            "cross_origin",
        ),
        (
            info,
            "vpr.example:8080",
            "http://evil.example:8080",
            "cross_origin",
        ),
        (
            info,
            "vpr.example:8080",
            "http://a.vpr.example:8080",
            "cross_origin",
        ),
        (
            info,
            "vpr.example:8080",
            "http://vpr.example:8080.evil.example",
            "cross_origin",
        ),
        (
            info,
            "vpr.example:8080",
            "http://vpr.example:8080@evil.example",
            "cross_origin",
        ),
        (
            info,
            "vpr.example:8080",
            "http://vpr.example:8080/path",
            "cross_origin",
        ),
        (
            info,
            "vpr.example:8080",
            "ftp://vpr.example:8080",
            "cross_origin",
        ),
        (info, "vpr.example:8080", "vpr.example:8080", "cross_origin"),
        (info, "vpr.example:8080", "null", "cross_origin"),
        (info, "vpr.example:8080", "", "cross_origin"),
        (info, "vpr.example:8080", "file://", "cross_origin"),
    ];
    for (info, host, origin, code) in cases {
        let headers = [("host", host), ("origin", origin)];
        assert_eq!(
            refusal(&app, info, "/maps", &headers).await,
            code,
            "{host} {origin:?}"
        );
    }
    let two = [
        ("host", "vpr.example"),
        ("origin", "http://vpr.example"),
        ("origin", "http://evil.example"),
    ];
    assert_eq!(refusal(&app, info, "/maps", &two).await, "cross_origin");
    let none = [("origin", "http://vpr.example")];
    assert_eq!(refusal(&app, info, "/maps", &none).await, "cross_origin");
}

#[tokio::test]
async fn what_a_browser_sends_for_another_site_without_an_origin_is_refused() {
    let app = App::new();
    let site = |kind| ("sec-fetch-site", kind);
    let host = ("host", "localhost");
    for kind in ["same-origin", "none", "same-site"] {
        assert_eq!(
            refusal(&app, LOOPBACK, "/maps", &[host, site(kind)]).await,
            "",
            "{kind}"
        );
    }
    let cross = [host, site("Cross-Site")];
    assert_eq!(
        refusal(&app, LOOPBACK, "/maps", &cross).await,
        "cross_origin"
    );
    assert_eq!(refusal(&app, LOOPBACK, "/livez", &cross).await, "");
    // Somebody follows a link; what it leads to is a page without data, or it is refused.
    let link = [
        host,
        site("cross-site"),
        ("sec-fetch-mode", "navigate"),
        ("sec-fetch-dest", "document"),
    ];
    assert_eq!(refusal(&app, LOOPBACK, "/docs/", &link).await, "");
    assert_eq!(
        refusal(&app, LOOPBACK, "/maps", &link).await,
        "cross_origin"
    );
    let frame = [
        host,
        site("cross-site"),
        ("sec-fetch-mode", "navigate"),
        ("sec-fetch-dest", "iframe"),
    ];
    assert_eq!(
        refusal(&app, LOOPBACK, "/docs/", &frame).await,
        "cross_origin"
    );
}

#[tokio::test]
async fn pages_of_allowed_origins_may_read_answers_and_send_keys() {
    let app = App::with(|config| {
        with_key(config);
        config.http.allowed_origins = vec!["https://console.example".into()];
    });
    let origin = ("origin", "https://console.example");
    let headers = [("host", "vpr.example"), origin, ("x-api-key", "secret")];
    let answer = app
        .send(request(Method::GET, "/maps", LOOPBACK, &headers))
        .await;
    answer.ok();
    assert_eq!(
        answer.header("access-control-allow-origin"),
        "https://console.example"
    );
    let headers = [
        ("host", "vpr.example"),
        origin,
        ("access-control-request-method", "DELETE"),
        ("access-control-request-headers", "x-api-key"),
    ];
    let preflight = request(Method::OPTIONS, "/maps/m", LOOPBACK, &headers);
    let preflight = app.send(preflight).await;
    assert_eq!(preflight.status, StatusCode::OK);
    assert_eq!(preflight.header("access-control-allow-methods"), "DELETE");
    assert_eq!(
        preflight.header("access-control-allow-headers"),
        "x-api-key"
    );
    let foreign = [
        ("host", "vpr.example"),
        ("origin", "https://evil.example"),
        ("access-control-request-method", "DELETE"),
    ];
    let preflight = app
        .send(request(Method::OPTIONS, "/maps/m", LOOPBACK, &foreign))
        .await;
    preflight.problem("cross_origin");
    assert_eq!(preflight.header("access-control-allow-origin"), "");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_real_listener_on_loopback_checks_names() {
    let server = Server::start(|_| {}).await;
    for (host, status) in [("localhost", "200"), ("evil.example", "403")] {
        let request = format!("GET /maps HTTP/1.1\r\nhost: {host}\r\nconnection: close\r\n\r\n");
        let answer = exchange(server.connect().await, request.as_bytes()).await;
        assert!(
            answer.starts_with(&format!("HTTP/1.1 {status}")),
            "{answer}"
        );
    }
}

#[test]
fn settings_that_name_no_host_or_origin_are_refused() {
    let refused = |change: fn(&mut Config)| {
        let mut config = Config::default();
        change(&mut config);
        config.http.check().unwrap_err().field
    };
    for change in [
        |config: &mut Config| config.http.allowed_hosts = vec!["a.example:80".into()],
        |config: &mut Config| config.http.allowed_hosts = vec!["http://a.example".into()],
        |config: &mut Config| config.http.allowed_hosts = vec![String::new()],
    ] {
        assert_eq!(refused(change), "http.allowed_hosts");
    }
    for change in [
        |config: &mut Config| config.http.allowed_origins = vec!["a.example".into()],
        |config: &mut Config| config.http.allowed_origins = vec!["https://a.example/x".into()],
        |config: &mut Config| config.http.allowed_origins = vec!["*".into()],
        |config: &mut Config| config.http.allowed_origins = vec!["null".into()],
    ] {
        assert_eq!(refused(change), "http.allowed_origins");
    }
    assert_eq!(
        refused(|config| config.http.tls_cert = Some("cert.pem".into())),
        "http.tls_cert"
    );
}
