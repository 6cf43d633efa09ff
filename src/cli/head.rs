//! Fit or train the projection to the global descriptor.

/// Arguments of this subcommand.
#[derive(Debug, clap::Args)]
pub struct HeadArgs {}

/// Runs it.
pub fn run(_args: HeadArgs) -> anyhow::Result<()> {
    anyhow::bail!("not built yet")
}
