//! Fits a head without labels: a PCA of pooled tokens to 256 components, partly whitened.
//!
//! In plain PCA a few strong components decide every distance. Full whitening gives all components
//! the same variance, and so amplifies the noise in the weak ones. What helps lies between: a
//! component is divided by its standard deviation to the power of the [`Whitening`].

use super::aggregate::Aggregate;
use super::components::{Components, Covariance};
use super::error::ExtractError;
use super::head::Head;
use placeformer_core::types::GLOBAL_DIM;
use std::collections::BTreeMap;

/// Components whose variance is below this share of the strongest one's hold rounding noise only.
/// They are scaled as if they had that much, so that the noise is not amplified.
const LEAST_VARIANCE: f64 = 1e-9;

/// The power of its standard deviation by which a component is divided: 0 leaves a plain PCA, 1
/// whitens fully.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Whitening(f64);

impl Whitening {
    /// A power from 0 to 1.
    ///
    /// # Errors
    /// A sentence for people, if it is no such power.
    pub fn new(power: f64) -> Result<Self, String> {
        if (0.0..=1.0).contains(&power) {
            Ok(Self(power))
        } else {
            Err(format!("whitening is a power from 0 to 1, not {power}"))
        }
    }

    /// The power.
    pub fn power(self) -> f64 {
        self.0
    }
}

/// Three quarters, which found more places of a city than a half or all of it, whatever the
/// aggregate.
impl Default for Whitening {
    fn default() -> Self {
        Self(0.75)
    }
}

/// The head for `backbone` whose rows are the 256 strongest components of the vectors that
/// `covariance` has seen, each divided as `whitening` says. `aggregate` says how the vectors were
/// pooled.
///
/// # Errors
/// [`ExtractError::TooFewImages`] for 256 vectors or fewer.
pub fn whitened_head(
    covariance: &Covariance,
    whitening: Whitening,
    aggregate: Aggregate,
    backbone: &str,
    notes: BTreeMap<String, String>,
) -> Result<Head, ExtractError> {
    check_count(covariance.count())?;
    let components = Components::of(covariance, GLOBAL_DIM);
    whitened(&components, whitening, aggregate, backbone, notes)
}

/// As [`whitened_head`], for `vectors` of one length that are longer than there are images.
///
/// # Errors
/// As [`whitened_head`].
pub fn whitened_head_of_few(
    vectors: &[Vec<f32>],
    whitening: Whitening,
    aggregate: Aggregate,
    backbone: &str,
    notes: BTreeMap<String, String>,
) -> Result<Head, ExtractError> {
    check_count(vectors.len())?;
    let components = Components::of_few(vectors, GLOBAL_DIM);
    whitened(&components, whitening, aggregate, backbone, notes)
}

/// Fewer vectors than this span fewer than 256 directions.
fn check_count(images: usize) -> Result<(), ExtractError> {
    if images > GLOBAL_DIM {
        Ok(())
    } else {
        Err(ExtractError::TooFewImages {
            dim: GLOBAL_DIM,
            images,
        })
    }
}

