//! What the model sees in one image: a global descriptor and key patches at three scales.

use crate::invalid::InvalidValue;
use half::f16;
use serde::{Deserialize, Serialize};
use std::fmt;
use std::str::FromStr;

/// Length of a global descriptor (paper III-A).
pub const GLOBAL_DIM: usize = 256;

/// Number of patch scales: base patches, and patches fused 2x2 and 3x3 (paper III-B).
pub const SCALES: usize = 3;

/// Width and height in pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct ImageSize {
    /// Pixels per row.
    pub width: u32,
    /// Rows.
    pub height: u32,
}

impl fmt::Display for ImageSize {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}x{}", self.width, self.height)
    }
}

impl FromStr for ImageSize {
    type Err = InvalidValue;

    /// Parses `WIDTHxHEIGHT`.
    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let wrong = || {
            InvalidValue::new(
                "size",
                format!("{text:?} is not WIDTHxHEIGHT, such as 448x336"),
            )
        };
        let (width, height) = text.split_once('x').ok_or_else(wrong)?;
        let width = width.parse().map_err(|_| wrong())?;
        let height = height.parse().map_err(|_| wrong())?;
        if width == 0 || height == 0 {
            Err(wrong())
        } else {
            Ok(Self { width, height })
        }
    }
}

/// A normalised image ready for the transformer: `[3, height, width]` f32, ImageNet mean and
/// deviation applied.
#[derive(Debug, Clone, PartialEq)]
pub struct ImageTensor {
    /// Width and height in pixels, multiples of the model's patch size.
    pub size: ImageSize,
    /// Planes R, G, B, each row-major.
    pub data: Vec<f32>,
}

/// How far apart fused windows lie; the paper (III-B) does not say.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum PoolingStride {
    /// As far as the kernel is wide: windows do not overlap, trailing rows and columns are
    /// dropped.
    #[default]
    Kernel,
    /// One patch.
    One,
}

impl PoolingStride {
    /// Stride in base patches at `scale` (1, 2 or 3).
    pub fn at(self, scale: usize) -> usize {
        match self {
            Self::Kernel => scale,
            Self::One => 1,
        }
    }
}

/// The grid of base patches from which key patches of every scale were taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PatchGrid {
    /// Base patches per row.
    pub columns: u16,
    /// Rows of base patches.
    pub rows: u16,
    /// Side of a base patch in pixels of the model's input.
    pub patch_px: u16,
    /// Distance between fused windows.
    pub stride: PoolingStride,
}

impl PatchGrid {
    /// Columns and rows of the fused grid at `scale` (floor mode).
    pub fn pooled(&self, scale: usize) -> (usize, usize) {
        let stride = self.stride.at(scale);
        let along = |n: u16| (n as usize + stride).saturating_sub(scale) / stride;
        (along(self.columns), along(self.rows))
    }

    /// Centre, in pixels of the model's input, of the window with row-major `index` in the fused
    /// grid at `scale`.
    pub fn centre(&self, scale: usize, index: usize) -> [f32; 2] {
        let (columns, _) = self.pooled(scale);
        let stride = self.stride.at(scale);
        let along = |i: usize| ((i * stride) as f32 + scale as f32 / 2.0) * self.patch_px as f32;
        [along(index % columns), along(index / columns)]
    }
}

/// Key patches of one scale in full precision, by attention descending, ties to the lower index
/// (paper III-C).
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ScaleKeyPatches {
    /// Row-major position in the fused grid, `[m]`.
    pub index: Vec<u32>,
    /// Attention in multiples of the uniform level heads/n, `[m]`.
    pub attention: Vec<f32>,
    /// L2-normalised descriptors, `[m, dim]` row-major.
    pub descriptors: Vec<f32>,
}

/// Key patches of all scales in full precision, as extraction makes them.
#[derive(Debug, Clone, PartialEq)]
pub struct KeyPatches {
    /// The grid they index.
    pub grid: PatchGrid,
    /// Length of a descriptor.
    pub dim: usize,
    /// Scales 1, 2, 3.
    pub scales: [ScaleKeyPatches; SCALES],
}

/// Key patches of all scales as they are matched and stored: int8 descriptors, one f32 factor
/// each.
///
/// Rows of scale 1 come first, then 2, then 3, so that a union of neighbouring scales is one
/// slice.
#[derive(Debug, Clone, PartialEq)]
pub struct PackedPatches {
    /// The grid they index.
    pub grid: PatchGrid,
    /// Length of a descriptor.
    pub dim: usize,
    /// Patches per scale.
    pub counts: [usize; SCALES],
    /// Row-major position in the fused grid of the patch's own scale, `[sum(counts)]`.
    pub index: Vec<u16>,
    /// Attention in multiples of the uniform level, `[sum(counts)]`.
    pub attention: Vec<f16>,
    /// Factor of each descriptor: value = code * factor, `[sum(counts)]`.
    pub factor: Vec<f32>,
    /// Codes in -127..=127, `[sum(counts), dim]` row-major.
    pub codes: Vec<i8>,
}

impl PackedPatches {
    /// Number of patches over all scales.
    pub fn len(&self) -> usize {
        self.counts.iter().sum()
    }

    /// Whether there is no patch at all.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Rows of `scale` (1, 2 or 3).
    pub fn rows(&self, scale: usize) -> std::ops::Range<usize> {
        let start = self.counts[..scale - 1].iter().sum();
        start..start + self.counts[scale - 1]
    }

