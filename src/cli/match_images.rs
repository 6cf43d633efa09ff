//! Match two images and draw the evidence.

/// Arguments of this subcommand.
#[derive(Debug, clap::Args)]
pub struct MatchArgs {}

/// Runs it.
pub fn run(_args: MatchArgs) -> anyhow::Result<()> {
    anyhow::bail!("not built yet")
}
