//! The vision transformer in candle: a plain implementation of [`Encoder`] in 32-bit floats, with
//! which the fused one is compared.
//!
//! Patch embedding, interpolated positions, then pre-norm blocks up to the last one that the spec
//! needs (paper III-A). The images of a batch are encoded one after another, so that a batch gives
//! bit for bit what single images give; threads share the work within each product. All operations
//! are candle's own except GELU, because candle's scalar error function would take a tenth of the
//! time.

use super::activation;
use super::encoder::{EncodedImage, Encoder, EncoderSpec, TokenGrid, check_image, token_grid};
use super::error::ExtractError;
use super::positions;
use super::preset::{Geometry, LAYER_NORM_EPS};
use super::weights::{BlockWeights, Linear, Norm, VitWeights};
use candle_core::{CpuStorage, D, Device, InplaceOp1, Layout, Tensor};
use candle_nn::ops::{layer_norm, softmax_last_dim};
use placeformer_core::types::ImageTensor;
use rayon::prelude::*;

type Result<T> = std::result::Result<T, candle_core::Error>;

/// The transformer, without the blocks after the last one that its spec needs.
pub struct CandleEncoder {
    spec: EncoderSpec,
    geometry: Geometry,
    grid: TokenGrid,
    /// From patches `[3 p p]` to tokens `[d]`.
    patch_embed: Dense,
    /// CLS token plus its position, `[1, d]`.
    cls: Tensor,
    /// `[n, d]`.
    positions: Tensor,
    blocks: Vec<Block>,
    norm: LayerNorm,
}

struct Dense {
    /// Transposed once, `[in, out]`.
    weight: Tensor,
    bias: Tensor,
}

struct LayerNorm {
    weight: Tensor,
    bias: Tensor,
}

struct Block {
    norm1: LayerNorm,
    qkv: Dense,
    proj: Dense,
    layer_scale1: Option<Tensor>,
    norm2: LayerNorm,
    fc1: Dense,
    fc2: Dense,
    layer_scale2: Option<Tensor>,
}

/// A linear layer of a block.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum BlockLayer {
    /// Queries, keys and values.
    Qkv,
    /// Output projection of attention.
    Proj,
    /// First layer of the MLP.
    Fc1,
    /// Second layer of the MLP.
    Fc2,
}

/// Called with the inputs of each linear layer, block by block.
type InputRecorder<'a> = &'a mut dyn FnMut(BlockLayer, &Tensor) -> Result<()>;

/// The results of one forward pass.
struct Pass {
    /// Tokens after the exit block, `[1 + n, d]`.
    tokens: Tensor,
    /// CLS attention in the attention block, `[heads, n]`.
    cls_attention: Tensor,
}

impl CandleEncoder {
    /// Copies the weights of the blocks that `spec` needs, and interpolates the positions to the
    /// grid of its input size.
    ///
    /// # Errors
    /// Those of candle.
    pub fn new(
        weights: &VitWeights,
        spec: &EncoderSpec,
    ) -> std::result::Result<Self, ExtractError> {
        let geometry = weights.geometry;
        let grid = token_grid(&geometry, spec);
        let dim = geometry.dim;
        let patch = geometry.patch;
        let table = positions::interpolate(
            &weights.positions,
            dim,
            weights.position_grid,
            (grid.rows, grid.columns),
        );
        let cls: Vec<f32> = weights
            .cls_token
            .iter()
            .zip(&table[..dim])
            .map(|(token, position)| token + position)
            .collect();
        let blocks = &weights.blocks[..spec.blocks()];
        let blocks: Result<Vec<Block>> = blocks
            .iter()
            .map(|block| Block::new(block, &geometry))
            .collect();
        Ok(Self {
            spec: *spec,
            geometry,
            grid,
            patch_embed: Dense::new(&weights.patch_embed, 3 * patch * patch)?,
            cls: tensor(&cls, &[1, dim])?,
            positions: tensor(&table[dim..], &[grid.len(), dim])?,
            blocks: blocks?,
            norm: LayerNorm::new(&weights.norm)?,
        })
    }

    /// Runs the transformer on `image` and calls `record(layer, inputs)` with the inputs `[1 + n,
    /// width]` of each linear layer, block by block.
    ///
    /// # Errors
    /// An image of the wrong size, and those of candle.
    pub(super) fn record_inputs(
        &self,
        image: &ImageTensor,
        record: &mut dyn FnMut(BlockLayer, &[f32]),
    ) -> std::result::Result<(), ExtractError> {
        check_image(image, &self.spec)?;
        self.run(image, &mut |layer, inputs| {
            record(layer, &inputs.flatten_all()?.to_vec1::<f32>()?);
            Ok(())
        })?;
        Ok(())
    }

