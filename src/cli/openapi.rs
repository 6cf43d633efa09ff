//! Print the OpenAPI document.

/// Arguments of this subcommand.
#[derive(Debug, clap::Args)]
pub struct OpenapiArgs {}

/// Runs it.
pub fn run(_args: OpenapiArgs) -> anyhow::Result<()> {
    anyhow::bail!("not built yet")
}
