//! Fits a head without labels: a PCA of pooled tokens to 256 components, half whitened.
//!
//! In plain PCA a few strong components decide every distance. Full whitening gives all components
//! the same variance, and so amplifies the noise in the weak ones. Half whitening lies between: a
//! component is divided by the square root of its standard deviation.
//!
//! The covariance is gathered image by image, so the memory needed does not depend on the number of
//! images. For vectors that are longer than there are images ([`half_whitened_head_of_few`]), the
//! components come from the matrix of inner products instead, which is smaller than the covariance.

use super::aggregate::Aggregate;
use super::error::ExtractError;
use super::head::Head;
use nalgebra::{DMatrix, SymmetricEigen};
use placeformer_core::types::GLOBAL_DIM;
use std::collections::BTreeMap;

/// Components whose variance is below this share of the strongest one's hold rounding noise only.
/// They are scaled as if they had that much, so that the noise is not amplified.
const LEAST_VARIANCE: f64 = 1e-9;

/// Mean and covariance of vectors seen one at a time (Welford's update, in f64).
#[derive(Debug, Clone)]
pub struct Covariance {
    count: usize,
    mean: Vec<f64>,
    /// Sum of the outer products of deviations, `[dim, dim]` row-major; only the lower triangle is
    /// filled.
    scatter: Vec<f64>,
}

impl Covariance {
    /// An accumulator for vectors of length `dim`.
    pub fn new(dim: usize) -> Self {
        Self {
            count: 0,
            mean: vec![0.0; dim],
            scatter: vec![0.0; dim * dim],
        }
    }

    /// Adds one vector.
    ///
    /// # Panics
    /// If it has another length than the others.
    pub fn add(&mut self, vector: &[f32]) {
        let dim = self.mean.len();
        assert_eq!(vector.len(), dim, "all vectors have one length");
        self.count += 1;
        let count = self.count as f64;
        let deviations: Vec<f64> = vector
            .iter()
            .zip(&self.mean)
            .map(|(&value, mean)| f64::from(value) - mean)
            .collect();
        for (mean, deviation) in self.mean.iter_mut().zip(&deviations) {
            *mean += deviation / count;
        }
        let shrink = (count - 1.0) / count;
        for (i, row) in self.scatter.chunks_exact_mut(dim).enumerate() {
            let factor = deviations[i] * shrink;
            for (sum, deviation) in row[..=i].iter_mut().zip(&deviations) {
                *sum += factor * deviation;
            }
        }
    }

    /// Number of vectors seen.
    pub fn count(&self) -> usize {
        self.count
    }

    fn matrix(&self) -> DMatrix<f64> {
        let dim = self.mean.len();
        let degrees_of_freedom = (self.count.max(2) - 1) as f64;
        DMatrix::from_fn(dim, dim, |row, column| {
            let lower = row.max(column) * dim + row.min(column);
            self.scatter[lower] / degrees_of_freedom
        })
    }

    /// The head for `backbone` whose rows are the 256 strongest components, each divided by the
    /// square root of its standard deviation. `aggregate` says how the vectors were pooled.
    ///
    /// The sign of a component is arbitrary; it is fixed so that the largest entry is positive.
    /// Equal input therefore gives an equal file.
    ///
    /// # Errors
    /// [`ExtractError::TooFewImages`] for 256 vectors or fewer.
    pub fn half_whitened_head(
        &self,
        aggregate: Aggregate,
        backbone: &str,
        notes: BTreeMap<String, String>,
    ) -> Result<Head, ExtractError> {
        check_count(self.count)?;
        let eigen = SymmetricEigen::new(self.matrix());
        let mut components = Vec::with_capacity(GLOBAL_DIM);
        for index in strongest(eigen.eigenvalues.as_slice()) {
            let column = eigen.eigenvectors.column(index);
            components.push(Component {
                variance: eigen.eigenvalues[index],
                direction: column.iter().copied().collect(),
            });
        }
        half_whitened(&self.mean, &components, aggregate, backbone, notes)
    }
}

