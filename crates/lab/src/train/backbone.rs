//! Training the transformer itself, wholly or its last blocks, together with the head.
//!
//! The same computation as [`CandleEncoder`](placeformer_vision::extract::CandleEncoder), built of
//! differentiable operations only and over whole batches; a test compares the two. Layers that are
//! not trained are plain tensors, so that no graph is recorded through them.

use super::augment::{Augmentation, augment};
use super::config::TrainConfig;
use super::error::TrainError;
use super::loss::normalise_rows;
use super::model::{Sample, TripletModel};
use super::trainer::{Outcome, Session, run};
use super::triplets::TripletSet;
use candle_core::{D, Device, Tensor, Var};
use placeformer_core::types::{GLOBAL_DIM, ImageTensor};
use placeformer_vision::extract::{
    Aggregate, EncoderSpec, Head, LAYER_NORM_EPS, VitWeights, interpolate_positions,
};
use placeformer_vision::image::{ImageConfig, load_tensor};
use rayon::prelude::*;
use std::collections::{BTreeMap, HashMap};
use std::path::Path;

type Result<T> = std::result::Result<T, TrainError>;

/// Which weights move besides the head.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TrainableBlocks {
    /// The last `n` of the computed blocks, and the final norm where it is used.
    Last(usize),
    /// Everything: patch embedding, positions and CLS token too.
    All,
}

/// A differentiable transformer with its head.
pub struct BackboneModel {
    base: VitWeights,
    spec: EncoderSpec,
    /// Every tensor of the computed part by its fused name.
    tensors: HashMap<String, Tensor>,
    /// Those that are trained, with the head's two.
    variables: BTreeMap<String, Var>,
    /// Interpolation of the learned positions to this input's grid, `[1 + n, 1 + table]`.
    interpolation: Tensor,
    images: ImageConfig,
    augmentation: Augmentation,
}

const HEAD_WEIGHT: &str = "head.weight";
const HEAD_BIAS: &str = "head.bias";

impl TrainableBlocks {
    /// Refuses more blocks than are computed, and none.
    fn check(self, computed: usize) -> Result<()> {
        match self {
            Self::Last(count) if !(1..=computed).contains(&count) => Err(TrainError::Setting(
                format!("{count} of {computed} computed blocks cannot be trained"),
            )),
            Self::Last(_) | Self::All => Ok(()),
        }
    }
}

impl BackboneModel {
    /// Starts from pre-trained weights and a head of `weight` `[256, dim]` and `bias` `[256]`.
    ///
    /// # Errors
    /// More blocks are to be trained than are computed, or a tensor has another shape than the
    /// model.
    pub fn new(
        base: VitWeights,
        spec: EncoderSpec,
        head: (&[f32], &[f32]),
        trainable: TrainableBlocks,
        images: ImageConfig,
        augmentation: Augmentation,
    ) -> Result<Self> {
        let blocks = spec.exit_block + 1;
        trainable.check(blocks)?;
        let mut tensors = HashMap::new();
        let mut variables = BTreeMap::new();
        for (name, shape, values) in base.tensors() {
            if block_of(&name).is_some_and(|block| block >= blocks) {
                continue;
            }
            let tensor = Tensor::from_slice(values, shape, &Device::Cpu)?;
            if is_trained(&name, trainable, blocks, spec.token_norm) {
                let variable = Var::from_tensor(&tensor)?;
                tensors.insert(name.clone(), variable.as_tensor().clone());
                variables.insert(name, variable);
            } else {
                tensors.insert(name, tensor);
            }
        }
        let (weight, bias) = head;
        let of_head = [
            (HEAD_WEIGHT, weight, vec![GLOBAL_DIM, base.geometry.dim]),
            (HEAD_BIAS, bias, vec![GLOBAL_DIM]),
        ];
        for (name, values, shape) in of_head {
            let variable = Var::from_tensor(&Tensor::from_slice(values, shape, &Device::Cpu)?)?;
            tensors.insert(name.into(), variable.as_tensor().clone());
            variables.insert(name.into(), variable);
        }
        let interpolation = interpolation_matrix(&base, &spec)?;
        Ok(Self {
            base,
            spec,
            tensors,
            variables,
            interpolation,
            images,
            augmentation,
        })
    }

