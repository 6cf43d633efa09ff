//! The transformer without intermediate tensors: what the service runs.
//!
//! The tokens of an image are cut into chunks of some dozens of rows, or a few hundred where there
//! are matrix registers. After the queries, keys and values of a block exist, a chunk needs no
//! other chunk until the next block: one task takes it through attention, projection, LayerNorm,
//! MLP, LayerNorm and the next block's projections, each product finished (bias, GELU, residual)
//! while it is in the first-level cache. So a block of the transformer is one parallel loop over
//! the chunks of all images, and scores and hidden activations never reach memory.
//!
//! Products are in f32, or layers in bf16 or int8, which may differ from block to block, and then
//! the scores of attention in int8 (bf16 in matrix registers) and its mix of values in bf16 (f32
//! where the CPU lacks it); everything between them is f32.
//!
//! No sum depends on how chunks are spread over threads or on other images, so a batch gives bit
//! for bit what single images give. Buffers are kept between calls; in the steady state only the
//! answer is allocated.

mod chunk;
mod operation;
mod spread;
#[cfg(test)]
mod tests;
mod weights;

use super::encoder::{
    EncodedImage, Encoder, EncoderSpec, Precision, TokenGrid, check_image, token_grid,
};
use super::error::ExtractError;
use super::positions::interpolate;
use super::preset::{Geometry, LAYER_NORM_EPS};
use super::weights::{Norm, VitWeights};
use chunk::{Chunk, ChunkPlan, HIDDEN_SLICE, Scratch};
use placeformer_core::types::{ImageTensor, InvalidValue};
use placeformer_kernels::aligned::AlignedBuffer;
use placeformer_kernels::attention::{AttentionShape, chunk_rows, first_row_attention};
use placeformer_kernels::elementwise::normalize_rows;
use placeformer_kernels::gemm::{MatrixUnitGuard, Tiling};
use placeformer_kernels::operand::Format;
use placeformer_kernels::{Simd, SimdLevel};
use rayon::prelude::*;
use std::ops::Range;
use std::sync::{Mutex, PoisonError};
use weights::{PackedBlock, PackedLinear};

/// Buffers of one call, for all images of a batch.
#[derive(Default)]
struct Workspace {
    tokens: AlignedBuffer<f32>,
    queries: AlignedBuffer<u32>,
    keys: AlignedBuffer<u32>,
    values: AlignedBuffer<u32>,
    next_keys: AlignedBuffer<u32>,
    next_values: AlignedBuffer<u32>,
    /// Scores of a few query rows, where only the CLS row's are wanted.
    scores: AlignedBuffer<f32>,
}

/// Things to be used again, by whoever comes next.
struct Pool<T>(Mutex<Vec<T>>);

impl<T: Default> Pool<T> {
    fn with<R>(&self, use_it: impl FnOnce(&mut T) -> R) -> R {
        // What a panicking user left is still a valid buffer, and it is not returned anyway.
        let mut item = self
            .0
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .pop()
            .unwrap_or_default();
        let result = use_it(&mut item);
        self.0
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .push(item);
        result
    }
}

/// The fused encoder.
pub struct FusedEncoder {
    spec: EncoderSpec,
    /// Never `Auto`.
    precision: Precision,
    geometry: Geometry,
    grid: TokenGrid,
    /// But for the chunks, which [`plan_for`](Self::plan_for) cuts for each call.
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
    /// Packs the weights of the blocks that `spec` needs, for the kernels of `simd`. The patch
    /// embedding is f32 at every precision: it is a hundredth of the work, and what it loses no
    /// later block brings back.
    ///
    /// # Errors
    /// The spec names a block or size the geometry lacks, heads are too narrow for the kernels, or
    /// the CPU lacks what the precision needs.
    pub fn new(
        weights: &VitWeights,
        spec: EncoderSpec,
        simd: Simd,
        precision: Precision,
    ) -> Result<Self, ExtractError> {
        let chosen = choose_formats(simd, precision, spec.blocks())?;
        Self::with_formats(weights, spec, simd, chosen)
    }

