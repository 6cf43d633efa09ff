//! Ask a running server whether it is ready.

/// Arguments of this subcommand.
#[derive(Debug, clap::Args)]
pub struct HealthcheckArgs {}

/// Runs it.
pub fn run(_args: HealthcheckArgs) -> anyhow::Result<()> {
    anyhow::bail!("not built yet")
}
