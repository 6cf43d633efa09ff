use super::*;
use proptest::prelude::*;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Patches that an extraction could make: any grid, up to 20 patches a scale.
fn patches() -> impl Strategy<Value = PackedPatches> {
    let stride = prop_oneof![Just(PoolingStride::Kernel), Just(PoolingStride::One)];
    let grid = (3u16..40, 3u16..40, 1u16..32, stride);
    let grid = grid.prop_map(|(columns, rows, patch_px, stride)| PatchGrid {
        columns,
        rows,
        patch_px,
        stride,
    });
    (grid, 1usize..40, any::<u64>()).prop_map(|(grid, dim, seed)| drawn(grid, dim, seed))
}

fn drawn(grid: PatchGrid, dim: usize, seed: u64) -> PackedPatches {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut counts = [0; SCALES];
    let mut index = Vec::new();
    for scale in 1..=SCALES {
        let (columns, rows) = grid.pooled(scale);
        let places = columns * rows;
        let count = random.random_range(0..=places.min(20));
        counts[scale - 1] = count;
        index.extend((0..count).map(|_| random.random_range(0..places) as u16));
    }
    let total = index.len();
    PackedPatches {
        grid,
        dim,
        counts,
        index,
        attention: (0..total)
            .map(|_| f16::from_f32(random.random_range(0.0..9.0)))
            .collect(),
        factor: (0..total).map(|_| random.random_range(0.0..1.0)).collect(),
        codes: (0..total * dim)
            .map(|_| random.random_range(-127..=127))
            .collect(),
    }
}

proptest! {
    #[test]
    fn what_is_written_is_read(patches in patches()) {
        let blob = encode(&patches).unwrap();
        prop_assert_eq!(blob.len(), HEADER + patches.len() * (8 + patches.dim) + TRAILER);
        prop_assert_eq!(decode(&blob).unwrap(), patches);
    }

    #[test]
    fn any_flipped_bit_is_noticed(
        patches in patches(),
        at in any::<prop::sample::Index>(),
        bit in 0u8..8,
    ) {
        let mut blob = encode(&patches).unwrap();
        let at = at.index(blob.len());
        blob[at] ^= 1 << bit;
        prop_assert!(decode(&blob).is_err());
    }

    #[test]
    fn cut_or_grown_blobs_are_refused(
        patches in patches(),
        keep in any::<prop::sample::Index>(),
        extra in 1usize..9,
    ) {
        let blob = encode(&patches).unwrap();
        prop_assert!(decode(&blob[..keep.index(blob.len())]).is_err());
        prop_assert!(decode(&[blob.as_slice(), &vec![0; extra]].concat()).is_err());
    }

    #[test]
    fn arbitrary_bytes_never_panic(
        mut bytes in prop::collection::vec(any::<u8>(), 0..200),
        starts_like_a_blob in any::<bool>(),
    ) {
        if starts_like_a_blob && bytes.len() > HEADER + TRAILER {
            bytes[..4].copy_from_slice(&MAGIC);
            bytes[4..6].copy_from_slice(&VERSION.to_le_bytes());
        }
        let _ = decode(&bytes);
    }

    #[test]
    fn vectors_survive(values in prop::collection::vec(-2f32..2.0, 0..300)) {
        prop_assert_eq!(decode_f32(&encode_f32(&values)).unwrap(), values.clone());
        for (back, value) in decode_f16(&encode_f16(&values)).unwrap().iter().zip(&values) {
            prop_assert!((back - value).abs() <= value.abs() / 1024.0 + 1e-7);
        }
    }
}

fn golden() -> PackedPatches {
    PackedPatches {
        grid: PatchGrid {
            columns: 4,
            rows: 3,
            patch_px: 14,
            stride: PoolingStride::Kernel,
        },
        dim: 2,
        counts: [1, 1, 0],
        index: vec![11, 1],
        attention: vec![f16::from_f32(1.5), f16::from_f32(2.0)],
        factor: vec![0.5, 0.25],
        codes: vec![127, -127, 1, -1],
    }
}

#[test]
fn version_1_bytes_never_change() {
    let expected: Vec<u8> = [
        b"PFKP".as_slice(),
        &[
            1, 0, 0, 0, 4, 0, 3, 0, 14, 0, 2, 0, 1, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0,
        ],
        &[
            11, 0, 1, 0, 0x00, 0x3e, 0x00, 0x40, 0, 0, 0, 0x3f, 0, 0, 0x80, 0x3e, 127, 129, 1, 255,
        ],
        &GOLDEN_CHECKSUM.to_le_bytes(),
    ]
    .concat();
    assert_eq!(encode(&golden()).unwrap(), expected);
    assert_eq!(decode(&expected).unwrap(), golden());
}

// As any CRC-32 (IEEE 802.3) tool computes it over the bytes above.
const GOLDEN_CHECKSUM: u32 = 0x0540_50d7;

#[test]
fn a_header_that_promises_gigabytes_allocates_nothing() {
    let mut blob = encode(&golden()).unwrap();
    blob[16..28].fill(0xff);
    blob[14..16].fill(0xff);
    assert!(matches!(decode(&blob), Err(CodecError::Length { .. })));
}

#[test]
fn values_out_of_range_are_neither_written_nor_read() {
    let breakages: [fn(&mut PackedPatches); 6] = [
        |p| p.index[0] = 12,
        |p| p.attention[0] = f16::NAN,
        |p| p.factor[1] = f32::INFINITY,
        |p| p.codes[2] = i8::MIN,
        |p| p.codes.push(0),
        |p| p.grid.rows = 0,
    ];
    for breakage in breakages {
        let mut patches = golden();
        breakage(&mut patches);
        assert!(
            matches!(encode(&patches), Err(CodecError::Value(_))),
            "{patches:?}"
        );
    }
}
