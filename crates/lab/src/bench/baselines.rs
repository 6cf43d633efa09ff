//! What one would write first: correct, parallel, and without a kernel of its own.

use super::scenes::RerankScene;
use candle_core::{Device, Tensor};
use image::imageops::FilterType;
use nalgebra::{SMatrix, SVector};
use placeformer_core::types::{GLOBAL_DIM, ImageSize, KeyPatches, ScaleSet};
use placeformer_vision::image::{DEVIATION, MEAN};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

/// The normalised tensor of an image with nothing but the `image` crate: its decoder and its
/// antialiased bilinear ("triangle") filter.
///
/// # Errors
/// The decoder's.
#[expect(
    clippy::disallowed_methods,
    reason = "the baseline is what the ban keeps out of the service"
)]
pub fn load_tensor(bytes: &[u8], size: ImageSize) -> Result<Vec<f32>, image::ImageError> {
    let image = image::load_from_memory(bytes)?;
    let small = image
        .resize_exact(size.width, size.height, FilterType::Triangle)
        .to_rgb8();
    let plane = |channel: usize| {
        let normalised = move |pixel: &image::Rgb<u8>| {
            (f32::from(pixel[channel]) / 255.0 - MEAN[channel]) / DEVIATION[channel]
        };
        small.pixels().map(normalised).collect::<Vec<_>>()
    };
    Ok((0..3).flat_map(plane).collect())
}

/// All distances in f32 on all threads, then a selection: squared distance and row of the `k`
/// nearest, nearest first.
pub fn nearest(vectors: &[f32], query: &[f32], k: usize) -> Vec<(f32, u32)> {
    const ROWS: usize = 4096;
    let select = |mut all: Vec<(f32, u32)>| {
        if all.len() > k {
            all.select_nth_unstable_by(k - 1, |a, b| a.0.total_cmp(&b.0));
            all.truncate(k);
        }
        all
    };
    let scan = |(number, chunk): (usize, &[f32])| {
        let first = number * ROWS;
        let rows = chunk.chunks_exact(GLOBAL_DIM).enumerate();
        let scored = rows.map(|(row, vector)| {
            let distance = squared_distance(vector, query);
            (distance, (first + row) as u32)
        });
        select(scored.collect())
    };
    let parts = vectors.par_chunks(ROWS * GLOBAL_DIM).enumerate().map(scan);
    let all = parts.reduce(Vec::new, |mut a, mut b| {
        a.append(&mut b);
        select(a)
    });
    let mut found = select(all);
    found.sort_by(|a, b| a.0.total_cmp(&b.0));
    found
}

/// In sixteen sums side by side, which the compiler turns into vector instructions.
fn squared_distance(row: &[f32], query: &[f32]) -> f32 {
    let mut lanes = [0f32; 16];
    let row = row.as_chunks::<16>().0;
    let query = query.as_chunks::<16>().0;
    for (row, query) in row.iter().zip(query) {
        for lane in 0..16 {
            let difference = row[lane] - query[lane];
            lanes[lane] += difference * difference;
        }
    }
    lanes.iter().sum()
}

/// Re-ranking with f32 descriptors: the whole similarity matrix by candle's GEMM, its maxima, and a
/// plain RANSAC (random samples, 8x8 solve, adaptive stop at the same confidence and at most 2000
/// samples). Sum of all inliers.
///
/// # Errors
/// Candle's.
pub fn rerank(scene: &RerankScene) -> Result<usize, candle_core::Error> {
    let score = |reference: &KeyPatches| -> Result<usize, candle_core::Error> {
        let scored = ScaleSet::paper_default().into_iter().map(|scales| {
            let points = mutual_pairs(joined(&scene.query, scales), joined(reference, scales))?;
            Ok(ransac(&points))
        });
        scored.sum()
    };
    scene.candidates.par_iter().map(score).sum()
}

type Centres = Vec<[f64; 2]>;
type PointPair = ([f64; 2], [f64; 2]);

/// Descriptors and centres of a union of scales.
pub fn joined(patches: &KeyPatches, scales: ScaleSet) -> (Vec<f32>, Centres) {
    let mut descriptors = Vec::new();
    let mut centres = Vec::new();
    for scale in scales.scales() {
        let part = &patches.scales[scale - 1];
        descriptors.extend_from_slice(&part.descriptors);
        centres.extend(
            part.index
                .iter()
                .map(|&i| patches.grid.centre(scale, i as usize).map(f64::from)),
        );
    }
    (descriptors, centres)
}

