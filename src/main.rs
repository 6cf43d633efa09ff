//! Parses the command line and dispatches; nothing else.

use clap::Parser;
use placeformer::cli::Cli;
use placeformer::cli::output::{OutputError, report_failure};
use std::process::ExitCode;

fn main() -> ExitCode {
    match Cli::parse().run() {
        Ok(()) => ExitCode::SUCCESS,
        // As other tools end in a pipe whose reader has gone: silently, and not as a success, for
        // nobody has read it all.
        Err(error) if matches!(error.downcast_ref(), Some(OutputError::Closed)) => {
            ExitCode::from(141)
        }
        Err(error) => {
            // The chain of causes is for the user; a backtrace would only hide it.
            report_failure(&error);
            ExitCode::FAILURE
        }
    }
}
