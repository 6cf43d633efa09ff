//! Import a folder of photos into a map.
//!
//! Through a running server or straight into a store: both are a [`Sink`]. Each photo's external id
//! is its path below the folder. What the map holds already, with the same content, is skipped, so
//! an interrupted import is resumed by running it again. Every photo gets a verdict: a line of the
//! JSONL report, a place in the summary; the exit code tells whether all are in.

mod http_sink;
mod metadata;
mod sink;
mod store_sink;
mod verdict;

use crate::cli::output::say;
use crate::config::ModelOverrides;
use anyhow::{Context, bail, ensure};
use indicatif::{ProgressBar, ProgressStyle};
use metadata::Metadata;
use placeformer_core::folder::list_images;
use placeformer_core::geography::UtmZone;
use placeformer_core::types::{ContentHash, ExternalId, MapName};
use sink::{Outcome, Sink, Upload};
use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use verdict::{Status, Verdict, VerdictLog};

/// Arguments of this subcommand.
#[derive(Debug, clap::Args)]
#[command(group(clap::ArgGroup::new("target").required(true).args(["server", "data"])))]
pub struct ImportArgs {
    /// Folder of photos; folders below it are taken too.
    folder: PathBuf,
    /// The map; created on first use.
    #[arg(long)]
    map: MapName,
    /// Import through this server.
    #[arg(long, value_name = "URL")]
    server: Option<String>,
    /// Import straight into the store in this folder; no server may have it open.
    #[arg(long, value_name = "DIR")]
    data: Option<PathBuf>,
    /// Settings for --data, as the server reads them (TOML).
    #[arg(
        long,
        env = "PLACEFORMER_CONFIG",
        value_name = "FILE",
        conflicts_with = "server"
    )]
    config: Option<PathBuf>,
    /// API key, where the server wants one.
    #[arg(
        long,
        env = "PLACEFORMER_API_KEY",
        hide_env_values = true,
        value_name = "KEY"
    )]
    api_key: Option<String>,
    /// CSV with the columns file, and any of lat and lon, heading, captured_at (RFC 3339).
    #[arg(long, value_name = "CSV")]
    positions: Option<PathBuf>,
    /// UTM zone and band, such as 33T, of @utm_east@utm_north@... names that do not give it.
    #[arg(long, value_name = "ZONE")]
    utm_zone: Option<UtmZone>,
    /// Refuse photos for which no position is found.
    #[arg(long)]
    require_position: bool,
    /// Photos under way at once.
    #[arg(long, default_value_t = 4, value_name = "N")]
    concurrency: usize,
    /// Attempts for one photo while the server is busy or out of reach.
    #[arg(long, default_value_t = 8, value_name = "N")]
    attempts: u32,
    /// Seconds to wait for one answer.
    #[arg(long, default_value_t = 120, value_name = "SECONDS")]
    timeout: u64,
    /// Write a verdict per photo as JSON lines.
    #[arg(long, value_name = "FILE")]
    report: Option<PathBuf>,
    /// The model behind --data; a server has its own.
    #[command(flatten)]
    model: ModelOverrides,
}

/// Runs it.
pub fn run(args: ImportArgs) -> anyhow::Result<()> {
    ensure!(args.concurrency > 0, "--concurrency must be at least 1");
    ensure!(args.attempts > 0, "--attempts must be at least 1");
    let images = list_images(&args.folder)?;
    ensure!(
        !images.is_empty(),
        "{} holds no JPEG, PNG or WebP image",
        args.folder.display()
    );
    let metadata = Metadata::read(
        args.positions.as_deref(),
        &args.folder,
        args.utm_zone,
        args.require_position,
    )?;
    let unmatched = metadata.without_image(images.iter().map(|(name, _)| name.as_str()));
    if let Some(example) = unmatched.first() {
        eprintln!(
            "warning: {} rows of the positions file name no image, such as {example:?}",
            unmatched.len()
        );
    }
    let log = VerdictLog::create(args.report.as_deref())?;
    let sink = open_sink(&args)?;
    let present = sink
        .present(&args.map)
        .context("cannot list what the map holds")?;
    let progress = progress_bar(images.len() as u64);
    let import = Import {
        sink: &*sink,
        metadata: &metadata,
        map: &args.map,
        present: &present,
        log: &log,
    };
    let stopped = import.run(&images, args.concurrency, &progress);
    progress.finish_and_clear();
    let summary = log.finish()?;
    say!("{summary}")?;
    if let Some(reason) = stopped {
        bail!("stopped: {reason}");
    }
    ensure!(
        summary.failed == 0,
        "{} of {} photos are not in the map",
        summary.failed,
        images.len()
    );
    Ok(())
}

