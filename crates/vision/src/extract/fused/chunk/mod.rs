//! What one thread does with one chunk of tokens.
//!
//! A chunk passes through a block of the transformer in one go, so that it stays in the cache of
//! its thread: `embed` makes tokens of patches, `block` takes them through attention and the MLP,
//! and `project` computes the queries, keys and values that the next block reads. All of them are
//! methods of [`ChunkPlan`], which also has the loop over the panels of a weight matrix.

mod block;
mod embed;
mod plan;
mod project;

pub(super) use embed::PatchSource;
pub(super) use plan::{Chunk, ChunkPlan, ChunkScratch, HIDDEN_SLICE, KeyValues};
