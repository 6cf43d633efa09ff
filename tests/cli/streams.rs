//! Standard output and standard error that take nothing: full, closed, or a pipe that nobody
//! reads. A server serves and stops as always, and counts the log lines that it lost; a command
//! ends with a sensible status and without a panic.

use crate::common::program::{command, has_model, offline};
use std::fs::{File, OpenOptions};
use std::io::{Read, Write};
use std::net::TcpListener;
use std::path::Path;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

const PATIENCE: Duration = Duration::from_secs(120);

/// What an ended process that caught a closed pipe reports, as a shell would for SIGPIPE.
const PIPE_CLOSED: i32 = 141;

fn full_disk() -> File {
    OpenOptions::new().write(true).open("/dev/full").unwrap()
}

/// A pipe that is full and that nobody reads; the reader keeps it open.
fn full_pipe() -> (std::io::PipeReader, std::io::PipeWriter) {
    let (reader, mut writer) = std::io::pipe().unwrap();
    // What a pipe holds on Linux unless it is told otherwise.
    writer.write_all(&[b'x'; 1 << 16]).unwrap();
    (reader, writer)
}

/// A pipe whose reader has gone.
fn closed_pipe() -> std::io::PipeWriter {
    let (reader, writer) = std::io::pipe().unwrap();
    drop(reader);
    writer
}

/// A server whose address is known beforehand, for it may be unable to say it.
struct Serving {
    child: Child,
    url: String,
    http: reqwest::blocking::Client,
    _folder: tempfile::TempDir,
}

impl Serving {
    /// Starts `serve` with streams as `change` has them, and waits until it is ready.
    #[track_caller]
    fn start(shell: Option<&str>, change: impl FnOnce(&mut Command)) -> Self {
        let folder = tempfile::tempdir().unwrap();
        // The port is free now, and hardly anybody else asks for it within a moment.
        let free = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = free.local_addr().unwrap().to_string();
        drop(free);
        let arguments = ["serve", "--data", "data", "--listen", &address];
        let mut serve = command(folder.path(), &arguments);
        if let Some(redirections) = shell {
            let mut within = Command::new("sh");
            within
                .args(["-c", &format!("exec \"$0\" \"$@\" {redirections}")])
                .arg(serve.get_program())
                .args(serve.get_args())
                .current_dir(folder.path());
            for (name, value) in serve.get_envs() {
                match value {
                    Some(value) => within.env(name, value),
                    None => within.env_remove(name),
                };
            }
            serve = within;
        }
        serve.stdin(Stdio::null());
        change(&mut serve);
        let child = serve.spawn().unwrap();
        // This fails only if a provider is installed already, which is as good.
        let _ = rustls::crypto::ring::default_provider().install_default();
        let http = reqwest::blocking::Client::builder()
            .timeout(PATIENCE)
            .build();
        let mut server = Self {
            child,
            url: format!("http://{address}"),
            http: http.unwrap(),
            _folder: folder,
        };
        server.wait_until_ready();
        server
    }

