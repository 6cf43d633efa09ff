//! What a step of training minimises.
//!
//! The paper's triplets compare one positive with one negative. InfoNCE and multi-similarity
//! compare every image of a batch with all the others, so that a batch of 80 images holds thousands
//! of comparisons instead of a few dozen.

mod in_batch;
mod triplet;

use super::error::TrainError;
use crate::choice::Choice;
pub(super) use in_batch::{Pairs, info_nce, multi_similarity};
use serde::{Deserialize, Serialize};
pub(super) use triplet::{normalise_rows, triplet_margin_loss};

/// Which loss, with its setting.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Loss {
    /// Triplet margin loss on squared distances (paper III-F).
    Triplet {
        /// By how much a negative must be farther than a positive.
        margin: f64,
    },
    /// Each positive against all negatives of its row (InfoNCE, van den Oord et al. 2018; with
    /// several positives as in supervised contrastive learning, Khosla et al. 2020).
    InfoNce {
        /// Similarities are divided by it.
        temperature: f64,
    },
    /// Multi-similarity (Wang et al. 2019): of each row only the pairs that are hard for it, softly
    /// weighted.
    MultiSimilarity,
}

impl Loss {
    /// Which of them it is.
    pub fn kind(self) -> LossKind {
        match self {
            Self::Triplet { .. } => LossKind::Triplet,
            Self::InfoNce { .. } => LossKind::InfoNce,
            Self::MultiSimilarity => LossKind::MultiSimilarity,
        }
    }

    pub(super) fn check(self) -> Result<(), TrainError> {
        let refuse = |reason: String| Err(TrainError::Setting(reason));
        match self {
            Self::Triplet { margin } if !(margin.is_finite() && margin >= 0.0) => {
                refuse(format!("the margin must not be negative, and is {margin}"))
            }
            Self::InfoNce { temperature } if !(temperature.is_finite() && temperature > 0.0) => {
                refuse(format!(
                    "the temperature must be positive, not {temperature}"
                ))
            }
            _ => Ok(()),
        }
    }
}

/// A loss by name.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LossKind {
    /// [`Loss::Triplet`].
    Triplet,
    /// [`Loss::InfoNce`].
    InfoNce,
    /// [`Loss::MultiSimilarity`].
    MultiSimilarity,
}

impl Choice for LossKind {
    const ALL: &'static [Self] = &[Self::Triplet, Self::InfoNce, Self::MultiSimilarity];

    fn as_str(self) -> &'static str {
        match self {
            Self::Triplet => "triplet",
            Self::InfoNce => "info-nce",
            Self::MultiSimilarity => "multi-similarity",
        }
    }

    fn description(self) -> &'static str {
        match self {
            Self::Triplet => "Triplets with a margin, as in the paper",
            Self::InfoNce => "Each positive against all negatives of the batch",
            Self::MultiSimilarity => "The hard pairs of the batch, softly weighted",
        }
    }
}
