//! Means of cosines that are the same in whatever order patches come.
//!
//! Sums of floating-point numbers depend on their order, and the order of patches says nothing
//! about a place. Cosines are therefore rounded to whole millionths and added up as integers.

/// Steps into which a cosine of 1 is divided.
const STEPS: f64 = (1 << 20) as f64;

/// Number, sum and sum of squares of cosines.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct CosineSums {
    count: i64,
    sum: i64,
    /// At most 2^40 for each, so that millions of them fit.
    squares: i64,
}

impl CosineSums {
    pub(super) fn add(&mut self, cosine: f32) {
        let steps = (f64::from(cosine) * STEPS).round() as i64;
        self.count += 1;
        self.sum += steps;
        self.squares += steps * steps;
    }

    /// The mean; 0 of none.
    pub(super) fn mean(&self) -> f64 {
        self.sum as f64 / self.count.max(1) as f64 / STEPS
    }

    /// The standard deviation; 0 of none.
    pub(super) fn deviation(&self) -> f64 {
        let mean_square = self.squares as f64 / self.count.max(1) as f64 / (STEPS * STEPS);
        (mean_square - self.mean().powi(2)).max(0.0).sqrt()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn mean_and_deviation_follow_the_formulas_in_any_order() {
        let mut there = CosineSums::default();
        let mut back = CosineSums::default();
        let cosines = [0.25f32, 0.5, -0.125, 0.875, 0.3];
        cosines.iter().for_each(|&cosine| there.add(cosine));
        cosines.iter().rev().for_each(|&cosine| back.add(cosine));
        assert!((there.mean() - 0.36).abs() < 1e-6);
        let variance = cosines.map(|cosine| (f64::from(cosine) - 0.36).powi(2));
        let deviation = (variance.iter().sum::<f64>() / 5.0).sqrt();
        assert!((there.deviation() - deviation).abs() < 1e-6);
        assert_eq!(there.mean(), back.mean());
        assert_eq!(there.deviation(), back.deviation());
        let none = CosineSums::default();
        assert_eq!((none.mean(), none.deviation()), (0.0, 0.0));
    }
}
