//! The fused encoder: packing the weights once, then running the blocks over all chunks.

use super::chunk::{ChunkPlan, ChunkScratch, HIDDEN_SLICE, PatchSource};
use super::formats::{Formats, choose_formats};
use super::pool::BufferPool;
use super::smoothing;
use super::weights::{PackedBlock, PackedLinear};
use super::workspace::Workspace;
use crate::extract::encoder::{
    EncodedImage, Encoder, EncoderSpec, Precision, TokenGrid, check_image, token_grid,
};
use crate::extract::error::ExtractError;
use crate::extract::positions::interpolate;
use crate::extract::preset::{Geometry, LAYER_NORM_EPS};
use crate::extract::weights::{Norm, VitWeights};
use placeformer_core::types::{ImageTensor, InvalidValue};
use placeformer_kernels::attention::{AttentionShape, chunk_rows, first_row_attention};
use placeformer_kernels::elementwise::normalize_rows;
use placeformer_kernels::gemm::{MatrixUnitGuard, Tiling};
use placeformer_kernels::operand::Format;
use placeformer_kernels::{Simd, SimdLevel};
use rayon::prelude::*;

/// The transformer that the service runs (paper III-A), cut off after the last block that its spec
/// needs.
pub struct FusedEncoder {
    spec: EncoderSpec,
    precision: Precision,
    geometry: Geometry,
    grid: TokenGrid,
    /// What all calls have in common. Its `chunk_rows` is only a placeholder: how the tokens are
    /// cut depends on the number of images and threads, so [`Self::plan_for`] sets it for each
    /// call.
    plan: ChunkPlan,
    embedding: PackedLinear,
    /// What each token starts from before its patch is added, `[1 + n, dim]`: its position, and in
    /// the first row also the CLS token.
    positions: Vec<f32>,
    blocks: Vec<PackedBlock>,
    norm: Norm,
    workspaces: BufferPool<Workspace>,
    scratches: BufferPool<ChunkScratch>,
}

impl FusedEncoder {
    /// Packs the weights of the blocks that `spec` needs for the kernels of `simd`.
    ///
    /// The patch embedding is f32 at every precision: it is a hundredth of the work, and what
    /// rounding loses there, no later block recovers.
    ///
    /// # Errors
    /// The spec names a block or size that the geometry does not have, the heads are too narrow for
    /// the kernels, or the CPU lacks the instructions that the precision needs.
    pub fn new(
        weights: &VitWeights,
        spec: EncoderSpec,
        simd: Simd,
        precision: Precision,
    ) -> Result<Self, ExtractError> {
        let formats = choose_formats(simd, precision, spec.blocks())?;
        Self::with_formats(weights, spec, simd, formats)
    }

    /// As [`FusedEncoder::new`], with the formats already chosen.
    pub(super) fn with_formats(
        weights: &VitWeights,
        spec: EncoderSpec,
        simd: Simd,
        formats: Formats,
    ) -> Result<Self, ExtractError> {
        // Matrix registers cannot multiply f32, and vectors are faster when the layout of the data
        // does not make allowance for those registers.
        let simd = if formats.precision == Precision::F32 {
            simd.at_most(SimdLevel::Avx512)
        } else {
            simd
        };
        check_spec(weights, &spec, simd)?;

        let geometry = weights.geometry;
        let grid = token_grid(&geometry, &spec);
        let tokens = 1 + grid.len();
        let shape = AttentionShape {
            scores: formats.scores,
            mix: formats.mix,
            tokens,
            heads: geometry.heads,
            head_dim: geometry.head_dim(),
            chunk_rows: chunk_rows(simd, tokens, 1, 1),
        };
        let plan = ChunkPlan {
            simd,
            shape,
            dim: geometry.dim,
            patch_len: 3 * geometry.patch * geometry.patch,
        };
        Ok(Self {
            spec,
            precision: formats.precision,
            geometry,
            grid,
            plan,
            embedding: PackedLinear::plain(simd, &weights.patch_embed),
            positions: starting_tokens(weights, grid),
            blocks: pack_blocks(weights, spec.blocks(), simd, &formats)?,
            norm: weights.norm.clone(),
            workspaces: BufferPool::new(),
            scratches: BufferPool::new(),
        })
    }

    /// The plan of a call with this many images, on the threads of the current pool.
    fn plan_for(&self, images: usize) -> ChunkPlan {
        let threads = rayon::current_num_threads();
        let mut plan = self.plan;
        plan.shape.chunk_rows = chunk_rows(plan.simd, plan.shape.tokens, images, threads);
        plan
    }

    /// Encodes images given as pixels `[3, height, width]` of the spec's size, and calls `pause`
    /// between the blocks.
    pub(super) fn encode_pixels(
        &self,
        images: &[&[f32]],
        pause: &dyn Fn(),
    ) -> Result<Vec<EncodedImage>, ExtractError> {
        if images.is_empty() {
            return Ok(Vec::new());
        }
        let encoded = self
            .workspaces
            .with(|workspace| self.run(images, workspace, pause));
        if encoded.iter().all(is_finite) {
            Ok(encoded)
        } else {
            Err(ExtractError::NotFinite)
        }
    }

