//! Ask which place a photo shows.

/// Arguments of this subcommand.
#[derive(Debug, clap::Args)]
pub struct QueryArgs {}

/// Runs it.
pub fn run(_args: QueryArgs) -> anyhow::Result<()> {
    anyhow::bail!("not built yet")
}
