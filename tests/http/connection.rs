//! What only a real connection shows: dawdlers, leavers, and the end of the server.

use crate::listener::{Server, post, read_all};
use crate::support::{PATIENCE, picture};
use std::time::Duration;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::time::{sleep, timeout};

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_body_that_dawdles_is_cut_off() {
    let server = Server::start(|config| config.http.body_idle_timeout_ms = 200).await;
    let whole = post("/references?map=m", &picture(1));
    let mut stream = server.connect().await;
    stream.write_all(&whole[..whole.len() - 10]).await.unwrap();
    let answer = read_all(&mut stream).await;
    assert!(
        answer.starts_with("HTTP/1.1 408") && answer.contains("request_timeout"),
        "{answer}"
    );
    assert_eq!(server.source.described(), 0);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_body_that_drips_is_cut_off_as_a_whole() {
    let server = Server::start(|config| config.http.body_timeout_ms = 300).await;
    let whole = post("/references?map=m", &picture(1));
    let (mut reader, mut writer) = server.connect().await.into_split();
    let dripping = tokio::spawn(async move {
        for byte in &whole {
            if writer.write_all(&[*byte]).await.is_err() {
                break;
            }
            sleep(Duration::from_millis(5)).await;
        }
    });
    let mut text = Vec::new();
    let _ = timeout(PATIENCE, reader.read_to_end(&mut text))
        .await
        .expect("the server kept the connection");
    assert!(String::from_utf8_lossy(&text).starts_with("HTTP/1.1 408"));
    dripping.abort();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_head_that_dawdles_is_cut_off() {
    let server = Server::start(|config| config.http.header_timeout_ms = 200).await;
    let mut stream = server.connect().await;
    stream
        .write_all(b"GET /livez HTTP/1.1\r\nhost: localhost\r\nx-slow")
        .await
        .unwrap();
    let answer = read_all(&mut stream).await;
    assert!(!answer.contains("200 OK"), "{answer}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_body_over_the_limit_is_refused_before_it_is_sent() {
    let server = Server::start(|config| config.image.max_bytes = 1000).await;
    let head = "POST /query?map=m HTTP/1.1\r\nhost: localhost\r\ncontent-type: image/png\r\ncontent-length: 999999999\r\n\r\n";
    let answer = server.exchange(head.as_bytes()).await;
    assert!(
        answer.starts_with("HTTP/1.1 413") && answer.contains("body_too_large"),
        "{answer}"
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_body_of_unknown_length_is_cut_off_at_the_limit() {
    let server = Server::start(|config| config.image.max_bytes = 1000).await;
    for path in ["/query?map=m", "/references?map=m"] {
        let mut stream = server.connect().await;
        let head = format!(
            "POST {path} HTTP/1.1\r\nhost: localhost\r\ncontent-type: image/png\r\ntransfer-encoding: chunked\r\n\r\n"
        );
        stream.write_all(head.as_bytes()).await.unwrap();
        // The last chunk never comes: the answer must not wait for it.
        for _ in 0..3 {
            stream
                .write_all(format!("190\r\n{}\r\n", "x".repeat(0x190)).as_bytes())
                .await
                .unwrap();
        }
        let answer = read_all(&mut stream).await;
        assert!(
            answer.starts_with("HTTP/1.1 413") && answer.contains("body_too_large"),
            "{answer}"
        );
        assert!(
            answer.to_ascii_lowercase().contains("connection: close"),
            "{answer}"
        );
    }
    assert_eq!(server.source.described(), 0);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_client_that_hangs_up_takes_its_work_along() {
    let server = Server::start(|_| {}).await;
    assert!(
        server
            .exchange(&post("/references?map=m", &picture(0)))
            .await
            .starts_with("HTTP/1.1 201")
    );
    server.source.slow_down(Duration::from_millis(400));
    let staying = {
        let mut stream = server.connect().await;
        stream
            .write_all(&post("/query?map=m", &picture(1)))
            .await
            .unwrap();
        stream
    };
    sleep(Duration::from_millis(150)).await;
    for seed in 2..5 {
        let mut leaving = server.connect().await;
        leaving
            .write_all(&post("/query?map=m", &picture(seed)))
            .await
            .unwrap();
        sleep(Duration::from_millis(30)).await;
        drop(leaving);
    }
    let mut staying = staying;
    assert!(read_all(&mut staying).await.starts_with("HTTP/1.1 200"));
    server.source.slow_down(Duration::ZERO);
    assert!(
        server
            .exchange(&post("/query?map=m", &picture(9)))
            .await
            .starts_with("HTTP/1.1 200")
    );
    assert_eq!(server.source.described(), 3);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn stopping_lets_requests_under_way_finish() {
    let mut server = Server::start(|_| {}).await;
    assert!(
        server
            .exchange(&post("/references?map=m", &picture(0)))
            .await
            .starts_with("HTTP/1.1 201")
    );
    server.source.slow_down(Duration::from_millis(500));
    let mut stream = server.connect().await;
    stream
        .write_all(&post("/query?map=m", &picture(1)))
        .await
        .unwrap();
    sleep(Duration::from_millis(150)).await;
    server.stop();
    assert!(read_all(&mut stream).await.starts_with("HTTP/1.1 200"));
    timeout(PATIENCE, &mut server.serving)
        .await
        .unwrap()
        .unwrap();
    assert!(TcpStream::connect(server.address).await.is_err());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_drain_delay_fails_readiness_first() {
    let mut server = Server::start(|config| config.http.drain_delay_ms = 1500).await;
    let get = b"GET /readyz HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n\r\n";
    assert!(server.exchange(get).await.starts_with("HTTP/1.1 200"));
    server.stop();
    sleep(Duration::from_millis(200)).await;
    let answer = server.exchange(get).await;
    assert!(
        answer.starts_with("HTTP/1.1 503") && answer.contains("draining"),
        "{answer}"
    );
    assert!(
        server
            .exchange(&post("/references?map=m", &picture(0)))
            .await
            .starts_with("HTTP/1.1 201")
    );
    timeout(PATIENCE, &mut server.serving)
        .await
        .unwrap()
        .unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_drain_deadline_answers_what_is_left() {
    let mut server = Server::start(|config| config.http.drain_timeout_ms = 200).await;
    assert!(
        server
            .exchange(&post("/references?map=m", &picture(0)))
            .await
            .starts_with("HTTP/1.1 201")
    );
    server.source.slow_down(Duration::from_secs(3));
    let mut stream = server.connect().await;
    stream
        .write_all(&post("/query?map=m", &picture(1)))
        .await
        .unwrap();
    sleep(Duration::from_millis(150)).await;
    server.stop();
    let answer = read_all(&mut stream).await;
    assert!(
        answer.starts_with("HTTP/1.1 503") && answer.contains("shutting_down"),
        "{answer}"
    );
    timeout(PATIENCE, &mut server.serving)
        .await
        .unwrap()
        .unwrap();
}
