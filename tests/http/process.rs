//! The real server in a process of its own: this test binary, started again on one test that
//! serves.

use crate::support::{BACKBONE, FakeSource, head};
use placeformer::config::{Config, Overrides};
use placeformer::ops::{LogConfig, LogFormat, logging};
use placeformer::server::{Loaders, run_server};
use placeformer_store::{SqliteStore, StoreConfig, crash_points};
use placeformer_vision::extract::Aggregate;
use serde_json::Value;
use std::io::{BufRead, BufReader, Read, Write};
use std::os::unix::process::ExitStatusExt;
use std::path::Path;
use std::process::{Child, ChildStdout, Command, ExitStatus, Stdio};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

// Without crash points the server would outlive what is to kill it, and the tests would prove
// nothing.
const _: () = assert!(crash_points::ENABLED);

/// What a crash point raises.
const SIGABRT: i32 = 6;
const DIRECTORY: &str = "PLACEFORMER_TEST_SERVED";
/// Set: the server logs JSON.
const LOGGED: &str = "PLACEFORMER_TEST_LOGGED";
/// A configuration file, which the server follows.
const CONFIGURED: &str = "PLACEFORMER_TEST_CONFIGURED";

/// The model of the child, to open its store with.
pub fn source() -> Arc<FakeSource> {
    FakeSource::with_head(head(1, BACKBONE, Aggregate::Mean))
}

/// Settings of the store behind the server.
pub fn store_config() -> StoreConfig {
    StoreConfig {
        reserve_bytes: 1 << 20,
        ..StoreConfig::default()
    }
}

/// Not a test of its own: the server that others start.
#[test]
fn child_that_serves_until_it_is_killed() {
    let Some(directory) = std::env::var_os(DIRECTORY) else {
        return;
    };
    let _flush = std::env::var_os(LOGGED).map(|_| {
        let config = LogConfig {
            format: LogFormat::Json,
            ..LogConfig::default()
        };
        logging::init(&config).unwrap()
    });
    let mut config = match std::env::var_os(CONFIGURED) {
        Some(file) => Config::load(Some(Path::new(&file)), &Overrides::default()).unwrap(),
        None => Config::default(),
    };
    config.store = store_config();
    config.data.directory = directory.into();
    config.pipeline.disk_reserve_bytes = 0;
    let (data, store) = (config.data.directory.clone(), config.store.clone());
    let loaders = Loaders {
        source: Box::new(|| Ok(source())),
        store: Box::new(move || Ok(Arc::new(SqliteStore::open(&data, &store)?))),
    };
    tokio::runtime::Runtime::new().unwrap().block_on(async {
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        // Past the test harness, which captures what `println!` prints.
        let line = format!("\nlistening on http://{}\n", listener.local_addr().unwrap());
        std::io::stdout().write_all(line.as_bytes()).unwrap();
        run_server(listener, config, loaders, std::future::pending())
            .await
            .unwrap();
    });
}

/// The server in a process of its own.
pub struct Server {
    child: Mutex<Child>,
    /// Kept open: the harness in the child prints a line after a minute, and ends the process if
    /// nobody listens.
    _output: BufReader<ChildStdout>,
    url: String,
    http: reqwest::blocking::Client,
}

impl Server {
    /// Starts it on what is in `directory` and waits until it is ready.
    #[track_caller]
    pub fn start(directory: &Path, crash_point: Option<String>) -> Self {
        let Some(point) = crash_point else {
            return Self::start_with(directory, |_| {}).unwrap();
        };
        // Starting goes on with what an earlier death interrupted, so the point may be reached
        // before it is ready.
        Self::start_with(directory, |command| {
            command.env(crash_points::VARIABLE, point);
        })
        .unwrap_or_else(|died| {
            assert_eq!(
                died.signal(),
                Some(SIGABRT),
                "the server died of something else while it started: {died}"
            );
            Self::start_with(directory, |_| {}).unwrap()
        })
    }

    /// As [`Server::start`], with its log as JSON in the file `log`.
    #[track_caller]
    pub fn start_logged(directory: &Path, log: &Path) -> Self {
        let log = std::fs::File::create(log).unwrap();
        Self::start_with(directory, |command| {
            command.env(LOGGED, "1").stderr(log);
        })
        .unwrap()
    }

