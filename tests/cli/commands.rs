//! `load`, `verify` and `bench` as commands: the real binary, its report, and how it fails.

use crate::common::program::offline;
use crate::common::{places, service as support};
use placeformer_core::types::ReferenceId;
use placeformer_store::{Inserted, SqliteStore, StoreConfig, WritePlaces};
use places::{map, named_reference};
use serde_json::Value;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::Output;
use support::{App, picture};
use tempfile::TempDir;
use tokio::runtime::Runtime;

/// Runs the binary in `folder`, where it finds no model, no network and no settings but its own.
fn placeformer(folder: &Path, arguments: &[&str]) -> Output {
    let mut command = offline(folder, arguments);
    command.output().expect("the binary was built")
}

/// What the binary prints when it succeeds.
#[track_caller]
fn succeeds(folder: &Path, arguments: &[&str]) -> String {
    let output = placeformer(folder, arguments);
    let error = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{arguments:?} failed: {error}");
    String::from_utf8(output.stdout).unwrap()
}

/// What the binary prints on standard output and standard error when it fails.
#[track_caller]
fn fails(folder: &Path, arguments: &[&str]) -> (String, String) {
    let output = placeformer(folder, arguments);
    assert!(!output.status.success(), "{arguments:?} succeeded");
    (
        String::from_utf8(output.stdout).unwrap(),
        String::from_utf8(output.stderr).unwrap(),
    )
}

mod verify {
    use super::*;

    /// A store of three references, closed, and the settings with which it was made.
    struct Closed {
        folder: TempDir,
        references: Vec<ReferenceId>,
    }

    impl Closed {
        fn new() -> Self {
            let folder = tempfile::tempdir().unwrap();
            let settings = "[store]\nreserve_bytes = 1048576\n";
            std::fs::write(folder.path().join("placeformer.toml"), settings).unwrap();
            let config = StoreConfig {
                reserve_bytes: 1 << 20,
                ..StoreConfig::default()
            };
            let store = SqliteStore::open(&folder.path().join("data"), &config).unwrap();
            let mut references = Vec::new();
            for seed in 0..3 {
                let new = named_reference(&map("city"), &format!("photo {seed}"), seed);
                match store.insert(new).unwrap() {
                    Inserted::Created(reference) => references.push(reference.id),
                    Inserted::AlreadyThere(reference) => panic!("{reference:?}"),
                }
            }
            Self { folder, references }
        }

