//! The compiled program, run as a user would run it, mostly on a small drawn town.

use placeformer_models::model_path;
use placeformer_vision::extract::Preset;
use serde_json::Value;
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

/// Small images: these tests follow the way from flags to files, and do not measure recall.
pub const SIZE: &str = "84x84";
/// The same, as a setting.
pub const SERVED_SIZE: &str = "{width=84,height=84}";

/// Whether the model's weights are there. They must be, unless `PLACEFORMER_TEST_NO_MODEL=1` says
/// that this run does without the tests that need them.
pub fn has_model() -> bool {
    let path = model_path(Preset::Dinov2Vits14).unwrap();
    let may_be_missing = std::env::var("PLACEFORMER_TEST_NO_MODEL").is_ok_and(|value| value == "1");
    if !path.exists() && may_be_missing {
        println!(
            "skipped: no model at {} and PLACEFORMER_TEST_NO_MODEL=1",
            path.display()
        );
        return false;
    }
    assert!(
        path.exists(),
        "no model at {}: run `placeformer model pull dinov2-vits14` first",
        path.display()
    );
    true
}

/// A command line's arguments, none of which contains a space.
pub fn words(command_line: &str) -> Vec<&str> {
    command_line.split_whitespace().collect()
}

/// The program in `folder`, without the settings that the environment of the tests may hold.
pub fn command(folder: &Path, arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_placeformer"));
    command
        .args(arguments)
        .current_dir(folder)
        .env_remove("PLACEFORMER_WEIGHTS")
        .env_remove("PLACEFORMER_CONFIG")
        .env("PLACEFORMER_EXTRACT__INPUT_SIZE", SERVED_SIZE);
    command
}

/// The program in `folder` where no model can be had: the cache is empty, the hub cannot be
/// reached, and pip is not found. Whatever gets as far as loading the model fails for that reason.
pub fn offline(folder: &Path, arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_placeformer"));
    for (name, _) in std::env::vars_os() {
        if name.to_string_lossy().starts_with("PLACEFORMER_") {
            command.env_remove(name);
        }
    }
    command
        .args(arguments)
        .current_dir(folder)
        .env("PLACEFORMER_CACHE", folder.join("cache"))
        .env("HF_ENDPOINT", "http://127.0.0.1:9")
        .env("PATH", "");
    command
}

/// Runs [`command`] to its end.
pub fn placeformer(folder: &Path, arguments: &[&str]) -> Output {
    command(folder, arguments)
        .output()
        .expect("the binary was built")
}

/// What it prints when it succeeds: to the user, and about its progress.
#[track_caller]
pub fn prints(folder: &Path, arguments: &[&str]) -> (String, String) {
    let output = placeformer(folder, arguments);
    let error = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.success(), "{arguments:?}: {error}");
    (String::from_utf8(output.stdout).unwrap(), error)
}

/// What it prints to the user when it succeeds.
#[track_caller]
pub fn succeeds(folder: &Path, arguments: &[&str]) -> String {
    prints(folder, arguments).0
}

/// Runs [`command`], which must fail; returns what it says about that.
#[track_caller]
pub fn refusal(folder: &Path, arguments: &[&str]) -> String {
    refused_by(&mut command(folder, arguments))
}

/// Runs `command`, which must fail; returns what it says about that.
#[track_caller]
pub fn refused_by(command: &mut Command) -> String {
    let output = command.output().expect("the binary was built");
    assert!(!output.status.success(), "{command:?} succeeded");
    String::from_utf8(output.stderr).unwrap()
}

/// A drawn street of `places` places, each with `views` references and a query, and queries from
/// elsewhere, in the folder `town`.
pub fn town(places: &str, views: &str) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    succeeds(
        folder.path(),
        &[
            "synth", "--out", "town", "--places", places, "--views", views, "--size", "96x72",
        ],
    );
    folder
}

/// A `serve` command that runs in a process of its own; killed when dropped.
pub struct Server {
    child: Child,
    /// Where it listens.
    pub url: String,
    http: reqwest::blocking::Client,
}

impl Server {
    /// Starts `command` and waits until it is ready.
    #[track_caller]
    pub fn start(mut command: Command) -> Self {
        let mut child = command
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
        let url =
            lines.find_map(|line| Some(line.unwrap().strip_prefix("listening on ")?.to_owned()));
        // This fails only if a provider is installed already, which is as good.
        let _ = rustls::crypto::ring::default_provider().install_default();
        let http = reqwest::blocking::Client::builder()
            .timeout(Duration::from_secs(60))
            .build()
            .unwrap();
        let server = Self {
            child,
            url: url.expect("the server did not start"),
            http,
        };
        server.wait_until_ready();
        server
    }

    #[track_caller]
    fn wait_until_ready(&self) {
        let readyz = format!("{}/readyz?for=query", self.url);
        let began = Instant::now();
        loop {
            let answer = self.http.get(&readyz).send();
            if answer.expect("the server died").status() == 200 {
                return;
            }
            assert!(
                began.elapsed() < Duration::from_secs(120),
                "the server never became ready"
            );
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// The JSON of an answer.
    pub fn get(&self, path: &str) -> Value {
        let url = format!("{}{path}", self.url);
        self.http.get(url).send().unwrap().json().unwrap()
    }

    /// Sends a PNG; returns the answer's status and JSON.
    pub fn post(&self, path: &str, body: Vec<u8>) -> (u16, Value) {
        let answer = self
            .http
            .post(format!("{}{path}", self.url))
            .header("content-type", "image/png")
            .body(body)
            .send()
            .unwrap();
        (answer.status().as_u16(), answer.json().unwrap())
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        // It may have died by itself, which the test has then reported.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
