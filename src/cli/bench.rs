//! Measure every stage beside its baselines.

/// Arguments of this subcommand.
#[derive(Debug, clap::Args)]
pub struct BenchArgs {}

/// Runs it.
pub fn run(_args: BenchArgs) -> anyhow::Result<()> {
    anyhow::bail!("not built yet")
}
