//! The transformer for training: the same computation as
//! [`CandleEncoder`](placeformer_vision::extract::CandleEncoder), but differentiable and over whole
//! batches. A test compares the two.

use super::error::TrainError;
use super::ops::{gelu, layer_norm, linear, multiply_row, softmax};
use super::weights::{Graph, Weights};
use candle_core::{D, Device, Tensor};
use placeformer_core::types::ImageTensor;
use placeformer_vision::extract::{EncoderSpec, Geometry, VitWeights, interpolate_positions};

type Result<T> = std::result::Result<T, TrainError>;

/// The layers of a block that are matrices, which adapters can be added to.
pub(super) const MATRICES: [&str; 4] = ["attn.qkv", "attn.proj", "mlp.fc1", "mlp.fc2"];

/// The shape of the computation; the weights are given to it.
pub(super) struct Transformer {
    geometry: Geometry,
    spec: EncoderSpec,
    /// Interpolation of the learned positions to this input's grid, `[1 + n, 1 + table]`.
    interpolation: Tensor,
}

/// Weights as a pass sees them.
#[derive(Clone, Copy)]
pub(super) struct Pass<'a> {
    pub(super) weights: &'a Weights,
    pub(super) graph: Graph,
}

impl Pass<'_> {
    /// The tensor of this name.
    pub(super) fn get(&self, name: &str) -> Result<Tensor> {
        self.weights.get(name, self.graph)
    }

    fn dense(&self, x: &Tensor, layer: &str) -> Result<Tensor> {
        let weight = self.get(&format!("{layer}.weight"))?;
        let bias = self.get(&format!("{layer}.bias"))?;
        Ok(linear(x, &weight, &bias)?)
    }

    fn norm(&self, x: &Tensor, layer: &str) -> Result<Tensor> {
        let weight = self.get(&format!("{layer}.weight"))?;
        let bias = self.get(&format!("{layer}.bias"))?;
        Ok(layer_norm(&x.contiguous()?, &weight, &bias)?)
    }

    fn residual(&self, x: &Tensor, branch: Tensor, scale: &str) -> Result<Tensor> {
        if !self.weights.has(scale) {
            return Ok((x + branch)?);
        }
        Ok((x + multiply_row(&branch, &self.get(scale)?)?)?)
    }
}

impl Transformer {
    pub(super) fn new(base: &VitWeights, spec: EncoderSpec) -> Result<Self> {
        Ok(Self {
            geometry: base.geometry,
            spec,
            interpolation: interpolation_matrix(base, &spec)?,
        })
    }

    /// Tokens before the first block, `[batch, 1 + n, dim]`.
    pub(super) fn embed_patches(&self, pass: Pass<'_>, images: &[ImageTensor]) -> Result<Tensor> {
        let dim = self.geometry.dim;
        let patch = self.geometry.patch;
        let patches: Vec<Tensor> = images
            .iter()
            .map(|image| unfold(image, patch))
            .collect::<Result<_>>()?;
        let kernel = pass
            .get("patch_embed.proj.weight")?
            .reshape((dim, 3 * patch * patch))?;
        let bias = pass.get("patch_embed.proj.bias")?;
        let patches = linear(&Tensor::stack(&patches, 0)?, &kernel, &bias)?;
        let cls =
            pass.get("cls_token")?
                .reshape((1, 1, dim))?
                .broadcast_as((images.len(), 1, dim))?;
        let table = pass.get("pos_embed")?;
        let table = table.reshape((table.elem_count() / dim, dim))?;
        let positions = self.interpolation.matmul(&table)?;
        Ok(Tensor::cat(&[&cls.contiguous()?, &patches], 1)?.broadcast_add(&positions)?)
    }

    /// Patch tokens of the exit block, `[batch, n, dim]`, from those before block `first`, `[batch,
    /// 1 + n, dim]`.
    pub(super) fn run(&self, pass: Pass<'_>, tokens: Tensor, first: usize) -> Result<Tensor> {
        let mut x = tokens;
        for block in first..=self.spec.exit_block {
            x = self.block(pass, &x, block)?;
        }
        if self.spec.token_norm {
            x = pass.norm(&x, "norm")?;
        }
        Ok(x.narrow(1, 1, x.dim(1)? - 1)?)
    }

    fn block(&self, pass: Pass<'_>, x: &Tensor, block: usize) -> Result<Tensor> {
        let (batch, length, dim) = x.dims3()?;
        let heads = self.geometry.heads;
        let head_dim = self.geometry.head_dim();
        let name = |part: &str| format!("blocks.{block}.{part}");
        let fused = pass.dense(&pass.norm(x, &name("norm1"))?, &name("attn.qkv"))?;
        let part = |index: usize| -> candle_core::Result<Tensor> {
            let part = fused.narrow(D::Minus1, index * dim, dim)?;
            part.reshape((batch, length, heads, head_dim))?
                .transpose(1, 2)?
                .contiguous()
        };
        let queries = (part(0)? * (head_dim as f64).powf(-0.5))?;
        let scores = queries.matmul(&part(1)?.transpose(2, 3)?)?;
        let mixed = softmax(&scores)?.matmul(&part(2)?)?;
        let mixed = mixed.transpose(1, 2)?.reshape((batch, length, dim))?;
        let branch = pass.dense(&mixed, &name("attn.proj"))?;
        let x = pass.residual(x, branch, &name("ls1.gamma"))?;
        let hidden = pass.dense(&pass.norm(&x, &name("norm2"))?, &name("mlp.fc1"))?;
        let branch = pass.dense(&gelu(&hidden)?, &name("mlp.fc2"))?;
        pass.residual(&x, branch, &name("ls2.gamma"))
    }
}

/// Patches in row-major order, each as channel, row, column: `[n, 3 p p]`.
fn unfold(image: &ImageTensor, patch: usize) -> Result<Tensor> {
    let width = image.size.width as usize;
    let height = image.size.height as usize;
    let columns = width / patch;
    let rows = height / patch;
    let planes = Tensor::from_slice(&image.data, (3, rows, patch, columns, patch), &Device::Cpu)?;
    Ok(planes
        .permute((1, 3, 0, 2, 4))?
        .reshape((rows * columns, 3 * patch * patch))?)
}

/// Interpolation of positions is linear in the table: interpolating unit vectors gives its matrix,
/// through which gradients can flow.
fn interpolation_matrix(base: &VitWeights, spec: &EncoderSpec) -> Result<Tensor> {
    let (columns, rows) = base.geometry.grid(spec.input_size);
    let entries = 1 + base.position_grid.0 * base.position_grid.1;
    let mut unit = vec![0.0f32; entries * entries];
    unit.iter_mut()
        .step_by(entries + 1)
        .for_each(|value| *value = 1.0);
    let matrix = interpolate_positions(&unit, entries, base.position_grid, (rows, columns));
    Ok(Tensor::from_vec(
        matrix,
        (1 + rows * columns, entries),
        &Device::Cpu,
    )?)
}