    fn run(&self, image: &ImageTensor, record: InputRecorder<'_>) -> Result<Pass> {
        let mut x = self.embed(image)?;
        let mut tokens = None;
        let mut cls_attention = None;
        for (index, block) in self.blocks.iter().enumerate() {
            if index > self.spec.exit_block && index == self.spec.attention_block {
                // Of this last block only the attention of the CLS query is needed.
                cls_attention = Some(block.cls_attention(&x, &self.geometry)?);
                break;
            }
            let (next, attention) = block.forward(&x, &self.geometry, record)?;
            x = next;
            if index == self.spec.attention_block {
                cls_attention = Some(attention);
            }
            if index == self.spec.exit_block {
                tokens = Some(if self.spec.token_norm {
                    self.norm.forward(&x)?
                } else {
                    x.clone()
                });
            }
        }
        match (tokens, cls_attention) {
            (Some(tokens), Some(cls_attention)) => Ok(Pass {
                tokens,
                cls_attention,
            }),
            _ => candle_core::bail!("the encoder holds too few blocks for its own spec"),
        }
    }

    /// Tokens before the first block, `[1 + n, d]`.
    fn embed(&self, image: &ImageTensor) -> Result<Tensor> {
        let patch_len = 3 * self.geometry.patch * self.geometry.patch;
        let patches = tensor(&self.patches(image), &[self.grid.len(), patch_len])?;
        let embedded = (self.patch_embed.forward(&patches)? + &self.positions)?;
        Tensor::cat(&[&self.cls, &embedded], 0)
    }

    /// The pixels of each patch in the order channel, row, column; patches row by row: `[n, 3 p
    /// p]`.
    fn patches(&self, image: &ImageTensor) -> Vec<f32> {
        let patch = self.geometry.patch;
        let width = image.size.width as usize;
        let height = image.size.height as usize;
        let mut out = Vec::with_capacity(image.data.len());
        for grid_row in 0..self.grid.rows {
            for grid_column in 0..self.grid.columns {
                let left = grid_column * patch;
                for channel in 0..3 {
                    for row in grid_row * patch..(grid_row + 1) * patch {
                        let start = (channel * height + row) * width + left;
                        out.extend_from_slice(&image.data[start..start + patch]);
                    }
                }
            }
        }
        out
    }
}

impl Encoder for CandleEncoder {
    fn spec(&self) -> &EncoderSpec {
        &self.spec
    }

    fn name(&self) -> String {
        "candle-f32".into()
    }

    fn weight_bytes(&self) -> usize {
        let blocks: usize = self.blocks.iter().map(Block::values).sum();
        let values = blocks + self.patch_embed.values() + self.positions.elem_count();
        values * size_of::<f32>()
    }

    fn encode(
        &self,
        images: &[ImageTensor],
    ) -> std::result::Result<Vec<EncodedImage>, ExtractError> {
        for image in images {
            check_image(image, &self.spec)?;
        }
        let mut encoded = Vec::with_capacity(images.len());
        for image in images {
            let pass = self.run(image, &mut |_, _| Ok(()))?;
            let mut tokens = pass.tokens.flatten_all()?.to_vec1::<f32>()?;
            let cls_token = tokens.drain(..self.geometry.dim).collect();
            encoded.push(EncodedImage {
                grid: self.grid,
                dim: self.geometry.dim,
                heads: self.geometry.heads,
                tokens,
                cls_token,
                cls_attention: pass.cls_attention.flatten_all()?.to_vec1::<f32>()?,
            });
        }
        Ok(encoded)
    }
}

impl Block {
    fn new(weights: &BlockWeights, geometry: &Geometry) -> Result<Self> {
        let dim = geometry.dim;
        let scale = |scale: &Option<Vec<f32>>| match scale {
            Some(scale) => tensor(scale, &[scale.len()]).map(Some),
            None => Ok(None),
        };
        Ok(Self {
            norm1: LayerNorm::new(&weights.norm1)?,
            qkv: Dense::new(&weights.qkv, dim)?,
            proj: Dense::new(&weights.proj, dim)?,
            layer_scale1: scale(&weights.layer_scale1)?,
            norm2: LayerNorm::new(&weights.norm2)?,
            fc1: Dense::new(&weights.fc1, dim)?,
            fc2: Dense::new(&weights.fc2, geometry.mlp_dim)?,
            layer_scale2: scale(&weights.layer_scale2)?,
        })
    }

    /// Number of values in the linear layers.
    fn values(&self) -> usize {
        self.qkv.values() + self.proj.values() + self.fc1.values() + self.fc2.values()
    }