/// The head whose rows are `components`.
fn whitened(
    components: &Components,
    whitening: Whitening,
    aggregate: Aggregate,
    backbone: &str,
    notes: BTreeMap<String, String>,
) -> Result<Head, ExtractError> {
    let Components { mean, strongest } = components;
    let largest = strongest.first().map_or(0.0, |first| first.variance);
    let least = largest * LEAST_VARIANCE;
    let mut weight = Vec::with_capacity(GLOBAL_DIM * mean.len());
    let mut bias = Vec::with_capacity(GLOBAL_DIM);
    for component in strongest {
        let direction = &component.direction;
        let scale = component.variance.max(least).powf(-0.5 * whitening.0);
        weight.extend(direction.iter().map(|value| (value * scale) as f32));
        let projected_mean: f64 = direction
            .iter()
            .zip(mean)
            .map(|(value, mean)| value * scale * mean)
            .sum();
        bias.push(-projected_mean as f32);
    }
    Head::new(aggregate, weight, bias, backbone, notes)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    const DIM: usize = 300;

    const HALF: Whitening = Whitening(0.5);

    /// Vectors whose coordinate i has deviation 1 / (1 + i) around a mean of i.
    fn sample(count: usize) -> Vec<Vec<f32>> {
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        let mut gauss = || (0..12).map(|_| rng.random::<f32>()).sum::<f32>() - 6.0;
        (0..count)
            .map(|_| {
                (0..DIM)
                    .map(|i| i as f32 * 0.01 + gauss() / (1 + i) as f32)
                    .collect()
            })
            .collect()
    }

    #[test]
    fn components_are_centred_uncorrelated_and_half_whitened() {
        let vectors = sample(2000);
        let mut covariance = Covariance::new(DIM);
        vectors.iter().for_each(|v| covariance.add(v));
        let head = whitened_head(&covariance, HALF, Aggregate::Mean, "x", BTreeMap::new()).unwrap();
        let outputs: Vec<Vec<f64>> = vectors.iter().map(|v| head.affine(v)).collect();
        let moment = |a: usize, b: usize| outputs.iter().map(|o| o[a] * o[b]).sum::<f64>() / 1999.0;
        let centre = outputs.iter().map(|o| o[0]).sum::<f64>() / 2000.0;
        assert!(centre.abs() < 1e-3, "{centre}");
        assert!(moment(0, 5).abs() < 1e-3, "{}", moment(0, 5));
        // Variance after half whitening is the deviation before: near 1 for the strongest, near 1/6
        // for the sixth.
        assert!((moment(0, 0) - 1.0).abs() < 0.1, "{}", moment(0, 0));
        assert!((moment(5, 5) * 6.0 - 1.0).abs() < 0.1, "{}", moment(5, 5));
    }

    #[test]
    fn few_long_vectors_have_the_components_of_their_covariance() {
        let vectors = sample(280);
        let mut covariance = Covariance::new(DIM);
        vectors.iter().for_each(|v| covariance.add(v));
        let direct =
            whitened_head(&covariance, HALF, Aggregate::Mean, "x", BTreeMap::new()).unwrap();
        let few =
            whitened_head_of_few(&vectors, HALF, Aggregate::Mean, "x", BTreeMap::new()).unwrap();
        // The weak components have nearly equal variances, so rounding may mix them. The strong
        // ones differ clearly and must agree.
        for vector in &vectors[..20] {
            let a = direct.affine(vector);
            let b = few.affine(vector);
            assert!(
                a[..40].iter().zip(&b).all(|(a, b)| (a - b).abs() < 1e-3),
                "{:?} {:?}",
                &a[..40],
                &b[..40]
            );
        }
        assert!(
            whitened_head_of_few(&vectors[..256], HALF, Aggregate::Mean, "x", BTreeMap::new())
                .is_err()
        );
    }

    #[test]
    fn full_whitening_gives_every_component_the_same_variance() {
        let vectors = sample(2000);
        let mut covariance = Covariance::new(DIM);
        vectors.iter().for_each(|v| covariance.add(v));
        let head = whitened_head(
            &covariance,
            Whitening(1.0),
            Aggregate::Mean,
            "x",
            BTreeMap::new(),
        )
        .unwrap();
        let outputs: Vec<Vec<f64>> = vectors.iter().map(|v| head.affine(v)).collect();
        for component in [0, 5, 50, 200] {
            let variance = outputs.iter().map(|o| o[component].powi(2)).sum::<f64>() / 1999.0;
            assert!((variance - 1.0).abs() < 1e-2, "{component}: {variance}");
        }
        assert!(Whitening::new(1.5).is_err());
        assert!(Whitening::new(f64::NAN).is_err());
    }

    #[test]
    fn too_few_images_are_refused() {
        let mut covariance = Covariance::new(DIM);
        sample(256).iter().for_each(|v| covariance.add(v));
        let error =
            whitened_head(&covariance, HALF, Aggregate::Mean, "x", BTreeMap::new()).unwrap_err();
        assert!(error.to_string().contains("more than 256"), "{error}");
    }
}
