//! Least-squares refinement of a homography on the correspondences near it.
//!
//! A homography through four patch centres is as inexact as the patch grid. A fit of all
//! correspondences near it averages the errors of the grid, and usually gains inliers. The quantity
//! that the fit minimises is algebraic; dividing each residual by the `w` of the previous estimate
//! turns it into the transfer error by which inliers are judged.

use nalgebra::{SMatrix, SVector};
use placeformer_kernels::homography::PointPairs;

/// Fewest correspondences for a fit. Four determine a homography exactly, and leave nothing to
/// average.
const LEAST_PAIRS: usize = 5;

/// Fits the correspondences whose transfer error under `homography` is within `radius` tolerances.
/// The points are normalised, so that the tolerance is 1. The last entry of `homography` is 1, and
/// so is that of the result, which is row-major too.
///
/// `None` if fewer than five correspondences are near, or they do not determine a homography that
/// keeps the orientation and has the origin, which is their common centre, in front of the camera.
pub(super) fn refit(pairs: &PointPairs, homography: &[f64; 9], radius: f64) -> Option<[f64; 9]> {
    let mut moments = Moments::default();
    for i in 0..pairs.len() {
        let pair = pairs.get(i).map(f64::from);
        if let Some(w) = w_if_near(homography, pair, radius) {
            moments.add(pair, 1.0 / (w * w));
        }
    }
    if moments.count < LEAST_PAIRS {
        return None;
    }
    moments.solve().filter(keeps_orientation)
}

/// The `w` of a correspondence under `homography`, scaled to a last entry of 1, if its transfer
/// error is within `radius`.
fn w_if_near(homography: &[f64; 9], [x, y, u, v]: [f64; 4], radius: f64) -> Option<f64> {
    let [a, b, c, d, e, f, g, h, i] = *homography;
    let w = g * x + h * y + i;
    // The error times w, which saves the divisions.
    let dx = a * x + b * y + c - u * w;
    let dy = d * x + e * y + f - v * w;
    let is_near = w > 0.0 && dx * dx + dy * dy <= radius * radius * w * w;
    is_near.then_some(w / i)
}

/// Whether the determinant is positive.
fn keeps_orientation(homography: &[f64; 9]) -> bool {
    let [a, b, c, d, e, f, g, h, i] = *homography;
    a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) > 0.0
}

/// The weighted sums of products of coordinates from which the normal equations are assembled.
#[derive(Default)]
struct Moments {
    /// Number of correspondences.
    count: usize,
    /// For each of the factors 1, u, v and u^2 + v^2: its products with xx, xy, yy, x, y and 1.
    sums: [[f64; 6]; 4],
}

/// Where the products of x, y and 1 with each other are among the six.
const PRODUCT: [[usize; 3]; 3] = [[0, 1, 3], [1, 2, 4], [3, 4, 5]];

impl Moments {
    fn add(&mut self, [x, y, u, v]: [f64; 4], weight: f64) {
        self.count += 1;
        let monomials = [x * x, x * y, y * y, x, y, 1.0].map(|monomial| weight * monomial);
        let factors = [1.0, u, v, u * u + v * v];
        for (sums, factor) in self.sums.iter_mut().zip(factors) {
            for (sum, monomial) in sums.iter_mut().zip(monomials) {
                *sum += factor * monomial;
            }
        }
    }

    /// The homography with last entry 1 that minimises the weighted squares of the residuals of
    /// `a x + b y + c - u (g x + h y) = u` and `d x + e y + f - v (g x + h y) = v`.
    fn solve(&self) -> Option<[f64; 9]> {
        let [plain, by_u, by_v, by_square] = &self.sums;
        // The unknowns are a, b, c (rows 0 to 2), d, e, f (3 to 5), g and h (6 and 7).
        let mut normal = SMatrix::<f64, 8, 8>::zeros();
        let mut right = SVector::<f64, 8>::zeros();
        for row in 0..3 {
            for column in 0..3 {
                let product = plain[PRODUCT[row][column]];
                normal[(row, column)] = product;
                normal[(3 + row, 3 + column)] = product;
            }
            for column in 0..2 {
                let u = -by_u[PRODUCT[row][column]];
                let v = -by_v[PRODUCT[row][column]];
                normal[(row, 6 + column)] = u;
                normal[(6 + column, row)] = u;
                normal[(3 + row, 6 + column)] = v;
                normal[(6 + column, 3 + row)] = v;
            }
            right[row] = by_u[PRODUCT[row][2]];
            right[3 + row] = by_v[PRODUCT[row][2]];
        }
        for row in 0..2 {
            for column in 0..2 {
                normal[(6 + row, 6 + column)] = by_square[PRODUCT[row][column]];
            }
            right[6 + row] = -by_square[PRODUCT[row][2]];
        }

        let solution = normal.cholesky()?.solve(&right);
        let mut homography = [1.0; 9];
        homography[..8].copy_from_slice(solution.as_slice());
        let is_finite = homography.iter().all(|entry| entry.is_finite());
        is_finite.then_some(homography)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TRUE: [f64; 9] = [1.1, 0.1, -3.0, -0.05, 0.9, 2.0, 0.004, -0.002, 1.0];

    fn grid(noise: f64) -> PointPairs {
        let mut pairs = PointPairs::default();
        pairs.fill((0..64).map(|i| {
            let x = (i % 8) as f64 * 4.0 - 14.0;
            let y = (i / 8) as f64 * 3.0 - 11.0;
            let at = |row: usize| TRUE[row] * x + TRUE[row + 1] * y + TRUE[row + 2];
            let wave = |k: f64| noise * (i as f64 * k).sin();
            let u = at(0) / at(6) + wave(1.7);
            let v = at(3) / at(6) + wave(2.9);
            [x, y, u, v].map(|value| value as f32)
        }));
        pairs
    }

    fn is_true_within(homography: &[f64; 9], bound: f64) -> bool {
        let mut pairs = homography.iter().zip(TRUE);
        pairs.all(|(ours, truth)| (ours - truth).abs() < bound)
    }

    #[test]
    fn the_truth_is_a_fixed_point_and_noise_is_averaged_out() {
        let exact = refit(&grid(0.0), &TRUE, 1.0).unwrap();
        assert!(is_true_within(&exact, 1e-4), "{exact:?}");
        let mut start = TRUE;
        start[2] += 0.3;
        let noisy = refit(&grid(0.3), &start, 1.0).unwrap();
        assert!(is_true_within(&noisy, 0.1), "{noisy:?}");
    }

    #[test]
    fn too_few_or_collinear_correspondences_give_nothing() {
        let identity = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
        let mut pairs = PointPairs::default();
        pairs.fill((0..4).map(|i| [i as f32, (i * i) as f32, i as f32, (i * i) as f32]));
        assert_eq!(refit(&pairs, &identity, 1.0), None);
        pairs.fill((0..20).map(|i| [i as f32, 2.0 * i as f32, i as f32, 2.0 * i as f32]));
        assert_eq!(refit(&pairs, &identity, 1.0), None);
        pairs.fill((0..20).map(|_| [1.0, 2.0, 1.0, 2.0]));
        assert_eq!(refit(&pairs, &identity, 1.0), None);
    }
}
