//! Outputs of the reference implementation, for tests.
//!
//! Three drawn streets, their key patches, which of them match, and the true homography between two
//! of them. The README next to the files says how they were made.

use placeformer_core::types::{KeyPatches, PatchGrid, PoolingStride, ScaleKeyPatches, ScaleSet};
use safetensors::tensor::{SafeTensors, TensorView};
use serde::Deserialize;
use std::collections::BTreeMap;
use std::path::Path;

/// The content of a golden file.
pub(crate) fn read(name: &str) -> Vec<u8> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../../tests/golden")
        .join(name);
    std::fs::read(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

/// Two images, and what matches between them.
#[derive(Deserialize)]
pub(crate) struct GoldenPair {
    pub query: String,
    pub reference: String,
    /// Width and height of the input in pixels.
    pub size: [u16; 2],
    /// By combination of scales, such as `1+2`.
    pub scores: BTreeMap<String, GoldenScore>,
}

/// What matches in one combination of scales.
#[derive(Deserialize)]
pub(crate) struct GoldenScore {
    /// Positions among the query's and the reference's patches of these scales.
    pub mutual_pairs: Vec<[usize; 2]>,
    pub opencv_inliers: u32,
}

impl GoldenPair {
    /// Both images' names and the size, for messages.
    pub(crate) fn describe(&self) -> String {
        format!("{} {} {:?}", self.query, self.reference, self.size)
    }

    /// The matched centres of one combination of scales: x, y in the query, u, v in the reference.
    pub(crate) fn points(&self, scales: ScaleSet, score: &GoldenScore) -> Vec<[f32; 4]> {
        let centres = |image: &str| -> Vec<[f32; 2]> {
            let patches = patches(image, self.size);
            let of_scales = scales
                .scales()
                .map(|scale| patches.centres[scale - 1].clone());
            of_scales.flatten().collect()
        };
        let query = centres(&self.query);
        let reference = centres(&self.reference);
        let pairs = score.mutual_pairs.iter();
        pairs
            .map(|&[q, r]| {
                let [x, y] = query[q];
                let [u, v] = reference[r];
                [x, y, u, v]
            })
            .collect()
    }

    /// The true homography from query to reference pixels, for images of the same street.
    pub(crate) fn true_homography(&self) -> Option<[f64; 9]> {
        let to_dusk = homography_to_dusk(self.size);
        match (&*self.query, &*self.reference) {
            ("street_a", "street_a_dusk") => Some(to_dusk),
            ("street_a_dusk", "street_a") => {
                let matrix = nalgebra::Matrix3::from_row_slice(&to_dusk);
                let back = matrix.try_inverse().unwrap();
                Some(std::array::from_fn(|i| back[(i / 3, i % 3)]))
            }
            ("street_a", "street_a") => Some([1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]),
            _ => None,
        }
    }
}

/// All pairs of images.
pub(crate) fn pairs() -> Vec<GoldenPair> {
    serde_json::from_slice(&read("pairs.json")).unwrap()
}

/// The key patches of one image, with default settings.
pub(crate) struct GoldenPatches {
    /// Of each scale, in pixels.
    pub centres: [Vec<[f32; 2]>; 3],
    /// Without descriptors if the file does not have those of all patches.
    pub key_patches: KeyPatches,
}

pub(crate) fn patches(image: &str, [width, height]: [u16; 2]) -> GoldenPatches {
    let bytes = read(&format!("{image}_{width}x{height}.safetensors"));
    let file = SafeTensors::deserialize(&bytes).unwrap();
    let tensor = |scale: usize, name: &str| file.tensor(&format!("exit8_key{scale}_{name}"));
    let grid = PatchGrid {
        columns: width / 14,
        rows: height / 14,
        patch_px: 14,
        stride: PoolingStride::Kernel,
    };
    let scales = [1, 2, 3].map(|scale| ScaleKeyPatches {
        index: indices(&tensor(scale, "index").unwrap()),
        attention: floats(&tensor(scale, "attention").unwrap()),
        descriptors: tensor(scale, "descriptor")
            .map(|values| floats(&values))
            .unwrap_or_default(),
    });
    let centres = [1, 2, 3].map(|scale| {
        let values = floats(&tensor(scale, "centre_xy").unwrap());
        let (points, _) = values.as_chunks::<2>();
        points.to_vec()
    });
    GoldenPatches {
        centres,
        key_patches: KeyPatches {
            grid,
            dim: 384,
            scales,
        },
    }
}

fn floats(tensor: &TensorView<'_>) -> Vec<f32> {
    let (words, _) = tensor.data().as_chunks::<4>();
    words.iter().map(|&word| f32::from_le_bytes(word)).collect()
}

fn indices(tensor: &TensorView<'_>) -> Vec<u32> {
    let (words, _) = tensor.data().as_chunks::<8>();
    words
        .iter()
        .map(|&word| i64::from_le_bytes(word) as u32)
        .collect()
}

/// From `street_a` to `street_a_dusk`, in pixels of a `width` x `height` input.
fn homography_to_dusk([width, height]: [u16; 2]) -> [f64; 9] {
    let all: BTreeMap<String, [[f64; 3]; 3]> =
        serde_json::from_slice(&read("homography.json")).unwrap();
    let at_640x480 = all["a_to_a_dusk_640x480"];
    let scale = [f64::from(width) / 640.0, f64::from(height) / 480.0, 1.0];
    std::array::from_fn(|i| at_640x480[i / 3][i % 3] * scale[i / 3] / scale[i % 3])
}

/// Mean distance in pixels between where two homographies map `points`.
pub(crate) fn mean_deviation(found: &[f64; 9], truth: &[f64; 9], points: &[[f64; 2]]) -> f64 {
    let deviation = |&point: &[f64; 2]| {
        let [u, v] = project(found, point);
        let [s, t] = project(truth, point);
        (u - s).hypot(v - t)
    };
    points.iter().map(deviation).sum::<f64>() / points.len() as f64
}

/// Where a homography maps a point.
pub(crate) fn project(homography: &[f64; 9], [x, y]: [f64; 2]) -> [f64; 2] {
    let [u, v, w] =
        [0, 3, 6].map(|row| homography[row] * x + homography[row + 1] * y + homography[row + 2]);
    [u / w, v / w]
}
