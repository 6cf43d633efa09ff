//! The vision transformer in candle: the reference implementation of [`Encoder`], in 32-bit floats.
//!
//! Patch embedding, interpolated positions, then pre-norm blocks up to the last one the spec needs
//! (paper III-A). Images of a batch go through one by one, so that a batch equals its single images
//! bit for bit; the threads work inside each product. Plain candle ops except GELU, whose scalar
//! error function would cost a tenth of the time.

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

/// A transformer cut off after the last block its spec needs.
pub struct CandleEncoder {
    spec: EncoderSpec,
    geometry: Geometry,
    grid: TokenGrid,
    /// `[3 p p, d]` and `[d]`.
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
    /// Projection of what attention mixed.
    Proj,
    /// Into the hidden layer of the MLP.
    Fc1,
    /// Out of it.
    Fc2,
}

/// Sees what the layers are given, one block after the other.
type Record<'a> = &'a mut dyn FnMut(BlockLayer, &Tensor) -> Result<()>;

/// What one pass leaves behind.
struct Pass {
    /// `[1 + n, d]`, of the exit block.
    tokens: Tensor,
    /// `[heads, n]`, of the attention block.
    cls_attention: Tensor,
}

impl CandleEncoder {
    /// Copies the weights of the blocks that `spec` needs; positions are interpolated here, once.
    pub fn new(
        weights: &VitWeights,
        spec: &EncoderSpec,
    ) -> std::result::Result<Self, ExtractError> {
        let geometry = weights.geometry;
        let grid = token_grid(&geometry, spec);
        let (dim, patch) = (geometry.dim, geometry.patch);
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
            .map(|(token, at)| token + at)
            .collect();
        Ok(Self {
            spec: *spec,
            geometry,
            grid,
            patch_embed: Dense::new(&weights.patch_embed, 3 * patch * patch)?,
            cls: tensor(&cls, &[1, dim])?,
            positions: tensor(&table[dim..], &[grid.len(), dim])?,
            blocks: weights.blocks[..spec.blocks()]
                .iter()
                .map(|b| Block::new(b, &geometry))
                .collect::<Result<_>>()?,
            norm: LayerNorm::new(&weights.norm)?,
        })
    }

    /// Runs the transformer for what goes into its linear layers: `record(layer, inputs)`, `[1 + n,
    /// width]`, one block after the other.
    ///
    /// # Errors
    /// The image's size, or candle's.
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

    fn run(&self, image: &ImageTensor, record: Record<'_>) -> Result<Pass> {
        let patches = tensor(
            &self.patches(image),
            &[
                self.grid.len(),
                3 * self.geometry.patch * self.geometry.patch,
            ],
        )?;
        let embedded = (self.patch_embed.forward(&patches)? + &self.positions)?;
        let mut x = Tensor::cat(&[&self.cls, &embedded], 0)?;
        let (mut tokens, mut cls_attention) = (None, None);
        for (i, block) in self.blocks.iter().enumerate() {
            if i > self.spec.exit_block && i == self.spec.attention_block {
                // Nothing but the attention of one query is wanted of this last block.
                cls_attention = Some(block.cls_attention(&x, &self.geometry)?);
                break;
            }
            let (next, attention) = block.forward(&x, &self.geometry, record)?;
            x = next;
            if i == self.spec.attention_block {
                cls_attention = Some(attention);
            }
            if i == self.spec.exit_block {
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

    /// Patches in row-major order, each as channel, row, column: `[n, 3 p p]`.
    fn patches(&self, image: &ImageTensor) -> Vec<f32> {
        let patch = self.geometry.patch;
        let (width, height) = (image.size.width as usize, image.size.height as usize);
        let mut out = Vec::with_capacity(image.data.len());
        for (row, column) in
            (0..self.grid.rows).flat_map(|r| (0..self.grid.columns).map(move |c| (r, c)))
        {
            for (channel, y) in (0..3).flat_map(|channel| (0..patch).map(move |y| (channel, y))) {
                let start = (channel * height + row * patch + y) * width + column * patch;
                out.extend_from_slice(&image.data[start..start + patch]);
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
        let dense = |layer: &Dense| layer.weight.elem_count() + layer.bias.elem_count();
        let blocks: usize = self
            .blocks
            .iter()
            .map(|b| {
                [&b.qkv, &b.proj, &b.fc1, &b.fc2]
                    .map(dense)
                    .iter()
                    .sum::<usize>()
            })
            .sum();
        4 * (blocks + dense(&self.patch_embed) + self.positions.elem_count())
    }

    fn encode(
        &self,
        images: &[ImageTensor],
    ) -> std::result::Result<Vec<EncodedImage>, ExtractError> {
        images
            .iter()
            .try_for_each(|image| check_image(image, &self.spec))?;
        images
            .iter()
            .map(|image| {
                let pass = self.run(image, &mut |_, _| Ok(()))?;
                let mut tokens = pass.tokens.flatten_all()?.to_vec1::<f32>()?;
                let cls_token = tokens.drain(..self.geometry.dim).collect();
                Ok(EncodedImage {
                    grid: self.grid,
                    dim: self.geometry.dim,
                    heads: self.geometry.heads,
                    tokens,
                    cls_token,
                    cls_attention: pass.cls_attention.flatten_all()?.to_vec1::<f32>()?,
                })
            })
            .collect()
    }
}

impl Block {
    fn new(weights: &BlockWeights, geometry: &Geometry) -> Result<Self> {
        let (dim, mlp_dim) = (geometry.dim, geometry.mlp_dim);
        let scale =
            |scale: &Option<Vec<f32>>| scale.as_ref().map(|s| tensor(s, &[s.len()])).transpose();
        Ok(Self {
            norm1: LayerNorm::new(&weights.norm1)?,
            qkv: Dense::new(&weights.qkv, dim)?,
            proj: Dense::new(&weights.proj, dim)?,
            layer_scale1: scale(&weights.layer_scale1)?,
            norm2: LayerNorm::new(&weights.norm2)?,
            fc1: Dense::new(&weights.fc1, dim)?,
            fc2: Dense::new(&weights.fc2, mlp_dim)?,
            layer_scale2: scale(&weights.layer_scale2)?,
        })
    }

    /// The block's output `[1 + n, d]` and its CLS attention `[heads, n]`; `record` sees what its
    /// layers are given.
    fn forward(
        &self,
        x: &Tensor,
        geometry: &Geometry,
        record: Record<'_>,
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
        patch_keys(&softmax_last_dim(
            &q.narrow(1, 0, 1)?.contiguous()?.matmul(&k)?,
        )?)
    }

    /// Scaled queries `[heads, length, d / heads]`, keys transposed `[heads, d / heads, length]`,
    /// values as queries.
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

/// The first query's attention over all keys but the first: `[heads, *, 1 + n]` -> `[heads, n]`.
fn patch_keys(attention: &Tensor) -> Result<Tensor> {
    let keys = attention.dim(D::Minus1)?;
    attention
        .narrow(1, 0, 1)?
        .squeeze(1)?
        .narrow(1, 1, keys - 1)?
        .contiguous()
}

/// x + branch * scale.
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

/// Exact GELU in place on a tensor nobody else holds.
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