    /// Tokens and CLS attention of every image.
    fn run(
        &self,
        images: &[&[f32]],
        workspace: &mut Workspace,
        pause: &dyn Fn(),
    ) -> Vec<EncodedImage> {
        let plan = &self.plan_for(images.len());
        let mut encoded: Vec<EncodedImage> = images.iter().map(|_| self.blank()).collect();
        self.embed(plan, images, workspace);
        for (index, block) in self.blocks.iter().enumerate() {
            pause();
            if index == self.spec.attention_block {
                for (image, out) in encoded.iter_mut().enumerate() {
                    self.read_attention(&plan.shape, image, workspace, out);
                }
            }
            let is_last = index == self.blocks.len() - 1;
            if is_last && index > self.spec.exit_block {
                // Only the attention of this block was asked for.
                break;
            }
            self.run_block(
                plan,
                images.len(),
                block,
                self.blocks.get(index + 1),
                workspace,
            );
            if index == self.spec.exit_block {
                for (image, out) in encoded.iter_mut().enumerate() {
                    self.read_tokens(plan, image, workspace, out);
                }
            }
        }
        encoded
    }

    /// Embeds the patches of all images, and projects them to the queries, keys and values of the
    /// first block.
    fn embed(&self, plan: &ChunkPlan, images: &[&[f32]], workspace: &mut Workspace) {
        let width = self.spec.input_size.width as usize;
        workspace.for_each_chunk(
            plan,
            images.len(),
            &self.scratches,
            |image, chunk, _, scratch| {
                let source = PatchSource {
                    pixels: images[image],
                    width,
                    side: self.geometry.patch,
                };
                plan.embed(chunk, source, &self.positions, &self.embedding, scratch);
                plan.project(chunk, &self.blocks[0], scratch);
            },
        );
    }

    /// Runs one block, and projects to the queries, keys and values of the `next` one, if any.
    fn run_block(
        &self,
        plan: &ChunkPlan,
        images: usize,
        block: &PackedBlock,
        next: Option<&PackedBlock>,
        workspace: &mut Workspace,
    ) {
        workspace.for_each_chunk(
            plan,
            images,
            &self.scratches,
            |_, chunk, key_values, scratch| {
                plan.transform(chunk, key_values, block, scratch);
                if let Some(next) = next {
                    plan.project(chunk, next, scratch);
                }
            },
        );
    }

    fn blank(&self) -> EncodedImage {
        let heads = self.geometry.heads;
        EncodedImage {
            grid: self.grid,
            dim: self.geometry.dim,
            heads,
            tokens: Vec::new(),
            cls_token: Vec::new(),
            cls_attention: Vec::with_capacity(heads * self.grid.len()),
        }
    }

    /// Copies the tokens of one image out of the workspace.
    fn read_tokens(
        &self,
        plan: &ChunkPlan,
        image: usize,
        workspace: &Workspace,
        out: &mut EncodedImage,
    ) {
        let dim = self.geometry.dim;
        let start = image * plan.shape.chunks() * plan.tokens_len();
        let len = (1 + self.grid.len()) * dim;
        let (cls, patches) = workspace.tokens[start..start + len].split_at(dim);
        if self.spec.token_norm {
            out.cls_token = self.final_norm(cls);
            out.tokens = self.final_norm(patches);
        } else {
            out.cls_token = cls.to_vec();
            out.tokens = patches.to_vec();
        }
    }

    /// The final LayerNorm of `rows` `[.., dim]`.
    fn final_norm(&self, rows: &[f32]) -> Vec<f32> {
        let dim = self.geometry.dim;
        let mut out = vec![0.0; rows.len()];
        normalize_rows(self.plan.simd, dim, LAYER_NORM_EPS, rows, &mut out);
        for row in out.chunks_exact_mut(dim) {
            let scales_and_shifts = self.norm.weight.iter().zip(&self.norm.bias);
            for (value, (scale, shift)) in row.iter_mut().zip(scales_and_shifts) {
                *value = *value * scale + shift;
            }
        }
        out
    }

    /// Computes the CLS attention of one image from the queries and keys in the workspace.
    fn read_attention(
        &self,
        shape: &AttentionShape,
        image: usize,
        workspace: &mut Workspace,
        out: &mut EncodedImage,
    ) {
        let simd = self.plan.simd;
        let queries_len = shape.chunks() * shape.queries_len();
        let keys_len = shape.chunks() * shape.keys_len();
        let queries = &workspace.queries[image * queries_len..(image + 1) * queries_len];
        let keys = &workspace.keys[image * keys_len..(image + 1) * keys_len];
        workspace
            .scores
            .resize(shape.scratch_len(simd) + shape.tokens);
        let (row, scratch) = workspace.scores.split_at_mut(shape.tokens);

        let _ready = MatrixUnitGuard::new(simd);
        for head in 0..shape.heads {
            first_row_attention(simd, shape, head, queries, keys, scratch, row);
            // The first key is the CLS token's own, which is not a patch.
            out.cls_attention.extend_from_slice(&row[1..]);
        }
    }

