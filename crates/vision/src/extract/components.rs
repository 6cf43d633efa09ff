//! Principal components of vectors: the directions in which they differ most.
//!
//! The covariance is gathered vector by vector, so the memory needed does not depend on how many
//! there are. For vectors that are longer than there are vectors ([`Components::of_few`]), the
//! components come from the matrix of inner products instead, which is smaller than the covariance.

use nalgebra::{DMatrix, SymmetricEigen};

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
}

/// A principal component.
#[derive(Debug, Clone)]
pub struct Component {
    /// Variance of the vectors along it.
    pub variance: f64,
    /// A unit vector, `[dim]`. Its sign is arbitrary; it is fixed so that the entry of the largest
    /// magnitude is positive, and so equal input gives equal components.
    pub direction: Vec<f64>,
}

/// The strongest principal components of some vectors.
#[derive(Debug, Clone)]
pub struct Components {
    /// Mean of the vectors, `[dim]`.
    pub mean: Vec<f64>,
    /// The components, strongest first.
    pub strongest: Vec<Component>,
}

impl Components {
    /// At most `count` components of the vectors that `covariance` has seen.
    pub fn of(covariance: &Covariance, count: usize) -> Self {
        let eigen = SymmetricEigen::new(covariance.matrix());
        let component = |index| {
            let column = eigen.eigenvectors.column(index);
            Component::new(eigen.eigenvalues[index], column.iter().copied().collect())
        };
        let order = strongest(eigen.eigenvalues.as_slice(), count);
        Self {
            mean: covariance.mean.clone(),
            strongest: order.into_iter().map(component).collect(),
        }
    }

    /// As [`Components::of`], of `vectors` of one length that are longer than there are vectors.
    ///
    /// The components are found through the `[n, n]` matrix of inner products, which has the same
    /// eigenvalues as the `[dim, dim]` covariance.
    ///
    /// # Panics
    /// If there are no vectors.
    pub fn of_few(vectors: &[Vec<f32>], count: usize) -> Self {
        let dim = vectors[0].len();
        let mut rows = DMatrix::from_fn(vectors.len(), dim, |row, column| {
            f64::from(vectors[row][column])
        });
        let mean: Vec<f64> = rows.column_iter().map(|column| column.mean()).collect();
        for (mut column, mean) in rows.column_iter_mut().zip(&mean) {
            column.add_scalar_mut(-mean);
        }
        let degrees_of_freedom = (vectors.len().max(2) - 1) as f64;
        let eigen = SymmetricEigen::new(&rows * rows.transpose() / degrees_of_freedom);
        let component = |index| {
            let direction = rows.tr_mul(&eigen.eigenvectors.column(index));
            let length = direction.norm().max(f64::MIN_POSITIVE);
            let direction = direction.iter().map(|value| value / length).collect();
            Component::new(eigen.eigenvalues[index], direction)
        };
        let order = strongest(eigen.eigenvalues.as_slice(), count);
        let strongest = order.into_iter().map(component).collect();
        Self { mean, strongest }
    }
}

impl Component {
    fn new(variance: f64, mut direction: Vec<f64>) -> Self {
        let magnitude = |a: &f64, b: &f64| a.abs().total_cmp(&b.abs());
        let largest = direction.iter().copied().max_by(magnitude);
        if largest.is_some_and(|largest| largest < 0.0) {
            direction.iter_mut().for_each(|value| *value = -*value);
        }
        Self {
            variance,
            direction,
        }
    }
}

/// Indices of the `count` largest variances, largest first.
fn strongest(variances: &[f64], count: usize) -> Vec<usize> {
    let mut order: Vec<usize> = (0..variances.len()).collect();
    order.sort_by(|&a, &b| variances[b].total_cmp(&variances[a]));
    order.truncate(count);
    order
}

#[cfg(test)]
mod tests {
    use super::*;

    const DIM: usize = 20;

    #[test]
    fn the_streamed_covariance_is_the_covariance() {
        let value = |row: usize, column: usize| ((row * 7 + column * 3 + row * column) % 11) as f32;
        let vectors: Vec<Vec<f32>> = (0..50)
            .map(|row| (0..DIM).map(|column| value(row, column)).collect())
            .collect();
        let mut streamed = Covariance::new(DIM);
        vectors.iter().for_each(|v| streamed.add(v));
        let mean = |i: usize| vectors.iter().map(|v| v[i] as f64).sum::<f64>() / 50.0;
        for (r, c) in [(0, 0), (3, 1), (1, 3), (19, 19)] {
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
}
