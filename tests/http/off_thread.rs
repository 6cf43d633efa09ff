//! Large bodies and answers do not hold up the threads that drive the connections.
//!
//! These tests have one such thread, and count how many probes it answers while something large is
//! taken apart or written: none, if it did the work itself.

use crate::support::App;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

/// More probes than are answered while requests merely wait for other threads a few times.
const MANY: usize = 20;

/// How many probes are answered while `work` is under way.
async fn probes_during(app: &App, work: impl Future<Output = ()>) -> usize {
    let is_done = AtomicBool::new(false);
    let probing = async {
        let mut answered = 0;
        while !is_done.load(Ordering::SeqCst) {
            app.get("/livez").await.ok();
            answered += 1;
            // Lets the other side go on, also where probes never wait.
            tokio::time::sleep(Duration::from_micros(100)).await;
        }
        answered
    };
    let working = async {
        work.await;
        is_done.store(true, Ordering::SeqCst);
    };
    tokio::join!(probing, working).0
}

/// 20 MB of base64 that is wrong at its end, so that nothing comes after the body is taken apart.
fn base64(slash: &str) -> String {
    let image = slash.repeat((20 << 20) / slash.len());
    format!("{{\"map\": \"m\", \"image\": \"{image}!\"}}")
}

#[tokio::test]
async fn probes_are_answered_while_json_is_taken_apart() {
    let app = App::new();
    for slash in ["/", "\\/", "\\u002f"] {
        let body = base64(slash);
        let sending = async {
            let answer = app.post("/query", "application/json", body).await;
            answer.problem("invalid_parameter");
        };
        let answered = probes_during(&app, sending).await;
        assert!(answered >= MANY, "{answered} probes beside {slash:?}");
    }
}

#[tokio::test]
async fn probes_are_answered_while_multipart_is_taken_apart() {
    let app = App::new();
    // Almost a boundary, again and again; the last part does not end.
    let head = "--b\r\ncontent-disposition: form-data; name=\"image\"\r\n\r\n";
    let body = format!("{head}{}", "\r\n--\r\n-".repeat((20 << 20) / 7));
    let sending = async {
        let answer = app.post("/query?map=m", "multipart/form-data; boundary=b", body);
        answer.await.problem("malformed_request");
    };
    let answered = probes_during(&app, sending).await;
    assert!(answered >= MANY, "{answered} probes");
}

#[tokio::test]
async fn multipart_whose_parts_begin_late_is_refused_without_a_search() {
    let app = App::new();
    let long = "x".repeat(20 << 20);
    let head = "content-disposition: form-data; name=\"image\"";
    for body in [
        format!("{long}\r\n--b\r\n{head}\r\n\r\nx\r\n--b--\r\n"),
        format!("--b\r\nx-long: {long}\r\n{head}\r\n\r\nx\r\n--b--\r\n"),
        format!("--b\r\n{head}\r\n\r\nx\r\n--b{long}\r\n\r\nx\r\n--b--\r\n"),
        String::new(),
        long.clone(),
    ] {
        let kind = "multipart/form-data; boundary=b";
        let answer = app.post("/query?map=m", kind, body).await;
        let detail = answer.problem("malformed_request");
        assert!(detail.contains("soon"), "{detail}");
    }
}

#[tokio::test]
async fn what_stands_around_the_parts_of_multipart_is_no_fault() {
    let app = App::new();
    let head = "content-disposition: form-data; name=\"json\"";
    let long = "x".repeat(1 << 20);
    let json = "{\"map\": \"m\"}";
    let body = format!("preamble\r\n--b \r\n{head}\r\n\r\n{json}\r\n--b--\r\n{long}");
    let kind = "multipart/form-data; boundary=\"b\"";
    let answer = app.post("/query", kind, body).await;
    let detail = answer.problem("invalid_parameter");
    assert!(
        detail.contains("the image \"image\" is missing"),
        "{detail}"
    );
}