/// As [`Covariance::half_whitened_head`], for vectors that are longer than there are images.
/// `vectors` have one length.
///
/// The components are found through the `[n, n]` matrix of inner products, which has the same
/// eigenvalues as the `[dim, dim]` covariance.
///
/// # Errors
/// [`ExtractError::TooFewImages`] for 256 vectors or fewer.
pub fn half_whitened_head_of_few(
    vectors: &[Vec<f32>],
    aggregate: Aggregate,
    backbone: &str,
    notes: BTreeMap<String, String>,
) -> Result<Head, ExtractError> {
    check_count(vectors.len())?;
    let count = vectors.len();
    let dim = vectors[0].len();
    let mut rows = DMatrix::from_fn(count, dim, |row, column| f64::from(vectors[row][column]));
    let mean: Vec<f64> = rows.column_iter().map(|column| column.mean()).collect();
    for (mut column, mean) in rows.column_iter_mut().zip(&mean) {
        column.add_scalar_mut(-mean);
    }

    let eigen = SymmetricEigen::new(&rows * rows.transpose() / (count - 1) as f64);
    let mut components = Vec::with_capacity(GLOBAL_DIM);
    for index in strongest(eigen.eigenvalues.as_slice()) {
        let direction = rows.tr_mul(&eigen.eigenvectors.column(index));
        let length = direction.norm().max(f64::MIN_POSITIVE);
        components.push(Component {
            variance: eigen.eigenvalues[index],
            direction: direction.iter().map(|value| value / length).collect(),
        });
    }
    half_whitened(&mean, &components, aggregate, backbone, notes)
}

/// A principal component.
struct Component {
    variance: f64,
    /// A unit vector, `[dim]`.
    direction: Vec<f64>,
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

/// Indices of the 256 largest variances, largest first.
fn strongest(variances: &[f64]) -> Vec<usize> {
    let mut order: Vec<usize> = (0..variances.len()).collect();
    order.sort_by(|&a, &b| variances[b].total_cmp(&variances[a]));
    order.truncate(GLOBAL_DIM);
    order
}

/// The head of `components`, which come strongest first.
fn half_whitened(
    mean: &[f64],
    components: &[Component],
    aggregate: Aggregate,
    backbone: &str,
    notes: BTreeMap<String, String>,
) -> Result<Head, ExtractError> {
    let strongest = components.first().map_or(0.0, |first| first.variance);
    let least = strongest * LEAST_VARIANCE;
    let mut weight = Vec::with_capacity(GLOBAL_DIM * mean.len());
    let mut bias = Vec::with_capacity(GLOBAL_DIM);
    for component in components {
        let direction = &component.direction;
        let scale = sign_of(direction) * component.variance.max(least).powf(-0.25);
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

/// The sign of the entry of the largest magnitude.
fn sign_of(direction: &[f64]) -> f64 {
    let magnitude = |a: &f64, b: &f64| a.abs().total_cmp(&b.abs());
    let largest = direction.iter().copied().max_by(magnitude);
    largest.unwrap_or(1.0).signum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    const DIM: usize = 300;

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
    fn the_streamed_covariance_is_the_covariance() {
        let vectors = sample(50);
        let mut streamed = Covariance::new(DIM);
        vectors.iter().for_each(|v| streamed.add(v));
        let mean = |i: usize| vectors.iter().map(|v| v[i] as f64).sum::<f64>() / 50.0;
        for (r, c) in [(0, 0), (3, 1), (1, 3), (299, 299)] {
            let mr = mean(r);
            let mc = mean(c);
            let direct = vectors
                .iter()
                .map(|v| (v[r] as f64 - mr) * (v[c] as f64 - mc))
                .sum::<f64>()
                / 49.0;
            assert!((streamed.matrix()[(r, c)] - direct).abs() < 1e-10);
        }
    }

    #[test]
    fn components_are_centred_uncorrelated_and_half_whitened() {
        let vectors = sample(2000);
        let mut covariance = Covariance::new(DIM);
        vectors.iter().for_each(|v| covariance.add(v));
        let head = covariance
            .half_whitened_head(Aggregate::Mean, "x", BTreeMap::new())
            .unwrap();
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
        let direct = covariance
            .half_whitened_head(Aggregate::Mean, "x", BTreeMap::new())
            .unwrap();
        let few =
            half_whitened_head_of_few(&vectors, Aggregate::Mean, "x", BTreeMap::new()).unwrap();
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
            half_whitened_head_of_few(&vectors[..256], Aggregate::Mean, "x", BTreeMap::new())
                .is_err()
        );
    }

    #[test]
    fn too_few_images_are_refused() {
        let mut covariance = Covariance::new(DIM);
        sample(256).iter().for_each(|v| covariance.add(v));
        let error = covariance
            .half_whitened_head(Aggregate::Mean, "x", BTreeMap::new())
            .unwrap_err();
        assert!(error.to_string().contains("more than 256"), "{error}");
    }
}