    /// Trains in place; afterwards the weights are the best seen.
    ///
    /// # Errors
    /// A setting is out of range, the checkpoint is one of another run, an image cannot be read, or
    /// the
    /// loss is no longer finite.
    pub fn train(
        &self,
        training: &TripletSet,
        validation: &TripletSet,
        config: &TrainConfig,
        session: Session<'_>,
    ) -> Result<Outcome> {
        run(self, training, validation, config, session)
    }

    /// Writes the backbone to `weights` and the head, bound to `backbone`, to `head`.
    ///
    /// The backbone's identity follows from its weights, so `backbone` is asked for only once these
    /// are written.
    ///
    /// # Errors
    /// A file cannot be written, or `backbone` fails.
    pub fn save(
        &self,
        weights: &Path,
        head: &Path,
        backbone: impl FnOnce() -> Result<String>,
        notes: BTreeMap<String, String>,
    ) -> Result<()> {
        let mut trained = self.base.clone();
        for (name, variable) in &self.variables {
            if name != HEAD_WEIGHT && name != HEAD_BIAS {
                let values = variable.flatten_all()?.to_vec1::<f32>()?;
                if !trained.replace(name, &values) {
                    return Err(TrainError::Tensor(format!(
                        "the backbone has no tensor {name} of this shape"
                    )));
                }
            }
        }
        trained.save(weights)?;
        let flat =
            |name: &str| Ok::<_, TrainError>(self.tensor(name)?.flatten_all()?.to_vec1::<f32>()?);
        Ok(Head::new(
            Aggregate::Mean,
            flat(HEAD_WEIGHT)?,
            flat(HEAD_BIAS)?,
            backbone()?,
            notes,
        )?
        .save(head)?)
    }

    fn tensor(&self, name: &str) -> Result<&Tensor> {
        self.tensors
            .get(name)
            .ok_or_else(|| TrainError::Tensor(format!("the backbone has no tensor {name}")))
    }

    /// Patch tokens of the exit block, `[batch, n, dim]`.
    fn tokens(&self, images: &[ImageTensor]) -> Result<Tensor> {
        let geometry = &self.base.geometry;
        let dim = geometry.dim;
        let patch = geometry.patch;
        let patches: Vec<Tensor> = images
            .iter()
            .map(|image| unfold(image, patch))
            .collect::<Result<_>>()?;
        let kernel = self
            .tensor("patch_embed.proj.weight")?
            .reshape((dim, 3 * patch * patch))?;
        let patches = linear(
            &Tensor::stack(&patches, 0)?,
            &kernel,
            self.tensor("patch_embed.proj.bias")?,
        )?;
        let cls = self
            .tensor("cls_token")?
            .reshape((1, 1, dim))?
            .broadcast_as((images.len(), 1, dim))?;
        let table = self.tensor("pos_embed")?;
        let table = table.reshape((table.elem_count() / dim, dim))?;
        let positions = self.interpolation.matmul(&table)?;
        let mut x = Tensor::cat(&[&cls.contiguous()?, &patches], 1)?.broadcast_add(&positions)?;
        for block in 0..=self.spec.exit_block {
            x = self.block(&x, block)?;
        }
        if self.spec.token_norm {
            x = self.norm(&x, "norm")?;
        }
        Ok(x.narrow(1, 1, x.dim(1)? - 1)?)
    }

    fn block(&self, x: &Tensor, block: usize) -> Result<Tensor> {
        let (batch, length, dim) = x.dims3()?;
        let heads = self.base.geometry.heads;
        let head_dim = self.base.geometry.head_dim();
        let name = |part: &str| format!("blocks.{block}.{part}");
        let fused = self.dense(&self.norm(x, &name("norm1"))?, &name("attn.qkv"))?;
        let part = |index: usize| -> candle_core::Result<Tensor> {
            let part = fused.narrow(D::Minus1, index * dim, dim)?;
            part.reshape((batch, length, heads, head_dim))?
                .transpose(1, 2)?
                .contiguous()
        };
        let queries = (part(0)? * (head_dim as f64).powf(-0.5))?;
        let scores = queries.matmul(&part(1)?.transpose(2, 3)?.contiguous()?)?;
        let mixed = candle_nn::ops::softmax(&scores, D::Minus1)?.matmul(&part(2)?)?;
        let mixed = mixed.transpose(1, 2)?.reshape((batch, length, dim))?;
        let x = self.residual(
            x,
            self.dense(&mixed, &name("attn.proj"))?,
            &name("ls1.gamma"),
        )?;
        let hidden = self
            .dense(&self.norm(&x, &name("norm2"))?, &name("mlp.fc1"))?
            .gelu_erf()?;
        self.residual(
            &x,
            self.dense(&hidden, &name("mlp.fc2"))?,
            &name("ls2.gamma"),
        )
    }

