//! The buffers of one call of the encoder, and the parallel loop over the chunks in them.

use super::chunk::{Chunk, ChunkPlan, ChunkScratch, KeyValues};
use super::pool::BufferPool;
use placeformer_kernels::aligned::AlignedBuffer;
use placeformer_kernels::gemm::MatrixUnitGuard;
use rayon::prelude::*;

/// Tokens, queries, keys and values of all images of a batch: image by image, and within an image
/// chunk by chunk.
///
/// While a block reads the keys and values of all chunks, the chunks already write those of the
/// next block. That is why both exist twice.
#[derive(Default)]
pub(super) struct Workspace {
    pub tokens: AlignedBuffer<f32>,
    pub queries: AlignedBuffer<u32>,
    pub keys: AlignedBuffer<u32>,
    pub values: AlignedBuffer<u32>,
    next_keys: AlignedBuffer<u32>,
    next_values: AlignedBuffer<u32>,
    /// Attention scores of the CLS query, where only its attention is asked for.
    pub scores: AlignedBuffer<f32>,
}

impl Workspace {
    /// Runs `task(image, chunk, key_values, scratch)` for every chunk of every image in parallel.
    ///
    /// `key_values` are those of the task's image for the current block. After the loop the keys
    /// and values that the tasks wrote become the current ones.
    pub fn for_each_chunk(
        &mut self,
        plan: &ChunkPlan,
        images: usize,
        scratches: &BufferPool<ChunkScratch>,
        task: impl Fn(usize, &mut Chunk<'_>, KeyValues<'_>, &mut ChunkScratch) + Sync,
    ) {
        self.resize(plan, images);
        let chunks = plan.shape.chunks();
        let keys_len = plan.shape.keys_len();
        let values_len = plan.shape.values_len();
        let all_keys: &[u32] = &self.keys;
        let all_values: &[u32] = &self.values;

        self.tokens
            .par_chunks_exact_mut(plan.tokens_len())
            .zip(self.queries.par_chunks_exact_mut(plan.shape.queries_len()))
            .zip(self.next_keys.par_chunks_exact_mut(keys_len))
            .zip(self.next_values.par_chunks_exact_mut(values_len))
            .enumerate()
            .with_max_len(1)
            .for_each(|(number, (((tokens, queries), keys), values))| {
                let image = number / chunks;
                let of_image = |len: usize| image * chunks * len..(image + 1) * chunks * len;
                let current = KeyValues {
                    keys: &all_keys[of_image(keys_len)],
                    values: &all_values[of_image(values_len)],
                };
                let mut chunk = Chunk {
                    index: number % chunks,
                    tokens,
                    queries,
                    keys,
                    values,
                };
                let _ready = MatrixUnitGuard::new(plan.simd);
                scratches.with(|scratch| task(image, &mut chunk, current, scratch));
            });

        std::mem::swap(&mut self.keys, &mut self.next_keys);
        std::mem::swap(&mut self.values, &mut self.next_values);
    }

    fn resize(&mut self, plan: &ChunkPlan, images: usize) {
        let chunks = images * plan.shape.chunks();
        let keys_len = plan.shape.keys_len();
        let values_len = plan.shape.values_len();
        self.tokens.resize(chunks * plan.tokens_len());
        self.queries.resize(chunks * plan.shape.queries_len());
        self.keys.resize(chunks * keys_len);
        self.next_keys.resize(chunks * keys_len);
        self.values.resize(chunks * values_len);
        self.next_values.resize(chunks * values_len);
    }
}