        fn arguments<'a>(&self, more: &[&'a str]) -> Vec<&'a str> {
            let fixed = ["verify", "--data", "data", "--config", "placeformer.toml"];
            [&fixed, more].concat()
        }

        /// Flips one bit of the second reference's content hash in the database file.
        fn damage(&self) {
            let path = self.folder.path().join("data").join(SqliteStore::DATABASE);
            let mut content = std::fs::read(&path).unwrap();
            let hash = named_reference(&map("city"), "photo 1", 1).content_hash.0;
            let found: Vec<usize> = (0..content.len() - hash.len())
                .filter(|&at| content[at..].starts_with(&hash))
                .collect();
            assert_eq!(found.len(), 1, "the hash is not there exactly once");
            content[found[0]] ^= 1;
            std::fs::write(&path, content).unwrap();
        }
    }

    #[test]
    fn a_whole_store_passes() {
        let store = Closed::new();
        let said = succeeds(store.folder.path(), &store.arguments(&[]));
        assert_eq!(said, "3 references read\nall checksums hold\n");
    }

    #[test]
    fn a_damaged_record_is_named_and_fails_the_command() {
        let store = Closed::new();
        store.damage();
        let (said, error) = fails(store.folder.path(), &store.arguments(&[]));
        let damaged = format!("damaged: {}: ", store.references[1]);
        let named: Vec<&str> = said
            .lines()
            .filter(|line| line.starts_with("damaged: "))
            .collect();
        assert_eq!(named.len(), 1, "{said}");
        assert!(named[0].starts_with(&damaged), "{said}");
        assert!(error.contains("1 faults found"), "{error}");
        assert!(!said.contains("all checksums hold"), "{said}");
    }

    #[test]
    fn the_json_report_names_the_damaged_record() {
        let store = Closed::new();
        store.damage();
        let (said, _) = fails(store.folder.path(), &store.arguments(&["--json"]));
        let report: Value = serde_json::from_str(&said).unwrap();
        assert_eq!(report["references"], 3);
        assert_eq!(report["engine_errors"].as_array().unwrap().len(), 0);
        let damaged = report["damaged"].as_array().unwrap();
        assert_eq!(damaged.len(), 1, "{said}");
        assert_eq!(damaged[0]["reference"], store.references[1].to_string());
        assert_ne!(damaged[0]["reason"].as_str().unwrap(), "");
    }

    /// What a killed process leaves of a store, without its log.
    fn without_its_log() -> Closed {
        let mut store = Closed::new();
        let killed = tempfile::tempdir().unwrap();
        let data = killed.path().join("data");
        std::fs::create_dir(&data).unwrap();
        let settings = store.folder.path().join("placeformer.toml");
        std::fs::copy(settings, killed.path().join("placeformer.toml")).unwrap();
        let config = StoreConfig {
            reserve_bytes: 16 << 20,
            ..StoreConfig::default()
        };
        let open = SqliteStore::open(&store.folder.path().join("data"), &config).unwrap();
        for seed in 10..12 {
            let new = named_reference(&map("city"), &format!("photo {seed}"), seed);
            open.insert(new).unwrap();
        }
        for name in [SqliteStore::DATABASE, "commit-mark"] {
            let from = store.folder.path().join("data").join(name);
            std::fs::copy(from, data.join(name)).unwrap();
        }
        drop(open);
        store.folder = killed;
        store
    }

    #[test]
    fn acknowledged_references_that_vanished_with_the_log_are_told_and_can_be_given_up() {
        let store = without_its_log();
        for _ in 0..2 {
            let (said, error) = fails(store.folder.path(), &store.arguments(&[]));
            assert_eq!(said, "");
            assert!(
                error.contains("2 of 5 acknowledged commits are missing"),
                "{error}"
            );
            assert!(error.contains("new references among them: 2"), "{error}");
        }
        // Neither is it served, nor copied as if it were whole.
        let (_, error) = fails(
            store.folder.path(),
            &["backup", "--data", "data", "--out", "copy"],
        );
        assert!(
            error.contains("acknowledged commits are missing"),
            "{error}"
        );
        let given_up = store.arguments(&["--accept-lost-tail"]);
        let said = succeeds(store.folder.path(), &given_up);
        assert_eq!(said, "3 references read\nall checksums hold\n");
        let said = succeeds(store.folder.path(), &store.arguments(&[]));
        assert_eq!(said, "3 references read\nall checksums hold\n");
    }

    #[test]
    fn a_folder_without_a_store_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let (_, error) = fails(folder.path(), &["verify", "--data", "nowhere"]);
        assert!(error.contains("there is no store in nowhere"), "{error}");
        let (_, error) = fails(folder.path(), &["verify"]);
        assert!(error.contains("--data"), "{error}");
    }

    #[test]
    fn a_store_that_a_server_has_open_is_refused() {
        let store = Closed::new();
        let data = store.folder.path().join("data");
        let config = StoreConfig {
            reserve_bytes: 1 << 20,
            ..StoreConfig::default()
        };
        let _open = SqliteStore::open(&data, &config).unwrap();
        let (said, error) = fails(store.folder.path(), &store.arguments(&[]));
        assert_eq!(said, "");
        assert!(error.contains("cannot open the store"), "{error}");
    }
}

mod load {
    use super::*;

    /// The real surface with made-up descriptors behind a socket, and a folder of photos.
    struct Served {
        /// Serves as long as it lives.
        runtime: Runtime,
        app: App,
        url: String,
        folder: TempDir,
    }

    impl Served {
        fn new() -> Self {
            let runtime = Runtime::new().unwrap();
            let app = App::new();
            let url = app.listen(&runtime);
            let added = runtime.block_on(app.post_png("/references?map=m", 0));
            added.created();
            Self {
                runtime,
                app,
                url,
                folder: photos(),
            }
        }

        fn arguments<'a>(&'a self, more: &[&'a str]) -> Vec<&'a str> {
            let fixed = ["load", "--server", &self.url, "--map", "m"];
            [&fixed, &["--images", "photos"][..], more].concat()
        }

        fn report(&self) -> Value {
            let text = std::fs::read(self.folder.path().join("report.json")).unwrap();
            serde_json::from_slice(&text).unwrap()
        }

        /// Queries that the server has answered with success.
        fn answered(&self) -> f64 {
            let series = "placeformer_http_requests_total\
                          {method=\"POST\",route=\"/query\",status=\"200\"}";
            self.runtime.block_on(self.app.metric(series))
        }
    }

    /// A folder with two photos in the folder `photos`.
    fn photos() -> TempDir {
        let folder = tempfile::tempdir().unwrap();
        let photos = folder.path().join("photos");
        std::fs::create_dir(&photos).unwrap();
        for seed in 0..2 {
            let name = format!("{seed}.png");
            std::fs::write(photos.join(name), picture(seed)).unwrap();
        }
        folder
    }