    /// The scale (1, 2 or 3) of `row`.
    pub fn scale_of(&self, row: usize) -> usize {
        (1..=SCALES)
            .find(|&scale| self.rows(scale).contains(&row))
            .unwrap_or(SCALES)
    }

    /// Centre of the patch in `row`, in pixels of the model's input.
    pub fn centre(&self, row: usize) -> [f32; 2] {
        self.grid
            .centre(self.scale_of(row), self.index[row] as usize)
    }

    /// Bytes on the heap.
    pub fn heap_bytes(&self) -> usize {
        self.index.len() * 2 + self.attention.len() * 2 + self.factor.len() * 4 + self.codes.len()
    }
}

/// Everything the service keeps of an image.
#[derive(Debug, Clone, PartialEq)]
pub struct Descriptor {
    /// L2-normalised global descriptor, `[256]`: searched.
    pub global: Vec<f32>,
    /// Pooled patch tokens before the head, L2-normalised, `[dim]` of the head's aggregate (the
    /// mean token, unless the head says otherwise): kept so that a map can be given a new head of
    /// the same aggregate.
    pub pooled: Vec<f32>,
    /// Key patches: re-ranked.
    pub patches: PackedPatches,
}

/// A non-empty set of scales matched jointly, such as `1+2` (a row of the paper's table of patch
/// sizes).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct ScaleSet(u8);

impl ScaleSet {
    /// The set holding `scales`, each 1, 2 or 3.
    pub fn new(scales: &[usize]) -> Result<Self, InvalidValue> {
        let mut bits = 0;
        for &scale in scales {
            if !(1..=SCALES).contains(&scale) {
                return Err(InvalidValue::new(
                    "scales",
                    format!("{scale} is not a scale; use 1, 2 or 3"),
                ));
            }
            bits |= 1 << (scale - 1);
        }
        if bits == 0 {
            Err(InvalidValue::new(
                "scales",
                "a combination needs at least one scale",
            ))
        } else {
            Ok(Self(bits))
        }
    }

    /// Whether `scale` belongs.
    pub fn contains(self, scale: usize) -> bool {
        (1..=SCALES).contains(&scale) && self.0 & (1 << (scale - 1)) != 0
    }

    /// The scales, ascending.
    pub fn scales(self) -> impl Iterator<Item = usize> {
        (1..=SCALES).filter(move |&scale| self.contains(scale))
    }

    /// The name of its score: `s11`, `s12`, `s23`, `s123`, ... (a lone scale is written twice, as
    /// in the paper).
    pub fn score_name(self) -> String {
        let digits: String = self.scales().map(|scale| scale.to_string()).collect();
        if digits.len() == 1 {
            format!("s{digits}{digits}")
        } else {
            format!("s{digits}")
        }
    }

    /// S = s11 + s12 + s23, the best row of the paper's table of patch sizes.
    pub fn paper_default() -> Vec<Self> {
        vec![Self(0b001), Self(0b011), Self(0b110)]
    }
}

impl fmt::Display for ScaleSet {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let parts: Vec<String> = self.scales().map(|scale| scale.to_string()).collect();
        f.write_str(&parts.join("+"))
    }
}

impl FromStr for ScaleSet {
    type Err = InvalidValue;

    /// Parses `1`, `1+2`, `2+3`, `1+2+3`, ...
    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let mut scales = Vec::new();
        for part in text.split('+') {
            let scale = part.trim().parse().map_err(|_| {
                let reason = format!("{text:?} is not scales joined by +, such as 1+2");
                InvalidValue::new("scales", reason)
            })?;
            scales.push(scale);
        }
        Self::new(&scales)
    }
}

impl TryFrom<String> for ScaleSet {
    type Error = InvalidValue;
    fn try_from(text: String) -> Result<Self, Self::Error> {
        text.parse()
    }
}

impl From<ScaleSet> for String {
    fn from(set: ScaleSet) -> Self {
        set.to_string()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const GRID: PatchGrid = PatchGrid {
        columns: 32,
        rows: 24,
        patch_px: 14,
        stride: PoolingStride::Kernel,
    };

    #[test]
    fn pooled_grids_follow_floor_mode() {
        assert_eq!(
            [1, 2, 3].map(|s| GRID.pooled(s)),
            [(32, 24), (16, 12), (10, 8)]
        );
        let dense = PatchGrid {
            stride: PoolingStride::One,
            ..GRID
        };
        assert_eq!(
            [1, 2, 3].map(|s| dense.pooled(s)),
            [(32, 24), (31, 23), (30, 22)]
        );
    }

    #[test]
    fn centres_lie_in_the_middle_of_their_windows() {
        assert_eq!(GRID.centre(1, 0), [7.0, 7.0]);
        assert_eq!(GRID.centre(2, 17), [42.0, 42.0]);
        assert_eq!(GRID.centre(3, 9), [9.0 * 42.0 + 21.0, 21.0]);
    }

    #[test]
    fn scale_sets_parse_print_and_name_their_score() {
        for (text, name) in [
            ("1", "s11"),
            ("1+2", "s12"),
            ("3+2", "s23"),
            ("1+2+3", "s123"),
        ] {
            assert_eq!(text.parse::<ScaleSet>().unwrap().score_name(), name);
        }
        for bad in ["", "0", "4", "1+", "a"] {
            assert!(bad.parse::<ScaleSet>().is_err(), "{bad}");
        }
    }
}
