//! The hub path against a local server that misbehaves on request.

use super::*;
use placeformer_core::progress::Silent;
use placeformer_vision::extract::{Record, VitWeights, verify_weights};
use sha2::{Digest, Sha256};
use std::io::{BufRead, BufReader, Write};
use std::net::{TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::time::Duration;

/// How the mock hub serves its one file.
#[derive(Clone)]
struct Mock {
    body: Arc<Vec<u8>>,
    /// Stated as the file's hash.
    etag: String,
    /// Cuts the connection after this many bytes of each answer.
    cut_after: Option<usize>,
    /// Ignores `Range`.
    no_ranges: bool,
    /// Answers everything with this.
    status: Option<&'static str>,
    /// The heads of all requests, lower case.
    seen: Arc<Mutex<Vec<String>>>,
}

impl Mock {
    fn of(body: Vec<u8>) -> Self {
        let etag = hex::encode(Sha256::digest(&body));
        let seen = Arc::default();
        Self {
            body: Arc::new(body),
            etag,
            cut_after: None,
            no_ranges: false,
            status: None,
            seen,
        }
    }

    /// Serves until the test process ends; returns the endpoint.
    fn start(&self) -> String {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = listener.local_addr().unwrap();
        let mock = self.clone();
        std::thread::spawn(move || {
            listener
                .incoming()
                .flatten()
                .for_each(|stream| mock.answer(stream))
        });
        format!("http://{address}")
    }

    fn answer(&self, mut stream: TcpStream) {
        let mut head = String::new();
        let mut reader = BufReader::new(stream.try_clone().unwrap());
        while !head.ends_with("\r\n\r\n") && reader.read_line(&mut head).unwrap_or(0) > 0 {}
        let head = head.to_ascii_lowercase();
        self.seen.lock().unwrap().push(head.clone());
        // The client may hang up at any point; that is its right.
        let _ = self.write_answer(&mut stream, &head);
    }

    fn write_answer(&self, stream: &mut TcpStream, head: &str) -> std::io::Result<()> {
        if let Some(status) = self.status {
            return write!(
                stream,
                "HTTP/1.1 {status}\r\ncontent-length: 0\r\nconnection: close\r\n\r\n"
            );
        }
        let total = self.body.len();
        if head.starts_with("head") {
            let etag = &self.etag;
            return write!(
                stream,
                "HTTP/1.1 302 Found\r\nlocation: /elsewhere\r\nx-linked-etag: \"{etag}\"\r\n\
                 x-linked-size: {total}\r\nconnection: close\r\n\r\n"
            );
        }
        let range = head.lines().find_map(|line| {
            line.strip_prefix("range: bytes=")?
                .trim_end_matches('-')
                .parse()
                .ok()
        });
        let start: usize = if self.no_ranges {
            0
        } else {
            range.unwrap_or(0)
        };
        let status = if start > 0 {
            "206 Partial Content"
        } else {
            "200 OK"
        };
        let rest = &self.body[start..];
        write!(
            stream,
            "HTTP/1.1 {status}\r\ncontent-length: {}\r\nconnection: close\r\n\r\n",
            rest.len()
        )?;
        stream.write_all(&rest[..rest.len().min(self.cut_after.unwrap_or(usize::MAX))])
    }

    fn requests(&self, method: &str) -> Vec<String> {
        self.seen
            .lock()
            .unwrap()
            .iter()
            .filter(|head| head.starts_with(method))
            .cloned()
            .collect()
    }
}

fn body() -> Vec<u8> {
    (0..100_000u32).map(|i| (i * 31 % 251) as u8).collect()
}

fn hub(endpoint: String) -> Hub {
    Hub::new(endpoint, None, Duration::from_millis(1))
}

fn fetch(mock: &Mock, dir: &Path) -> Result<PathBuf, PullError> {
    hub(mock.start()).fetch(
        "owner/model",
        "model.safetensors",
        &dir.join("model.safetensors"),
        &Silent,
    )
}

#[test]
fn a_file_arrives_whole() {
    let mock = Mock::of(body());
    let dir = tempfile::tempdir().unwrap();
    let part = fetch(&mock, dir.path()).unwrap();
    assert_eq!(std::fs::read(part).unwrap(), body());
    assert!(
        mock.requests("get")[0].starts_with("get /owner/model/resolve/main/model.safetensors ")
    );
}

#[test]
fn a_broken_connection_is_resumed_where_it_stopped() {
    let mock = Mock {
        cut_after: Some(40_000),
        ..Mock::of(body())
    };
    let dir = tempfile::tempdir().unwrap();
    assert_eq!(
        std::fs::read(fetch(&mock, dir.path()).unwrap()).unwrap(),
        body()
    );
    let gets = mock.requests("get");
    assert_eq!(gets.len(), 3);
    assert!(
        gets[1].contains("range: bytes=40000-") && gets[2].contains("range: bytes=80000-"),
        "{gets:?}"
    );
}

#[test]
fn an_earlier_process_part_is_continued_also_without_range_support() {
    for no_ranges in [false, true] {
        let dir = tempfile::tempdir().unwrap();
        let short = Mock {
            cut_after: Some(10_000),
            ..Mock::of(body())
        };
        let error = fetch(&short, dir.path()).unwrap_err().to_string();
        assert!(
            error.contains("of 100000 bytes") || error.contains("body"),
            "{error}"
        );
        let mock = Mock {
            no_ranges,
            ..Mock::of(body())
        };
        assert_eq!(
            std::fs::read(fetch(&mock, dir.path()).unwrap()).unwrap(),
            body()
        );
        assert!(
            mock.requests("get")[0].contains("range: bytes=40000-"),
            "{:?}",
            mock.requests("get")
        );
    }
}

#[test]
fn a_wrong_hash_is_refused_after_one_fresh_try_and_leaves_nothing() {
    let mock = Mock {
        etag: "ab".repeat(32),
        ..Mock::of(body())
    };
    let dir = tempfile::tempdir().unwrap();
    let error = fetch(&mock, dir.path()).unwrap_err();
    assert!(
        matches!(&error, PullError::WrongHash { expected, .. } if *expected == "ab".repeat(32)),
        "{error}"
    );
    assert_eq!(mock.requests("get").len(), 2);
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 0);
}

