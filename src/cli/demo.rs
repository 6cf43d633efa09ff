//! Serve a demo map, query it, write a report.

/// Arguments of this subcommand.
#[derive(Debug, clap::Args)]
pub struct DemoArgs {}

/// Runs it.
pub fn run(_args: DemoArgs) -> anyhow::Result<()> {
    anyhow::bail!("not built yet")
}
