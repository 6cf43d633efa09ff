//! Run the service.

/// Arguments of this subcommand.
#[derive(Debug, clap::Args)]
pub struct ServeArgs {}

/// Runs it.
pub fn run(_args: ServeArgs) -> anyhow::Result<()> {
    anyhow::bail!("not built yet")
}