    /// The block's output `[1 + n, d]` and its CLS attention `[heads, n]`; `record` gets the inputs
    /// of its linear layers.
    fn forward(
        &self,
        x: &Tensor,
        geometry: &Geometry,
        record: InputRecorder<'_>,
    ) -> Result<(Tensor, Tensor)> {
        let (length, dim) = x.dims2()?;
        let normed = self.norm1.forward(x)?;
        record(BlockLayer::Qkv, &normed)?;
        let [q, k, v] = self.queries_keys_values(&normed, geometry)?;
        let attention = softmax_last_dim(&q.matmul(&k)?)?;
        let mixed = attention
            .matmul(&v)?
            .transpose(0, 1)?
            .reshape((length, dim))?;
        record(BlockLayer::Proj, &mixed)?;
        let x = residual(x, self.proj.forward(&mixed)?, &self.layer_scale1)?;
        let normed = self.norm2.forward(&x)?;
        record(BlockLayer::Fc1, &normed)?;
        let hidden = self.fc1.forward(&normed)?;
        hidden.inplace_op1(&Gelu)?;
        record(BlockLayer::Fc2, &hidden)?;
        let x = residual(&x, self.fc2.forward(&hidden)?, &self.layer_scale2)?;
        Ok((x, patch_keys(&attention)?))
    }

    /// The CLS attention `[heads, n]` alone.
    fn cls_attention(&self, x: &Tensor, geometry: &Geometry) -> Result<Tensor> {
        let [q, k, _] = self.queries_keys_values(&self.norm1.forward(x)?, geometry)?;
        let cls_query = q.narrow(1, 0, 1)?.contiguous()?;
        let attention = softmax_last_dim(&cls_query.matmul(&k)?)?;
        patch_keys(&attention)
    }

    /// Queries `[heads, length, d / heads]`, scaled; keys transposed, `[heads, d / heads, length]`;
    /// and values `[heads, length, d / heads]`.
    fn queries_keys_values(&self, normed: &Tensor, geometry: &Geometry) -> Result<[Tensor; 3]> {
        let (length, dim) = normed.dims2()?;
        let fused = self.qkv.forward(normed)?;
        let part = |index: usize| {
            fused
                .narrow(1, index * dim, dim)?
                .reshape((length, geometry.heads, geometry.head_dim()))?
                .transpose(0, 1)
        };
        let scale = (geometry.head_dim() as f64).powf(-0.5);
        let q = (part(0)? * scale)?.contiguous()?;
        let k = part(1)?.transpose(D::Minus1, D::Minus2)?.contiguous()?;
        Ok([q, k, part(2)?.contiguous()?])
    }
}

/// The attention of the first query, the CLS token, over all keys but its own: `[heads, *, 1 + n]`
/// to `[heads, n]`.
fn patch_keys(attention: &Tensor) -> Result<Tensor> {
    let keys = attention.dim(D::Minus1)?;
    attention
        .narrow(1, 0, 1)?
        .squeeze(1)?
        .narrow(1, 1, keys - 1)?
        .contiguous()
}

/// x + branch * scale, without the factor if there is no LayerScale.
fn residual(x: &Tensor, branch: Tensor, scale: &Option<Tensor>) -> Result<Tensor> {
    match scale {
        Some(scale) => x + branch.broadcast_mul(scale)?,
        None => x + branch,
    }
}

impl Dense {
    fn new(layer: &Linear, input: usize) -> Result<Self> {
        let out = layer.bias.len();
        Ok(Self {
            weight: tensor(&layer.weight, &[out, input])?.t()?.contiguous()?,
            bias: tensor(&layer.bias, &[out])?,
        })
    }

    /// Number of values.
    fn values(&self) -> usize {
        self.weight.elem_count() + self.bias.elem_count()
    }

    fn forward(&self, x: &Tensor) -> Result<Tensor> {
        x.matmul(&self.weight)?.broadcast_add(&self.bias)
    }
}

impl LayerNorm {
    fn new(norm: &Norm) -> Result<Self> {
        let dim = norm.weight.len();
        Ok(Self {
            weight: tensor(&norm.weight, &[dim])?,
            bias: tensor(&norm.bias, &[dim])?,
        })
    }

    fn forward(&self, x: &Tensor) -> Result<Tensor> {
        layer_norm(x, &self.weight, &self.bias, LAYER_NORM_EPS)
    }
}

fn tensor(values: &[f32], shape: &[usize]) -> Result<Tensor> {
    Tensor::from_slice(values, shape, &Device::Cpu)
}

/// Exact GELU in place. Only for a tensor whose storage is not shared with another one.
struct Gelu;

impl InplaceOp1 for Gelu {
    fn name(&self) -> &'static str {
        "gelu-erf"
    }

    fn cpu_fwd(&self, storage: &mut CpuStorage, layout: &Layout) -> Result<()> {
        let (CpuStorage::F32(values), Some((start, end))) = (storage, layout.contiguous_offsets())
        else {
            candle_core::bail!("gelu-erf takes contiguous f32 tensors");
        };
        values[start..end]
            .par_chunks_mut(1 << 14)
            .for_each(activation::gelu);
        Ok(())
    }
}
