//! Print the OpenAPI document.

use crate::cli::output::say_part;
use crate::http::openapi;
use anyhow::{Context, ensure};
use std::path::PathBuf;

/// Arguments of this subcommand.
#[derive(Debug, clap::Args)]
pub struct OpenapiArgs {
    /// Write to this file instead of standard output.
    #[arg(long, value_name = "FILE", conflicts_with = "check")]
    out: Option<PathBuf>,
    /// Fail if this file differs from the document.
    #[arg(long, value_name = "FILE")]
    check: Option<PathBuf>,
}

/// Prints, writes or compares the document.
pub fn run(args: OpenapiArgs) -> anyhow::Result<()> {
    let document = openapi::document_text();
    if let Some(path) = args.check {
        let committed = std::fs::read_to_string(&path)
            .with_context(|| format!("cannot read {}", path.display()))?;
        ensure!(
            committed == document,
            "{} differs from the code; renew it with: placeformer openapi --out {0}",
            path.display()
        );
        return Ok(());
    }
    match args.out {
        Some(path) => std::fs::write(&path, document)
            .with_context(|| format!("cannot write {}", path.display())),
        None => {
            say_part!("{document}")?;
            Ok(())
        }
    }
}
