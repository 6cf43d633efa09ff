//! Made-up weights of a transformer: they cost what learned ones cost, and describe nothing.

use super::noise::values;
use placeformer_vision::extract::{BlockWeights, Geometry, Linear, Norm, Preset, VitWeights};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

/// Weights of `geometry`, drawn from `seed`, with positions for a grid of `position_grid` patches
/// (rows, columns).
pub fn made_up(
    preset: Preset,
    geometry: Geometry,
    position_grid: (usize, usize),
    seed: u64,
) -> VitWeights {
    let Geometry { dim, patch, .. } = geometry;
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let position_count = 1 + position_grid.0 * position_grid.1;
    VitWeights {
        preset,
        unused_parameters: 0,
        merged: None,
        geometry,
        position_grid,
        blocks: (0..geometry.depth)
            .map(|_| block(&mut random, geometry))
            .collect(),
        patch_embed: linear(&mut random, 3 * patch * patch, dim),
        cls_token: values(&mut random, dim, 1.0),
        positions: values(&mut random, position_count * dim, 0.1),
        norm: norm(dim),
    }
}

fn block(random: &mut ChaCha8Rng, geometry: Geometry) -> BlockWeights {
    let Geometry { dim, mlp_dim, .. } = geometry;
    let layer_scale = geometry.layer_scale.then(|| vec![0.5; dim]);
    BlockWeights {
        norm1: norm(dim),
        qkv: linear(random, dim, 3 * dim),
        proj: linear(random, dim, dim),
        layer_scale1: layer_scale.clone(),
        norm2: norm(dim),
        fc1: linear(random, dim, mlp_dim),
        fc2: linear(random, mlp_dim, dim),
        layer_scale2: layer_scale,
    }
}

/// A layer whose outputs are about as large as its inputs.
fn linear(random: &mut ChaCha8Rng, inputs: usize, outputs: usize) -> Linear {
    let spread = (inputs as f32).sqrt().recip();
    Linear {
        weight: values(random, outputs * inputs, spread),
        bias: values(random, outputs, 0.1),
    }
}

fn norm(dim: usize) -> Norm {
    Norm {
        weight: vec![1.0; dim],
        bias: vec![0.0; dim],
    }
}
