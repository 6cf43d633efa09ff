//! The data directory removed or exchanged under a running server: it says so, acknowledges
//! nothing, goes on answering queries, and goes on storing once the directory is back.

use crate::process::Server;
use crate::support::picture;
use serde_json::{Value, json};
use std::fs;
use std::path::PathBuf;
use std::time::{Duration, Instant};
use tempfile::TempDir;

/// A server on a directory that can be moved, with three references.
struct Held {
    folder: TempDir,
    server: Server,
    ids: Vec<String>,
}

impl Held {
    fn start() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let server = Server::start(&folder.path().join("data"), None);
        let ids = (0..3)
            .map(|seed| {
                let path = format!("/references?map=m&external_id={seed}");
                let (status, answer) = server.post(&path, picture(seed)).unwrap();
                assert_eq!(status, 201, "{answer}");
                answer["id"].as_str().unwrap().to_owned()
            })
            .collect();
        Self {
            folder,
            server,
            ids,
        }
    }

    fn data(&self) -> PathBuf {
        self.folder.path().join("data")
    }

    fn add(&self, seed: u64) -> (u16, Value) {
        let path = format!("/references?map=m&external_id={seed}");
        self.server.post(&path, picture(seed)).unwrap()
    }

    #[track_caller]
    fn refuses_writes(&self) {
        let refused = |(status, answer): (u16, Value)| {
            let found = (status, answer["code"].as_str(), &answer["retryable"]);
            assert_eq!(found, (507, Some("storage_lost"), &json!(true)), "{answer}");
        };
        refused(self.add(50));
        refused(
            self.server
                .delete(&format!("/references/{}", self.ids[0]))
                .unwrap(),
        );
        refused(self.server.delete("/maps/m").unwrap());
        let metrics = self.server.text("/metrics");
        let counted = "placeformer_rejected_total{reason=\"storage_lost\"} ";
        let line = metrics
            .lines()
            .find(|line| line.starts_with(counted))
            .unwrap();
        assert_ne!(line, format!("{counted}0"));
    }

    #[track_caller]
    fn answers_queries(&self) {
        assert_eq!(self.server.get("/readyz?for=query").unwrap().0, 200);
        for (seed, id) in (0..).zip(&self.ids) {
            let answer = self.server.post("/query?map=m&top_k=1", picture(seed));
            let (status, answer) = answer.unwrap();
            assert_eq!(status, 200, "{answer}");
            assert_eq!(
                answer["results"][0]["reference_id"],
                id.as_str(),
                "{answer}"
            );
        }
    }

    /// Waits until `/readyz` answers so; the server looks at the disk every other second.
    #[track_caller]
    fn becomes(&self, status: u16, reason: &str) -> Value {
        let began = Instant::now();
        loop {
            let (found, body) = self.server.get("/readyz").unwrap();
            if found == status && body["status"] == reason {
                return body;
            }
            let waited = began.elapsed();
            assert!(
                waited < Duration::from_secs(60),
                "/readyz stays {found} {body}"
            );
            std::thread::sleep(Duration::from_millis(50));
        }
    }
}

#[test]
fn a_directory_that_was_moved_away_and_back() {
    let held = Held::start();
    let aside = held.folder.path().join("aside");
    fs::rename(held.data(), &aside).unwrap();
    // Even before the server has looked by itself.
    held.refuses_writes();
    let body = held.becomes(503, "storage_lost");
    let detail = body["detail"].as_str().unwrap();
    assert!(detail.contains("cannot find"), "{detail}");
    held.answers_queries();
    held.refuses_writes();
    fs::rename(&aside, held.data()).unwrap();
    held.becomes(200, "ready");
    assert_eq!(held.add(60).0, 201);
    held.answers_queries();
    held.server.kill();
    let server = Server::start(&held.data(), None);
    let (_, page) = server.get("/references?limit=100").unwrap();
    assert_eq!(page["references"].as_array().unwrap().len(), 4);
}

#[test]
fn a_directory_that_was_removed_without_a_request_is_noticed() {
    let held = Held::start();
    fs::remove_dir_all(held.data()).unwrap();
    held.becomes(503, "storage_lost");
    held.refuses_writes();
    held.answers_queries();
    held.server.kill();
}

#[test]
fn a_database_replaced_by_a_copy_needs_a_restart_and_says_so() {
    let held = Held::start();
    let path = held.data().join("placeformer.db");
    let copy = held.folder.path().join("copy");
    fs::copy(&path, &copy).unwrap();
    fs::rename(&copy, &path).unwrap();
    let body = held.becomes(503, "storage_lost");
    assert!(
        body["detail"].as_str().unwrap().contains("restart"),
        "{body}"
    );
    held.refuses_writes();
    held.answers_queries();
    held.server.kill();
}
