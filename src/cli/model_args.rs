//! Flags that choose the model and its settings, for the subcommands that run it themselves.

use anyhow::anyhow;
use placeformer_core::types::{ImageSize, PoolingStride, SCALES};
use placeformer_vision::extract::{ExtractConfig, HeadChoice, Precision, Preset};
use std::path::PathBuf;

/// The model and what it computes. What is left out is the preset's own.
#[derive(Debug, Clone, clap::Args)]
#[command(next_help_heading = "Model")]
pub struct ModelOptions {
    /// Backbone: dinov2-vits14, dinov2-vitb14, dinov2-vitl14 or placeformer-vits16.
    #[arg(long, value_name = "NAME", default_value_t)]
    pub preset: Preset,
    /// Weights file; the preset's own are pulled on first use otherwise.
    #[arg(long, env = "PLACEFORMER_WEIGHTS", value_name = "FILE")]
    pub weights: Option<PathBuf>,
    /// Difference to the weights, as `train` writes it; it is merged with them.
    #[arg(long, value_name = "FILE")]
    pub difference: Option<PathBuf>,
    /// Projection to the global descriptor: default, none, or a file.
    #[arg(long, value_name = "HEAD", default_value_t)]
    pub head: HeadChoice,
    /// Size images are squashed to, such as 448x336.
    #[arg(long, value_name = "WxH")]
    pub input_size: Option<ImageSize>,
    /// 0-based block whose tokens and attention are used.
    #[arg(long, value_name = "BLOCK")]
    pub exit_block: Option<usize>,
    /// Whether tokens pass the final LayerNorm: true or false.
    #[arg(long, value_name = "BOOL")]
    pub token_norm: Option<bool>,
    /// 0-based block whose CLS attention ranks patches; the exit block unless set.
    #[arg(long, value_name = "BLOCK")]
    pub attention_block: Option<usize>,
    /// Attention heads, where weights were trained with another count than the preset's.
    #[arg(long, value_name = "N")]
    pub heads: Option<usize>,
    /// Key patches must exceed this multiple of the uniform attention.
    #[arg(long)]
    pub tau: Option<f32>,
    /// Most key patches at the three scales, such as 400,200,50.
    #[arg(long, value_name = "N,N,N", value_delimiter = ',', num_args = 1)]
    pub caps: Option<Vec<usize>>,
    /// Distance between fused windows: kernel or one.
    #[arg(long, value_parser = parse_stride)]
    pub stride: Option<PoolingStride>,
    /// Arithmetic of the transformer: f32, bf16, int8, mixed (int8 in the blocks where it shows
    /// least, bf16 in the others), or auto (mixed where the CPU has AVX-512 VNNI, else f32).
    #[arg(long, value_name = "NAME")]
    pub precision: Option<Precision>,
}

fn parse_stride(text: &str) -> Result<PoolingStride, String> {
    serde_json::from_value(text.to_lowercase().into()).map_err(|_| "use kernel or one".to_owned())
}

impl ModelOptions {
    /// The settings, checked.
    ///
    /// # Errors
    /// A setting does not fit the preset.
    pub fn extract_config(&self) -> anyhow::Result<ExtractConfig> {
        let mut config = ExtractConfig {
            preset: self.preset,
            weights: self.weights.clone(),
            difference: self.difference.clone(),
            head: self.head.clone(),
            input_size: self.input_size,
            exit_block: self.exit_block,
            token_norm: self.token_norm,
            attention_block: self.attention_block,
            heads: self.heads,
            ..Default::default()
        };
        if let Some(caps) = &self.caps {
            config.caps = <[usize; SCALES]>::try_from(caps.as_slice())
                .map_err(|_| anyhow!("--caps needs three numbers, such as 400,200,50"))?;
        }
        config.tau = self.tau.unwrap_or(config.tau);
        config.stride = self.stride.unwrap_or(config.stride);
        config.precision = self.precision.unwrap_or(config.precision);
        config.encoder_spec()?;
        Ok(config)
    }
}
