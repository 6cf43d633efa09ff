//! The learning rate over the run: linear warm-up, then half a cosine down to zero.

use super::error::TrainError;
use serde::{Deserialize, Serialize};

/// Cosine schedule with warm-up.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Schedule {
    /// Highest rate, reached after the warm-up (paper: 5e-4).
    pub peak: f64,
    /// Steps of linear growth from zero.
    pub warm_up: u64,
    /// Steps of the whole run, warm-up included; the rate is zero from there on.
    pub total: u64,
}

impl Default for Schedule {
    fn default() -> Self {
        Self {
            peak: 5e-4,
            warm_up: 100,
            total: 5000,
        }
    }
}

impl Schedule {
    /// Rate of the 0-based `step`.
    pub fn rate(&self, step: u64) -> f64 {
        if step < self.warm_up {
            return self.peak * (step + 1) as f64 / self.warm_up as f64;
        }
        if step >= self.total {
            return 0.0;
        }
        let progress = (step - self.warm_up) as f64 / (self.total - self.warm_up) as f64;
        self.peak * 0.5 * (1.0 + (std::f64::consts::PI * progress).cos())
    }

    pub(super) fn check(&self) -> Result<(), TrainError> {
        if !(self.peak.is_finite() && self.peak > 0.0) {
            return Err(TrainError::Setting(format!(
                "the learning rate must be positive, not {}",
                self.peak
            )));
        }
        if self.warm_up >= self.total {
            let Self { warm_up, total, .. } = self;
            return Err(TrainError::Setting(format!(
                "{warm_up} steps of warm-up leave nothing of {total} steps"
            )));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_rate_climbs_then_falls_to_zero() {
        let schedule = Schedule {
            peak: 1.0,
            warm_up: 10,
            total: 110,
        };
        assert_eq!(schedule.rate(0), 0.1);
        assert_eq!(schedule.rate(9), 1.0);
        assert_eq!(schedule.rate(10), 1.0);
        assert!((schedule.rate(60) - 0.5).abs() < 1e-12);
        assert_eq!(schedule.rate(110), 0.0);
        assert!((10..110).all(|step| schedule.rate(step) > schedule.rate(step + 1)));
    }

    #[test]
    fn impossible_schedules_are_refused() {
        assert!(
            Schedule {
                warm_up: 5000,
                ..Schedule::default()
            }
            .check()
            .is_err()
        );
        assert!(
            Schedule {
                peak: f64::NAN,
                ..Schedule::default()
            }
            .check()
            .is_err()
        );
    }
}
