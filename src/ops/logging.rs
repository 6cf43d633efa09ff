//! Logs: text for people, or one JSON object a line for collectors.

use serde::{Deserialize, Serialize};
use std::backtrace::{Backtrace, BacktraceStatus};
use std::panic::PanicHookInfo;
use tracing_subscriber::EnvFilter;
use tracing_subscriber::fmt::format::FmtSpan;
use utoipa::ToSchema;

/// How log lines look.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum LogFormat {
    /// Coloured text.
    #[default]
    Human,
    /// One JSON object a line.
    Json,
}

/// Settings of the logs. The comments of the fields are printed as the manual of the
/// configuration file.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(default, deny_unknown_fields)]
pub struct LogConfig {
    /// "human" (coloured text) or "json" (one object a line).
    #[schema(value_type = String)]
    pub format: LogFormat,
    /// What is logged, in the syntax of `tracing` directives: "info", "placeformer=debug", ...
    pub filter: String,
}

impl Default for LogConfig {
    fn default() -> Self {
        Self {
            format: LogFormat::Human,
            filter: "info".into(),
        }
    }
}

/// The log filter is not a list of directives.
#[derive(Debug, thiserror::Error)]
#[error("log.filter {filter:?} is not valid: {reason}")]
pub struct InvalidFilter {
    filter: String,
    reason: String,
}

impl LogConfig {
    /// Checks the filter.
    ///
    /// # Errors
    /// It is not a list of directives.
    pub fn check(&self) -> Result<(), InvalidFilter> {
        self.directives().map(drop)
    }

    fn directives(&self) -> Result<EnvFilter, InvalidFilter> {
        EnvFilter::try_new(&self.filter).map_err(|error| InvalidFilter {
            filter: self.filter.clone(),
            reason: error.to_string(),
        })
    }
}

/// Sends all events and the text of panics to standard error from now on. After a second call the
/// settings of the first one stay in force.
///
/// # Errors
/// The filter is not a list of directives.
pub fn init(config: &LogConfig) -> Result<(), InvalidFilter> {
    let lines = tracing_subscriber::fmt()
        .with_env_filter(config.directives()?)
        .with_span_events(FmtSpan::NONE)
        .with_writer(std::io::stderr);
    let outcome = match config.format {
        LogFormat::Human => lines.try_init(),
        LogFormat::Json => lines
            .json()
            .flatten_event(true)
            .with_current_span(true)
            .with_span_list(false)
            .try_init(),
    };
    match outcome {
        Ok(()) => std::panic::set_hook(Box::new(log_panic)),
        Err(_) => tracing::debug!("logs were set up before"),
    }
    Ok(())
}

/// Logs a panic as an event: one line in the format of the others, with the request during which it
/// happened.
fn log_panic(panic: &PanicHookInfo<'_>) {
    let backtrace = Backtrace::capture();
    let captured = backtrace.status() == BacktraceStatus::Captured;
    let backtrace = captured.then(|| backtrace.to_string());
    let location = panic.location().map(ToString::to_string);
    tracing::error!(
        panic = panic.payload_as_str().unwrap_or("no text"),
        location,
        backtrace,
        "a thread panicked"
    );
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_wrong_filter_is_named() {
        let config = LogConfig {
            filter: "placeformer=loud".into(),
            ..Default::default()
        };
        assert!(
            config
                .check()
                .unwrap_err()
                .to_string()
                .contains("placeformer=loud")
        );
        assert!(LogConfig::default().check().is_ok());
    }
}