fn open_sink(args: &ImportArgs) -> anyhow::Result<Box<dyn Sink>> {
    match (&args.server, &args.data) {
        (Some(url), _) => {
            let ModelOverrides {
                preset,
                weights: _,
                head,
                precision,
            } = &args.model;
            let given = preset.is_some() || head.is_some() || precision.is_some();
            ensure!(
                !given,
                "--preset, --head and --precision go with --data: a server has its own model"
            );
            let settings = http_sink::Settings {
                url: url.clone(),
                api_key: args.api_key.clone(),
                timeout: std::time::Duration::from_secs(args.timeout),
                attempts: args.attempts,
            };
            Ok(Box::new(http_sink::HttpSink::new(settings)?))
        }
        (None, Some(data)) => Ok(Box::new(store_sink::StoreSink::open(
            data,
            args.config.as_deref(),
            args.model.clone(),
        )?)),
        (None, None) => bail!("give --server or --data"),
    }
}

fn progress_bar(length: u64) -> ProgressBar {
    let style = ProgressStyle::with_template("{wide_bar} {pos}/{len} {per_sec} {eta} {msg}")
        .unwrap_or_else(|_| ProgressStyle::default_bar());
    ProgressBar::new(length).with_style(style)
}

struct Import<'a> {
    sink: &'a dyn Sink,
    metadata: &'a Metadata,
    map: &'a MapName,
    /// Content by external id.
    present: &'a HashMap<String, String>,
    log: &'a VerdictLog,
}

