//! The real server in a process of its own: this test binary, started again on one test that serves.

use crate::support::{BACKBONE, FakeSource, head};
use placeformer::cli::serve::{Loaders, run_server};
use placeformer::config::Config;
use placeformer::extract::Aggregate;
use placeformer::store::{SqliteStore, StoreConfig, crash_points};
use serde_json::Value;
use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

const DIRECTORY: &str = "PLACEFORMER_TEST_SERVED";

/// Settings of the store behind the server.
pub fn store_config() -> StoreConfig {
    StoreConfig { reserve_bytes: 1 << 20, ..StoreConfig::default() }
}

/// Not a test of its own: the server that others start.
#[test]
fn child_that_serves_until_it_is_killed() {
    let Some(directory) = std::env::var_os(DIRECTORY) else { return };
    let mut config = Config { store: store_config(), ..Config::default() };
    config.data.directory = directory.into();
    config.pipeline.disk_reserve_bytes = 0;
    let (data, store) = (config.data.directory.clone(), config.store.clone());
    let loaders = Loaders {
        source: Box::new(|| Ok(FakeSource::with_head(head(1, BACKBONE, Aggregate::Mean)))),
        store: Box::new(move || Ok(Arc::new(SqliteStore::open(&data, &store)?))),
    };
    tokio::runtime::Runtime::new().unwrap().block_on(async {
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        // Past the test harness, which captures what `println!` prints.
        let line = format!("\nlistening on http://{}\n", listener.local_addr().unwrap());
        std::io::stdout().write_all(line.as_bytes()).unwrap();
        run_server(listener, config, loaders, std::future::pending()).await.unwrap();
    });
}

/// The server in a process of its own.
pub struct Server {
    child: Mutex<Child>,
    url: String,
    http: reqwest::blocking::Client,
}

impl Server {
    /// Starts it on what is in `directory` and waits until it is ready.
    #[track_caller]
    pub fn start(directory: &Path, crash_point: Option<String>) -> Self {
        let mut command = Command::new(std::env::current_exe().unwrap());
        command
            .args(["--exact", "process::child_that_serves_until_it_is_killed", "--nocapture"])
            .env(DIRECTORY, directory)
            .stdout(Stdio::piped())
            .stderr(Stdio::null());
        if let Some(point) = crash_point {
            command.env(crash_points::VARIABLE, point);
        }
        let mut child = command.spawn().unwrap();
        let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
        let url = lines.find_map(|line| Some(line.unwrap().strip_prefix("listening on ")?.to_owned()));
        // Fails only if one is installed already, which is as good.
        let _ = rustls::crypto::ring::default_provider().install_default();
        let http = reqwest::blocking::Client::builder().timeout(Duration::from_secs(30)).build().unwrap();
        let server = Self { child: Mutex::new(child), url: url.expect("the server did not start"), http };
        let began = Instant::now();
        while server.get("/readyz").is_none_or(|(status, _)| status != 200) {
            assert!(began.elapsed() < Duration::from_secs(60), "the server never became ready");
            std::thread::sleep(Duration::from_millis(2));
        }
        server
    }

    /// Status and body; `None` if the server died over it.
    pub fn get(&self, path: &str) -> Option<(u16, Value)> {
        read(self.http.get(format!("{}{path}", self.url)).send())
    }

    /// As [`Server::get`], with a picture.
    pub fn post(&self, path: &str, body: Vec<u8>) -> Option<(u16, Value)> {
        let url = format!("{}{path}", self.url);
        read(self.http.post(url).header("content-type", "image/png").body(body).send())
    }

    /// As [`Server::get`], with a file.
    pub fn put(&self, path: &str, body: Vec<u8>) -> Option<(u16, Value)> {
        let url = format!("{}{path}", self.url);
        read(self.http.put(url).header("content-type", "application/octet-stream").body(body).send())
    }

    /// As [`Server::get`].
    pub fn delete(&self, path: &str) -> Option<(u16, Value)> {
        read(self.http.delete(format!("{}{path}", self.url)).send())
    }

    /// SIGKILL; a server that died at its crash point is gone already.
    pub fn kill(&self) {
        let mut child = self.child.lock().unwrap();
        child.kill().unwrap();
        child.wait().unwrap();
    }
}

fn read(response: reqwest::Result<reqwest::blocking::Response>) -> Option<(u16, Value)> {
    let response = response.ok()?;
    let status = response.status().as_u16();
    // An answer cut short is no acknowledgement.
    let text = response.text().ok()?;
    Some((status, serde_json::from_str(&text).unwrap_or_default()))
}
