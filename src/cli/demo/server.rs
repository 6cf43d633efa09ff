//! The demo's own server process.

use crate::cli::client::{ServerArgs, ServerClient};
use anyhow::{Context, bail, ensure};
use std::fs::File;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// Longest wait for readiness: building indexes of a demo takes moments, loading a model seconds.
const START_LIMIT: Duration = Duration::from_secs(120);
/// Longest wait for a drain.
const STOP_LIMIT: Duration = Duration::from_secs(30);

/// A running server on a free loopback port; killed if the demo fails.
pub(super) struct DemoServer {
    child: Child,
    url: String,
    log: PathBuf,
}

impl DemoServer {
    /// Starts `serve` on a store below `out` and waits until it is ready.
    pub(super) fn start(out: &Path) -> anyhow::Result<Self> {
        let log = out.join("server.log");
        let log_file = File::create(&log).with_context(|| format!("cannot write {}", log.display()))?;
        let program = std::env::current_exe().context("cannot find this program's own file")?;
        let data = out.join("data");
        println!("   $ placeformer serve --listen 127.0.0.1:0 --data {}", data.display());
        let mut child = Command::new(program)
            .args(["serve", "--listen", "127.0.0.1:0", "--data"])
            .arg(&data)
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(log_file)
            .spawn()
            .context("cannot start the server")?;
        let mut first_line = String::new();
        if let Some(stdout) = child.stdout.take() {
            BufReader::new(stdout).read_line(&mut first_line)?;
        }
        let url = first_line.trim().strip_prefix("listening on ").unwrap_or_default().to_owned();
        let server = Self { child, url, log };
        ensure!(!server.url.is_empty(), "the server did not start; see {}", server.log.display());
        server.wait_until_ready()
    }

    /// Its address.
    pub(super) fn url(&self) -> &str {
        &self.url
    }

    fn wait_until_ready(mut self) -> anyhow::Result<Self> {
        let started = Instant::now();
        let client = ServerClient::new(ServerArgs { server: self.url.clone(), api_key: None, timeout: 10 })?;
        while started.elapsed() < START_LIMIT {
            if let Some(status) = self.child.try_wait()? {
                bail!("the server ended with {status}; see {}", self.log.display());
            }
            if client.probe("/readyz").is_ok_and(|(status, _)| status == 200) {
                return Ok(self);
            }
            std::thread::sleep(Duration::from_millis(50));
        }
        bail!("the server was not ready within {} s; see {}", START_LIMIT.as_secs(), self.log.display())
    }

    /// Asks it to stop, as a supervisor would, and waits for the drain.
    pub(super) fn stop(mut self) -> anyhow::Result<()> {
        let asked = Command::new("kill").args(["-TERM", &self.child.id().to_string()]).status();
        ensure!(asked.is_ok_and(|status| status.success()), "the server could not be asked to stop");
        let started = Instant::now();
        while started.elapsed() < STOP_LIMIT {
            if let Some(status) = self.child.try_wait()? {
                ensure!(status.success(), "the server stopped with {status}; see {}", self.log.display());
                return Ok(());
            }
            std::thread::sleep(Duration::from_millis(20));
        }
        bail!("the server did not stop within {} s", STOP_LIMIT.as_secs())
    }
}

impl Drop for DemoServer {
    fn drop(&mut self) {
        // Already stopped in the good case; then there is nothing to kill and the error says only that.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
