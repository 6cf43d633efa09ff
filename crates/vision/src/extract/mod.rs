//! A normalised image to its descriptor: transformer, global descriptor, fusion, selection (paper
//! III-A to III-C).
//!
//! ```text
//! ImageTensor --encoder--> tokens [n, d], CLS attention [heads, n]
//!     tokens    --aggregate--> pooled [d] --head--> global [256]
//!     attention --fusion--> per scale --selection--> key patches, fused from tokens
//! ```
//!
//! [`Extractor`] puts it together from [`ExtractConfig`], a weights file and a [`Head`]; [`pull`]
//! obtains the weights. [`Encoder`] is the seam between them and the transformer: [`FusedEncoder`]
//! computes it for the service, [`CandleEncoder`] is the plain implementation it is tested against.

mod activation;
mod aggregate;
mod config;
mod encoder;
mod error;
mod extractor;
mod fused;
mod fusion;
mod global;
mod head;
mod model_id;
mod packing;
mod pca;
mod positions;
mod preset;
mod record;
mod selection;
mod trace;
mod vit;
mod weights;

pub use aggregate::{Aggregate, VladWords, sample_tokens};
pub use config::{ExtractConfig, HeadChoice};
pub use encoder::{
    EncodedImage, Encoder, EncoderSpec, Precision, TokenGrid, check_image, token_grid,
};
pub use error::ExtractError;
pub use extractor::{Extractor, build_encoder};
pub use fused::{FusedEncoder, mixed_int8_blocks};
pub use fusion::{attention_map, average_pool};
pub use global::{l2_normalise, mean_token, squared_distance};
pub use head::Head;
pub use packing::pack;
pub use pca::{Covariance, half_whitened_head_of_few};
pub use positions::interpolate as interpolate_positions;
pub use preset::{Geometry, LAYER_NORM_EPS, Preset};
pub use record::{Record, verify as verify_weights};
pub use selection::{key_patches, select};
pub use trace::{ExtractionTrace, TraceArray, TraceValues};
pub use vit::CandleEncoder;
pub use weights::{BlockWeights, Linear, Norm, VitWeights};
