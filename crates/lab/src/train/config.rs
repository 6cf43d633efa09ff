//! The settings of a run, and the recall it watches.

use super::augment::Augmentation;
use super::error::TrainError;
use super::loss::Loss;
use super::model::Group;
use super::schedule::Schedule;
use serde::{Deserialize, Serialize};

/// Settings of a run (paper III-F and IV-B where a number is given there).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TrainConfig {
    /// What is minimised.
    pub loss: Loss,
    /// Learning rate of the transformer over the run; the others rise and fall with it.
    pub schedule: Schedule,
    /// Highest learning rate of the aggregate; that of the transformer if it is `None`.
    pub aggregate_rate: Option<f64>,
    /// Highest learning rate of the head's projection; that of the transformer if it is `None`.
    pub projection_rate: Option<f64>,
    /// Share of every weight that a step takes away, by its learning rate.
    pub weight_decay: f64,
    /// Greatest length of the gradients of a step; longer ones are shortened.
    pub longest_gradient: Option<f64>,
    /// Triplets of a step, or pairs of a query and a positive for losses over a whole batch.
    pub batch: usize,
    /// Pairs that are added to each drawn one because they look like it; they count as part of the
    /// batch. For losses over a whole batch.
    pub hard_pairs: usize,
    /// Most images in a graph at once on a thread, where that is fewer than a step has. It bounds
    /// the memory and costs one more forward pass.
    pub images_at_once: Option<usize>,
    /// Steps between two minings; also between validations and checkpoints.
    pub steps_per_cycle: u64,
    /// Hard negatives kept for each query, one of which is drawn.
    pub negatives: usize,
    /// Most images compared when mining.
    pub mining_pool: usize,
    /// Cycles without a better validation recall after which the run stops.
    pub patience: u32,
    /// Which weights come out.
    pub keep: Keep,
    /// Variation of the training images.
    pub augmentation: Augmentation,
    /// How the result is made of the trained weights.
    pub finish: Finish,
    /// Where every random choice comes from.
    pub seed: u64,
}

/// Which weights of a run come out.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Keep {
    /// Those with the best validation recall; it may be those before the first step.
    #[default]
    Best,
    /// Those after the last step.
    Last,
}

/// What becomes of trained weights. Validation watches the recall of what would come out.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Finish {
    /// Share of the trained weights in the result; the rest is of those that training started from
    /// (Wortsman et al. 2022). What was trained on one city overfits it, and lies near weights that
    /// serve other cities better.
    pub average: f64,
    /// The projection is fitted anew at the end, as a PCA of the training images whitened to this
    /// power; `None` keeps the trained one.
    pub whitening: Option<f64>,
    /// Most training images behind the PCA that is fitted for each validation.
    pub fit_images: usize,
}

impl Default for Finish {
    fn default() -> Self {
        Self {
            average: 1.0,
            whitening: None,
            fit_images: 1024,
        }
    }
}

impl Finish {
    /// Whether the result is something else than the trained weights.
    pub fn changes(&self) -> bool {
        self.average != 1.0 || self.whitening.is_some()
    }

    fn check(&self) -> Result<(), TrainError> {
        if !(0.0..=1.0).contains(&self.average) || self.average == 0.0 {
            return Err(TrainError::Setting(format!(
                "the share of the trained weights must lie above 0 and up to 1, and is {}",
                self.average
            )));
        }
        match self.whitening {
            Some(power) if !(0.0..=1.0).contains(&power) => Err(TrainError::Setting(format!(
                "whitening is a power from 0 to 1, not {power}"
            ))),
            _ => Ok(()),
        }
    }
}

impl Default for TrainConfig {
    fn default() -> Self {
        Self {
            loss: Loss::Triplet { margin: 0.01 },
            schedule: Schedule::default(),
            aggregate_rate: None,
            projection_rate: None,
            weight_decay: 0.0,
            longest_gradient: None,
            batch: 16,
            hard_pairs: 1,
            images_at_once: None,
            steps_per_cycle: 100,
            negatives: 10,
            mining_pool: 20_000,
            patience: 8,
            keep: Keep::default(),
            augmentation: Augmentation::default(),
            finish: Finish::default(),
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
        self.loss.check()?;
        self.schedule.check()?;
        self.augmentation.check()?;
        self.finish.check()?;
        let positive = [
            ("batch", self.batch as u64),
            ("images at once", self.images_at_once.unwrap_or(1) as u64),
            ("steps per cycle", self.steps_per_cycle),
            ("negatives", self.negatives as u64),
            ("mining pool", self.mining_pool as u64),
            ("patience", u64::from(self.patience)),
        ];
        if let Some((name, _)) = positive.iter().find(|(_, value)| *value == 0) {
            return Err(TrainError::Setting(format!("{name} must be at least 1")));
        }
        let rates = [
            ("rate of the aggregate", self.aggregate_rate),
            ("rate of the projection", self.projection_rate),
            ("longest gradient", self.longest_gradient),
        ];
        for (name, value) in rates {
            if value.is_some_and(|value| !(value.is_finite() && value > 0.0)) {
                return Err(TrainError::Setting(format!("the {name} must be positive")));
            }
        }
        if !(0.0..1.0).contains(&self.weight_decay) {
            return Err(TrainError::Setting(format!(
                "weight decay must lie in [0, 1), and is {}",
                self.weight_decay
            )));
        }
        Ok(())
    }

    /// Learning rate of a group at the 0-based `step`.
    pub(super) fn rate(&self, group: Group, step: u64) -> f64 {
        let peak = match group {
            Group::Blocks => None,
            Group::Aggregate => self.aggregate_rate,
            Group::Projection => self.projection_rate,
        };
        let factor = peak.map_or(1.0, |peak| peak / self.schedule.peak);
        self.schedule.rate(step) * factor
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rates_of_all_groups_rise_and_fall_together() {
        let config = TrainConfig {
            aggregate_rate: Some(2e-3),
            ..TrainConfig::default()
        };
        for step in [0, 50, 100, 3000, 4999] {
            let blocks = config.rate(Group::Blocks, step);
            assert_eq!(config.rate(Group::Projection, step), blocks);
            assert!((config.rate(Group::Aggregate, step) - 4.0 * blocks).abs() < 1e-12);
        }
    }

    #[test]
    fn each_broken_rule_is_named() {
        let broken = |change: fn(&mut TrainConfig)| {
            let mut config = TrainConfig::default();
            change(&mut config);
            config.check().unwrap_err().to_string()
        };
        for (message, part) in [
            (broken(|c| c.finish.average = 0.0), "trained weights"),
            (broken(|c| c.finish.whitening = Some(2.0)), "whitening"),
            (broken(|c| c.weight_decay = f64::NAN), "weight decay"),
            (broken(|c| c.aggregate_rate = Some(0.0)), "aggregate"),
            (broken(|c| c.images_at_once = Some(0)), "images at once"),
            (
                broken(|c| c.loss = Loss::InfoNce { temperature: 0.0 }),
                "temperature",
            ),
            (
                broken(|c| c.loss = Loss::Triplet { margin: -1.0 }),
                "margin",
            ),
        ] {
            assert!(message.contains(part), "{part}: {message}");
        }
        TrainConfig::default().check().unwrap();
    }
}