    #[track_caller]
    fn wait_until_ready(&mut self) {
        let began = Instant::now();
        while self.status("/readyz") != Some(200) {
            assert_eq!(self.child.try_wait().unwrap(), None, "the server died");
            assert!(began.elapsed() < PATIENCE, "the server never became ready");
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    fn status(&self, path: &str) -> Option<u16> {
        let answer = self.http.get(format!("{}{path}", self.url)).send();
        answer.ok().map(|answer| answer.status().as_u16())
    }

    /// Each is answered, and is a line of the log.
    #[track_caller]
    fn answers(&self, requests: usize) {
        for number in 0..requests {
            assert_eq!(self.status("/nowhere"), Some(404), "request {number}");
        }
        assert_eq!(self.status("/livez"), Some(200));
    }

    /// Waits until so many lost lines are counted.
    #[track_caller]
    fn counts_lost_lines(&self, least: u64) {
        let began = Instant::now();
        loop {
            let metrics = self.http.get(format!("{}/metrics", self.url)).send();
            let metrics = metrics.unwrap().text().unwrap();
            let line = metrics
                .lines()
                .find_map(|line| line.strip_prefix("placeformer_log_lines_dropped_total "));
            let lost: f64 = line.unwrap().parse().unwrap();
            if lost >= least as f64 {
                return;
            }
            assert!(began.elapsed() < PATIENCE, "only {lost} lines are counted");
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// Asks it to stop, and waits until it has.
    #[track_caller]
    fn stops(mut self) {
        let asked = Command::new("kill")
            .args(["-TERM", &self.child.id().to_string()])
            .status();
        assert!(asked.unwrap().success());
        let status = ended(&mut self.child);
        assert!(status.success(), "{status}");
    }
}

impl Drop for Serving {
    fn drop(&mut self) {
        // It may have ended already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[track_caller]
fn ended(child: &mut Child) -> ExitStatus {
    let began = Instant::now();
    loop {
        if let Some(status) = child.try_wait().unwrap() {
            return status;
        }
        assert!(began.elapsed() < PATIENCE, "the process does not end");
        std::thread::sleep(Duration::from_millis(20));
    }
}

#[test]
fn a_server_whose_log_is_a_full_disk_serves_and_counts() {
    if !has_model() {
        return;
    }
    let server = Serving::start(None, |serve| {
        serve.stdout(Stdio::null()).stderr(full_disk());
    });
    server.answers(300);
    server.counts_lost_lines(300);
    server.stops();
}

#[test]
fn a_server_whose_log_has_lost_its_reader_serves_and_counts() {
    if !has_model() {
        return;
    }
    let server = Serving::start(None, |serve| {
        serve.stdout(closed_pipe()).stderr(closed_pipe());
    });
    server.answers(300);
    server.counts_lost_lines(300);
    server.stops();
}

#[test]
fn a_server_whose_log_nobody_reads_serves_counts_and_stops() {
    if !has_model() {
        return;
    }
    let mut server = Serving::start(None, |serve| {
        serve.stdout(Stdio::null()).stderr(Stdio::piped());
    });
    // Held open and not read: what the pipe and the queue hold, and some more.
    let mut unread = server.child.stderr.take().unwrap();
    server.answers(4000);
    server.counts_lost_lines(100);
    server.stops();
    let mut kept = String::new();
    unread.read_to_string(&mut kept).unwrap();
    // A pipe holds 64 KiB, less what the next line did not fit into.
    assert!(
        kept.len() >= 50_000,
        "only {} bytes were logged",
        kept.len()
    );
}

#[test]
fn a_server_whose_log_is_read_late_loses_nothing() {
    if !has_model() {
        return;
    }
    let mut server = Serving::start(None, |serve| {
        serve
            .env("PLACEFORMER_LOG__FORMAT", "json")
            .stdout(Stdio::null())
            .stderr(Stdio::piped());
    });
    let mut log = server.child.stderr.take().unwrap();
    server.answers(600);
    let reading = std::thread::spawn(move || {
        let mut text = String::new();
        log.read_to_string(&mut text).unwrap();
        text
    });
    server.stops();
    let text = reading.join().unwrap();
    let answered = |line: &&str| line.contains("\"answered\"") && line.contains("404");
    assert_eq!(text.lines().filter(answered).count(), 600);
    assert!(text.lines().last().unwrap().contains("stop") || text.contains("stopping"));
    for line in text.lines() {
        serde_json::from_str::<serde_json::Value>(line).unwrap();
    }
}

#[test]
fn a_server_without_standard_streams_serves() {
    if !has_model() {
        return;
    }
    let server = Serving::start(Some(">&- 2>&- <&-"), |_| {});
    server.answers(300);
    server.stops();
}

#[test]
fn a_server_that_cannot_say_where_it_listens_serves() {
    if !has_model() {
        return;
    }
    let (_reader, writer) = full_pipe();
    let server = Serving::start(None, |serve| {
        serve.stdout(writer).stderr(Stdio::null());
    });
    server.answers(10);
    server.stops();
    let server = Serving::start(None, |serve| {
        serve.stdout(full_disk()).stderr(full_disk());
    });
    server.answers(10);
    server.stops();
}

/// How a command ends with these streams.
fn end_of(arguments: &[&str], change: impl FnOnce(&mut Command)) -> (Option<i32>, String) {
    let folder = tempfile::tempdir().unwrap();
    let mut command = offline(folder.path(), arguments);
    command
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::piped());
    change(&mut command);
    let mut child = command.spawn().unwrap();
    let stderr = child.stderr.take();
    let status = ended(&mut child);
    let mut said = String::new();
    if let Some(mut stderr) = stderr {
        stderr.read_to_string(&mut said).unwrap();
    }
    (status.code(), said)
}

#[test]
fn a_command_whose_reader_has_gone_ends_in_silence() {
    for arguments in [
        &["openapi"][..],
        &["serve", "--print-config"],
        &["model", "list"],
    ] {
        let (code, said) = end_of(arguments, |command| {
            command.stdout(closed_pipe());
        });
        assert_eq!(
            (code, said.as_str()),
            (Some(PIPE_CLOSED), ""),
            "{arguments:?}"
        );
        let (code, said) = end_of(arguments, |command| {
            command.stdout(full_disk());
        });
        assert_eq!(code, Some(1), "{arguments:?}: {said}");
        assert!(said.contains("cannot write to standard output"), "{said}");
    }
    for arguments in [&["--help"][..], &["--version"], &["serve", "--help"]] {
        let (code, said) = end_of(arguments, |command| {
            command.stdout(closed_pipe());
        });
        assert!(code.is_some_and(|code| code != 101), "{arguments:?}");
        assert!(!said.contains("panicked"), "{said}");
    }
}

#[test]
fn a_command_that_cannot_say_why_it_fails_fails_all_the_same() {
    let nowhere: &[&str] = &["verify", "--data", "nowhere"];
    let broken: &[&str] = &["serve", "--config", "nowhere.toml"];
    let unreachable: &[&str] = &[
        "query",
        "x.jpg",
        "--map",
        "m",
        "--server",
        "http://127.0.0.1:9",
    ];
    for arguments in [nowhere, broken, unreachable] {
        for stderr in [Stdio::from(full_disk()), closed_pipe().into()] {
            let (code, _) = end_of(arguments, |command| {
                command.stderr(stderr);
            });
            assert_eq!(code, Some(1), "{arguments:?}");
        }
        let (_reader, writer) = full_pipe();
        let (code, _) = end_of(arguments, |command| {
            command.stderr(writer);
        });
        assert_eq!(code, Some(1), "{arguments:?}");
    }
    assert!(Path::new("/dev/full").exists());
}
