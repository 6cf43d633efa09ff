//! The transformer without intermediate tensors: what the service runs.
//!
//! The tokens of an image are cut into chunks of a few dozen rows. After the queries, keys and values of a block exist,
//! a chunk needs no other chunk until the next block: one task takes it through attention, projection, LayerNorm, MLP,
//! LayerNorm and the next block's projections, each product finished (bias, GELU, residual) while it is in the
//! first-level cache. So a block of the transformer is one parallel loop over the chunks of all images, and scores and
//! hidden activations never reach memory.
//!
//! No sum depends on how chunks are spread over threads or on other images, so a batch gives bit for bit what single
//! images give. Buffers are kept between calls; in the steady state only the answer is allocated.

mod chunk;
#[cfg(test)]
mod tests;
mod weights;

use super::encoder::{EncodedImage, Encoder, EncoderSpec, TokenGrid, check_image, token_grid};
use super::error::ExtractError;
use super::positions::interpolate;
use super::preset::{Geometry, LAYER_NORM_EPS};
use super::weights::{Norm, VitWeights};
use crate::kernels::Simd;
use crate::kernels::aligned::AlignedBuffer;
use crate::kernels::attention::{AttentionShape, chunk_rows, first_row_attention};
use crate::kernels::elementwise::normalize_rows;
use crate::kernels::gemm::{Rows, Tiling};
use crate::types::{ImageTensor, InvalidValue};
use chunk::{Chunk, ChunkPlan, Scratch};
use rayon::prelude::*;
use std::sync::{Mutex, PoisonError};
use weights::{PackedBlock, PackedLinear};

/// Buffers of one call, for all images of a batch.
#[derive(Default)]
struct Workspace {
    tokens: AlignedBuffer<f32>,
    queries: AlignedBuffer<f32>,
    keys: AlignedBuffer<f32>,
    values: AlignedBuffer<f32>,
    next_keys: AlignedBuffer<f32>,
    next_values: AlignedBuffer<f32>,
}

/// Things to be used again, by whoever comes next.
struct Pool<T>(Mutex<Vec<T>>);

impl<T: Default> Pool<T> {
    fn with<R>(&self, use_it: impl FnOnce(&mut T) -> R) -> R {
        // What a panicking user left is still a valid buffer, and it is not returned anyway.
        let mut item = self.0.lock().unwrap_or_else(PoisonError::into_inner).pop().unwrap_or_default();
        let result = use_it(&mut item);
        self.0.lock().unwrap_or_else(PoisonError::into_inner).push(item);
        result
    }
}

/// The fused encoder at f32.
pub struct FusedEncoder {
    spec: EncoderSpec,
    geometry: Geometry,
    grid: TokenGrid,
    plan: ChunkPlan,
    embedding: PackedLinear,
    /// Positions at the input's grid, `[1 + n, dim]`; the first row has the CLS token added.
    positions: Vec<f32>,
    blocks: Vec<PackedBlock>,
    norm: Norm,
    workspaces: Pool<Workspace>,
    scratches: Pool<Scratch>,
}

