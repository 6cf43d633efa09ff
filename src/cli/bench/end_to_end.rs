//! `POST /query` through a server process, over loopback.

use super::peers::{Peers, QueryFigures};
use crate::cli::child_server::ChildServer;
use crate::cli::client::resident_bytes;
use crate::cli::output::say;
use crate::cli::progress::ProgressBars;
use crate::cli::serve::print_address;
use crate::config::Config;
use crate::server::{Loaders, open_model, serve_until_signal};
use anyhow::{Context, ensure};
use hdrhistogram::Histogram;
use placeformer_core::types::ImageSize;
use placeformer_lab::bench::filled::FilledStore;
use placeformer_lab::bench::scenes::street;
use placeformer_lab::bench::{REFERENCE_SIZE, fill_with_streets, street_map};
use placeformer_store::{SqliteStore, StoreConfig};
use placeformer_vision::extract::{ExtractConfig, Extractor};
use serde::Serialize;
use std::collections::BTreeMap;
use std::ffi::OsString;
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

/// Different query photos, sent in turn.
const PHOTOS: u64 = 32;
const PHOTO_SIZE: ImageSize = ImageSize {
    width: 1280,
    height: 720,
};
/// Where the drawn references are, within the folder of a run.
const STORE: &str = "end-to-end";

/// What to measure.
pub(super) struct EndToEnd<'a> {
    pub(super) references: &'a [u64],
    pub(super) drawn: u64,
    pub(super) clients: &'a [usize],
    pub(super) seconds: f64,
    pub(super) extractor: &'a Extractor,
    pub(super) folder: &'a Path,
    /// Python with the peers' packages and the weights' file, to measure the peers too.
    pub(super) peers: Option<(&'a Path, &'a Path)>,
}

/// One measurement.
#[derive(Debug, Serialize)]
pub(super) struct EndToEndRow {
    /// References of the map.
    pub(super) references: u64,
    /// Clients that ask one query after the other.
    pub(super) clients: usize,
    #[serde(flatten)]
    pub(super) ours: QueryFigures,
    /// What users assemble today, with one client and no HTTP between.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) peer: Option<QueryFigures>,
}

impl EndToEnd<'_> {
    pub(super) fn measure(&self) -> anyhow::Result<Vec<EndToEndRow>> {
        let directory = self.folder.join(STORE);
        say!("drawing and describing {} references", self.drawn)?;
        let store = SqliteStore::open(&directory, &StoreConfig::default())?;
        fill_with_streets(&store, self.extractor, self.drawn)?;
        drop(store);
        let mut photos = Vec::new();
        for place in 0..PHOTOS {
            photos.push(bytes::Bytes::from(street(place * 7, 1, PHOTO_SIZE)?));
        }
        let photos: Arc<[bytes::Bytes]> = photos.into();
        let mut peers = None;
        if let Some((python, weights)) = self.peers {
            let model = (self.extractor, weights);
            let drawn = (self.drawn, REFERENCE_SIZE);
            peers = Some(Peers::prepare(python, self.folder, model, drawn, &photos)?);
        }
        let runtime = tokio::runtime::Runtime::new()?;
        let mut rows: Vec<EndToEndRow> = Vec::new();
        for &references in self.references {
            ensure!(
                references >= self.drawn,
                "--references {references} are fewer than --drawn {}",
                self.drawn
            );
            let mut measured = self.at(references, &runtime, &photos)?;
            if let (Some(peers), Some(row)) = (&peers, measured.first_mut()) {
                say!("{references} references, the peers")?;
                row.peer = Some(peers.measure(references, self.seconds)?);
            }
            rows.extend(measured);
        }
        Ok(rows)
    }

    /// All numbers of clients on one server.
    fn at(
        &self,
        references: u64,
        runtime: &tokio::runtime::Runtime,
        photos: &Arc<[bytes::Bytes]>,
    ) -> anyhow::Result<Vec<EndToEndRow>> {
        let extra = (references - self.drawn).to_string();
        let folder = self.folder.as_os_str().to_owned();
        // The same arguments, so that the model is the same.
        let same = std::env::args_os().skip(1);
        let serve = [
            OsString::from("--serve-filled"),
            extra.into(),
            "--folder-of-filled".into(),
            folder,
        ];
        let server = ChildServer::start(same.chain(serve), self.folder.join("server.log"))?;
        let client = reqwest::Client::builder()
            .timeout(Duration::from_secs(60))
            .build()?;
        let mut rows = Vec::new();
        for &clients in self.clients {
            say!("{references} references, {clients} clients")?;
            let time = Duration::from_secs_f64(self.seconds);
            let (asked, resident) = runtime.block_on(async {
                let asked = ask(&client, server.url(), photos, clients, time).await?;
                let metrics = client.get(format!("{}/metrics", server.url())).send();
                let metrics = metrics.await?.text().await?;
                let resident = resident_bytes(&metrics);
                let resident = resident.context("the server does not report its memory")?;
                anyhow::Ok((asked, resident))
            })?;
            rows.push(asked.row(references, clients, resident));
        }
        server.stop()?;
        Ok(rows)
    }
}

