//! More connections than there may be: who goes, who gets in, and what is kept for probes.

use crate::listener::{Server, exchange, get, get_and_stay, post, read_all};
use crate::support::{PATIENCE, picture};
use std::time::Duration;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::time::{sleep, timeout};

const OK: &str = "HTTP/1.1 200";
const OVERLOADED: &str = "HTTP/1.1 503";

/// A server whose queries are held until the gate of its source is opened.
async fn holding(change: impl FnOnce(&mut placeformer::config::Config)) -> Server {
    let patient = |config: &mut placeformer::config::Config| {
        config.pipeline.deadline_ms = 60_000;
        config.pipeline.max_wait_ms = 60_000;
        change(config);
    };
    let server = Server::start(patient).await;
    let answer = server
        .exchange(&post("/references?map=m", &picture(0)))
        .await;
    assert!(answer.starts_with("HTTP/1.1 201"), "{answer}");
    server.until_open("general", 0).await;
    server.source.describing.gate.close();
    server
}

/// Sends a query that is held.
async fn hold(mut stream: TcpStream) -> TcpStream {
    let query = post("/query?map=m", &picture(1));
    stream.write_all(&query).await.unwrap();
    // The head arrives together with the body, so the server soon works on it.
    sleep(Duration::from_millis(100)).await;
    stream
}

