//! Least-squares refinement of a homography on the correspondences near it.
//!
//! A homography through four patch centres inherits their quantisation to the patch grid. Fitting
//! all correspondences within reach evens that out, and usually gains inliers. The algebraic
//! residuals are divided by the previous estimate's `w`, which makes them the transfer error that
//! inliers are judged by.

use nalgebra::{SMatrix, SVector};
use placeformer_kernels::homography::PointPairs;

/// Fits the correspondences whose transfer error under `homography` is within `radius` tolerances.
///
/// Row-major, last entry 1 on return. `None` where fewer than five are in reach, or they do not
/// determine a homography that keeps orientation and has the origin (their common centre) in front.
pub(super) fn refit(pairs: &PointPairs, homography: &[f64; 9], radius: f64) -> Option<[f64; 9]> {
    let mut sums = Sums::default();
    for i in 0..pairs.len() {
        let pair = pairs.get(i).map(f64::from);
        if let Some(w) = reach(homography, pair, radius) {
            sums.add(pair, 1.0 / (w * w));
        }
    }
    if sums.count < 5 {
        None
    } else {
        sums.solve().filter(keeps_orientation)
    }
}

/// The `w` of a correspondence under `homography` (scaled to a last entry of 1) if its error is
/// within `radius`.
fn reach(homography: &[f64; 9], [x, y, u, v]: [f64; 4], radius: f64) -> Option<f64> {
    let [a, b, c, d, e, f, g, h, i] = *homography;
    let w = g * x + h * y + i;
    let (dx, dy) = (a * x + b * y + c - u * w, d * x + e * y + f - v * w);
    (w > 0.0 && dx * dx + dy * dy <= radius * radius * w * w).then_some(w / i)
}

fn keeps_orientation(homography: &[f64; 9]) -> bool {
    let [a, b, c, d, e, f, g, h, i] = *homography;
    a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) > 0.0
}

/// Moments of the correspondences from which the normal equations are assembled.
#[derive(Default)]
struct Sums {
    count: usize,
    /// Each of 1, u, v and u^2 + v^2 times each of xx, xy, yy, x, y, 1.
    moments: [[f64; 6]; 4],
}

impl Sums {
    fn add(&mut self, [x, y, u, v]: [f64; 4], weight: f64) {
        self.count += 1;
        let monomials = [x * x, x * y, y * y, x, y, 1.0].map(|monomial| weight * monomial);
        for (moments, factor) in self.moments.iter_mut().zip([1.0, u, v, u * u + v * v]) {
            moments
                .iter_mut()
                .zip(monomials)
                .for_each(|(moment, monomial)| *moment += factor * monomial);
        }
    }

    /// Minimises the weighted residuals of `a x + b y + c - u (g x + h y) = u` and its like for
    /// `v`.
    fn solve(&self) -> Option<[f64; 9]> {
        let [plain, by_u, by_v, by_square] = &self.moments;
        // Positions of the products of x, y and 1 within a row of moments.
        const PRODUCT: [[usize; 3]; 3] = [[0, 1, 3], [1, 2, 4], [3, 4, 5]];
        let mut normal = SMatrix::<f64, 8, 8>::zeros();
        let mut right = SVector::<f64, 8>::zeros();
        for row in 0..3 {
            for column in 0..3 {
                normal[(row, column)] = plain[PRODUCT[row][column]];
                normal[(3 + row, 3 + column)] = plain[PRODUCT[row][column]];
            }
            for column in 0..2 {
                let (u, v) = (-by_u[PRODUCT[row][column]], -by_v[PRODUCT[row][column]]);
                (normal[(row, 6 + column)], normal[(6 + column, row)]) = (u, u);
                (normal[(3 + row, 6 + column)], normal[(6 + column, 3 + row)]) = (v, v);
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
        let homography = std::array::from_fn(|i| if i < 8 { solution[i] } else { 1.0 });
        homography
            .iter()
            .all(|entry| entry.is_finite())
            .then_some(homography)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TRUE: [f64; 9] = [1.1, 0.1, -3.0, -0.05, 0.9, 2.0, 0.004, -0.002, 1.0];

    fn grid(noise: f64) -> PointPairs {
        let mut pairs = PointPairs::default();
        pairs.fill((0..64).map(|i| {
            let (x, y) = ((i % 8) as f64 * 4.0 - 14.0, (i / 8) as f64 * 3.0 - 11.0);
            let at = |row: usize| TRUE[row] * x + TRUE[row + 1] * y + TRUE[row + 2];
            let wobble = |k: f64| noise * (i as f64 * k).sin();
            [
                x,
                y,
                at(0) / at(6) + wobble(1.7),
                at(3) / at(6) + wobble(2.9),
            ]
            .map(|value| value as f32)
        }));
        pairs
    }

    #[test]
    fn the_truth_is_a_fixed_point_and_noise_is_evened_out() {
        let exact = refit(&grid(0.0), &TRUE, 1.0).unwrap();
        assert!(
            exact
                .iter()
                .zip(TRUE)
                .all(|(ours, truth)| (ours - truth).abs() < 1e-4),
            "{exact:?}"
        );
        let mut start = TRUE;
        start[2] += 0.3;
        let noisy = refit(&grid(0.3), &start, 1.0).unwrap();
        assert!(
            noisy
                .iter()
                .zip(TRUE)
                .all(|(ours, truth)| (ours - truth).abs() < 0.1),
            "{noisy:?}"
        );
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
