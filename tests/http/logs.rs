//! The log as a collector sees it: one JSON object a line, and every line of a request under its
//! id.

use crate::disk::damage_patches;
use crate::process::{Server, source};
use crate::support::{App, BREAKS_THE_DECODER, BREAKS_THE_MODEL, picture};
use serde_json::Value;
use std::path::Path;
use std::sync::Arc;

fn lines(log: &Path) -> Vec<Value> {
    let text = std::fs::read_to_string(log).unwrap();
    text.lines()
        .map(|line| serde_json::from_str(line).unwrap_or_else(|_| panic!("not JSON: {line}")))
        .collect()
}

const BROKEN: &str = "a blocking task failed";

/// Request id, path, body, expected status, and lines that must be logged beside "answered".
type Case = (
    &'static str,
    &'static str,
    Vec<u8>,
    u16,
    &'static [&'static str],
);

#[test]
fn every_line_of_a_request_carries_its_id_whatever_thread_it_comes_from() {
    let directory = Arc::new(tempfile::tempdir().unwrap());
    tokio::runtime::Runtime::new().unwrap().block_on(async {
        let app = App::open(directory.clone(), source(), |_| {});
        for seed in 0..5 {
            app.post_png("/references?map=m", seed).await.created();
        }
    });
    damage_patches(directory.path(), 3);
    let logs = tempfile::tempdir().unwrap();
    let log = logs.path().join("log");
    let server = Server::start_logged(directory.path(), &log);
    let mut seen = lines(&log).len();
    assert!(seen > 0, "the start is logged");
    let cases: [Case; 4] = [
        ("adds", "/references?map=m", picture(9), 201, &[]),
        (
            "meets-damage",
            "/query?map=m",
            picture(1),
            200,
            &["a stored reference is damaged; it is quarantined"],
        ),
        (
            "breaks-decoder",
            "/query?map=m",
            BREAKS_THE_DECODER.to_vec(),
            422,
            &["a thread panicked", BROKEN],
        ),
        (
            "breaks-model",
            "/query?map=m",
            BREAKS_THE_MODEL.to_vec(),
            500,
            &["a thread panicked", BROKEN, "request failed"],
        ),
    ];
    for (id, path, body, status, expected) in cases {
        let (answered, answer) = server.post_as(id, path, body).unwrap();
        assert_eq!(answered, status, "{answer}");
        let all = lines(&log);
        let new = &all[seen..];
        for line in new {
            assert_eq!(
                line["span"]["request_id"], id,
                "a line of {id} without its id: {line}"
            );
        }
        for text in expected.iter().chain(&["answered"]) {
            assert!(
                new.iter().any(|line| line["message"] == *text),
                "{id}: no line says {text:?}: {new:?}"
            );
        }
        seen = all.len();
    }
    server.kill();
}

#[test]
fn a_deadline_that_passes_is_no_error_in_the_log() {
    let directory = Arc::new(tempfile::tempdir().unwrap());
    tokio::runtime::Runtime::new().unwrap().block_on(async {
        let app = App::open(directory.clone(), source(), |_| {});
        app.post_png("/references?map=m", 1).await.created();
    });
    let logs = tempfile::tempdir().unwrap();
    let log = logs.path().join("log");
    let server = Server::start_logged(directory.path(), &log);
    let is_late = |seed: &u64| {
        let (status, answer) = server
            .post("/query?map=m&deadline_ms=1", picture(*seed))
            .unwrap();
        assert!(matches!(status, 200 | 504), "{answer}");
        status == 504
    };
    assert!(
        (0..500).any(|seed| is_late(&seed)),
        "a millisecond was always enough"
    );
    for line in lines(&log) {
        assert!(
            line["level"] == "INFO" || line["level"] == "DEBUG",
            "{line}"
        );
    }
}