    #[test]
    fn the_report_has_the_numbers_asked_for() {
        let served = Served::new();
        let arguments = ["--rate", "20", "--duration", "1.5", "--json", "report.json"];
        let said = succeeds(served.folder.path(), &served.arguments(&arguments));
        let report = served.report();
        assert_eq!(report["rate"], 20.0);
        assert_eq!(report["duration"], 1.5);
        assert_eq!(report["capacity"], Value::Null);
        assert_eq!(report["admitted"], 30);
        for none in [
            "rejected",
            "rejected_without_retry_after",
            "failed",
            "not_sent",
        ] {
            assert_eq!(report[none], 0, "{none}");
        }
        assert_eq!(served.answered(), 30.0);
        let latency = &report["admitted_ms"];
        let at = |point: &str| latency[point].as_f64().unwrap();
        assert!(at("p50") > 0.0, "{latency}");
        assert!(
            at("p50") <= at("p99") && at("p99") <= at("max"),
            "{latency}"
        );
        assert!(said.contains("offered    20.00 queries/s"), "{said}");
        assert!(said.contains("admitted   30 (20.00/s)"), "{said}");
    }

    #[test]
    fn a_multiple_of_the_capacity_is_offered() {
        let served = Served::new();
        let arguments = [
            &["--times-capacity", "0.5", "--capacity-seconds", "0.5"],
            &["--capacity-clients", "2", "--duration", "0.5"][..],
            &["--json", "report.json"],
        ]
        .concat();
        succeeds(served.folder.path(), &served.arguments(&arguments));
        let report = served.report();
        let capacity = report["capacity"].as_f64().unwrap();
        let rate = report["rate"].as_f64().unwrap();
        assert!(capacity > 0.0);
        assert!((rate / capacity - 0.5).abs() < 1e-9, "{rate} of {capacity}");
    }

    #[test]
    fn a_broken_bound_fails_the_command_after_the_report() {
        let served = Served::new();
        let arguments = [
            "--rate",
            "10",
            "--duration",
            "0.5",
            "--min-admitted-rate",
            "1e6",
        ];
        let (said, error) = fails(served.folder.path(), &served.arguments(&arguments));
        assert!(said.contains("admitted   5 "), "{said}");
        assert!(error.contains("fewer than 1000000"), "{error}");
    }

    #[test]
    fn queries_that_the_server_cannot_answer_fail_the_command() {
        let served = Served::new();
        let arguments = [
            &["load", "--server", &served.url, "--map", "unknown"],
            &["--images", "photos", "--rate", "10", "--duration", "0.5"][..],
        ]
        .concat();
        let (said, error) = fails(served.folder.path(), &arguments);
        assert!(said.contains("failed     5"), "{said}");
        assert!(said.contains("map_not_found"), "{said}");
        assert!(error.contains("5 requests failed"), "{error}");
    }

    /// A server that is ready and turns every query away, with these headers besides.
    fn refusing_server(headers: &'static str) -> String {
        let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        let url = format!("http://{}", listener.local_addr().unwrap());
        std::thread::spawn(move || {
            for stream in listener.incoming().flatten() {
                // The client may hang up at any moment, which is no failure of the test.
                let _ = refuse(stream, headers);
            }
        });
        url
    }

    fn refuse(mut stream: TcpStream, headers: &str) -> std::io::Result<()> {
        let mut reader = BufReader::new(stream.try_clone()?);
        let mut head = String::new();
        while !head.ends_with("\r\n\r\n") && reader.read_line(&mut head)? > 0 {}
        let head = head.to_ascii_lowercase();
        let length = head
            .lines()
            .find_map(|line| line.strip_prefix("content-length:")?.trim().parse().ok())
            .unwrap_or(0);
        reader.take(length).read_to_end(&mut Vec::new())?;
        let status = if head.starts_with("post") {
            "503 Service Unavailable"
        } else {
            "200 OK"
        };
        write!(
            stream,
            "HTTP/1.1 {status}\r\n{headers}content-length: 0\r\nconnection: close\r\n\r\n"
        )
    }

