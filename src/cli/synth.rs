//! Render synthetic street scenes.

/// Arguments of this subcommand.
#[derive(Debug, clap::Args)]
pub struct SynthArgs {}

/// Runs it.
pub fn run(_args: SynthArgs) -> anyhow::Result<()> {
    anyhow::bail!("not built yet")
}