/// What the server process of a measurement does: serves the drawn references in `folder` and
/// `extra` made-up ones.
pub(super) fn serve_filled(
    folder: &Path,
    extra: u64,
    extract: ExtractConfig,
) -> anyhow::Result<()> {
    let directory = folder.join(STORE);
    let mut config = Config::default();
    config.data.directory.clone_from(&directory);
    config.http.listen = "127.0.0.1:0".into();
    let loaders = Loaders {
        source: Box::new(move || open_model(&extract, &ProgressBars::default())),
        store: Box::new(move || {
            Ok(Arc::new(FilledStore::around(
                SqliteStore::open(&directory, &StoreConfig::default())?,
                extra,
            )?))
        }),
    };
    serve_until_signal(config, loaders, |address| print_address("http", address))?;
    Ok(())
}

/// Answers of one measurement.
struct ServerAnswers {
    latency: Histogram<u64>,
    stages: BTreeMap<String, Histogram<u64>>,
    /// From the first question to the last answer.
    elapsed: Duration,
}

impl Default for ServerAnswers {
    fn default() -> Self {
        Self {
            latency: histogram(),
            stages: BTreeMap::new(),
            elapsed: Duration::ZERO,
        }
    }
}

/// Microseconds, growing as needed.
fn histogram() -> Histogram<u64> {
    // Cannot fail: three digits are within the crate's documented bounds.
    Histogram::new(3).expect("constant digits are valid")
}

impl ServerAnswers {
    fn add(&mut self, latency: Duration, timings: &serde_json::Value) -> anyhow::Result<()> {
        self.latency.record(latency.as_micros() as u64)?;
        for (stage, ms) in timings.as_object().into_iter().flatten() {
            let micros = ms.as_f64().unwrap_or_default() * 1e3;
            self.stages
                .entry(stage.clone())
                .or_insert_with(histogram)
                .record(micros as u64)?;
        }
        Ok(())
    }

    fn row(&self, references: u64, clients: usize, resident_bytes: u64) -> EndToEndRow {
        let at = |histogram: &Histogram<u64>, quantile| {
            histogram.value_at_quantile(quantile) as f64 / 1e3
        };
        let ours = QueryFigures {
            queries: self.latency.len(),
            p50_ms: at(&self.latency, 0.5),
            p99_ms: at(&self.latency, 0.99),
            queries_per_second: self.latency.len() as f64 / self.elapsed.as_secs_f64(),
            stages_ms: self
                .stages
                .iter()
                .map(|(stage, times)| (stage.clone(), at(times, 0.5)))
                .collect(),
            resident_bytes,
        };
        EndToEndRow {
            references,
            clients,
            ours,
            peer: None,
        }
    }
}

/// Closed loop: each client asks again as soon as it is answered, until `time` is over. The first
/// answers are not counted: they warm connections and caches.
async fn ask(
    client: &reqwest::Client,
    url: &str,
    photos: &Arc<[bytes::Bytes]>,
    clients: usize,
    time: Duration,
) -> anyhow::Result<ServerAnswers> {
    let url = format!("{url}/query?map={}&deadline_ms=60000", street_map());
    for photo in photos.iter().take(2) {
        query(client, &url, photo.clone()).await?;
    }
    let asked = Arc::new(Mutex::new(ServerAnswers::default()));
    let began = Instant::now();
    let tasks = (0..clients).map(|number| {
        let client = client.clone();
        let url = url.clone();
        let photos = Arc::clone(photos);
        let asked = Arc::clone(&asked);
        tokio::spawn(async move {
            for photo in photos.iter().cycle().skip(number * 5) {
                if began.elapsed() >= time {
                    break;
                }
                let (latency, timings) = query(&client, &url, photo.clone()).await?;
                asked
                    .lock()
                    .unwrap_or_else(PoisonError::into_inner)
                    .add(latency, &timings)?;
            }
            anyhow::Ok(())
        })
    });
    for task in tasks.collect::<Vec<_>>() {
        task.await??;
    }
    let asked = std::mem::take(&mut *asked.lock().unwrap_or_else(PoisonError::into_inner));
    Ok(ServerAnswers {
        elapsed: began.elapsed(),
        ..asked
    })
}

async fn query(
    client: &reqwest::Client,
    url: &str,
    photo: bytes::Bytes,
) -> anyhow::Result<(Duration, serde_json::Value)> {
    let started = Instant::now();
    let answer = client
        .post(url)
        .header("content-type", "image/jpeg")
        .body(photo)
        .send()
        .await?;
    let status = answer.status();
    let mut body: serde_json::Value = answer.json().await?;
    let latency = started.elapsed();
    ensure!(status.is_success(), "{status}: {body}");
    ensure!(body["reranked"] == true, "an answer was not re-ranked");
    Ok((latency, body["timings_ms"].take()))
}
