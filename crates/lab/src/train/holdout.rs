//! Keeping places back for validation: blocks of ground of data sets with positions, and the last
//! part of drives without.

use super::error::TrainError;
use crate::datasets::{Dataset, GroundSplit};
use std::path::PathBuf;

/// How much is held out, and how.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Holdout {
    /// Share of the images to hold out, between 0 and 1.
    pub share: f64,
    /// Side of a block in metres.
    pub block_m: f64,
    /// Training images nearer than this to a held-out one, in metres, are left out.
    pub gap_m: f64,
    /// Frames left out between the two parts of a drive.
    pub gap_frames: usize,
    /// Decides which blocks are held out.
    pub seed: u64,
}

/// Frames of several drives, each in order.
pub type Drives = Vec<Vec<PathBuf>>;

impl Holdout {
    /// Splits a data set by blocks of ground into what is learnt from and what is held out. Images
    /// without a position are in neither.
    ///
    /// # Errors
    /// A setting is out of range, no image has a position, or all lie in one block.
    pub fn by_blocks(&self, dataset: &Dataset) -> Result<(Dataset, Dataset), TrainError> {
        let ground = GroundSplit {
            share: self.share,
            block_m: self.block_m,
            gap_m: self.gap_m,
            seed: self.seed,
        };
        Ok(ground.split(dataset)?)
    }

    /// Splits drives (frames in order): the last share of each is held out, behind a gap.
    ///
    /// # Errors
    /// The share is out of range.
    pub fn by_tails(&self, drives: &[Vec<PathBuf>]) -> Result<(Drives, Drives), TrainError> {
        if !(self.share > 0.0 && self.share < 1.0) {
            return Err(TrainError::Setting(format!(
                "the share of places held out must lie between 0 and 1, and is {}",
                self.share
            )));
        }
        let split = |drive: &Vec<PathBuf>| {
            let tail = drive.len() - (drive.len() as f64 * self.share).round() as usize;
            (
                drive[..tail.saturating_sub(self.gap_frames)].to_vec(),
                drive[tail..].to_vec(),
            )
        };
        Ok(drives.iter().map(split).unzip())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_end_of_each_drive_is_held_out_behind_a_gap() {
        let holdout = Holdout {
            share: 0.2,
            block_m: 100.0,
            gap_m: 25.0,
            gap_frames: 15,
            seed: 3,
        };
        let drive: Vec<PathBuf> = (0..100).map(|i| PathBuf::from(format!("{i}"))).collect();
        let (training, validation) = holdout
            .by_tails(&[drive.clone(), drive[..10].to_vec()])
            .unwrap();
        assert_eq!((training[0].len(), validation[0].len()), (65, 20));
        assert_eq!(validation[0][0], drive[80]);
        assert_eq!((training[1].len(), validation[1].len()), (0, 2));
        let all = Holdout {
            share: 1.0,
            ..holdout
        };
        assert!(all.by_tails(&[drive]).is_err());
    }
}
