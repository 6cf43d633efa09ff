//! Made-up references for tests of the store and the index.

use half::f16;
use placeformer_core::types::{
    Altitude, ContentHash, Descriptor, ExternalId, GLOBAL_DIM, GeoPoint, Heading, MapName,
    Metadata, ModelId, NewReference, PackedPatches, PatchGrid, PoolingStride, ReferenceFields,
    Timestamp,
};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// The model of every made-up descriptor unless a test says otherwise.
pub const MODEL: &str = "test-model";

/// A map's name.
pub fn map(name: &str) -> MapName {
    name.parse().unwrap()
}

/// A unit vector drawn from `seed`.
pub fn unit_vector(seed: u64, dim: usize) -> Vec<f32> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let raw: Vec<f32> = (0..dim).map(|_| random.random_range(-1.0..1.0)).collect();
    let length = raw.iter().map(|v| v * v).sum::<f32>().sqrt();
    raw.iter().map(|v| v / length).collect()
}

/// A descriptor drawn from `seed` with `patches` key patches of length `dim`.
pub fn descriptor(seed: u64, patches: usize, dim: usize) -> Descriptor {
    let mut random = ChaCha8Rng::seed_from_u64(!seed);
    let counts = [patches - patches / 2, patches / 2, 0];
    Descriptor {
        global: unit_vector(seed, GLOBAL_DIM),
        pooled: unit_vector(seed ^ 0x5555, 384),
        patches: PackedPatches {
            grid: PatchGrid {
                columns: 32,
                rows: 24,
                patch_px: 14,
                stride: PoolingStride::Kernel,
            },
            dim,
            counts,
            index: (0..counts[0] as u16).chain(0..counts[1] as u16).collect(),
            attention: (0..patches)
                .map(|_| f16::from_f32(random.random_range(1.0..5.0)))
                .collect(),
            factor: (0..patches)
                .map(|_| random.random_range(0.001..0.01))
                .collect(),
            codes: (0..patches * dim)
                .map(|_| random.random_range(-127..=127))
                .collect(),
        },
    }
}

/// A reference of `map` drawn from `seed`, without an external id.
pub fn reference(map: &MapName, seed: u64) -> NewReference {
    let seconds = 1_700_000_000 + seed as i64 % 100_000;
    let captured = Timestamp::from_unix_micros(seconds * 1_000_000).unwrap();
    let metadata = format!(r#"{{"seed":{seed},"note":"a b"}}"#);
    let metadata = Metadata::parse(&metadata).unwrap();
    NewReference {
        map: map.clone(),
        fields: ReferenceFields {
            external_id: None,
            location: Some(GeoPoint::new(51.0 + (seed % 1000) as f64 * 1e-4, 7.0).unwrap()),
            alt: Altitude::new((seed % 500) as f64).ok(),
            heading: Some(Heading::new((seed % 360) as f64).unwrap()),
            captured_at: Some(captured),
            metadata: Some(metadata),
        },
        content_hash: ContentHash::of(&seed.to_le_bytes()),
        model: ModelId::new(MODEL),
        descriptor: descriptor(seed, 20, 16),
    }
}

/// The same with an external id.
pub fn named_reference(map: &MapName, external_id: &str, seed: u64) -> NewReference {
    let mut new = reference(map, seed);
    new.fields.external_id = Some(external_id.parse::<ExternalId>().unwrap());
    new
}
