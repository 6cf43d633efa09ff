//! Measure recall on a data set.

/// Arguments of this subcommand.
#[derive(Debug, clap::Args)]
pub struct EvalArgs {}

/// Runs it.
pub fn run(_args: EvalArgs) -> anyhow::Result<()> {
    anyhow::bail!("not built yet")
}
