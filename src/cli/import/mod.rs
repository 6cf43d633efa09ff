//! Import a folder of photos into a map.
//!
//! An import goes through a running server or straight into a store; both are a [`Sink`]. Each
//! photo's external id is its path below the folder. Photos that the map has already, with the same
//! content, are skipped, so that an interrupted import is resumed by running it again. Every photo
//! gets a line in the JSONL report and a place in the summary, and the exit code tells whether all
//! of them are in the map.

mod importer;
mod metadata;
mod report;
mod server_sink;
mod sink;
mod store_sink;

use crate::cli::client::{ServerArgs, TrustArgs};
use crate::cli::output::{note, say};
use crate::cli::progress::ProgressBars;
use crate::config::ModelOverrides;
use anyhow::{Context, bail, ensure};
use importer::Importer;
use metadata::Metadata;
use placeformer_core::folder::list_images;
use placeformer_core::geography::UtmZone;
use placeformer_core::types::MapName;
use report::{ImportReport, Summary};
use server_sink::ServerSink;
use sink::Sink;
use std::path::PathBuf;
use store_sink::StoreSink;

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
    #[command(flatten)]
    trust: TrustArgs,
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
    let metadata = read_metadata(&args, &images)?;
    let (summary, stopped) = import(&args, &images, &metadata)?;
    say!("{summary}")?;
    if let Some(reason) = stopped {
        bail!("stopped: {reason}");
    }
    let failed = summary.failed;
    ensure!(
        failed == 0,
        "{failed} of {} photos are not in the map",
        images.len()
    );
    Ok(())
}

/// What is known of the photos from other files than their own.
fn read_metadata(args: &ImportArgs, images: &[(String, PathBuf)]) -> anyhow::Result<Metadata> {
    let metadata = Metadata::read(
        args.positions.as_deref(),
        &args.folder,
        args.utm_zone,
        args.require_position,
    )?;
    let names = images.iter().map(|(name, _)| name.as_str());
    let unmatched = metadata.without_image(names);
    if let Some(example) = unmatched.first() {
        let count = unmatched.len();
        note!("warning: {count} rows of the positions file name no image, such as {example:?}");
    }
    Ok(metadata)
}

/// Imports all photos; returns the counts, and why the import stopped if it did before the end.
fn import(
    args: &ImportArgs,
    images: &[(String, PathBuf)],
    metadata: &Metadata,
) -> anyhow::Result<(Summary, Option<String>)> {
    let report = ImportReport::create(args.report.as_deref())?;
    let sink = open_sink(args)?;
    let present = sink
        .present(&args.map)
        .context("cannot list what the map holds")?;
    let importer = Importer {
        sink: &*sink,
        metadata,
        map: &args.map,
        present: &present,
        report: &report,
        progress: &ProgressBars::default(),
    };
    let stopped = importer.run(images, args.concurrency);
    Ok((report.finish()?, stopped))
}

fn open_sink(args: &ImportArgs) -> anyhow::Result<Box<dyn Sink>> {
    if let Some(server) = &args.server {
        refuse_model_options(&args.model)?;
        let server = ServerArgs {
            server: server.clone(),
            api_key: args.api_key.clone(),
            trust: args.trust.clone(),
            timeout: args.timeout,
        };
        return Ok(Box::new(ServerSink::new(server, args.attempts)?));
    }
    let Some(data) = &args.data else {
        bail!("give --server or --data");
    };
    let sink = StoreSink::open(data, args.config.as_deref(), args.model.clone())?;
    Ok(Box::new(sink))
}

/// A server has its own model. `--weights` is let through, because the environment sets it, too.
fn refuse_model_options(model: &ModelOverrides) -> anyhow::Result<()> {
    let ModelOverrides {
        preset,
        weights: _,
        head,
        precision,
    } = model;
    let is_given = preset.is_some() || head.is_some() || precision.is_some();
    ensure!(
        !is_given,
        "--preset, --head and --precision go with --data: a server has its own model"
    );
    Ok(())
}
