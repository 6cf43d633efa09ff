//! Ask a running server whether it is ready.

use super::client::{ServerArgs, ServerClient};
use crate::cli::output::say;
use anyhow::ensure;

/// Arguments of this subcommand.
#[derive(Debug, clap::Args)]
pub struct HealthcheckArgs {
    #[command(flatten)]
    server: ServerArgs,
    /// Only ask whether the process lives, not whether it is ready.
    #[arg(long)]
    live: bool,
    /// Also ask whether it takes new references, which it does not while its disk is full.
    #[arg(long, conflicts_with = "live")]
    ingest: bool,
}

/// Succeeds if the server is ready for queries; fails with its own reason if not.
///
/// A full disk alone is no failure: a supervisor that restarted the server, or a balancer that left
/// it out, would end the queries and deletions that still work and gain nothing.
pub fn run(args: HealthcheckArgs) -> anyhow::Result<()> {
    let path = if args.live {
        "/livez"
    } else if args.ingest {
        "/readyz"
    } else {
        "/readyz?for=query"
    };
    let (status, body) = ServerClient::new(args.server)?.probe(path)?;
    ensure!(status == 200, "not ready ({status}): {body}");
    say!("{body}")?;
    Ok(())
}