    /// Columns of patch tokens and attention that one token has when both share a tensor.
    pub(super) fn token_and_attention_width(&self) -> usize {
        self.geometry.dim + self.geometry.heads
    }

    /// Tokens of an image, the CLS token included.
    pub(super) fn token_count(&self) -> usize {
        1 + self.grid.len()
    }
}

impl Encoder for FusedEncoder {
    fn spec(&self) -> &EncoderSpec {
        &self.spec
    }

    fn name(&self) -> String {
        format!("fused-{}-{}", self.precision, self.plan.simd.level())
    }

    fn weight_bytes(&self) -> usize {
        let blocks: usize = self.blocks.iter().map(PackedBlock::bytes).sum();
        blocks + self.embedding.bytes() + size_of_val(self.positions.as_slice())
    }

    fn encode(&self, images: &[ImageTensor]) -> Result<Vec<EncodedImage>, ExtractError> {
        self.encode_with_pauses(images, &|| ())
    }

    fn encode_with_pauses(
        &self,
        images: &[ImageTensor],
        pause: &dyn Fn(),
    ) -> Result<Vec<EncodedImage>, ExtractError> {
        for image in images {
            check_image(image, &self.spec)?;
        }
        let pixels: Vec<&[f32]> = images.iter().map(|image| image.data.as_slice()).collect();
        self.encode_pixels(&pixels, pause)
    }
}

/// Refuses a spec that these weights or the kernels of `simd` cannot compute.
fn check_spec(weights: &VitWeights, spec: &EncoderSpec, simd: Simd) -> Result<(), InvalidValue> {
    let geometry = weights.geometry;
    if spec.blocks() > weights.blocks.len() {
        let asked = spec.blocks() - 1;
        let reason = format!(
            "block {asked} was asked for, there are {}",
            weights.blocks.len()
        );
        return Err(InvalidValue::new("exit_block", reason));
    }

    let patch = geometry.patch;
    let size = spec.input_size;
    let is_whole = |side: u32| side > 0 && (side as usize).is_multiple_of(patch);
    if !is_whole(size.width) || !is_whole(size.height) {
        let reason = format!("{size} is not whole patches of {patch} pixels");
        return Err(InvalidValue::new("input_size", reason));
    }

    let columns = Tiling::of(simd).columns;
    if !geometry.head_dim().is_multiple_of(columns) {
        let reason = format!(
            "heads {} wide cannot be computed at level {}, which takes multiples of {columns}",
            geometry.head_dim(),
            simd.level()
        );
        return Err(InvalidValue::new("heads", reason));
    }
    Ok(())
}

/// What each token starts from before its embedded patch is added, `[1 + n, dim]`.
///
/// The embedding adds its bias to every row. The CLS row has no patch, so its bias is subtracted
/// here beforehand.
fn starting_tokens(weights: &VitWeights, grid: TokenGrid) -> Vec<f32> {
    let dim = weights.geometry.dim;
    let to = (grid.rows, grid.columns);
    let mut tokens = interpolate(&weights.positions, dim, weights.position_grid, to);
    let cls_row = &mut tokens[..dim];
    for (value, cls) in cls_row.iter_mut().zip(&weights.cls_token) {
        *value += cls;
    }
    for (value, bias) in cls_row.iter_mut().zip(&weights.patch_embed.bias) {
        *value -= bias;
    }
    tokens
}

/// Packs the first `count` blocks, each in its own format.
fn pack_blocks(
    weights: &VitWeights,
    count: usize,
    simd: Simd,
    formats: &Formats,
) -> Result<Vec<PackedBlock>, ExtractError> {
    let geometry = weights.geometry;
    let smoothings = smoothing::measure(weights, formats.int8_blocks.end)?;
    let blocks = weights.blocks[..count].par_iter().enumerate();
    let packed = blocks.map(|(index, block)| {
        let is_int8 = formats.int8_blocks.contains(&index);
        let smoothing = is_int8.then(|| &smoothings[index]);
        let format = if is_int8 {
            Format::Int8
        } else {
            formats.other_layers
        };
        PackedBlock::pack(simd, format, block, &geometry, HIDDEN_SLICE, smoothing)
    });
    Ok(packed.collect())
}

fn is_finite(image: &EncodedImage) -> bool {
    let parts = [&image.tokens, &image.cls_token, &image.cls_attention];
    parts
        .iter()
        .all(|values| values.iter().all(|value| value.is_finite()))
}