    /// As [`Server::start_logged`], with the settings of a file.
    #[track_caller]
    pub fn start_configured(directory: &Path, log: &Path, file: &Path) -> Self {
        let log = std::fs::File::create(log).unwrap();
        Self::start_with(directory, |command| {
            command.env(LOGGED, "1").env(CONFIGURED, file).stderr(log);
        })
        .unwrap()
    }

    /// A server that is ready, or how it died before it was.
    #[track_caller]
    fn start_with(directory: &Path, change: impl FnOnce(&mut Command)) -> Result<Self, ExitStatus> {
        let mut command = Command::new(std::env::current_exe().unwrap());
        command
            .args([
                "--exact",
                "process::child_that_serves_until_it_is_killed",
                "--nocapture",
            ])
            .env(DIRECTORY, directory)
            .stdout(Stdio::piped())
            .stderr(Stdio::null());
        change(&mut command);
        let mut child = command.spawn().unwrap();
        let mut output = BufReader::new(child.stdout.take().unwrap());
        let url = output
            .by_ref()
            .lines()
            .find_map(|line| Some(line.unwrap().strip_prefix("listening on ")?.to_owned()));
        // Fails only if one is installed already, which is as good.
        let _ = rustls::crypto::ring::default_provider().install_default();
        let http = reqwest::blocking::Client::builder()
            .timeout(Duration::from_secs(30))
            .build()
            .unwrap();
        let server = Self {
            child: Mutex::new(child),
            _output: output,
            url: url.expect("the server did not start"),
            http,
        };
        let began = Instant::now();
        while server
            .get("/readyz")
            .is_none_or(|(status, _)| status != 200)
        {
            if let Some(died) = server.child.lock().unwrap().try_wait().unwrap() {
                return Err(died);
            }
            assert!(
                began.elapsed() < Duration::from_secs(60),
                "the server never became ready"
            );
            std::thread::sleep(Duration::from_millis(2));
        }
        Ok(server)
    }

    /// Status and body; `None` if the server died over it.
    pub fn get(&self, path: &str) -> Option<(u16, Value)> {
        read(self.http.get(format!("{}{path}", self.url)).send())
    }

    /// The status of an answer to a caller with a key.
    pub fn get_with_key(&self, path: &str, key: &str) -> u16 {
        let request = self.http.get(format!("{}{path}", self.url));
        let answer = request.header("x-api-key", key).send().unwrap();
        answer.status().as_u16()
    }

    /// SIGHUP.
    pub fn hang_up(&self) {
        let pid = self.child.lock().unwrap().id().to_string();
        let sent = Command::new("kill").args(["-HUP", &pid]).status().unwrap();
        assert!(sent.success());
    }

    /// An answer that is not JSON.
    pub fn text(&self, path: &str) -> String {
        self.http
            .get(format!("{}{path}", self.url))
            .send()
            .unwrap()
            .text()
            .unwrap()
    }

    /// As [`Server::get`], with a picture.
    pub fn post(&self, path: &str, body: Vec<u8>) -> Option<(u16, Value)> {
        let url = format!("{}{path}", self.url);
        read(
            self.http
                .post(url)
                .header("content-type", "image/png")
                .body(body)
                .send(),
        )
    }

    /// As [`Server::get`], with a file.
    pub fn put(&self, path: &str, body: Vec<u8>) -> Option<(u16, Value)> {
        let url = format!("{}{path}", self.url);
        read(
            self.http
                .put(url)
                .header("content-type", "application/octet-stream")
                .body(body)
                .send(),
        )
    }

    /// As [`Server::post`], under the request id `id`.
    pub fn post_as(&self, id: &str, path: &str, body: Vec<u8>) -> Option<(u16, Value)> {
        let request = self
            .http
            .post(format!("{}{path}", self.url))
            .header("x-request-id", id);
        read(
            request
                .header("content-type", "image/png")
                .body(body)
                .send(),
        )
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

/// A server that no test killed would outlive the tests, and keep open whatever they were given.
impl Drop for Server {
    fn drop(&mut self) {
        let child = self.child.get_mut();
        let child = child.unwrap_or_else(PoisonError::into_inner);
        // It may have died by itself, which the test has then reported.
        let _ = child.kill();
        let _ = child.wait();
    }
}

fn read(response: reqwest::Result<reqwest::blocking::Response>) -> Option<(u16, Value)> {
    let response = response.ok()?;
    let status = response.status().as_u16();
    // An answer cut short is no acknowledgement.
    let text = response.text().ok()?;
    Some((status, serde_json::from_str(&text).unwrap_or_default()))
}
