//! Check every record of a store.

/// Arguments of this subcommand.
#[derive(Debug, clap::Args)]
pub struct VerifyArgs {}

/// Runs it.
pub fn run(_args: VerifyArgs) -> anyhow::Result<()> {
    anyhow::bail!("not built yet")
}