impl Import<'_> {
    /// Imports all images from `concurrency` threads; says why if it had to stop before the end.
    fn run(
        &self,
        images: &[(String, PathBuf)],
        concurrency: usize,
        progress: &ProgressBar,
    ) -> Option<String> {
        let (next, stop) = (AtomicUsize::new(0), AtomicBool::new(false));
        let reason = Mutex::new(None);
        std::thread::scope(|scope| {
            for _ in 0..concurrency.min(images.len()) {
                scope.spawn(|| {
                    while !stop.load(Ordering::Relaxed) {
                        let Some((name, path)) = images.get(next.fetch_add(1, Ordering::Relaxed))
                        else {
                            break;
                        };
                        let (verdict, hopeless) = self.import(name, path);
                        if verdict.status == Status::Failed {
                            progress.suspend(|| {
                                eprintln!(
                                    "{name}: {}",
                                    verdict.detail.as_deref().unwrap_or("failed")
                                )
                            });
                        }
                        let logged = self.log.add(&verdict);
                        progress.inc(1);
                        if hopeless || logged.is_err() {
                            let why = logged
                                .err()
                                .map(|error| format!("cannot write the report: {error}"))
                                .or(verdict.detail);
                            // A poisoned lock means another thread panicked; its reason is as good.
                            reason
                                .lock()
                                .unwrap_or_else(|poisoned| poisoned.into_inner())
                                .get_or_insert(why.unwrap_or_default());
                            stop.store(true, Ordering::Relaxed);
                        }
                    }
                });
            }
        });
        reason
            .into_inner()
            .unwrap_or_else(|poisoned| poisoned.into_inner())
    }

    /// The verdict on one image, and whether going on is hopeless.
    fn import(&self, name: &str, path: &Path) -> (Verdict, bool) {
        let failed = |code: &str, detail: String| (Verdict::failed(name, code, detail, 0), false);
        let external_id: ExternalId = match name.parse() {
            Ok(id) => id,
            Err(error) => return failed("invalid_parameter", format!("{error}")),
        };
        let bytes = match std::fs::read(path) {
            Ok(bytes) => bytes,
            Err(error) => return failed("unreadable_file", error.to_string()),
        };
        let hash = ContentHash::of(&bytes).to_string();
        match self.present.get(name) {
            Some(present) if *present == hash => return (Verdict::skipped(name), false),
            Some(_) => {
                let detail = "the map holds another image under this name; delete it there or rename this one";
                return failed("external_id_conflict", detail.into());
            }
            None => {}
        }
        let fields = match self.metadata.fields(name, external_id, &bytes) {
            Ok(fields) => fields,
            Err(detail) => return failed("no_position", detail),
        };
        let located = fields.location.is_some();
        let sent = self.sink.send(Upload {
            map: self.map.clone(),
            fields,
            image: bytes.into(),
        });
        match sent.outcome {
            Outcome::Created(id) => (
                Verdict::stored(name, Status::Created, id, located, sent.attempts),
                false,
            ),
            Outcome::Present(id) => (
                Verdict::stored(name, Status::Present, id, located, sent.attempts),
                false,
            ),
            Outcome::Refused { code, detail } => (
                Verdict::failed(name, &code, detail, sent.attempts),
                sink::is_hopeless(&code),
            ),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::sink::Sent;
    use super::*;

    /// Keeps what it is sent; refuses images that start with `!`, with the code that follows.
    #[derive(Default)]
    struct Memory(Mutex<HashMap<String, String>>);

    impl Sink for Memory {
        fn present(&self, _map: &MapName) -> anyhow::Result<HashMap<String, String>> {
            Ok(self.0.lock().unwrap().clone())
        }

        fn send(&self, upload: Upload) -> Sent {
            if let Some(code) = upload.image.strip_prefix(b"!") {
                let code = String::from_utf8_lossy(code).into_owned();
                return Sent {
                    outcome: Outcome::Refused {
                        code,
                        detail: "refused".into(),
                    },
                    attempts: 1,
                };
            }
            let id = upload.fields.external_id.unwrap().to_string();
            self.0
                .lock()
                .unwrap()
                .insert(id, ContentHash::of(&upload.image).to_string());
            Sent {
                outcome: Outcome::Created("id".into()),
                attempts: 1,
            }
        }
    }

    fn import(folder: &Path, sink: &Memory, report: &Path) -> (verdict::Summary, Option<String>) {
        let images = list_images(folder).unwrap();
        let metadata = Metadata::read(None, Path::new("."), None, false).unwrap();
        let map = "m".parse().unwrap();
        let present = sink.present(&map).unwrap();
        let log = VerdictLog::create(Some(report)).unwrap();
        let import = Import {
            sink,
            metadata: &metadata,
            map: &map,
            present: &present,
            log: &log,
        };
        let stopped = import.run(&images, 3, &ProgressBar::hidden());
        (log.finish().unwrap(), stopped)
    }

    #[test]
    fn a_second_import_skips_what_is_there_and_reports_what_changed() {
        let folder = tempfile::tempdir().unwrap();
        let photos = folder.path().join("photos");
        std::fs::create_dir_all(photos.join("sub")).unwrap();
        for name in ["a.jpg", "b.jpg", "sub/c.png"] {
            std::fs::write(photos.join(name), name).unwrap();
        }
        std::fs::write(photos.join("bad.jpg"), b"!image_undecodable").unwrap();
        let (sink, report) = (Memory::default(), folder.path().join("report.jsonl"));
        let (summary, stopped) = import(&photos, &sink, &report);
        assert_eq!((summary.created, summary.failed, stopped), (3, 1, None));
        std::fs::write(photos.join("b.jpg"), "other").unwrap();
        std::fs::remove_file(photos.join("bad.jpg")).unwrap();
        std::fs::write(photos.join("d.jpg"), "new").unwrap();
        let (summary, _) = import(&photos, &sink, &report);
        assert_eq!(
            (summary.created, summary.skipped, summary.failed),
            (1, 2, 1)
        );
        let lines: Vec<serde_json::Value> = std::fs::read_to_string(&report)
            .unwrap()
            .lines()
            .map(|line| serde_json::from_str(line).unwrap())
            .collect();
        assert_eq!(lines.len(), 4);
        let changed = lines.iter().find(|line| line["file"] == "b.jpg").unwrap();
        assert_eq!(
            (&changed["status"], &changed["code"]),
            (&"failed".into(), &"external_id_conflict".into())
        );
    }

    #[test]
    fn what_holds_for_every_image_stops_the_import() {
        let folder = tempfile::tempdir().unwrap();
        for i in 0..50 {
            std::fs::write(
                folder.path().join(format!("{i:02}.jpg")),
                b"!model_mismatch",
            )
            .unwrap();
        }
        let report = folder.path().join("report.jsonl");
        let (summary, stopped) = import(folder.path(), &Memory::default(), &report);
        assert!(
            summary.failed <= 3 && stopped.is_some(),
            "{summary} {stopped:?}"
        );
    }
}