/// Centres of mutual nearest neighbours.
fn mutual_pairs(
    (query, query_centres): (Vec<f32>, Centres),
    (reference, reference_centres): (Vec<f32>, Centres),
) -> Result<Vec<PointPair>, candle_core::Error> {
    let n = query_centres.len();
    let m = reference_centres.len();
    if n == 0 || m == 0 {
        return Ok(Vec::new());
    }
    let dim = query.len() / n;
    let query = Tensor::from_vec(query, (n, dim), &Device::Cpu)?;
    let reference = Tensor::from_vec(reference, (m, dim), &Device::Cpu)?;
    let similarity = query.matmul(&reference.t()?)?;
    let forth = similarity.argmax(1)?.to_vec1::<u32>()?;
    let back = similarity.argmax(0)?.to_vec1::<u32>()?;
    let mutual = (0..n).filter(|&i| back[forth[i] as usize] == i as u32);
    Ok(mutual
        .map(|i| (query_centres[i], reference_centres[forth[i] as usize]))
        .collect())
}

/// Pixels within which a homography must place a patch.
const TOLERANCE: f64 = 21.0;
const MOST_SAMPLES: usize = 2000;
const CONFIDENCE: f64 = 0.995;

/// The most inliers of any homography that was tried.
fn ransac(points: &[PointPair]) -> usize {
    let n = points.len();
    if n < 4 {
        return 0;
    }
    let mut rng = ChaCha8Rng::seed_from_u64(n as u64);
    let mut best = 0;
    let mut needed = MOST_SAMPLES;
    let mut drawn = 0;
    while drawn < needed {
        drawn += 1;
        let sample = rand::seq::index::sample(&mut rng, n, 4);
        let Some(h) = solve(sample.iter().map(|i| points[i])) else {
            continue;
        };
        let count = points.iter().filter(|pair| agrees(&h, pair)).count();
        if count > best {
            best = count;
            let all = (best as f64 / n as f64).powi(4);
            let enough = ((1.0 - CONFIDENCE).ln() / (1.0 - all).ln()).ceil();
            if enough.is_finite() {
                needed = needed.min(enough.max(0.0) as usize);
            }
        }
    }
    best
}

/// The homography through four pairs of points, its last element 1.
fn solve(sample: impl Iterator<Item = PointPair>) -> Option<SVector<f64, 8>> {
    let mut a = SMatrix::<f64, 8, 8>::zeros();
    let mut b = SVector::<f64, 8>::zeros();
    for (i, ([x, y], [u, v])) in sample.enumerate() {
        for (row, values, right) in [
            (2 * i, [x, y, 1.0, 0.0, 0.0, 0.0, -u * x, -u * y], u),
            (2 * i + 1, [0.0, 0.0, 0.0, x, y, 1.0, -v * x, -v * y], v),
        ] {
            for (column, value) in values.into_iter().enumerate() {
                a[(row, column)] = value;
            }
            b[row] = right;
        }
    }
    a.lu().solve(&b)
}

/// Whether a homography brings the first point near the second.
fn agrees(h: &SVector<f64, 8>, ([x, y], [u, v]): &PointPair) -> bool {
    let w = h[6] * x + h[7] * y + 1.0;
    let dx = (h[0] * x + h[1] * y + h[2]) / w - u;
    let dy = (h[3] * x + h[4] * y + h[5]) / w - v;
    w > 0.0 && dx * dx + dy * dy <= TOLERANCE * TOLERANCE
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bench::scenes::unit_vector;

    #[test]
    fn the_plain_scan_finds_what_sorting_finds() {
        let vectors: Vec<f32> = (0..9000).flat_map(unit_vector).collect();
        let query = unit_vector(77_777);
        let found = nearest(&vectors, &query, 10);
        let distance =
            |row: &[f32]| -> f32 { row.iter().zip(&query).map(|(a, b)| (a - b) * (a - b)).sum() };
        let mut all: Vec<(f32, u32)> = vectors
            .chunks_exact(GLOBAL_DIM)
            .zip(0..)
            .map(|(row, number)| (distance(row), number))
            .collect();
        all.sort_by(|a, b| a.0.total_cmp(&b.0));
        let rows = |list: &[(f32, u32)]| list.iter().map(|found| found.1).collect::<Vec<_>>();
        assert_eq!(rows(&found), rows(&all[..10]));
    }

    #[test]
    fn a_planted_homography_is_found_by_the_plain_ransac() {
        let moved = |i: usize| {
            let x = (i * 37 % 400) as f64;
            let y = (i * 91 % 300) as f64;
            ([x, y], [1.1 * x + 12.0, 0.9 * y - 7.0])
        };
        let points: Vec<PointPair> = (0..60).map(moved).collect();
        assert_eq!(ransac(&points), 60);
        assert_eq!(ransac(&points[..3]), 0);
    }
}
