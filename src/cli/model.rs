//! Obtain and inspect models.

/// Arguments of this subcommand.
#[derive(Debug, clap::Args)]
pub struct ModelArgs {}

/// Runs it.
pub fn run(_args: ModelArgs) -> anyhow::Result<()> {
    anyhow::bail!("not built yet")
}
