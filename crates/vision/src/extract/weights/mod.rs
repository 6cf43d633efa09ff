//! Weights of a vision transformer as plain slices, read from safetensors files.
//!
//! Published files name the same tensors in different ways, and a file that lacks one or has one of
//! another shape must not be loaded in part. Two families of names are understood, each with or
//! without a common prefix such as `backbone.`: that of Hugging Face
//! (`encoder.layer.0.attention.attention.query.weight`), and the one that timm, DINO and DINOv2
//! share, in which query, key and value are fused (`blocks.0.attn.qkv.weight`). Both end up in the
//! fused form. The content hash covers that form, so equal weights have one identity, however they
//! were named and stored.
//!
//! `vit_weights` holds the weights, their names and their hash; `read` takes them out of a file;
//! `difference` is what training changes of them.

mod difference;
mod read;
#[cfg(test)]
mod tests;
mod vit_weights;

pub use difference::{Difference, Factors, Merged};
pub use vit_weights::{BlockWeights, Linear, Norm, VitWeights};
