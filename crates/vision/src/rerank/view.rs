//! Which homographies can relate two photos of one place, and how the inliers of one lie.
//!
//! A homography has eight degrees of freedom, enough to bend two unrelated photos onto each other:
//! it can squeeze one into a line, fold it at the horizon, or stretch a row of patches over
//! another row. Such a homography has many inliers and says nothing about the place. A camera that
//! sees the same facades again does not see them mirrored, a hundred times as large, or as a line.
//! So the homography is looked at where its inliers are, and so are the inliers: all on a thin
//! line, as along a kerb or a wire, they would agree with almost anything.

use placeformer_kernels::homography::PointPairs;

/// Most that the second photo may be larger or smaller at the inliers.
const LARGEST_SCALE: f64 = 4.0;
/// Most that one direction may be stretched against the other.
const LARGEST_STRETCH: f64 = 4.0;
/// Most that the farthest inlier may be farther away than the nearest, in the plane's own depth.
const LARGEST_DEPTH_RATIO: f64 = 4.0;
/// Least deviation of the inliers from their best line in either photo, in tolerances. Two rows of
/// patches have 0.33, three 0.54, four 0.75.
const LEAST_SPREAD: f64 = 0.5;

/// Correspondences that are summed up at a time.
const LANES: usize = 4;
/// Quantities that are summed up: 1, x, y, u, v, and the products of x and y and of u and v.
const TERMS: usize = 11;

/// Sums over the inliers of a homography.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct InlierMoments {
    /// Of 1, x, y, u, v, xx, xy, yy, uu, uv and vv.
    sums: [f64; TERMS],
    /// Least and most `w`.
    depths: [f64; 2],
}

impl InlierMoments {
    /// Those of `homography` among normalised correspondences; the tolerance is 1.
    pub(super) fn of_points(points: &PointPairs, homography: &[f32; 9]) -> Self {
        let [a, b, c, d, e, f, g, h, i] = *homography;
        let [xs, ys, us, vs] = [0, 1, 2, 3].map(|axis| points.axis(axis).as_chunks::<LANES>().0);
        let mut sums = [[0f32; LANES]; TERMS];
        let mut least = [f32::INFINITY; LANES];
        let mut most = [0f32; LANES];
        for (((xs, ys), us), vs) in xs.iter().zip(ys).zip(us).zip(vs) {
            for lane in 0..LANES {
                let [x, y, u, v] = [xs[lane], ys[lane], us[lane], vs[lane]];
                let w = g * x + h * y + i;
                let dx = a * x + b * y + c - u * w;
                let dy = d * x + e * y + f - v * w;
                let is_inlier = (dx * dx + dy * dy <= w * w) & (w > 0.0);
                // What fills the last group up is NaN, so it must not be multiplied by zero.
                for (sum, term) in sums.iter_mut().zip(terms(x, y, u, v)) {
                    sum[lane] += if is_inlier { term } else { 0.0 };
                }
                least[lane] = if is_inlier & (w < least[lane]) {
                    w
                } else {
                    least[lane]
                };
                most[lane] = if is_inlier & (w > most[lane]) {
                    w
                } else {
                    most[lane]
                };
            }
        }
        Self {
            sums: sums.map(|lanes| lanes.iter().copied().map(f64::from).sum()),
            depths: [
                f64::from(least.into_iter().fold(f32::INFINITY, f32::min)),
                f64::from(most.into_iter().fold(0.0, f32::max)),
            ],
        }
    }

    /// Those of correspondences in pixels that are known to be inliers.
    ///
    /// Patches lie at multiples of half a pixel, so the sums are exact and do not depend on the
    /// order.
    pub(super) fn of_inliers(
        inliers: impl Iterator<Item = [f32; 4]>,
        homography: &[f64; 9],
    ) -> Self {
        let mut moments = Self {
            sums: [0.0; TERMS],
            depths: [f64::INFINITY, 0.0],
        };
        for pair in inliers {
            let [x, y, u, v] = pair.map(f64::from);
            for (sum, term) in moments.sums.iter_mut().zip(terms(x, y, u, v)) {
                *sum += term;
            }
            let w = homography[6] * x + homography[7] * y + homography[8];
            let [least, most] = &mut moments.depths;
            *least = least.min(w);
            *most = most.max(w);
        }
        moments
    }

    /// Number of inliers.
    pub(super) fn count(&self) -> u32 {
        self.sums[0] as u32
    }

    /// How `homography` shows the second photo where these, its inliers, are. There must be one.
    pub(super) fn view(&self, homography: &[f64; 9]) -> View {
        let [count, x, y, u, v, xx, xy, yy, uu, uv, vv] = self.sums;
        let [x, y, u, v] = [x, y, u, v].map(|sum| sum / count);
        let deviation = |square: f64, mean: f64, other: f64| square / count - mean * other;
        let spread = [
            least_deviation(
                deviation(xx, x, x),
                deviation(xy, x, y),
                deviation(yy, y, y),
            ),
            least_deviation(
                deviation(uu, u, u),
                deviation(uv, u, v),
                deviation(vv, v, v),
            ),
        ];
        let [least, most] = self.depths;
        let (scale, stretch) = scale_and_stretch(homography, [x, y]);
        View {
            spread,
            scale,
            stretch,
            depth_ratio: most / least,
        }
    }
}

/// What is summed up of a correspondence.
#[inline(always)]
fn terms<T: Copy + std::ops::Mul<Output = T> + From<u8>>(x: T, y: T, u: T, v: T) -> [T; TERMS] {
    [
        T::from(1),
        x,
        y,
        u,
        v,
        x * x,
        x * y,
        y * y,
        u * u,
        u * v,
        v * v,
    ]
}

