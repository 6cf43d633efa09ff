//! A server process that a command starts for itself, such as the demo's.

use super::client::{ServerArgs, ServerClient, TrustArgs};
use anyhow::{Context, bail, ensure};
use std::ffi::OsString;
use std::fs::File;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// Longest wait for readiness: loading a model takes seconds, building the index of millions a
/// minute.
const START_LIMIT: Duration = Duration::from_secs(300);
/// Longest wait for a server that was asked to stop, which answers what it has begun.
const STOP_LIMIT: Duration = Duration::from_secs(30);

/// A running server; killed when dropped.
pub(super) struct ChildServer {
    child: Child,
    url: String,
    log: PathBuf,
}

impl ChildServer {
    /// Runs this program with arguments that make it serve on a free loopback port, and waits until
    /// it is ready. What it says goes to `log`.
    pub(super) fn start(
        arguments: impl IntoIterator<Item = OsString>,
        log: PathBuf,
    ) -> anyhow::Result<Self> {
        let mut child = spawn(arguments, &log)?;
        let mut first_line = String::new();
        if let Some(stdout) = child.stdout.take() {
            BufReader::new(stdout).read_line(&mut first_line)?;
        }
        let url = first_line.trim().strip_prefix("listening on ");
        // From here on the process is ended when something fails.
        let server = Self {
            child,
            url: url.unwrap_or_default().to_owned(),
            log,
        };
        ensure!(
            !server.url.is_empty(),
            "the server did not start; see {}",
            server.log.display()
        );
        server.wait_until_ready()
    }

    /// Its address.
    pub(super) fn url(&self) -> &str {
        &self.url
    }

    fn wait_until_ready(mut self) -> anyhow::Result<Self> {
        let started = Instant::now();
        let client = ServerClient::new(ServerArgs {
            server: self.url.clone(),
            api_key: None,
            trust: TrustArgs::default(),
            timeout: 10,
        })?;
        while started.elapsed() < START_LIMIT {
            if let Some(status) = self.child.try_wait()? {
                bail!("the server ended with {status}; see {}", self.log.display());
            }
            if client
                .probe("/readyz")
                .is_ok_and(|(status, _)| status == 200)
            {
                return Ok(self);
            }
            std::thread::sleep(Duration::from_millis(50));
        }
        bail!(
            "the server was not ready within {} s; see {}",
            START_LIMIT.as_secs(),
            self.log.display()
        )
    }

    /// Asks it to stop, as a supervisor would, and waits until it has ended.
    pub(super) fn stop(mut self) -> anyhow::Result<()> {
        let asked = Command::new("kill")
            .args(["-TERM", &self.child.id().to_string()])
            .status();
        ensure!(
            asked.is_ok_and(|status| status.success()),
            "the server could not be asked to stop"
        );
        let started = Instant::now();
        while started.elapsed() < STOP_LIMIT {
            if let Some(status) = self.child.try_wait()? {
                ensure!(
                    status.success(),
                    "the server stopped with {status}; see {}",
                    self.log.display()
                );
                return Ok(());
            }
            std::thread::sleep(Duration::from_millis(20));
        }
        bail!("the server did not stop within {} s", STOP_LIMIT.as_secs())
    }
}

/// Starts this program with its standard output piped and its standard error in `log`.
fn spawn(arguments: impl IntoIterator<Item = OsString>, log: &Path) -> anyhow::Result<Child> {
    let log_file = File::create(log).with_context(|| format!("cannot write {}", log.display()))?;
    let program = std::env::current_exe().context("cannot find this program's own file")?;
    Command::new(program)
        .args(arguments)
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(log_file)
        .spawn()
        .context("cannot start the server")
}

impl Drop for ChildServer {
    fn drop(&mut self) {
        // Mostly it has stopped already. Then there is nothing to kill, and the error says only
        // that.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