#[test]
fn a_spoiled_part_is_thrown_away_and_fetched_anew() {
    let mock = Mock::of(body());
    let dir = tempfile::tempdir().unwrap();
    let part = fetch(&mock, dir.path()).unwrap();
    std::fs::write(&part, vec![0; 50_000]).unwrap();
    assert_eq!(
        std::fs::read(fetch(&mock, dir.path()).unwrap()).unwrap(),
        body()
    );
}

#[test]
fn a_missing_file_fails_at_once_and_a_sick_server_after_some_tries() {
    for (status, tries) in [("404 Not Found", 1), ("503 Service Unavailable", 4)] {
        let mock = Mock {
            status: Some(status),
            ..Mock::of(body())
        };
        let error = fetch(&mock, tempfile::tempdir().unwrap().path())
            .unwrap_err()
            .to_string();
        assert!(error.contains(&status[..3]), "{error}");
        assert_eq!(mock.requests("head").len(), tries, "{status}");
    }
}

#[test]
fn the_token_is_sent_to_the_hub() {
    let mock = Mock::of(body());
    let dir = tempfile::tempdir().unwrap();
    let hub = Hub::new(mock.start(), Some("secret".into()), Duration::ZERO);
    hub.fetch("o/m", "model.safetensors", &dir.path().join("m"), &Silent)
        .unwrap();
    assert!(
        mock.requests("")
            .iter()
            .all(|head| head.contains("authorization: bearer secret"))
    );
}

#[test]
fn what_is_not_the_model_never_reaches_the_cache() {
    let mock = Mock::of(body());
    let dir = tempfile::tempdir().unwrap();
    let target = dir.path().join("model.safetensors");
    let hub = hub(mock.start());
    let puller = Puller {
        target: target.clone(),
        preset: Preset::Dinov2Vits14,
        hub,
        wheel: false,
        offline: false,
    };
    let error = puller.pull(false, &Silent).unwrap_err().to_string();
    assert!(
        error.contains("dinov2-vits14 could not be fetched") && error.contains("safetensors"),
        "{error}"
    );
    assert!(!target.exists());
}

