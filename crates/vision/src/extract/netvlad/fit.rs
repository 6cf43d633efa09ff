//! Learning a NetVLAD from tokens without labels: a PCA for the projection, k-means for the words.

use super::{NetVlad, NetVladParameters, dot};
use crate::extract::components::{Components, Covariance};
use crate::extract::error::ExtractError;
use crate::extract::global::l2_normalise;
use crate::extract::vlad::VladWords;

/// What a NetVLAD that is learnt from tokens should be.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct NetVladShape {
    /// Number of visual words.
    pub words: usize,
    /// Width of a projected token.
    pub width: usize,
    /// How strongly a token prefers the word that it is most alike: the factor of cosines before
    /// the softmax. A very large one makes a VLAD.
    pub sharpness: f32,
}

impl Default for NetVladShape {
    fn default() -> Self {
        Self {
            words: 64,
            width: 96,
            sharpness: 20.0,
        }
    }
}

impl NetVlad {
    /// Learns the parts from tokens `[n, dim]`: their mean, their strongest principal components,
    /// and words by k-means among the projected tokens. Equal `seed`s give equal parts.
    ///
    /// # Errors
    /// [`ExtractError::TooFewTokens`] if there are fewer tokens than words, or than the width.
    pub fn fit(
        tokens: &[f32],
        dim: usize,
        shape: NetVladShape,
        seed: u64,
    ) -> Result<Self, ExtractError> {
        let count = tokens.len() / dim;
        let needed = shape.words.max(shape.width);
        if needed == 0 || count < needed || shape.width > dim {
            return Err(ExtractError::TooFewTokens {
                words: needed,
                tokens: count,
            });
        }
        let mut unit = tokens.to_vec();
        unit.chunks_exact_mut(dim).for_each(l2_normalise);
        let mut covariance = Covariance::new(dim);
        unit.chunks_exact(dim)
            .for_each(|token| covariance.add(token));
        let components = Components::of(&covariance, shape.width);
        let mean: Vec<f32> = components.mean.iter().map(|&value| value as f32).collect();
        let projection: Vec<f32> = components
            .strongest
            .iter()
            .flat_map(|component| component.direction.iter().map(|&value| value as f32))
            .collect();

        let mut projected = Vec::with_capacity(count * shape.width);
        for token in unit.chunks_exact(dim) {
            let centred: Vec<f32> = token.iter().zip(&mean).map(|(a, b)| a - b).collect();
            projected.extend(projection.chunks_exact(dim).map(|row| dot(row, &centred)));
        }
        let fitted = VladWords::fit(&projected, shape.width, shape.words, seed)?;
        let mut words = fitted.values().to_vec();
        words.chunks_exact_mut(shape.width).for_each(l2_normalise);
        let assignment = words.iter().map(|value| value * shape.sharpness).collect();
        let parameters = NetVladParameters {
            mean,
            projection,
            words,
            assignment,
        };
        Self::new(parameters).map_err(|reason| ExtractError::BadFile {
            path: "NetVLAD".into(),
            reason,
        })
    }
}
