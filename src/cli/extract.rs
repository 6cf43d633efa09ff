//! Show every intermediate of extraction.

/// Arguments of this subcommand.
#[derive(Debug, clap::Args)]
pub struct ExtractArgs {}

/// Runs it.
pub fn run(_args: ExtractArgs) -> anyhow::Result<()> {
    anyhow::bail!("not built yet")
}
