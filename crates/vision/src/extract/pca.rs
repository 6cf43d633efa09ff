//! Fits a head without labels: PCA of pooled tokens to 256 components with half whitening.
//!
//! Components are divided by the square root of their standard deviation, half way between plain
//! PCA, in which a few strong components drown the rest, and full whitening, which raises the noise
//! of the weak ones. The covariance is gathered image by image, so the number of images does not
//! matter to memory.

use super::aggregate::Aggregate;
use super::error::ExtractError;
use super::head::Head;
use nalgebra::{DMatrix, SymmetricEigen};
use placeformer_core::types::GLOBAL_DIM;
use std::collections::BTreeMap;

/// Mean and covariance of vectors seen one at a time (Welford's update, in f64).
#[derive(Debug, Clone)]
pub struct Covariance {
    count: usize,
    mean: Vec<f64>,
    /// Sum of outer products of deviations, lower triangle filled, `[dim, dim]` row-major.
    scatter: Vec<f64>,
}

impl Covariance {
    /// Of vectors of length `dim`.
    pub fn new(dim: usize) -> Self {
        Self {
            count: 0,
            mean: vec![0.0; dim],
            scatter: vec![0.0; dim * dim],
        }
    }

    /// Adds one vector.
    pub fn add(&mut self, vector: &[f32]) {
        let dim = self.mean.len();
        assert_eq!(vector.len(), dim, "all vectors have one length");
        self.count += 1;
        let before: Vec<f64> = vector
            .iter()
            .zip(&self.mean)
            .map(|(&v, mean)| v as f64 - mean)
            .collect();
        let count = self.count as f64;
        self.mean
            .iter_mut()
            .zip(&before)
            .for_each(|(mean, d)| *mean += d / count);
        let shrink = (count - 1.0) / count;
        for (i, row) in self.scatter.chunks_exact_mut(dim).enumerate() {
            let factor = before[i] * shrink;
            row[..=i]
                .iter_mut()
                .zip(&before)
                .for_each(|(sum, d)| *sum += factor * d);
        }
    }

    /// Vectors seen.
    pub fn count(&self) -> usize {
        self.count
    }

    fn matrix(&self) -> DMatrix<f64> {
        let dim = self.mean.len();
        let n = (self.count.max(2) - 1) as f64;
        DMatrix::from_fn(dim, dim, |r, c| self.scatter[r.max(c) * dim + r.min(c)] / n)
    }

    /// The head for `backbone` whose rows are the 256 strongest components, each divided by
    /// sigma^0.5. `aggregate` is how the vectors seen were pooled.
    ///
    /// Signs are fixed (the largest entry of a component is positive), so equal input gives an
    /// equal file.
    pub fn half_whitened_head(
        &self,
        aggregate: Aggregate,
        backbone: &str,
        notes: BTreeMap<String, String>,
    ) -> Result<Head, ExtractError> {
        enough(self.count)?;
        let eigen = SymmetricEigen::new(self.matrix());
        let components = strongest(eigen.eigenvalues.as_slice())
            .into_iter()
            .map(|component| {
                let direction = eigen
                    .eigenvectors
                    .column(component)
                    .iter()
                    .copied()
                    .collect();
                (eigen.eigenvalues[component], direction)
            });
        half_whitened(&self.mean, components.collect(), aggregate, backbone, notes)
    }
}

/// As [`Covariance::half_whitened_head`], for vectors longer than there are images: the components
/// are found through the `[n, n]` matrix of inner products instead of the `[dim, dim]` covariance.
/// `vectors` are rows of one length.
pub fn half_whitened_head_of_few(
    vectors: &[Vec<f32>],
    aggregate: Aggregate,
    backbone: &str,
    notes: BTreeMap<String, String>,
) -> Result<Head, ExtractError> {
    enough(vectors.len())?;
    let (count, dim) = (vectors.len(), vectors[0].len());
    let mut rows = DMatrix::from_fn(count, dim, |r, c| f64::from(vectors[r][c]));
    let mean: Vec<f64> = rows.column_iter().map(|column| column.mean()).collect();
    rows.column_iter_mut()
        .zip(&mean)
        .for_each(|(mut column, mean)| column.add_scalar_mut(-mean));
    let eigen = SymmetricEigen::new(&rows * rows.transpose() / (count - 1) as f64);
    let components = strongest(eigen.eigenvalues.as_slice())
        .into_iter()
        .map(|component| {
            let direction = rows.tr_mul(&eigen.eigenvectors.column(component));
            let length = direction.norm().max(f64::MIN_POSITIVE);
            (
                eigen.eigenvalues[component],
                direction.iter().map(|value| value / length).collect(),
            )
        });
    half_whitened(&mean, components.collect(), aggregate, backbone, notes)
}

fn enough(images: usize) -> Result<(), ExtractError> {
    if images > GLOBAL_DIM {
        Ok(())
    } else {
        Err(ExtractError::TooFewImages {
            dim: GLOBAL_DIM,
            images,
        })
    }
}

/// Indices of the 256 largest values, descending.
fn strongest(variances: &[f64]) -> Vec<usize> {
    let mut order: Vec<usize> = (0..variances.len()).collect();
    order.sort_by(|&a, &b| variances[b].total_cmp(&variances[a]));
    order.truncate(GLOBAL_DIM);
    order
}

/// The head of `components`: variance and unit direction, strongest first.
fn half_whitened(
    mean: &[f64],
    components: Vec<(f64, Vec<f64>)>,
    aggregate: Aggregate,
    backbone: &str,
    notes: BTreeMap<String, String>,
) -> Result<Head, ExtractError> {
    // Directions without variance carry rounding noise only; a floor keeps them from being blown
    // up.
    let floor = components.first().map_or(0.0, |strongest| strongest.0) * 1e-9;
    let (mut weight, mut bias) = (
        Vec::with_capacity(GLOBAL_DIM * mean.len()),
        Vec::with_capacity(GLOBAL_DIM),
    );
    for (variance, direction) in components {
        let sign = direction
            .iter()
            .copied()
            .max_by(|a, b| a.abs().total_cmp(&b.abs()))
            .unwrap_or(1.0)
            .signum();
        let scale = sign * variance.max(floor).powf(-0.25);
        weight.extend(direction.iter().map(|v| (v * scale) as f32));
        bias.push(
            -direction
                .iter()
                .zip(mean)
                .map(|(v, mean)| v * scale * mean)
                .sum::<f64>() as f32,
        );
    }
    Head::new(aggregate, weight, bias, backbone, notes)
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
            let (mr, mc) = (mean(r), mean(c));
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
        // The strong components are well apart; the weak ones may turn into each other by rounding.
        for vector in &vectors[..20] {
            let (a, b) = (direct.affine(vector), few.affine(vector));
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