#[test]
fn an_unreachable_hub_is_named_in_the_message() {
    let dir = tempfile::tempdir().unwrap();
    let target = dir.path().join("model.safetensors");
    // Port 9 (discard) is closed on any machine that runs tests.
    let hub = hub("http://127.0.0.1:9".into());
    let error = Puller {
        target,
        preset: Preset::Dinov2Vits14,
        hub,
        wheel: false,
        offline: false,
    }
    .pull(false, &Silent)
    .unwrap_err()
    .to_string();
    assert!(
        error.contains("Tried:") && error.contains("http://127.0.0.1:9/facebook/dinov2-small"),
        "{error}"
    );
}

#[test]
fn a_damaged_cached_model_is_noticed() {
    let dir = tempfile::tempdir().unwrap();
    let target = dir.path().join("model.safetensors");
    std::fs::write(&target, b"not what was fetched").unwrap();
    let record = Record {
        preset: "x".into(),
        source: "x".into(),
        sha256: "00".repeat(32),
        bytes: 20,
    };
    record.save(&target).unwrap();
    assert!(matches!(
        verify_weights(&target),
        Err(ExtractError::HashMismatch { .. })
    ));
    let hub = hub("http://127.0.0.1:9".into());
    let puller = Puller {
        target,
        preset: Preset::Dinov2Vits14,
        hub,
        wheel: false,
        offline: false,
    };
    assert!(
        matches!(
            puller.pull(false, &Silent),
            Err(PullError::AllFailed { .. })
        ),
        "it must try to fetch it again"
    );
}

/// Weights of the default preset's shapes, all zero.
fn zero_weights() -> VitWeights {
    use placeformer_vision::extract::{BlockWeights, Linear, Norm};
    let preset = Preset::Dinov2Vits14;
    let geometry = preset.geometry();
    let dim = geometry.dim;
    let mlp = geometry.mlp_dim;
    let position_grid = (37, 37);
    let linear = |from: usize, to: usize| Linear {
        weight: vec![0.0; from * to],
        bias: vec![0.0; to],
    };
    let norm = || Norm {
        weight: vec![0.0; dim],
        bias: vec![0.0; dim],
    };
    let block = || BlockWeights {
        norm1: norm(),
        qkv: linear(dim, 3 * dim),
        proj: linear(dim, dim),
        layer_scale1: Some(vec![0.0; dim]),
        norm2: norm(),
        fc1: linear(dim, mlp),
        fc2: linear(mlp, dim),
        layer_scale2: Some(vec![0.0; dim]),
    };
    VitWeights {
        preset,
        geometry,
        position_grid,
        patch_embed: linear(3 * geometry.patch * geometry.patch, dim),
        cls_token: vec![0.0; dim],
        positions: vec![0.0; (1 + position_grid.0 * position_grid.1) * dim],
        blocks: (0..geometry.depth).map(|_| block()).collect(),
        norm: norm(),
        unused_parameters: 0,
        merged: None,
    }
}

#[test]
fn well_formed_weights_that_are_not_the_presets_count_as_a_source_that_failed() {
    let dir = tempfile::tempdir().unwrap();
    let other = dir.path().join("other.safetensors");
    zero_weights().save(&other).unwrap();
    let mock = Mock::of(std::fs::read(&other).unwrap());
    std::fs::remove_file(other).unwrap();
    let target = dir.path().join("model.safetensors");
    let preset = Preset::Dinov2Vits14;
    let hub = hub(mock.start());
    let error = Puller {
        target: target.clone(),
        preset,
        hub,
        wheel: false,
        offline: false,
    }
    .pull(false, &Silent)
    .unwrap_err();
    let PullError::AllFailed { tried, .. } = &error else {
        panic!("the next source would not be tried: {error}")
    };
    assert!(
        tried[0].contains("other weights") && tried[0].contains(preset.content_sha256().unwrap()),
        "{tried:?}"
    );
    assert!(!target.exists());
    let parts = std::fs::read_dir(dir.path()).unwrap().filter(|entry| {
        entry
            .as_ref()
            .unwrap()
            .path()
            .extension()
            .is_some_and(|extension| extension == "part")
    });
    assert_eq!(
        parts.count(),
        0,
        "what can never become the model is not kept"
    );
}
