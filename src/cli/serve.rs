//! Run the service.

use crate::cli::output::{say, say_part, within_patience};
use crate::cli::progress::ProgressBars;
use crate::config::{Config, Overrides};
use crate::ops::logging;
use crate::server::{loaders, serve_until_signal};
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;

/// Arguments of this subcommand.
#[derive(Debug, clap::Args)]
pub struct ServeArgs {
    #[command(flatten)]
    overrides: Overrides,
    /// Configuration file (TOML).
    #[arg(long, env = "PLACEFORMER_CONFIG", value_name = "FILE")]
    config: Option<PathBuf>,
    /// Print the configuration in force, with every key explained, and stop.
    #[arg(long)]
    print_config: bool,
}

/// Runs it.
pub fn run(args: ServeArgs) -> anyhow::Result<()> {
    let config = Config::load(args.config.as_deref(), &args.overrides)?;
    if args.print_config {
        say_part!("{}", config.to_annotated_toml()?)?;
        return Ok(());
    }
    // The last lines are written whichever way this ends.
    let _flush = logging::init(&config.log)?;
    placeformer_kernels::self_check()?;
    let loaders = loaders(&config, Arc::new(ProgressBars::default()));
    let scheme = if config.http.has_tls() {
        "https"
    } else {
        "http"
    };
    serve_until_signal(config, loaders, |address| print_address(scheme, address))?;
    Ok(())
}

/// Prints where the server listens.
pub(super) fn print_address(scheme: &'static str, address: SocketAddr) {
    // Whoever started the server may have closed the pipe already, or left it full, which is no
    // reason to stop or to wait.
    match within_patience(move || say!("listening on {scheme}://{address}")) {
        Some(Ok(())) => {}
        Some(Err(error)) => tracing::warn!(%error, %address, "the address was not printed"),
        None => tracing::warn!(%address, "nobody reads the address on standard output"),
    }
}
