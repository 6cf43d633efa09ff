//! Import a folder of photos into a map.

/// Arguments of this subcommand.
#[derive(Debug, clap::Args)]
pub struct ImportArgs {}

/// Runs it.
pub fn run(_args: ImportArgs) -> anyhow::Result<()> {
    anyhow::bail!("not built yet")
}
