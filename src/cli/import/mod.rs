//! Import a folder of photos into a map.
//!
//! An import goes through a running server or straight into a store; both are a [`Sink`]. Each
//! photo's external id is its path below the folder. Photos that the map has already, with the same
//! content, are not sent again, so that an interrupted import is resumed by running it again; what
//! this import knows better about them is changed. Everything in the folder gets a line in the
//! JSONL report and a place in the summary, and the exit code tells whether all photos are in the
//! map.

mod importer;
mod metadata;
mod photo_file;
mod positions;
mod report;
mod server_sink;
mod sink;
mod store_sink;
mod timezone;

use crate::cli::client::{ServerArgs, TrustArgs};
use crate::cli::output::{note, say};
use crate::cli::progress::ProgressBars;
use crate::config::ModelOverrides;
use anyhow::{Context, anyhow, bail, ensure};
use importer::Importer;
use metadata::Metadata;
use placeformer_core::folder::{FolderScan, PassedOver, scan_folder};
use placeformer_core::geography::UtmZone;
use placeformer_core::printable::Printable;
use placeformer_core::types::MapName;
use positions::{Positions, folder_of};
use report::{ImportReport, PhotoRecord, Summary, describe_ignored};
use server_sink::{PhotoTreatment, ServerSink};
use sink::Sink;
use std::path::PathBuf;
use std::sync::atomic::AtomicUsize;
use store_sink::StoreSink;
use timezone::ClockZone;

/// Arguments of this subcommand.
#[derive(Debug, clap::Args)]
#[command(group(clap::ArgGroup::new("target").required(true).args(["server", "data"])))]
pub struct ImportArgs {
    /// Folder of photos, or one photo. Folders below it are taken too, links to folders are not
    /// followed.
    #[arg(value_name = "FOLDER")]
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
    /// Table (CSV) with the columns file, and any of lat and lon, alt (metres), heading,
    /// captured_at (RFC 3339).
    ///
    /// Usual other headings are known (latitude, lng, filename, ...), and columns may be separated
    /// by commas, semicolons or tabs. Rows name photos by their path below the folder or the
    /// table, by their whole path, or by their name alone if it is unique. What a row says replaces
    /// what the map has.
    #[arg(long, value_name = "CSV")]
    positions: Option<PathBuf>,
    /// Succeed although rows of the positions file match no photo.
    #[arg(long, requires = "positions")]
    allow_unmatched_rows: bool,
    /// Time zone (Europe/Paris) or offset (+02:00) of times that do not say theirs.
    ///
    /// These are times in EXIF, XMP and the positions file. Without it, EXIF and XMP are taken as
    /// UTC, and the positions file is refused.
    #[arg(long, value_name = "ZONE", allow_hyphen_values = true)]
    timezone: Option<ClockZone>,
    /// Leave alone what the photos say about themselves in EXIF and XMP.
    #[arg(long)]
    no_exif: bool,
    /// Import photos that show nothing to know a place by (dark, blank, a covered lens), too.
    #[arg(long)]
    allow_uninformative: bool,
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
    let scan = scan_folder(&args.folder)?;
    if scan.images.is_empty() {
        return Err(nothing_to_import(&args, &scan));
    }
    let metadata = read_metadata(&args, &scan.images)?;
    let (summary, stopped) = import(&args, &scan, &metadata)?;
    say!("{summary}")?;
    if summary.ignored > 0 {
        say!("ignored: {}", describe_ignored(&scan.passed_over))?;
    }
    if let Some(reason) = stopped {
        bail!("stopped: {}", Printable(reason));
    }
    let failed = summary.failed;
    let total = scan.images.len() + losses(&scan).count();
    ensure!(failed == 0, "{failed} of {total} photos are not in the map");
    let unmatched = metadata.positions.unmatched.len();
    ensure!(
        unmatched == 0 || args.allow_unmatched_rows,
        "{unmatched} rows of the positions file match no photo (--allow-unmatched-rows accepts that)"
    );
    Ok(())
}

/// What in the folder may be photos that cannot be read.
fn losses(scan: &FolderScan) -> impl Iterator<Item = &PassedOver> {
    scan.passed_over.iter().filter(|entry| entry.is_loss)
}