/// The root of the smaller eigenvalue of a covariance: the deviation from the best line.
fn least_deviation(xx: f64, xy: f64, yy: f64) -> f64 {
    let middle = f64::midpoint(xx, yy);
    let half = (xx - yy).hypot(2.0 * xy) / 2.0;
    (middle - half).max(0.0).sqrt()
}

/// The root of the determinant of the derivative of `homography` at a point of the first photo, and
/// the ratio of its singular values; 0 and infinity where it mirrors or collapses.
fn scale_and_stretch(homography: &[f64; 9], [x, y]: [f64; 2]) -> (f64, f64) {
    let [a, b, c, d, e, f, g, h, i] = *homography;
    let w = g * x + h * y + i;
    let u = (a * x + b * y + c) / w;
    let v = (d * x + e * y + f) / w;
    let [ux, uy, vx, vy] = [a - u * g, b - u * h, d - v * g, e - v * h].map(|entry| entry / w);
    let determinant = ux * vy - uy * vx;
    // Not a number is not greater either.
    let keeps_orientation = w > 0.0 && determinant > 0.0;
    if !keeps_orientation {
        return (0.0, f64::INFINITY);
    }
    // Of the singular values p >= q are known the product and the sum of the squares.
    let mean = (ux * ux + uy * uy + vx * vx + vy * vy) / (2.0 * determinant);
    let stretch = mean + (mean * mean - 1.0).max(0.0).sqrt();
    (determinant.sqrt(), stretch)
}

/// How the plane of a homography is seen again, where its inliers are.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct View {
    /// Deviation of the inliers from their best line, in the first photo and in the second.
    pub(super) spread: [f64; 2],
    /// How much larger the second photo shows what the first does.
    pub(super) scale: f64,
    /// How much more one direction is stretched than the other, at least 1.
    pub(super) stretch: f64,
    /// How much farther away the farthest inlier is than the nearest, at least 1.
    depth_ratio: f64,
}

impl View {
    /// Whether a camera that sees a place again can see it so. `tolerance` is that of the inliers,
    /// in the unit of the spread.
    pub(super) fn is_plausible(&self, tolerance: f64) -> bool {
        let spread = self.spread.iter().all(|&it| it >= LEAST_SPREAD * tolerance);
        let scale = (1.0 / LARGEST_SCALE..=LARGEST_SCALE).contains(&self.scale);
        let stretch = self.stretch <= LARGEST_STRETCH;
        let depth = self.depth_ratio <= LARGEST_DEPTH_RATIO;
        spread && scale && stretch && depth
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::golden::project;

    fn grid() -> Vec<[f64; 2]> {
        let at = |i: usize| (i as f64 - 3.5) * 2.0;
        let points = (0..8).flat_map(|row| (0..8).map(move |column| [at(column), at(row)]));
        points.collect()
    }

    /// Where all of `points` are inliers.
    fn view(homography: &[f64; 9], points: &[[f64; 2]]) -> View {
        let mut pairs = PointPairs::default();
        pairs.fill(points.iter().map(|&[x, y]| {
            let [u, v] = project(homography, [x, y]);
            [x, y, u, v].map(|value| value as f32)
        }));
        let rounded = homography.map(|entry| entry as f32);
        let moments = InlierMoments::of_points(&pairs, &rounded);
        assert_eq!(moments.count() as usize, points.len());
        let all = (0..pairs.len()).map(|i| pairs.get(i));
        let exact = InlierMoments::of_inliers(all, homography).view(homography);
        let view = moments.view(homography);
        assert!((view.scale - exact.scale).abs() < 1e-3 * exact.scale.max(1.0));
        for (ours, theirs) in view.spread.into_iter().zip(exact.spread) {
            assert!((ours - theirs).abs() < 0.05, "{view:?} {exact:?}");
        }
        view
    }

    #[test]
    fn views_of_a_camera_are_plausible() {
        for homography in [
            [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
            [0.5, 0.1, 3.0, -0.1, 0.4, -2.0, 0.01, -0.02, 1.0],
            [2.5, 0.3, 3.0, 0.1, 1.5, -2.0, 0.03, 0.01, 1.0],
            // Turned by a quarter.
            [0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0],
        ] {
            let view = view(&homography, &grid());
            assert!(view.is_plausible(1.0), "{homography:?}: {view:?}");
        }
    }

    #[test]
    fn what_mirrors_collapses_or_folds_is_not() {
        for homography in [
            // Left and right exchanged.
            [-1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
            // Onto a line, and onto a point.
            [0.02, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
            [0.02, 0.0, 0.0, 0.0, 0.02, 0.0, 0.0, 0.0, 1.0],
            // Stretched over everything.
            [9.0, 0.0, 0.0, 0.0, 9.0, 0.0, 0.0, 0.0, 1.0],
            // Folded at the horizon, beside the grid.
            [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.14, 0.0, 1.0],
        ] {
            let view = view(&homography, &grid());
            assert!(!view.is_plausible(1.0), "{homography:?}: {view:?}");
        }
    }

    #[test]
    fn inliers_on_a_line_are_not_either() {
        let identity = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
        let line = |i: usize| [i as f64 * 0.7, i as f64 * 0.3 + (i % 2) as f64 * 0.4];
        let line: Vec<[f64; 2]> = (0..40).map(line).collect();
        assert!(!view(&identity, &line).is_plausible(1.0));
        // Four rows of patches, 2/3 of a tolerance apart.
        let rows = |i: usize| [(i / 4) as f64 * 0.7, (i % 4) as f64 * 0.667];
        let rows: Vec<[f64; 2]> = (0..40).map(rows).collect();
        assert!(view(&identity, &rows).is_plausible(1.0));
    }
}