impl FusedEncoder {
    /// Packs the weights of the blocks that `spec` needs, for the kernels of `simd`.
    ///
    /// # Errors
    /// The spec names a block or size the geometry lacks, or heads are too narrow for the kernels.
    pub fn new(weights: &VitWeights, spec: EncoderSpec, simd: Simd) -> Result<Self, ExtractError> {
        let geometry = weights.geometry;
        let (patch, size) = (geometry.patch, spec.input_size);
        if spec.blocks() > weights.blocks.len() {
            let reason = format!("block {} was asked for, there are {}", spec.blocks() - 1, weights.blocks.len());
            return Err(InvalidValue::new("exit_block", reason).into());
        }
        let whole = |side: u32| side > 0 && (side as usize).is_multiple_of(patch);
        if !whole(size.width) || !whole(size.height) {
            return Err(
                InvalidValue::new("input_size", format!("{size} is not whole patches of {patch} pixels")).into()
            );
        }
        let columns = Tiling::of(simd).columns;
        if !geometry.head_dim().is_multiple_of(columns) {
            let reason = format!(
                "heads {} wide cannot be computed at level {}, which takes multiples of {columns}",
                geometry.head_dim(),
                simd.level()
            );
            return Err(InvalidValue::new("heads", reason).into());
        }
        let grid = token_grid(&geometry, &spec);
        let mut positions =
            interpolate(&weights.positions, geometry.dim, weights.position_grid, (grid.rows, grid.columns));
        positions.iter_mut().zip(&weights.cls_token).for_each(|(position, cls)| *position += cls);
        // The embedding adds its bias to every row, the CLS row too.
        positions.iter_mut().zip(&weights.patch_embed.bias).for_each(|(position, bias)| *position -= bias);
        let shape = AttentionShape {
            tokens: 1 + grid.len(),
            heads: geometry.heads,
            head_dim: geometry.head_dim(),
            chunk_rows: chunk_rows(simd),
        };
        let pack = |block| PackedBlock::pack(simd, block, geometry.dim, geometry.head_dim());
        Ok(Self {
            spec,
            geometry,
            grid,
            plan: ChunkPlan { simd, shape, dim: geometry.dim, patch_len: 3 * patch * patch },
            embedding: PackedLinear::plain(simd, &weights.patch_embed),
            positions,
            blocks: weights.blocks[..spec.blocks()].iter().map(pack).collect(),
            norm: weights.norm.clone(),
            workspaces: Pool(Mutex::default()),
            scratches: Pool(Mutex::default()),
        })
    }