/// Sends a request on a connection that stays open, and reads the first bytes of the answer.
async fn ask(stream: &mut TcpStream) -> bool {
    if stream.write_all(&get_and_stay("/livez")).await.is_err() {
        return false;
    }
    let mut bytes = [0; 1024];
    let read = timeout(PATIENCE, stream.read(&mut bytes)).await.unwrap();
    read.is_ok_and(|read| bytes[..read].starts_with(OK.as_bytes()))
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn silent_connections_shut_nobody_out() {
    let server = Server::start(|config| {
        config.http.max_connections = 16;
        config.http.max_connections_per_address = 8;
    })
    .await;
    let mut silent = Vec::new();
    for _ in 0..300 {
        silent.push(server.connect().await);
    }
    for path in ["/livez", "/readyz", "/metrics", "/maps"] {
        let answer = server.exchange(&get(path)).await;
        assert!(answer.starts_with(OK), "{path}: {answer}");
    }
    let stored = server
        .exchange(&post("/references?map=m", &picture(0)))
        .await;
    assert!(stored.starts_with("HTTP/1.1 201"), "{stored}");
    assert!(server.open("general") <= 8.0);
    assert!(server.cut("evicted") >= 292.0);
    assert_eq!(server.cut("refused"), 0.0);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn heads_that_drip_do_not_keep_their_place() {
    let server = Server::start(|config| config.http.max_connections = 2).await;
    let mut dripping = Vec::new();
    for _ in 0..2 {
        let mut stream = server.connect().await;
        stream
            .write_all(b"GET /livez HTTP/1.1\r\nx-slow: ")
            .await
            .unwrap();
        dripping.push(stream);
    }
    server.until_open("general", 2).await;
    sleep(Duration::from_millis(50)).await;
    for stream in &mut dripping {
        stream.write_all(b"x").await.unwrap();
    }
    assert!(server.exchange(&get("/maps")).await.starts_with(OK));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_idlest_connection_goes_and_busy_ones_stay() {
    let server = holding(|config| config.http.max_connections = 3).await;
    let mut idlest = server.connect().await;
    assert!(ask(&mut idlest).await);
    let mut busy = hold(server.connect().await).await;
    let mut idle = server.connect().await;
    assert!(ask(&mut idle).await);

    assert!(server.exchange(&get("/maps")).await.starts_with(OK));
    let mut byte = [0];
    let ended = timeout(PATIENCE, idlest.read(&mut byte)).await.unwrap();
    assert!(matches!(ended, Ok(0) | Err(_)));
    assert!(ask(&mut idle).await);
    server.source.describing.gate.open();
    assert!(read_all(&mut busy).await.starts_with(OK));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_address_with_many_connections_gives_way_before_one_with_few() {
    let server = Server::start(|config| config.http.max_connections = 4).await;
    let mut few = server.connect_from("127.0.0.2").await;
    assert!(ask(&mut few).await);
    let mut many = Vec::new();
    for _ in 0..3 {
        let mut stream = server.connect_from("127.0.0.1").await;
        assert!(ask(&mut stream).await);
        many.push(stream);
    }
    let newcomer = server.connect_from("127.0.0.3").await;
    assert!(exchange(newcomer, &get("/maps")).await.starts_with(OK));
    assert!(ask(&mut few).await);
    assert!(!ask(&mut many[0]).await);
    assert!(ask(&mut many[2]).await);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn one_address_has_only_so_many_connections() {
    let server = holding(|config| config.http.max_connections_per_address = 3).await;
    let mut busy = Vec::new();
    for _ in 0..3 {
        busy.push(hold(server.connect_from("127.0.0.2").await).await);
    }
    let fourth = exchange(server.connect_from("127.0.0.2").await, &get("/maps")).await;
    assert!(fourth.starts_with(OVERLOADED), "{fourth}");
    assert!(fourth.to_lowercase().contains("connection: close"));
    let probe = exchange(server.connect_from("127.0.0.2").await, &get("/livez")).await;
    assert!(probe.starts_with(OK), "{probe}");
    let other = exchange(server.connect_from("127.0.0.3").await, &get("/maps")).await;
    assert!(other.starts_with(OK), "{other}");
    server.source.describing.gate.open();
    for stream in &mut busy {
        assert!(read_all(stream).await.starts_with(OK));
    }
    server.until_open("general", 0).await;
    let again = exchange(server.connect_from("127.0.0.2").await, &get("/maps")).await;
    assert!(again.starts_with(OK), "{again}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_trusted_proxy_may_have_more_connections() {
    let server = holding(|config| {
        config.http.max_connections_per_address = 1;
        config.http.trusted_proxies = vec!["127.0.0.2".parse().unwrap()];
    })
    .await;
    let _busy = hold(server.connect_from("127.0.0.2").await).await;
    let proxied = exchange(server.connect_from("127.0.0.2").await, &get("/maps")).await;
    assert!(proxied.starts_with(OK), "{proxied}");
    server.source.describing.gate.open();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn probes_have_connections_of_their_own() {
    let server = holding(|config| {
        config.http.max_connections = 2;
        config.http.reserved_connections = 2;
    })
    .await;
    let _busy = [
        hold(server.connect().await).await,
        hold(server.connect().await).await,
    ];
    // Neither silent connections, nor those that take no answer, keep probes out.
    let mut crowd = Vec::new();
    for _ in 0..20 {
        let mut stream = server.connect_narrowly().await;
        stream.write_all(&get_and_stay("/metrics")).await.unwrap();
        crowd.push(stream);
        crowd.push(server.connect().await);
    }
    for path in ["/livez", "/readyz", "/readyz?for=query", "/metrics"] {
        let mut stream = server.connect().await;
        // The probe does not end the connection; the server does.
        stream.write_all(&get_and_stay(path)).await.unwrap();
        let answer = read_all(&mut stream).await;
        assert!(answer.starts_with(OK), "{path}: {answer}");
        assert!(answer.to_lowercase().contains("connection: close"));
    }
    for request in [
        get_and_stay("/maps"),
        get_and_stay("/openapi.json"),
        get_and_stay("/nowhere"),
        post("/query?map=m", &picture(2)),
    ] {
        let answer = server.exchange(&request).await;
        assert!(answer.starts_with(OVERLOADED), "{answer}");
        assert!(answer.contains("\"code\":\"overloaded\""), "{answer}");
        assert!(answer.to_lowercase().contains("connection: close"));
        assert!(answer.to_lowercase().contains("retry-after: "));
    }
    assert!(server.open("reserved") <= 2.0);
    server.source.describing.gate.open();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn silence_ends_sooner_in_a_crowd() {
    let server = Server::start(|config| {
        config.http.max_connections = 8;
        config.http.crowded_silence_ms = 100;
    })
    .await;
    let mut spoken = server.connect().await;
    assert!(ask(&mut spoken).await);
    let _silent = [
        server.connect().await,
        server.connect().await,
        server.connect().await,
        server.connect().await,
        server.connect().await,
        server.connect().await,
    ];
    server.until_open("general", 7).await;
    sleep(Duration::from_millis(300)).await;
    let _newcomer = server.connect().await;
    server.until_open("general", 2).await;
    assert_eq!(server.cut("silent"), 6.0);
    assert!(ask(&mut spoken).await);
}
