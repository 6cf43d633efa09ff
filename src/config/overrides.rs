//! Settings given on the command line.

use crate::ops::LogFormat;
use placeformer_vision::extract::{HeadChoice, Precision, Preset};
use std::path::PathBuf;

/// Settings given on the command line; absent ones leave the other sources in force.
#[derive(Debug, Clone, Default, PartialEq, clap::Args)]
pub struct Overrides {
    /// Address and port to listen on; port 0 picks a free one.
    #[arg(long, value_name = "ADDR")]
    pub listen: Option<String>,
    /// Listen on an address that other machines reach although there are no API keys.
    #[arg(long)]
    pub insecure: bool,
    /// Directory of the store.
    #[arg(long, value_name = "DIR")]
    pub data: Option<PathBuf>,
    /// Log lines for people or as JSON.
    #[arg(long, value_enum)]
    pub log_format: Option<LogFormat>,
    /// Log filter, such as `info` or `placeformer=debug`.
    #[arg(long, value_name = "FILTER")]
    pub log: Option<String>,
    /// The model.
    #[command(flatten)]
    pub model: ModelOverrides,
}

/// The model of a service, given on the command line.
#[derive(Debug, Clone, Default, PartialEq, clap::Args)]
#[command(next_help_heading = "Model")]
pub struct ModelOverrides {
    /// Backbone: dinov2-vits14, dinov2-vitb14, dinov2-vitl14 or placeformer-vits16.
    #[arg(long, value_name = "NAME")]
    pub preset: Option<Preset>,
    /// Weights file for the backbone, such as `train` writes; its published ones are pulled on
    /// first use otherwise.
    #[arg(long, env = "PLACEFORMER_WEIGHTS", value_name = "FILE")]
    pub weights: Option<PathBuf>,
    /// Difference to the weights, as `train` writes it; it is merged with them.
    #[arg(long, value_name = "FILE")]
    pub difference: Option<PathBuf>,
    /// Projection to the global descriptor: default, or a file.
    #[arg(long, value_name = "HEAD")]
    pub head: Option<HeadChoice>,
    /// Arithmetic of the transformer: f32, bf16, int8, mixed (int8 in the blocks where it shows
    /// least, bf16 in the others), or auto (mixed where the CPU has AVX-512 VNNI, else f32).
    #[arg(long, value_name = "NAME")]
    pub precision: Option<Precision>,
}

impl Overrides {
    /// The flag that sets `key`, such as `--listen` for `http.listen`, if it was given.
    pub(super) fn flag_of(&self, key: &str) -> Option<&'static str> {
        let (given, flag) = match key {
            "http.listen" => (self.listen.is_some(), "--listen"),
            "http.insecure" => (self.insecure, "--insecure"),
            "data.directory" => (self.data.is_some(), "--data"),
            "log.format" => (self.log_format.is_some(), "--log-format"),
            "log.filter" => (self.log.is_some(), "--log"),
            "extract.preset" => (self.model.preset.is_some(), "--preset"),
            "extract.weights" => (
                self.model.weights.is_some(),
                "--weights or PLACEFORMER_WEIGHTS",
            ),
            "extract.difference" => (self.model.difference.is_some(), "--difference"),
            "extract.head" => (self.model.head.is_some(), "--head"),
            "extract.precision" => (self.model.precision.is_some(), "--precision"),
            _ => return None,
        };
        given.then_some(flag)
    }
}
