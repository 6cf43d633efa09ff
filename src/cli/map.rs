//! Inspect and change maps.

/// Arguments of this subcommand.
#[derive(Debug, clap::Args)]
pub struct MapArgs {}

/// Runs it.
pub fn run(_args: MapArgs) -> anyhow::Result<()> {
    anyhow::bail!("not built yet")
}