/// Says what there is instead of photos, also in the report.
fn nothing_to_import(args: &ImportArgs, scan: &FolderScan) -> anyhow::Error {
    let report = ImportReport::create(args.report.as_deref())
        .and_then(|report| report_passed_over(&report, scan).and(report.finish()));
    if let Err(error) = report {
        return error;
    }
    let folder = Printable(args.folder.display());
    let ignored = describe_ignored(&scan.passed_over);
    match ignored.as_str() {
        "" => anyhow!("{folder} holds no JPEG, PNG or WebP image"),
        _ => anyhow!("{folder} holds no JPEG, PNG or WebP image (ignored: {ignored})"),
    }
}

/// Reports what of the folder is not imported, and shows what may be photos.
fn report_passed_over(report: &ImportReport, scan: &FolderScan) -> anyhow::Result<()> {
    for entry in &scan.passed_over {
        let record = PhotoRecord::passed_over(entry);
        report.add(&record).context("cannot write the report")?;
    }
    for entry in losses(scan) {
        let detail = entry.reason.detail();
        note!("{}", Printable(format_args!("{}: {detail}", entry.name)));
    }
    Ok(())
}

/// What is known of the photos from other files than their own.
fn read_metadata(args: &ImportArgs, images: &[(String, PathBuf)]) -> anyhow::Result<Metadata> {
    let timezone = args.timezone.clone();
    let positions = match &args.positions {
        None => Positions::default(),
        Some(path) => {
            // A single photo is named by its path below the folder in which it lies.
            let folder = match args.folder.is_file() {
                true => folder_of(&args.folder),
                false => &args.folder,
            };
            Positions::read(path, folder, images, timezone.as_ref())?
        }
    };
    if args.positions.is_some() {
        note!("columns of the positions file: {}", positions.columns);
    }
    if let Some(example) = positions.unmatched.first() {
        let count = positions.unmatched.len();
        let example = Printable(example);
        note!("{count} rows of the positions file match no photo, such as \"{example}\"");
    }
    if positions.elsewhere > 0 {
        let count = positions.elsewhere;
        note!("{count} rows of the positions file are for files outside the folder");
    }
    Ok(Metadata {
        positions,
        utm_zone: args.utm_zone,
        timezone,
        ignores_exif: args.no_exif,
    })
}

/// Imports all photos; returns the counts, and why the import stopped if it did before the end.
fn import(
    args: &ImportArgs,
    scan: &FolderScan,
    metadata: &Metadata,
) -> anyhow::Result<(Summary, Option<String>)> {
    let report = ImportReport::create(args.report.as_deref())?;
    report_passed_over(&report, scan)?;
    let sink = open_sink(args)?;
    let present = sink
        .present(&args.map)
        .context("cannot list what the map holds")?;
    let importer = Importer {
        sink: &*sink,
        metadata,
        map: &args.map,
        present: &present,
        requires_position: args.require_position,
        warnings: AtomicUsize::new(0),
        report: &report,
        progress: &ProgressBars::default(),
    };
    let stopped = importer.run(&scan.images, args.concurrency);
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
        return Ok(Box::new(ServerSink::new(
            server,
            args.attempts,
            PhotoTreatment {
                ignores_exif: args.no_exif,
                allows_uninformative: args.allow_uninformative,
            },
        )?));
    }
    let Some(data) = &args.data else {
        bail!("give --server or --data");
    };
    let sink = StoreSink::open(
        data,
        args.config.as_deref(),
        args.model.clone(),
        args.allow_uninformative,
    )?;
    Ok(Box::new(sink))
}

/// A server has its own model. `--weights` is let through, because the environment sets it, too.
fn refuse_model_options(model: &ModelOverrides) -> anyhow::Result<()> {
    let ModelOverrides {
        preset,
        weights: _,
        difference,
        head,
        precision,
    } = model;
    let is_given =
        preset.is_some() || difference.is_some() || head.is_some() || precision.is_some();
    ensure!(
        !is_given,
        "--preset, --difference, --head and --precision go with --data: a server has its own model"
    );
    Ok(())
}
