//! What is done to key patches after extraction, so that rows of a table can share one.

use crate::eval::error::EvalError;
use nalgebra::{DMatrix, DVector, SymmetricEigen};
use placeformer_core::types::{PackedPatches, SCALES};

/// What is done to key patches after extraction.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Cut {
    None,
    /// Only patches above tau, at most so many per scale.
    Limits {
        tau: f32,
        caps: [usize; SCALES],
    },
    /// Not cut but described once more, in f32.
    FullPrecision,
    /// Descriptors as another codec would give them back.
    Codec(Codec),
}

/// How a descriptor is stored.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Codec {
    /// Every value in so many bits.
    Bits(u32),
    /// The leading components of so many dimensions, 8 bits each.
    Components(usize),
}

impl Codec {
    /// What the store keeps.
    pub(super) const INT8: Self = Self::Bits(8);

    /// The store has no codec of fewer bits than 8: their values are rounded as it would, and their
    /// size is computed.
    pub(super) fn name(self) -> String {
        match self {
            Self::INT8 => "int8".into(),
            Self::Bits(bits) => format!("int{bits} simulated"),
            Self::Components(count) => format!("pca{count} int8"),
        }
    }

    /// Bits of a value.
    pub(super) fn bits(self) -> u32 {
        match self {
            Self::Bits(bits) => bits,
            Self::Components(_) => 8,
        }
    }
}

/// `patches` after `cut`; `components` are needed for [`Codec::Components`].
pub(super) fn apply(
    patches: &PackedPatches,
    cut: Cut,
    components: Option<&Components>,
) -> Result<PackedPatches, EvalError> {
    match cut {
        Cut::None => Ok(patches.clone()),
        Cut::FullPrecision => Err(EvalError::Setting(
            "full precision cannot be had from stored patches".into(),
        )),
        Cut::Limits { tau, caps } => Ok(limit(patches, tau, caps)),
        Cut::Codec(Codec::Bits(bits)) => Ok(coarsen(patches, bits)),
        Cut::Codec(Codec::Components(_)) => match components {
            Some(components) => Ok(components.project(patches)),
            None => Err(EvalError::Setting(
                "principal components were asked for before they were found".into(),
            )),
        },
    }
}

/// The patches above `tau`, at most `caps` per scale. Attention is kept in 16 bits, so tau is
/// rounded likewise.
pub(super) fn limit(patches: &PackedPatches, tau: f32, caps: [usize; SCALES]) -> PackedPatches {
    let tau = half::f16::from_f32(tau);
    let mut kept = PackedPatches {
        grid: patches.grid,
        dim: patches.dim,
        counts: [0; SCALES],
        index: Vec::new(),
        attention: Vec::new(),
        factor: Vec::new(),
        codes: Vec::new(),
    };
    for scale in 1..=SCALES {
        let rows = patches.rows(scale);
        let above = patches.attention[rows.clone()]
            .iter()
            .take_while(|&&attention| attention > tau)
            .count();
        let rows = rows.start..rows.start + above.min(caps[scale - 1]);
        kept.counts[scale - 1] = rows.len();
        kept.index.extend_from_slice(&patches.index[rows.clone()]);
        kept.attention
            .extend_from_slice(&patches.attention[rows.clone()]);
        kept.factor.extend_from_slice(&patches.factor[rows.clone()]);
        kept.codes
            .extend_from_slice(&patches.codes[rows.start * patches.dim..rows.end * patches.dim]);
    }
    kept
}

/// The same patches with codes of fewer bits: what a smaller codec would give back.
pub(super) fn coarsen(patches: &PackedPatches, bits: u32) -> PackedPatches {
    let mut coarse = patches.clone();
    let steps = f32::from((1i16 << (bits - 1)) - 1);
    for (code, factor) in coarse
        .codes
        .chunks_mut(patches.dim.max(1))
        .zip(&mut coarse.factor)
    {
        for value in code.iter_mut() {
            *value = (f32::from(*value) / 127.0 * steps).round() as i8;
        }
        *factor *= 127.0 / steps;
    }
    coarse
}

/// Principal components of key patch descriptors.
pub(super) struct Components {
    mean: DVector<f64>,
    /// One component a row.
    rows: DMatrix<f64>,
}

/// Descriptors the components are found from: enough for a few hundred dimensions.
pub(super) const SAMPLE: usize = 20_000;

impl Components {
    /// The `count` strongest directions of `descriptors`, `[n, dim]`.
    pub(super) fn of(descriptors: &[f32], dim: usize, count: usize) -> Self {
        // Without any key patch there is nothing to project either.
        let n = descriptors.len().checked_div(dim).unwrap_or(0);
        if n == 0 {
            return Self {
                mean: DVector::zeros(0),
                rows: DMatrix::zeros(0, 0),
            };
        }
        let mut data =
            DMatrix::from_row_iterator(n, dim, descriptors.iter().map(|&value| f64::from(value)));
        let mean = DVector::from_iterator(
            dim,
            data.column_iter().map(|column| column.sum() / n as f64),
        );
        for (mut column, mean) in data.column_iter_mut().zip(mean.iter()) {
            column.add_scalar_mut(-mean);
        }
        let eigen = SymmetricEigen::new(data.tr_mul(&data) / n as f64);
        let mut order: Vec<usize> = (0..dim).collect();
        order.sort_by(|&a, &b| eigen.eigenvalues[b].total_cmp(&eigen.eigenvalues[a]));
        let rows = DMatrix::from_fn(count.min(dim), dim, |row, column| {
            eigen.eigenvectors[(column, order[row])]
        });
        Self { mean, rows }
    }

    /// The same patches in these directions, of unit length again.
    fn project(&self, patches: &PackedPatches) -> PackedPatches {
        let dim = self.rows.nrows();
        let mut short = PackedPatches {
            dim,
            codes: Vec::new(),
            factor: Vec::new(),
            ..patches.clone()
        };
        for descriptor in unpack(patches) {
            let centred =
                DVector::from_iterator(descriptor.len(), descriptor.iter().map(|&v| f64::from(v)))
                    - &self.mean;
            let projected = &self.rows * centred;
            let length = projected.norm().max(f64::MIN_POSITIVE);
            let peak = projected.amax().max(f64::MIN_POSITIVE);
            short.factor.push((peak / length / 127.0) as f32);
            short.codes.extend(
                projected
                    .iter()
                    .map(|value| (value / peak * 127.0).round() as i8),
            );
        }
        short
    }
}

/// The descriptors behind the codes.
pub(super) fn unpack(patches: &PackedPatches) -> impl Iterator<Item = Vec<f32>> + '_ {
    let rows = patches
        .codes
        .chunks_exact(patches.dim.max(1))
        .zip(&patches.factor);
    rows.map(|(codes, factor)| codes.iter().map(|&code| f32::from(code) * factor).collect())
}