    /// Runs `task(image, chunk, keys, values, scratch)` for every chunk of every image, where `keys` and `values` are
    /// the image's of the current block, and then makes what the chunks wrote the current ones.
    fn each_chunk(
        &self,
        images: usize,
        work: &mut Workspace,
        task: impl Fn(usize, &mut Chunk<'_>, (&[f32], &[f32]), &mut Scratch) + Sync,
    ) {
        let shape = &self.plan.shape;
        let (rows_len, chunk_len, chunks) = (shape.chunk_rows * self.plan.dim, shape.chunk_len(), shape.chunks());
        let Workspace { tokens, queries, keys, values, next_keys, next_values } = work;
        for buffer in [&mut *tokens, queries] {
            buffer.resize(images * chunks * rows_len);
        }
        for buffer in [&mut *keys, values, next_keys, next_values] {
            buffer.resize(images * chunks * chunk_len);
        }
        let (image_keys, image_values): (&[f32], &[f32]) = (keys, values);
        tokens
            .par_chunks_exact_mut(rows_len)
            .zip(queries.par_chunks_exact_mut(rows_len))
            .zip(next_keys.par_chunks_exact_mut(chunk_len))
            .zip(next_values.par_chunks_exact_mut(chunk_len))
            .enumerate()
            .with_max_len(1)
            .for_each(|(at, (((tokens, queries), keys), values))| {
                let (image, index) = (at / chunks, at % chunks);
                let places = image * chunks * chunk_len..(image + 1) * chunks * chunk_len;
                let current = (&image_keys[places.clone()], &image_values[places]);
                let mut chunk = Chunk { index, tokens, queries, keys, values };
                self.scratches.with(|scratch| task(image, &mut chunk, current, scratch));
            });
        std::mem::swap(keys, next_keys);
        std::mem::swap(values, next_values);
    }

    /// Tokens and CLS attention of every image.
    fn run(&self, images: &[ImageTensor], work: &mut Workspace) -> Vec<EncodedImage> {
        let (plan, side) = (&self.plan, self.geometry.patch);
        let mut encoded: Vec<_> = images.iter().map(|_| self.blank()).collect();
        self.each_chunk(images.len(), work, |image, chunk, _, scratch| {
            let image = &images[image];
            plan.embed(
                chunk,
                (&image.data, image.size.width as usize, side),
                &self.positions,
                &self.embedding,
                scratch,
            );
            plan.project(chunk, &self.blocks[0], scratch);
        });
        for (index, block) in self.blocks.iter().enumerate() {
            if index == self.spec.attention_block {
                encoded.iter_mut().enumerate().for_each(|(image, out)| self.read_attention(image, work, out));
            }
            if index == self.blocks.len() - 1 && index > self.spec.exit_block {
                break;
            }
            self.each_chunk(images.len(), work, |_, chunk, key_values, scratch| {
                plan.transform(chunk, key_values, block, scratch);
                if let Some(next) = self.blocks.get(index + 1) {
                    plan.project(chunk, next, scratch);
                }
            });
            if index == self.spec.exit_block {
                encoded.iter_mut().enumerate().for_each(|(image, out)| self.read_tokens(image, work, out));
            }
        }
        encoded
    }

    fn blank(&self) -> EncodedImage {
        let (dim, heads) = (self.geometry.dim, self.geometry.heads);
        EncodedImage {
            grid: self.grid,
            dim,
            heads,
            tokens: Vec::new(),
            cls_token: Vec::new(),
            cls_attention: Vec::with_capacity(heads * self.grid.len()),
        }
    }

    fn read_tokens(&self, image: usize, work: &Workspace, out: &mut EncodedImage) {
        let dim = self.geometry.dim;
        let padded = self.plan.shape.chunks() * self.plan.shape.chunk_rows * dim;
        let (cls, patches) = work.tokens[image * padded..][..(1 + self.grid.len()) * dim].split_at(dim);
        (out.cls_token, out.tokens) = if self.spec.token_norm {
            (self.final_norm(cls), self.final_norm(patches))
        } else {
            (cls.to_vec(), patches.to_vec())
        };
    }

    fn final_norm(&self, rows: &[f32]) -> Vec<f32> {
        let mut out = vec![0.0; rows.len()];
        normalize_rows(self.plan.simd, self.geometry.dim, LAYER_NORM_EPS, rows, &mut out);
        for row in out.chunks_exact_mut(self.geometry.dim) {
            for ((value, scale), shift) in row.iter_mut().zip(&self.norm.weight).zip(&self.norm.bias) {
                *value = *value * scale + shift;
            }
        }
        out
    }

    fn read_attention(&self, image: usize, work: &mut Workspace, out: &mut EncodedImage) {
        let (simd, shape, dim) = (self.plan.simd, &self.plan.shape, self.geometry.dim);
        let (rows, keys) = (shape.chunks() * shape.chunk_rows * dim, shape.chunks() * shape.chunk_len());
        let queries = &work.queries[image * rows..(image + 1) * rows];
        let keys = &work.keys[image * keys..(image + 1) * keys];
        // Next keys are written only by the chunks of the next loop: until then there is room for one row of weights.
        let (scratch, row) = (&mut *work.next_keys, &mut work.next_values[..shape.tokens]);
        for head in 0..shape.heads {
            let left = Rows { data: &queries[head * shape.head_dim..], stride: dim };
            first_row_attention(simd, shape, head, left, keys, scratch, row);
            out.cls_attention.extend_from_slice(&row[1..]);
        }
    }
}

impl Encoder for FusedEncoder {
    fn spec(&self) -> &EncoderSpec {
        &self.spec
    }

    fn name(&self) -> String {
        format!("fused-f32-{}", self.plan.simd.level())
    }

    fn weight_bytes(&self) -> usize {
        self.blocks.iter().map(PackedBlock::bytes).sum::<usize>()
            + self.embedding.bytes()
            + size_of_val(self.positions.as_slice())
    }

    fn encode(&self, images: &[ImageTensor]) -> Result<Vec<EncodedImage>, ExtractError> {
        images.iter().try_for_each(|image| check_image(image, &self.spec))?;
        if images.is_empty() {
            return Ok(Vec::new());
        }
        let encoded = self.workspaces.with(|work| self.run(images, work));
        let finite = |values: &[f32]| values.iter().all(|value| value.is_finite());
        if !encoded
            .iter()
            .all(|image| finite(&image.tokens) && finite(&image.cls_token) && finite(&image.cls_attention))
        {
            return Err(ExtractError::NotFinite);
        }
        Ok(encoded)
    }
}
