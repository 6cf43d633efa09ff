//! Why two images were found to match, or not: everything the picture of a match needs, computed
//! anew for one pair.

use super::error::EvalError;
use crate::draw::{AttentionMap, CombinationLines, DrawnSide, match_picture};
use placeformer_core::types::PackedPatches;
use placeformer_vision::extract::Extractor;
use placeformer_vision::extract::pack;
use placeformer_vision::image::{ImageConfig, RgbImage, decode, load_tensor};
use placeformer_vision::rerank::CombinationMatch;

/// What the model saw in one image.
pub struct Seen {
    /// The photo, upright, at full size.
    pub image: RgbImage,
    /// Attention in multiples of the uniform level, one value per base patch.
    pub attention: Vec<f32>,
    /// Key patches.
    pub patches: PackedPatches,
    /// Searched vector.
    pub global: Vec<f32>,
}

impl Seen {
    /// Runs the model on one image and keeps what a picture needs.
    ///
    /// # Errors
    /// The image cannot be decoded, or the model fails.
    pub fn new(
        extractor: &Extractor,
        limits: &ImageConfig,
        bytes: &[u8],
    ) -> Result<Self, EvalError> {
        let trace = extractor.trace(&load_tensor(bytes, limits, extractor.input_size())?)?;
        Ok(Self {
            image: decode(bytes, limits)?,
            attention: trace.attention,
            patches: pack(&trace.key_patches),
            global: trace.global,
        })
    }

    fn side(&self) -> DrawnSide<'_> {
        let grid = self.patches.grid;
        let columns = usize::from(grid.columns);
        let rows = usize::from(grid.rows);
        let attention = Some(AttentionMap {
            values: &self.attention,
            columns,
            rows,
        });
        DrawnSide {
            image: &self.image,
            attention,
            patches: &self.patches,
        }
    }
}

/// Both images side by side with attention and key patches, and the inliers of every combination.
///
/// # Errors
/// An image has no pixels, or a match names a patch that is not there.
pub fn picture(
    query: &Seen,
    reference: &Seen,
    matches: &[CombinationMatch],
) -> Result<RgbImage, EvalError> {
    let inliers = |found: &CombinationMatch| -> Vec<(u32, u32)> {
        let inliers = found.correspondences.iter().filter(|pair| pair.inlier);
        inliers.map(|pair| (pair.query, pair.reference)).collect()
    };
    let lists: Vec<Vec<(u32, u32)>> = matches.iter().map(inliers).collect();
    let lines: Vec<CombinationLines<'_>> = matches
        .iter()
        .zip(&lists)
        .map(|(found, inliers)| CombinationLines {
            scales: found.score.scales,
            matches: found.correspondences.len(),
            inliers,
        })
        .collect();
    Ok(match_picture(&query.side(), &reference.side(), &lines)?)
}
