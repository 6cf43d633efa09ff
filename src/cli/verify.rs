//! Check every record of a store.

use crate::cli::output::{OutputError, say};
use crate::config::{Config, Overrides};
use crate::ops::logging;
use anyhow::{Context, ensure};
use placeformer_store::{LostTail, VerifyReport};
use serde_json::json;
use std::path::PathBuf;

/// Arguments of this subcommand.
#[derive(Debug, clap::Args)]
pub struct VerifyArgs {
    /// Directory of the store; no server may be using it.
    #[arg(long, value_name = "DIR")]
    data: PathBuf,
    /// Settings of the store, as the server reads them (TOML).
    #[arg(long, env = "PLACEFORMER_CONFIG", value_name = "FILE")]
    config: Option<PathBuf>,
    /// Open the store although acknowledged commits are missing, or may be, and give them up: the
    /// log says what they were. From then on the store opens as it is.
    #[arg(long)]
    accept_lost_tail: bool,
    /// Print the report as JSON.
    #[arg(long)]
    json: bool,
}

/// Reads everything, quarantines what is damaged, and fails if anything was.
pub fn run(args: VerifyArgs) -> anyhow::Result<()> {
    ensure!(
        args.data.is_dir(),
        "there is no store in {}",
        args.data.display()
    );
    let config = Config::load(args.config.as_deref(), &Overrides::default())?;
    let tail = if args.accept_lost_tail {
        LostTail::Accept
    } else {
        LostTail::Refuse
    };
    let _flush = logging::init(&config.log)?;
    let store = crate::server::open_store_with(&args.data, &config.store, tail)?;
    let report = store.verify().context("the store cannot be read")?;
    if args.json {
        print_json(&report)?;
    } else {
        print_lines(&report)?;
    }
    let found = report.damaged.len() + report.engine_errors.len();
    ensure!(
        found == 0,
        "{found} faults found; damaged references are quarantined and no longer served"
    );
    say!("all checksums hold")?;
    Ok(())
}

fn print_json(report: &VerifyReport) -> anyhow::Result<()> {
    let mut damaged = Vec::new();
    for (id, reason) in &report.damaged {
        damaged.push(json!({"reference": id, "reason": reason}));
    }
    let report = json!({
        "references": report.references,
        "damaged": damaged,
        "engine_errors": report.engine_errors,
    });
    say!("{}", serde_json::to_string_pretty(&report)?)?;
    Ok(())
}

fn print_lines(report: &VerifyReport) -> Result<(), OutputError> {
    say!("{} references read", report.references)?;
    for (id, reason) in &report.damaged {
        say!("damaged: {id}: {reason}")?;
    }
    for error in &report.engine_errors {
        say!("engine: {error}")?;
    }
    Ok(())
}