    fn with_formats(
        weights: &VitWeights,
        spec: EncoderSpec,
        simd: Simd,
        (precision, formats): (Precision, Formats),
    ) -> Result<Self, ExtractError> {
        let geometry = weights.geometry;
        // Tiles do nothing for f32, and vectors of it are faster without regard to them.
        let simd = if precision == Precision::F32 {
            simd.at_most(SimdLevel::Avx512)
        } else {
            simd
        };
        let (patch, size) = (geometry.patch, spec.input_size);
        if spec.blocks() > weights.blocks.len() {
            let reason = format!(
                "block {} was asked for, there are {}",
                spec.blocks() - 1,
                weights.blocks.len()
            );
            return Err(InvalidValue::new("exit_block", reason).into());
        }
        let whole = |side: u32| side > 0 && (side as usize).is_multiple_of(patch);
        if !whole(size.width) || !whole(size.height) {
            return Err(InvalidValue::new(
                "input_size",
                format!("{size} is not whole patches of {patch} pixels"),
            )
            .into());
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
        let mut positions = interpolate(
            &weights.positions,
            geometry.dim,
            weights.position_grid,
            (grid.rows, grid.columns),
        );
        positions
            .iter_mut()
            .zip(&weights.cls_token)
            .for_each(|(position, cls)| *position += cls);
        // The embedding adds its bias to every row, the CLS row too.
        positions
            .iter_mut()
            .zip(&weights.patch_embed.bias)
            .for_each(|(position, bias)| *position -= bias);
        let shape = AttentionShape {
            scores: formats.scores,
            mix: formats.mix,
            tokens: 1 + grid.len(),
            heads: geometry.heads,
            head_dim: geometry.head_dim(),
            chunk_rows: chunk_rows(simd, 1 + grid.len(), 1, 1),
        };
        let dims = (geometry.dim, geometry.head_dim());
        let spreads = spread::measure(weights, formats.int8_blocks.end)?;
        let pack = |(index, block)| {
            let spread = formats
                .int8_blocks
                .contains(&index)
                .then(|| &spreads[index]);
            let format = if spread.is_some() {
                Format::Int8
            } else {
                formats.others
            };
            PackedBlock::pack((simd, format), block, dims, HIDDEN_SLICE, spread)
        };
        Ok(Self {
            spec,
            precision,
            geometry,
            grid,
            plan: ChunkPlan {
                simd,
                shape,
                dim: geometry.dim,
                patch_len: 3 * patch * patch,
            },
            embedding: PackedLinear::plain(simd, &weights.patch_embed),
            positions,
            blocks: weights.blocks[..spec.blocks()]
                .par_iter()
                .enumerate()
                .map(pack)
                .collect(),
            norm: weights.norm.clone(),
            workspaces: Pool(Mutex::default()),
            scratches: Pool(Mutex::default()),
        })
    }

    /// How so many images are cut into chunks for the threads at hand.
    fn plan_for(&self, images: usize) -> ChunkPlan {
        let ChunkPlan { simd, shape, .. } = self.plan;
        let chunk_rows = chunk_rows(simd, shape.tokens, images, rayon::current_num_threads());
        ChunkPlan {
            shape: AttentionShape {
                chunk_rows,
                ..shape
            },
            ..self.plan
        }
    }

    /// Runs `task(image, chunk, keys, values, scratch)` for every chunk of every image, where
    /// `keys` and `values` are the image's of the current block, and then makes what the chunks
    /// wrote the current ones.
    fn each_chunk(
        &self,
        plan: &ChunkPlan,
        images: usize,
        work: &mut Workspace,
        task: impl Fn(usize, &mut Chunk<'_>, (&[u32], &[u32]), &mut Scratch) + Sync,
    ) {
        let shape = &plan.shape;
        let (rows_len, chunks) = (shape.chunk_rows * plan.dim, shape.chunks());
        let (keys_len, values_len) = (shape.keys_len(), shape.values_len());
        let queries_len = shape.queries_len();
        let Workspace {
            tokens,
            queries,
            keys,
            values,
            next_keys,
            next_values,
            ..
        } = work;
        tokens.resize(images * chunks * rows_len);
        queries.resize(images * chunks * queries_len);
        for (buffer, len) in [
            (&mut *keys, keys_len),
            (&mut *next_keys, keys_len),
            (&mut *values, values_len),
            (&mut *next_values, values_len),
        ] {
            buffer.resize(images * chunks * len);
        }
        let (image_keys, image_values): (&[u32], &[u32]) = (keys, values);
        tokens
            .par_chunks_exact_mut(rows_len)
            .zip(queries.par_chunks_exact_mut(queries_len))
            .zip(next_keys.par_chunks_exact_mut(keys_len))
            .zip(next_values.par_chunks_exact_mut(values_len))
            .enumerate()
            .with_max_len(1)
            .for_each(|(at, (((tokens, queries), keys), values))| {
                let (image, index) = (at / chunks, at % chunks);
                let of = |len: usize| image * chunks * len..(image + 1) * chunks * len;
                let current = (&image_keys[of(keys_len)], &image_values[of(values_len)]);
                let mut chunk = Chunk {
                    index,
                    tokens,
                    queries,
                    keys,
                    values,
                };
                let _ready = MatrixUnitGuard::new(plan.simd);
                self.scratches
                    .with(|scratch| task(image, &mut chunk, current, scratch));
            });
        std::mem::swap(keys, next_keys);
        std::mem::swap(values, next_values);
    }

    /// Tokens and CLS attention of every image.
    fn run(&self, images: &[&[f32]], work: &mut Workspace) -> Vec<EncodedImage> {
        let (plan, side) = (&self.plan_for(images.len()), self.geometry.patch);
        let width = self.spec.input_size.width as usize;
        let mut encoded: Vec<_> = images.iter().map(|_| self.blank()).collect();
        self.each_chunk(plan, images.len(), work, |image, chunk, _, scratch| {
            plan.embed(
                chunk,
                (images[image], width, side),
                &self.positions,
                &self.embedding,
                scratch,
            );
            plan.project(chunk, &self.blocks[0], scratch);
        });
        for (index, block) in self.blocks.iter().enumerate() {
            if index == self.spec.attention_block {
                for (image, out) in encoded.iter_mut().enumerate() {
                    self.read_attention(&plan.shape, image, work, out);
                }
            }
            if index == self.blocks.len() - 1 && index > self.spec.exit_block {
                break;
            }
            self.each_chunk(plan, images.len(), work, |_, chunk, key_values, scratch| {
                plan.transform(chunk, key_values, block, scratch);
                if let Some(next) = self.blocks.get(index + 1) {
                    plan.project(chunk, next, scratch);
                }
            });
            if index == self.spec.exit_block {
                for (image, out) in encoded.iter_mut().enumerate() {
                    self.read_tokens(&plan.shape, image, work, out);
                }
            }
        }
        encoded
    }

    /// Encodes pixels `[3, height, width]` of the spec's size.
    fn encode_pixels(&self, images: &[&[f32]]) -> Result<Vec<EncodedImage>, ExtractError> {
        if images.is_empty() {
            return Ok(Vec::new());
        }
        let encoded = self.workspaces.with(|work| self.run(images, work));
        let finite = |values: &[f32]| values.iter().all(|value| value.is_finite());
        let whole = |image: &EncodedImage| {
            finite(&image.tokens) && finite(&image.cls_token) && finite(&image.cls_attention)
        };
        if encoded.iter().all(whole) {
            Ok(encoded)
        } else {
            Err(ExtractError::NotFinite)
        }
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

    fn read_tokens(
        &self,
        shape: &AttentionShape,
        image: usize,
        work: &Workspace,
        out: &mut EncodedImage,
    ) {
        let dim = self.geometry.dim;
        let padded = shape.chunks() * shape.chunk_rows * dim;
        let (cls, patches) =
            work.tokens[image * padded..][..(1 + self.grid.len()) * dim].split_at(dim);
        (out.cls_token, out.tokens) = if self.spec.token_norm {
            (self.final_norm(cls), self.final_norm(patches))
        } else {
            (cls.to_vec(), patches.to_vec())
        };
    }

    fn final_norm(&self, rows: &[f32]) -> Vec<f32> {
        let mut out = vec![0.0; rows.len()];
        normalize_rows(
            self.plan.simd,
            self.geometry.dim,
            LAYER_NORM_EPS,
            rows,
            &mut out,
        );
        for row in out.chunks_exact_mut(self.geometry.dim) {
            for ((value, scale), shift) in
                row.iter_mut().zip(&self.norm.weight).zip(&self.norm.bias)
            {
                *value = *value * scale + shift;
            }
        }
        out
    }

    fn read_attention(
        &self,
        shape: &AttentionShape,
        image: usize,
        work: &mut Workspace,
        out: &mut EncodedImage,
    ) {
        let simd = self.plan.simd;
        let queries_len = shape.chunks() * shape.queries_len();
        let keys_len = shape.chunks() * shape.keys_len();
        let queries = &work.queries[image * queries_len..(image + 1) * queries_len];
        let keys = &work.keys[image * keys_len..(image + 1) * keys_len];
        work.scores.resize(shape.scratch_len(simd) + shape.tokens);
        let (row, scratch) = work.scores.split_at_mut(shape.tokens);
        let _ready = MatrixUnitGuard::new(simd);
        for head in 0..shape.heads {
            first_row_attention(simd, shape, head, queries, keys, scratch, row);
            out.cls_attention.extend_from_slice(&row[1..]);
        }
    }
}

/// Formats of all products.
#[derive(Clone)]
struct Formats {
    /// Blocks whose layers are int8.
    int8_blocks: Range<usize>,
    /// The layers of the others.
    others: Format,
    scores: Format,
    mix: Format,
}

/// What `precision` comes to at this level in so many blocks; `Auto` is settled.
fn choose_formats(
    simd: Simd,
    precision: Precision,
    blocks: usize,
) -> Result<(Precision, Formats), ExtractError> {
    let lacks = |what: &str| {
        let reason = format!(
            "it needs a CPU with {what}, used at level avx512; this is level {}",
            simd.level()
        );
        Err(ExtractError::Precision {
            precision: precision.name(),
            reason,
        })
    };
    let (int8, bf16) = (
        Format::Int8.is_available(simd),
        Format::Bf16.is_available(simd),
    );
    let mix = if bf16 { Format::Bf16 } else { Format::F32 };
    // A head's codes lose no more of a score than bf16 does. Where matrix registers multiply bf16,
    // finishing sums of integers would take as long as it saves.
    let scores = if int8 && simd.level() < SimdLevel::Amx {
        Format::Int8
    } else {
        mix
    };
    let chosen = |int8_blocks, others| {
        Ok((
            precision,
            Formats {
                int8_blocks,
                others,
                scores,
                mix,
            },
        ))
    };
    match precision {
        // At level scalar codes are possible, but slower than floats.
        Precision::Auto if simd.level() >= SimdLevel::Avx512 => {
            choose_formats(simd, Precision::Mixed, blocks)
        }
        Precision::Auto => choose_formats(simd, Precision::F32, blocks),
        Precision::F32 => {
            let (others, scores, mix) = (Format::F32, Format::F32, Format::F32);
            Ok((
                precision,
                Formats {
                    int8_blocks: 0..0,
                    others,
                    scores,
                    mix,
                },
            ))
        }
        Precision::Bf16 if bf16 => chosen(0..0, Format::Bf16),
        Precision::Bf16 => lacks("AVX-512 BF16"),
        Precision::Mixed if int8 => chosen(mixed_int8_blocks(blocks), mix),
        Precision::Int8 if int8 => chosen(0..blocks, mix),
        Precision::Mixed | Precision::Int8 => lacks("AVX-512 VNNI"),
    }
}

/// Of so many blocks, those that [`Precision::Mixed`] computes in int8: from the second to the
/// middle. There an error costs least: the first block's inputs stray most, and what the later ones
/// lose no block evens out.
pub fn mixed_int8_blocks(blocks: usize) -> Range<usize> {
    1..blocks.div_ceil(2).max(1)
}

impl Encoder for FusedEncoder {
    fn spec(&self) -> &EncoderSpec {
        &self.spec
    }

    fn name(&self) -> String {
        format!("fused-{}-{}", self.precision, self.plan.simd.level())
    }

    fn weight_bytes(&self) -> usize {
        self.blocks.iter().map(PackedBlock::bytes).sum::<usize>()
            + self.embedding.bytes()
            + size_of_val(self.positions.as_slice())
    }

    fn encode(&self, images: &[ImageTensor]) -> Result<Vec<EncodedImage>, ExtractError> {
        images
            .iter()
            .try_for_each(|image| check_image(image, &self.spec))?;
        let pixels: Vec<&[f32]> = images.iter().map(|image| image.data.as_slice()).collect();
        self.encode_pixels(&pixels)
    }
}
