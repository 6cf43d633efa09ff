//! From a normalised image to its descriptor: transformer, global descriptor, fusion, selection
//! (paper III-A to III-C).
//!
//! ```text
//! ImageTensor --encoder--> tokens [n, d], CLS attention [heads, n]
//!     tokens    --aggregate--> pooled [d] --head--> global [256]
//!     attention --fusion--> attention per scale --selection--> key patches, averaged from tokens
//! ```
//!
//! [`Extractor`] puts it together from an [`ExtractConfig`], a weights file and a [`Head`]. The
//! transformer is behind the trait [`Encoder`]: [`FusedEncoder`] computes it for the service, and
//! [`CandleEncoder`] is the plain implementation that the other is compared with.
//!
//! Imports between the modules go one way:
//!
//! ```text
//! extractor -> model_id, selection, trace, fused -> vit -> weights, positions, encoder
//! model_id, pca -> head -> aggregate -> netvlad -> vlad -> global
//! pca, netvlad -> components
//! config -> weights, encoder -> preset
//! all of them -> error
//! ```

mod activation;
mod aggregate;
mod components;
mod config;
mod encoder;
mod error;
mod extractor;
mod fused;
mod fusion;
mod global;
mod head;
mod model_id;
mod netvlad;
mod packing;
mod pca;
mod positions;
mod preset;
mod record;
mod selection;
mod tensor_file;
mod trace;
mod vit;
mod vlad;
mod weights;

pub use activation::gelu;
pub use aggregate::Aggregate;
pub use components::Covariance;
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
pub use netvlad::{NetVlad, NetVladParameters, NetVladShape};
pub use packing::pack;
pub use pca::{Whitening, whitened_head, whitened_head_of_few};
pub use positions::interpolate as interpolate_positions;
pub use preset::{Geometry, LAYER_NORM_EPS, Preset};
pub use record::{Record, verify as verify_weights};
pub use selection::{key_patches, select};
pub use trace::{ExtractionTrace, TraceArray, TraceValues};
pub use vit::CandleEncoder;
pub use vlad::{VladWords, sample_tokens};
pub use weights::{BlockWeights, Difference, Factors, Linear, Merged, Norm, VitWeights};
