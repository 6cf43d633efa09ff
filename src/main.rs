//! Parses the command line and dispatches; nothing else.

use clap::Parser;
use placeformer::cli::Cli;

fn main() -> anyhow::Result<()> {
    Cli::parse().run()
}
