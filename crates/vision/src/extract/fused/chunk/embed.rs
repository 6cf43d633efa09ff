//! Patch embedding: pixels to tokens.

use super::plan::{Chunk, ChunkPlan, ChunkScratch, RowOperand};
use crate::extract::fused::weights::PackedLinear;
use placeformer_kernels::elementwise::{Epilogue, finish_block};

/// An image to be cut into patches.
#[derive(Debug, Clone, Copy)]
pub(crate) struct PatchSource<'a> {
    /// Pixels, `[3, height, width]`.
    pub pixels: &'a [f32],
    /// Width of the image in pixels.
    pub width: usize,
    /// Side of a patch in pixels.
    pub side: usize,
}

impl PatchSource<'_> {
    /// Copies the pixels of patch `number` (row-major) to `out`: channel, row, column.
    fn copy_patch(&self, number: usize, out: &mut [f32]) {
        let side = self.side;
        let plane = self.pixels.len() / 3;
        let patches_per_row = self.width / side;
        let top = number / patches_per_row * side;
        let left = number % patches_per_row * side;
        for (line, out) in out.chunks_exact_mut(side).enumerate() {
            let channel = line / side;
            let row = top + line % side;
            let start = channel * plane + row * self.width + left;
            out.copy_from_slice(&self.pixels[start..start + side]);
        }
    }
}

impl ChunkPlan {
    /// Embeds the patches of the chunk and adds them to `positions` (`[tokens, dim]`, CLS token
    /// included and the embedding's bias taken off the CLS row).
    pub fn embed(
        &self,
        chunk: &mut Chunk<'_>,
        source: PatchSource<'_>,
        positions: &[f32],
        embedding: &PackedLinear,
        scratch: &mut ChunkScratch,
    ) {
        let rows = self.padded_rows(chunk.index);
        let first_token = chunk.index * self.shape.chunk_rows;
        scratch
            .hidden
            .resize(self.shape.chunk_rows * self.patch_len);
        let patches = scratch.hidden.chunks_exact_mut(self.patch_len).take(rows);
        for (token, patch) in (first_token..).zip(patches) {
            // Token 0 is the CLS token, and rows beyond the last token are padding.
            if token == 0 || token >= self.shape.tokens {
                patch.fill(0.0);
            } else {
                source.copy_patch(token - 1, patch);
            }
        }

        let filled = self.filled_rows(chunk.index) * self.dim;
        chunk.tokens[..filled].copy_from_slice(&positions[first_token * self.dim..][..filled]);
        chunk.tokens[filled..].fill(0.0);

        let left = scratch.packed.pack(
            self.simd,
            embedding.weight.format(),
            rows,
            self.patch_len,
            (&scratch.hidden, self.patch_len),
        );
        let patches = RowOperand { rows, left };
        let sums = &mut scratch.sums;
        self.multiply(patches, embedding, sums, |panel, first_row, product| {
            let start = first_row * self.dim + panel * self.panel_columns();
            let out = &mut chunk.tokens[start..];
            finish_block(self.simd, Epilogue::BiasResidual, product, out, self.dim);
        });
    }
}
