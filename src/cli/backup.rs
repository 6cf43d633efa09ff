//! Copy a store to a file while a server may be using it.

use crate::cli::output::say;
use crate::config::{Config, Overrides};
use anyhow::{Context, ensure};
use placeformer_store::SqliteStore;
use std::path::PathBuf;

/// Arguments of this subcommand.
#[derive(Debug, clap::Args)]
pub struct BackupArgs {
    /// Directory of the store; a server may be running on it.
    #[arg(long, value_name = "DIR")]
    data: PathBuf,
    /// Data directory to make of the copy; it must not hold a store yet. `verify --data`, `map
    /// rehead --data` and `serve --data` take it as it is.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Settings of the store, as the server reads them (TOML).
    #[arg(long, env = "PLACEFORMER_CONFIG", value_name = "FILE")]
    config: Option<PathBuf>,
}

/// Runs it.
pub fn run(args: BackupArgs) -> anyhow::Result<()> {
    let config = Config::load(args.config.as_deref(), &Overrides::default())?;
    ensure!(
        args.data.is_dir(),
        "there is no store in {}",
        args.data.display()
    );
    std::fs::create_dir_all(&args.out)
        .with_context(|| format!("cannot create {}", args.out.display()))?;
    let target = args.out.join(SqliteStore::DATABASE);
    let bytes = SqliteStore::backup_of(&args.data, &config.store, &target)
        .with_context(|| format!("cannot back up {}", args.data.display()))?;
    say!("{}: {bytes} bytes", target.display())?;
    Ok(())
}
