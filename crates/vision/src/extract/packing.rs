//! Key patches in full precision to the int8 form in which they are matched and stored.

use half::f16;
use placeformer_core::types::{KeyPatches, PackedPatches};
use placeformer_kernels::{quantise, simd};

/// Quantises descriptors symmetrically: the largest magnitude of each becomes 127, and its factor
/// turns codes back into values.
///
/// # Panics
/// Where `PLACEFORMER_SIMD` asks for a level the CPU lacks. Programs have checked that at start, by
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
        packed.index.extend(scale.index.iter().map(|&i| i as u16));
        let attention = scale.attention.iter().map(|&a| f16::from_f32(a));
        packed.attention.extend(attention);
        for descriptor in scale.descriptors.chunks_exact(patches.dim) {
            let peak = quantise::largest(simd, descriptor).max(f32::MIN_POSITIVE);
            packed.factor.push(peak / 127.0);
            let start = packed.codes.len();
            packed.codes.resize(start + patches.dim, 0);
            quantise::quantise(simd, descriptor, peak, 127.0, &mut packed.codes[start..]);
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
        assert_eq!(
            (packed.counts, packed.scale_of(0), packed.rows(2)),
            ([0, 1, 0], 2, 0..1)
        );
        for (code, value) in packed.codes.iter().zip(&values) {
            assert!(
                (*code as f32 * packed.factor[0] - value).abs() <= packed.factor[0] / 2.0 + 1e-6
            );
        }
    }
}
