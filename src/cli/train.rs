//! Train the model.

/// Arguments of this subcommand.
#[derive(Debug, clap::Args)]
pub struct TrainArgs {}

/// Runs it.
pub fn run(_args: TrainArgs) -> anyhow::Result<()> {
    anyhow::bail!("not built yet")
}