    #[test]
    fn a_rejection_must_say_when_to_come_back() {
        let folder = photos();
        let run = |url: &str| {
            let arguments = [
                &["load", "--server", url, "--map", "m", "--images", "photos"],
                &["--rate", "10", "--duration", "0.5"][..],
            ]
            .concat();
            placeformer(folder.path(), &arguments)
        };
        let polite = run(&refusing_server("retry-after: 1\r\n"));
        let said = String::from_utf8(polite.stdout).unwrap();
        assert!(polite.status.success(), "{said}");
        assert!(
            said.contains("rejected   5 (0 without Retry-After)"),
            "{said}"
        );
        let silent = run(&refusing_server(""));
        let error = String::from_utf8(silent.stderr).unwrap();
        assert!(!silent.status.success());
        assert!(
            error.contains("5 rejections carried no Retry-After"),
            "{error}"
        );
    }

    #[test]
    fn wrong_arguments_name_the_cause() {
        let folder = photos();
        let error = |more: &[&str]| {
            let fixed = ["load", "--map", "m", "--images", "photos"];
            fails(folder.path(), &[&fixed, more].concat()).1
        };
        let nowhere = ["--server", "http://127.0.0.1:9"];
        let with = |more: &[&'static str]| error(&[&nowhere, more].concat());
        assert!(error(&["--rate", "1"]).contains("--server"));
        assert!(with(&[]).contains("--rate"));
        assert!(with(&["--rate", "1", "--times-capacity", "2"]).contains("--times-capacity"));
        assert!(with(&["--rate", "1", "--duration", "0"]).contains("--duration must be"));
        assert!(with(&["--rate", "1"]).contains("cannot reach the server at http://127.0.0.1:9"));
        let error = error(&["--server", "localhost", "--rate", "1"]);
        assert!(error.contains("\"localhost\" is not an address"), "{error}");
    }

    #[test]
    fn a_rate_must_be_positive_and_photos_must_be_there() {
        let served = Served::new();
        let (_, error) = fails(served.folder.path(), &served.arguments(&["--rate", "0"]));
        assert!(
            error.contains("the rate must be positive, not 0"),
            "{error}"
        );
        let empty: PathBuf = served.folder.path().join("empty");
        std::fs::create_dir(&empty).unwrap();
        let arguments = [
            &["load", "--server", &served.url, "--map", "m"],
            &["--images", "empty", "--rate", "1"][..],
        ]
        .concat();
        let (_, error) = fails(served.folder.path(), &arguments);
        assert!(error.contains("empty holds no JPEG"), "{error}");
    }
}

mod bench {
    use super::*;
    use crate::common::weights::made_up;
    use placeformer_vision::extract::Preset;

    /// The row that runs no transformer, so that the weights' values do not matter.
    const ROW: &str = "decode_resize_1080p";

    /// Saves weights of the paper's geometry in `folder`.
    fn save_weights(folder: &Path) {
        let preset = Preset::PlaceformerVits16;
        let weights = made_up(preset, preset.geometry(), (14, 14), 7);
        weights.save(&folder.join("weights.safetensors")).unwrap();
    }

    fn arguments<'a>(row: &'a str, more: &[&'a str]) -> Vec<&'a str> {
        let fixed = ["bench", "--only", row, "--rounds", "1"];
        let model = ["--preset", "placeformer-vits16", "--head", "none"];
        let weights = ["--weights", "weights.safetensors"];
        [&fixed, &model[..], &weights, more].concat()
    }

    #[test]
    fn a_named_row_is_measured_and_reported() {
        let folder = tempfile::tempdir().unwrap();
        save_weights(folder.path());
        let said = succeeds(folder.path(), &arguments(ROW, &["--json", "report.json"]));
        let text = std::fs::read(folder.path().join("report.json")).unwrap();
        let report: Value = serde_json::from_slice(&text).unwrap();
        let rows = report["rows"].as_array().unwrap();
        assert_eq!(rows.len(), 1, "{report}");
        let row = &rows[0];
        assert_eq!(row["name"], ROW);
        let figure = |name: &str| row[name].as_f64().unwrap();
        assert!(
            figure("ours_ms") > 0.0 && figure("baseline_ms") > 0.0,
            "{row}"
        );
        let ratio = figure("baseline_ms") / figure("ours_ms");
        assert!((figure("ratio") - ratio).abs() < 1e-9 * ratio, "{row}");
        assert_eq!(report["version"], env!("CARGO_PKG_VERSION"));
        assert!(said.contains(ROW), "{said}");
    }

    #[test]
    fn an_unknown_row_is_named_with_those_there_are() {
        let folder = tempfile::tempdir().unwrap();
        save_weights(folder.path());
        let (_, error) = fails(folder.path(), &arguments("decode", &[]));
        assert!(error.contains("there is no row \"decode\""), "{error}");
        assert!(error.contains(ROW), "{error}");
        let (_, error) = fails(folder.path(), &["bench", "--rounds", "0"]);
        assert!(error.contains("--rounds"), "{error}");
    }
}
