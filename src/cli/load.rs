//! Drive a server at a constant rate.

/// Arguments of this subcommand.
#[derive(Debug, clap::Args)]
pub struct LoadArgs {}

/// Runs it.
pub fn run(_args: LoadArgs) -> anyhow::Result<()> {
    anyhow::bail!("not built yet")
}
