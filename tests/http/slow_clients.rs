//! Clients that take their answers slowly or not at all, and those that send slowly.

use crate::listener::{Server, exchange, get, get_and_stay, post, read_all};
use crate::support::{PATIENCE, picture, until};
use std::time::Duration;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::time::{sleep, timeout};

/// The largest file of the documentation, more than a megabyte.
const BUNDLE: &str = "/docs/swagger-ui-bundle.js";

/// Sends `request` again and again until the server takes no more; reads nothing.
fn pipeline(stream: TcpStream, request: Vec<u8>) -> tokio::task::JoinHandle<TcpStream> {
    tokio::spawn(async move {
        let mut stream = stream;
        for _ in 0..20_000 {
            if stream.write_all(&request).await.is_err() {
                break;
            }
        }
        stream
    })
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn clients_that_never_read_are_cut_off() {
    let server = Server::start(|config| config.http.answer_stall_timeout_ms = 300).await;
    let mut clients = Vec::new();
    for request in [
        get_and_stay(BUNDLE),
        get_and_stay("/livez"),
        get_and_stay("/metrics"),
    ] {
        clients.push(pipeline(server.connect().await, request.clone()));
        clients.push(pipeline(server.connect_narrowly().await, request));
    }
    until("the cut of all of them", || {
        server.cut("slow_reader") >= 6.0
    })
    .await;
    server.until_open("general", 0).await;
    assert!(server.exchange(&get("/livez")).await.contains("200 OK"));
    for client in clients {
        drop(client.await.unwrap());
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_client_that_reads_drop_by_drop_is_cut_off() {
    let server = Server::start(|config| {
        config.http.answer_stall_timeout_ms = 300;
        config.http.min_answer_bytes_per_second = 1 << 20;
    })
    .await;
    let mut stream = server.connect_narrowly().await;
    stream.write_all(&get_and_stay(BUNDLE)).await.unwrap();
    let mut buffer = [0; 256];
    let reading = async {
        while stream.read(&mut buffer).await.is_ok_and(|read| read > 0) {
            sleep(Duration::from_millis(10)).await;
        }
    };
    timeout(PATIENCE, reading)
        .await
        .expect("the server kept it");
    assert_eq!(server.cut("slow_reader"), 1.0);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_client_that_is_slow_but_fast_enough_gets_all_of_its_answer() {
    let server = Server::start(|config| {
        config.http.answer_stall_timeout_ms = 300;
        config.http.min_answer_bytes_per_second = 1000;
    })
    .await;
    let mut stream = server.connect_narrowly().await;
    stream.write_all(&get(BUNDLE)).await.unwrap();
    let mut text = Vec::new();
    let mut buffer = vec![0; 16 << 10];
    loop {
        match timeout(PATIENCE, stream.read(&mut buffer)).await.unwrap() {
            Ok(0) => break,
            Ok(read) => text.extend_from_slice(&buffer[..read]),
            Err(error) => panic!("cut off after {} bytes: {error}", text.len()),
        }
        sleep(Duration::from_millis(5)).await;
    }
    let head = text.windows(4).position(|end| end == b"\r\n\r\n").unwrap();
    let announced = String::from_utf8_lossy(&text[..head]).to_lowercase();
    let length = announced.split("content-length: ").nth(1).unwrap();
    let length: usize = length.lines().next().unwrap().parse().unwrap();
    assert_eq!(text.len() - head - 4, length);
    assert_eq!(server.cut("slow_reader"), 0.0);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn listings_that_nobody_reads_count_against_a_budget() {
    let server = Server::start(|config| config.http.max_unsent_bytes = 1 << 20).await;
    let padding = "x".repeat(7000);
    for seed in 0..50 {
        let path = format!("/references?map=m&metadata=%7B%22p%22:%22{padding}%22%7D");
        let answer = server.exchange(&post(&path, &picture(seed))).await;
        assert!(answer.starts_with("HTTP/1.1 201"), "{answer}");
    }
    let listing = get("/references?limit=1000");
    let mut unread = server.connect_narrowly().await;
    unread.write_all(&listing).await.unwrap();
    // Its answer begins, and so is made.
    unread.readable().await.unwrap();

    let refused = server.exchange(&listing).await;
    assert!(
        refused.starts_with("HTTP/1.1 503") && refused.contains("answers"),
        "{}",
        &refused[..200.min(refused.len())]
    );
    assert!(refused.to_lowercase().contains("retry-after"));
    assert_eq!(
        server.metric("placeformer_rejected_total{reason=\"answer_memory\"}"),
        1.0
    );
    for path in ["/livez", "/metrics", "/maps", "/references?limit=1"] {
        assert!(
            server.exchange(&get(path)).await.contains("200 OK"),
            "{path}"
        );
    }

    assert!(read_all(&mut unread).await.len() > 350_000);
    assert!(server.exchange(&listing).await.contains("200 OK"));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_listing_whose_client_has_left_is_given_back() {
    let server = Server::start(|config| config.http.max_unsent_bytes = 1 << 20).await;
    let padding = "x".repeat(7000);
    for seed in 0..50 {
        let path = format!("/references?map=m&metadata=%7B%22p%22:%22{padding}%22%7D");
        server.exchange(&post(&path, &picture(seed))).await;
    }
    let listing = get("/references?limit=1000");
    let mut unread = server.connect_narrowly().await;
    unread.write_all(&listing).await.unwrap();
    unread.readable().await.unwrap();
    assert!(server.exchange(&listing).await.starts_with("HTTP/1.1 503"));
    drop(unread);
    server.until_open("general", 0).await;
    assert!(server.exchange(&listing).await.contains("200 OK"));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_body_that_comes_too_slowly_is_cut_off_long_before_its_end() {
    let server = Server::start(|config| {
        config.http.body_timeout_ms = 3_600_000;
        config.http.body_idle_timeout_ms = 300;
        config.http.min_body_bytes_per_second = 1 << 20;
    })
    .await;
    let whole = post("/references?map=m", &vec![7; 1 << 20]);
    let (mut reader, mut writer) = server.connect().await.into_split();
    let dripping = tokio::spawn(async move {
        for piece in whole.chunks(100) {
            if writer.write_all(piece).await.is_err() {
                break;
            }
            sleep(Duration::from_millis(20)).await;
        }
    });
    let mut text = Vec::new();
    let _ = timeout(PATIENCE, reader.read_to_end(&mut text))
        .await
        .expect("the server kept the connection");
    let text = String::from_utf8_lossy(&text);
    assert!(
        text.starts_with("HTTP/1.1 408") && text.contains("slowly"),
        "{text}"
    );
    dripping.abort();
    let quick = server
        .exchange(&post("/references?map=m", &picture(1)))
        .await;
    assert!(quick.starts_with("HTTP/1.1 201"), "{quick}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_connection_ends_at_its_age_with_the_answer_under_way() {
    let server = Server::start(|config| config.http.max_connection_age_ms = 400).await;
    let mut idle = server.connect().await;
    idle.write_all(&get_and_stay("/livez")).await.unwrap();
    assert!(read_all(&mut idle).await.contains("200 OK"));

    server
        .exchange(&post("/references?map=m", &picture(0)))
        .await;
    server.source.describing.gate.close();
    let mut busy = server.connect().await;
    busy.write_all(&post("/query?map=m", &picture(1)))
        .await
        .unwrap();
    sleep(Duration::from_millis(600)).await;
    server.source.describing.gate.open();
    assert!(read_all(&mut busy).await.contains("200 OK"));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn requests_sent_ahead_are_answered_one_after_the_other() {
    let server = Server::start(|_| {}).await;
    let ahead = [get_and_stay("/livez"), get_and_stay("/maps"), get("/livez")].concat();
    let answers = exchange(server.connect().await, &ahead).await;
    let bodies = [
        "{\"status\":\"live\"}",
        "{\"maps\":[]}",
        "{\"status\":\"live\"}",
    ];
    let mut rest = answers.as_str();
    for body in bodies {
        rest = rest
            .split_once(body)
            .unwrap_or_else(|| panic!("{answers}"))
            .1;
    }
}
