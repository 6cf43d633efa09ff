//! Inputs of the benchmarks, the same at every run.

use crate::synth::{Condition, StreetWorld, Viewpoint};
use placeformer_core::types::{
    GLOBAL_DIM, GeoPoint, ImageSize, KeyPatches, PatchGrid, PoolingStride, ReferenceId,
    ScaleKeyPatches,
};
use placeformer_vision::image::{ImageError, encode_jpeg};
use placeformer_vision::search::IndexEntry;
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// A full-HD JPEG of a drawn street: its entropy is that of a photo, and nothing needs to be
/// shipped.
///
/// # Errors
/// The encoder's.
pub fn photo() -> Result<Vec<u8>, ImageError> {
    street(0, 0, PHOTO_SIZE)
}

/// Size of the [`photo`].
pub const PHOTO_SIZE: ImageSize = ImageSize {
    width: 1920,
    height: 1080,
};

/// A JPEG of place `place`, seen as the `view`th time.
///
/// # Errors
/// The encoder's.
pub fn street(place: u64, view: u64, size: ImageSize) -> Result<Vec<u8>, ImageError> {
    let viewpoint = Viewpoint {
        along_m: view as f64 * 0.7,
        across_m: -1.5,
        turn_deg: 45.0 + view as f64 * 3.0,
    };
    encode_jpeg(
        &StreetWorld::new(1).render(place, viewpoint, Condition::Day, size),
        85,
    )
}

/// Approximately normal values, scaled to unit length: directions without preference, the hardest
/// case for the search's bounds.
pub fn unit_vector(seed: u64) -> Vec<f32> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut normal = || (0..4).map(|_| random.random_range(-1f32..1.0)).sum::<f32>();
    let raw: Vec<f32> = (0..GLOBAL_DIM).map(|_| normal()).collect();
    let length = raw.iter().map(|v| v * v).sum::<f32>().sqrt();
    raw.iter().map(|v| v / length).collect()
}

/// The id of a made-up reference; ascending like real ones, and below all of them.
pub fn made_up_id(number: u64) -> ReferenceId {
    ReferenceId::from_bytes(u128::from(number).to_be_bytes())
}

/// A made-up reference of an index, 11 cm north of the one before.
pub fn index_entry(number: u64) -> IndexEntry {
    let location = GeoPoint::new(51.0 + number as f64 * 1e-6, 7.0).ok();
    IndexEntry {
        id: made_up_id(number),
        global: unit_vector(number),
        location,
        alt: None,
        heading: None,
        captured_at: None,
    }
}

/// Candidates of a query.
pub const CANDIDATES: usize = 100;
/// Key patches per scale: the paper's caps.
pub const CAPS: [usize; 3] = [400, 200, 50];
/// Length of a patch descriptor.
pub const DIM: usize = 384;
const GRID: PatchGrid = PatchGrid {
    columns: 46,
    rows: 34,
    patch_px: 14,
    stride: PoolingStride::Kernel,
};

/// One query and its candidates in full precision.
pub struct RerankScene {
    /// The query.
    pub query: KeyPatches,
    /// [`CANDIDATES`] of them.
    pub candidates: Vec<KeyPatches>,
}

impl RerankScene {
    /// Candidates in each of which `share` of the query's patches reappear under a homography.
    pub fn new(share: f64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        let query = KeyPatches {
            grid: GRID,
            dim: DIM,
            scales: [1, 2, 3].map(|scale| random_scale(scale, &mut rng)),
        };
        let candidates = (0..CANDIDATES)
            .map(|_| candidate(&query, share, &mut rng))
            .collect();
        Self { query, candidates }
    }
}

fn gaussian(rng: &mut impl Rng) -> f32 {
    // Twelve uniforms: near enough to normal for descriptors.
    (0..12).map(|_| rng.random::<f32>()).sum::<f32>() - 6.0
}

fn normalised(values: impl Iterator<Item = f32>) -> Vec<f32> {
    let values: Vec<f32> = values.collect();
    let norm = values.iter().map(|v| v * v).sum::<f32>().sqrt();
    values.into_iter().map(|v| v / norm).collect()
}

fn random_scale(scale: usize, rng: &mut impl Rng) -> ScaleKeyPatches {
    let (columns, rows) = GRID.pooled(scale);
    let index = (0..CAPS[scale - 1])
        .map(|_| rng.random_range(0..(columns * rows) as u32))
        .collect();
    let descriptors = (0..CAPS[scale - 1]).flat_map(|_| {
        normalised(
            (0..DIM)
                .map(|_| gaussian(rng))
                .collect::<Vec<_>>()
                .into_iter(),
        )
    });
    ScaleKeyPatches {
        index,
        attention: vec![1.0; CAPS[scale - 1]],
        descriptors: descriptors.collect(),
    }
}

/// A view of the query in which `share` of the patches reappear under a homography, snapped to the
/// grid.
fn candidate(query: &KeyPatches, share: f64, rng: &mut impl Rng) -> KeyPatches {
    let mut around = |middle: f64, spread: f64| middle + spread * (2.0 * rng.random::<f64>() - 1.0);
    let h = [
        around(1.0, 0.1),
        around(0.0, 0.05),
        around(0.0, 40.0),
        around(0.0, 0.05),
        around(1.0, 0.1),
        around(0.0, 40.0),
        around(0.0, 1e-4),
        around(0.0, 1e-4),
        1.0,
    ];
    let scales = [1, 2, 3].map(|scale| {
        let mut fresh = random_scale(scale, rng);
        let (columns, rows) = GRID.pooled(scale);
        let side = (scale * 14) as f64;
        for i in 0..CAPS[scale - 1] {
            let from = &query.scales[scale - 1];
            let [x, y] = GRID.centre(scale, from.index[i] as usize).map(f64::from);
            let w = h[6] * x + h[7] * y + h[8];
            let column = ((h[0] * x + h[1] * y + h[2]) / w / side).floor();
            let row = ((h[3] * x + h[4] * y + h[5]) / w / side).floor();
            let inside =
                (0.0..columns as f64).contains(&column) && (0.0..rows as f64).contains(&row);
            if rng.random::<f64>() < share && inside {
                fresh.index[i] = row as u32 * columns as u32 + column as u32;
                let old = &from.descriptors[i * DIM..][..DIM];
                let near = normalised(
                    old.iter()
                        .map(|v| v + 0.03 * gaussian(rng))
                        .collect::<Vec<_>>()
                        .into_iter(),
                );
                fresh.descriptors[i * DIM..][..DIM].copy_from_slice(&near);
            }
        }
        fresh
    });
    KeyPatches {
        grid: GRID,
        dim: DIM,
        scales,
    }
}
