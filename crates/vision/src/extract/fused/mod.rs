//! The transformer as the service runs it: without intermediate tensors in memory.
//!
//! A plain implementation writes the result of every operation to memory and reads it back for the
//! next one. At this model's size that traffic costs more time than the arithmetic. Here the tokens
//! of an image are cut into chunks of some dozens of rows (a few hundred where the CPU has matrix
//! registers). Once the queries, keys and values of a block exist, a chunk needs nothing of the
//! other chunks until the next block. So one task takes a chunk through attention, projection,
//! LayerNorm, MLP, and the query, key and value projections of the next block, and finishes each
//! product (bias, GELU, residual) while it is in the first-level cache. A block of the transformer
//! is then one parallel loop over the chunks of all images, and neither attention scores nor hidden
//! activations ever reach memory.
//!
//! Linear layers are multiplied in f32, bf16 or int8; the format may differ from block to block.
//! Below f32, the scores of attention are computed in int8 (in bf16 with matrix registers), and the
//! weighted sum of the values in bf16 (in f32 where the CPU lacks bf16). Everything between the
//! products is f32.
//!
//! No sum depends on how chunks are spread over threads or on the other images of a batch, so a
//! batch gives bit for bit what single images give. Buffers are kept between calls, so that a
//! running service allocates only its answers.
//!
//! | module | holds |
//! |---|---|
//! | `encoder` | [`FusedEncoder`]: the order of the blocks, and reading the results |
//! | `workspace`, `pool` | the buffers of a call, and the parallel loop over chunks |
//! | `chunk` | what one thread does with one chunk |
//! | `weights` | the weights, packed as the kernels read them |
//! | `formats` | which number format each product uses |
//! | `smoothing`, `street` | per-channel scales for int8, and the picture they are measured on |
//! | `operation` | the encoder as one operation of candle |

mod chunk;
mod encoder;
mod formats;
mod operation;
mod pool;
mod smoothing;
mod street;
#[cfg(test)]
mod tests;
mod weights;
mod workspace;

pub use encoder::FusedEncoder;
pub use formats::mixed_int8_blocks;
