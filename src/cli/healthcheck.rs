//! Ask a running server whether it is ready.

use super::client::{ServerArgs, ServerClient};
use anyhow::ensure;

/// Arguments of this subcommand.
#[derive(Debug, clap::Args)]
pub struct HealthcheckArgs {
    #[command(flatten)]
    server: ServerArgs,
    /// Only ask whether the process lives, not whether it is ready.
    #[arg(long)]
    live: bool,
}

/// Succeeds if the server is ready; fails with its own reason if not.
pub fn run(args: HealthcheckArgs) -> anyhow::Result<()> {
    let path = if args.live { "/livez" } else { "/readyz" };
    let (status, body) = ServerClient::new(args.server)?.probe(path)?;
    ensure!(status == 200, "not ready ({status}): {body}");
    println!("{body}");
    Ok(())
}
