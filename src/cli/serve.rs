//! Run the service.

use crate::cli::output::{say, say_part};
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
    logging::init(&config.log)?;
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
pub(super) fn print_address(scheme: &str, address: SocketAddr) {
    // Whoever started the server may have closed the pipe already, which is no reason to stop.
    if let Err(error) = say!("listening on {scheme}://{address}") {
        tracing::warn!(%error, %address, "the address was not printed");
    }
}