    fn residual(&self, x: &Tensor, branch: Tensor, scale: &str) -> Result<Tensor> {
        Ok(match self.tensors.get(scale) {
            Some(scale) => (x + branch.broadcast_mul(scale)?)?,
            None => (x + branch)?,
        })
    }

    fn dense(&self, x: &Tensor, layer: &str) -> Result<Tensor> {
        linear(
            x,
            self.tensor(&format!("{layer}.weight"))?,
            self.tensor(&format!("{layer}.bias"))?,
        )
    }

    fn norm(&self, x: &Tensor, layer: &str) -> Result<Tensor> {
        let weight = self.tensor(&format!("{layer}.weight"))?;
        let bias = self.tensor(&format!("{layer}.bias"))?;
        // The fused LayerNorm of candle has no gradient.
        Ok(candle_nn::ops::layer_norm_slow(
            x,
            weight,
            bias,
            LAYER_NORM_EPS,
        )?)
    }

    fn load(&self, set: &TripletSet, sample: &Sample) -> Result<ImageTensor> {
        let path = &set.images(sample.side)[sample.index];
        let bytes = std::fs::read(path).map_err(|source| TrainError::Io {
            path: path.clone(),
            source,
        })?;
        let image = load_tensor(&bytes, &self.images, self.spec.input_size)
            .map_err(|error| TrainError::Setting(format!("{}: {error}", path.display())))?;
        Ok(match sample.variation {
            Some(seed) => augment(&image, &self.augmentation, seed),
            None => image,
        })
    }
}

impl TripletModel for BackboneModel {
    fn variables(&self) -> Vec<(String, Var)> {
        self.variables
            .iter()
            .map(|(name, variable)| (name.clone(), variable.clone()))
            .collect()
    }

    fn embed(&self, set: &TripletSet, samples: &[Sample]) -> Result<Tensor> {
        let images: Vec<ImageTensor> = samples
            .par_iter()
            .map(|sample| self.load(set, sample))
            .collect::<Result<_>>()?;
        let pooled = normalise_rows(&self.tokens(&images)?.mean(1)?)?;
        let projected = linear(&pooled, self.tensor(HEAD_WEIGHT)?, self.tensor(HEAD_BIAS)?)?;
        Ok(normalise_rows(&projected)?)
    }

    fn embed_batch(&self) -> usize {
        8
    }
}

/// x W^T + b over the last dimension.
fn linear(x: &Tensor, weight: &Tensor, bias: &Tensor) -> Result<Tensor> {
    let mut shape = x.dims().to_vec();
    let input = shape.pop().unwrap_or_default();
    let rows = x.reshape((x.elem_count() / input.max(1), input))?;
    shape.push(bias.elem_count());
    Ok(rows
        .matmul(&weight.t()?)?
        .broadcast_add(bias)?
        .reshape(shape)?)
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

fn block_of(name: &str) -> Option<usize> {
    name.strip_prefix("blocks.")?
        .split('.')
        .next()?
        .parse()
        .ok()
}

fn is_trained(name: &str, trainable: TrainableBlocks, blocks: usize, token_norm: bool) -> bool {
    match (trainable, block_of(name)) {
        (TrainableBlocks::Last(count), Some(block)) => block + count >= blocks,
        (TrainableBlocks::Last(_), None) => name.starts_with("norm.") && token_norm,
        (TrainableBlocks::All, None) if name.starts_with("norm.") => token_norm,
        (TrainableBlocks::All, _) => true,
    }
}

#[cfg(test)]
mod tests;
