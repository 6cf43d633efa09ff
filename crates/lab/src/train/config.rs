//! The settings of a run, and the recall it watches.

use super::augment::Augmentation;
use super::error::TrainError;
use super::schedule::Schedule;
use serde::{Deserialize, Serialize};

/// Settings of a run (paper III-F and IV-B where a number is given there).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TrainConfig {
    /// Margin m of the loss.
    pub margin: f64,
    /// Learning rate over the run.
    pub schedule: Schedule,
    /// Triplets per step.
    pub batch: usize,
    /// Steps between two minings; also between validations and checkpoints.
    pub steps_per_cycle: u64,
    /// Hard negatives kept for each query, one of which is drawn.
    pub negatives: usize,
    /// Most database images compared when mining.
    pub mining_pool: usize,
    /// Cycles without a better validation recall after which the run stops.
    pub patience: u32,
    /// Variation of the training images.
    pub augmentation: Augmentation,
    /// Where every random choice comes from.
    pub seed: u64,
}

impl Default for TrainConfig {
    fn default() -> Self {
        Self {
            margin: 0.01,
            schedule: Schedule::default(),
            batch: 16,
            steps_per_cycle: 100,
            negatives: 10,
            mining_pool: 20_000,
            patience: 8,
            augmentation: Augmentation::default(),
            seed: 0,
        }
    }
}

impl TrainConfig {
    /// Refuses settings that are out of range.
    ///
    /// # Errors
    /// A setting is out of range.
    pub fn check(&self) -> Result<(), TrainError> {
        self.schedule.check()?;
        self.augmentation.check()?;
        let positive = [
            ("batch", self.batch as u64),
            ("steps per cycle", self.steps_per_cycle),
            ("negatives", self.negatives as u64),
            ("mining pool", self.mining_pool as u64),
            ("patience", u64::from(self.patience)),
        ];
        if let Some((name, _)) = positive.iter().find(|(_, value)| *value == 0) {
            return Err(TrainError::Setting(format!("{name} must be at least 1")));
        }
        if !(self.margin.is_finite() && self.margin >= 0.0) {
            return Err(TrainError::Setting(format!(
                "the margin must not be negative, and is {}",
                self.margin
            )));
        }
        Ok(())
    }
}

/// Recall of the current weights on held-out places, in percent, given descriptors of both sides.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ValidationRecall {
    /// Recall@1.
    pub at_1: f64,
    /// Recall@5.
    pub at_5: f64,
    /// Recall@10.
    pub at_10: f64,
}

impl ValidationRecall {
    /// What early stopping watches: the mean of R@1 and R@10.
    pub fn criterion(&self) -> f64 {
        (self.at_1 + self.at_10) / 2.0
    }
}
