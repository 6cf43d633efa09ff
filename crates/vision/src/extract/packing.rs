//! Key patches in full precision to the int8 form in which they are matched and stored.
//!
//! A descriptor becomes int8 codes and one f32 factor that turns codes back into values. That takes
//! a quarter of the memory and loses no recall.

use half::f16;
use placeformer_core::types::{KeyPatches, PackedPatches};
use placeformer_kernels::{quantise, simd};

/// The largest magnitude of an int8 code.
const LARGEST_CODE: f32 = 127.0;

/// Quantises descriptors symmetrically: the largest magnitude of each becomes 127.
///
/// # Panics
/// If `PLACEFORMER_SIMD` asks for a level that the CPU lacks. Programs rule that out at start, by
/// [`placeformer_kernels::self_check`].
pub fn pack(patches: &KeyPatches) -> PackedPatches {
    let simd = simd::selected();
    let counts = [0, 1, 2].map(|s| patches.scales[s].index.len());
    let total = counts.iter().sum();
    let mut packed = PackedPatches {
        grid: patches.grid,
        dim: patches.dim,
        counts,
        index: Vec::with_capacity(total),
        attention: Vec::with_capacity(total),
        factor: Vec::with_capacity(total),
        codes: Vec::with_capacity(total * patches.dim),
    };
    for scale in &patches.scales {
        let index = scale.index.iter().map(|&index| index as u16);
        let attention = scale.attention.iter().map(|&value| f16::from_f32(value));
        packed.index.extend(index);
        packed.attention.extend(attention);
        for descriptor in scale.descriptors.chunks_exact(patches.dim) {
            let peak = quantise::largest(simd, descriptor).max(f32::MIN_POSITIVE);
            packed.factor.push(peak / LARGEST_CODE);
            let start = packed.codes.len();
            packed.codes.resize(start + patches.dim, 0);
            let codes = &mut packed.codes[start..];
            quantise::quantise(simd, descriptor, peak, LARGEST_CODE, codes);
        }
    }
    packed
}

#[cfg(test)]
mod tests {
    use super::*;
    use placeformer_core::types::{PatchGrid, PoolingStride, ScaleKeyPatches};

    const GRID: PatchGrid = PatchGrid {
        columns: 32,
        rows: 24,
        patch_px: 14,
        stride: PoolingStride::Kernel,
    };

    #[test]
    fn quantising_keeps_descriptors_within_half_a_step() {
        let values: Vec<f32> = (0..8).map(|i| (i as f32 - 3.5) / 10.0).collect();
        let one = ScaleKeyPatches {
            index: vec![5],
            attention: vec![1.5],
            descriptors: values.clone(),
        };
        let patches = KeyPatches {
            grid: GRID,
            dim: 8,
            scales: [Default::default(), one, Default::default()],
        };
        let packed = pack(&patches);
        assert_eq!(packed.counts, [0, 1, 0]);
        assert_eq!(packed.scale_of(0), 2);
        assert_eq!(packed.rows(2), 0..1);
        let factor = packed.factor[0];
        for (&code, value) in packed.codes.iter().zip(&values) {
            let error = (f32::from(code) * factor - value).abs();
            assert!(error <= factor / 2.0 + 1e-6);
        }
    }
}
