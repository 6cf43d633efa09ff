//! Key patches as bytes on disk.
//!
//! The blob is what makes a map large, so it holds int8 codes and grid positions instead of floats
//! and coordinates; and it outlives releases, so it names its version and carries a checksum. All
//! numbers are little-endian:
//!
//! | offset | bytes | what |
//! |---|---|---|
//! | 0 | 4 | `PFKP` |
//! | 4 | 2 | version, 1 |
//! | 6 | 1 | stride of fused windows: 0 as the kernel, 1 one patch |
//! | 7 | 1 | 0 |
//! | 8 | 6 | columns, rows, side of a base patch in pixels, u16 each |
//! | 14 | 2 | length of a descriptor |
//! | 16 | 12 | patches at scales 1, 2, 3, u32 each; their sum is n |
//! | 28 | 2n | positions in the fused grid, u16 |
//! | .. | 2n | attention, f16 |
//! | .. | 4n | factor of each descriptor, f32 |
//! | .. | n * length | codes, i8, row-major |
//! | end - 4 | 4 | CRC-32 (IEEE) of all bytes before |
//!
//! Decoding checks the length that the counts imply against the bytes at hand before it allocates,
//! then the checksum, then every value's range: whatever the bytes, the outcome is a valid
//! [`PackedPatches`] or an error.

use half::f16;
use half::slice::HalfFloatSliceExt;
use placeformer_core::types::{PackedPatches, PatchGrid, PoolingStride, SCALES};

const MAGIC: [u8; 4] = *b"PFKP";
const VERSION: u16 = 1;
const HEADER: usize = 28;
const TRAILER: usize = 4;

/// Why bytes are not key patches, or key patches cannot become bytes.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum CodecError {
    /// Too few or too many bytes for what the header announces.
    #[error("{found} bytes where {expected} are needed")]
    Length {
        /// Bytes at hand.
        found: usize,
        /// Bytes needed.
        expected: usize,
    },
    /// Not a patch blob.
    #[error("the blob does not start as key patches do")]
    Magic,
    /// Written by a newer release.
    #[error("blob version {0} is not known to this release")]
    Version(u16),
    /// The bytes are not those that were written.
    #[error("checksum {found:08x} where {expected:08x} was stored")]
    Checksum {
        /// Of the bytes at hand.
        found: u32,
        /// As stored.
        expected: u32,
    },
    /// A value is out of its range.
    #[error("{0}")]
    Value(String),
}

/// Writes `patches` as a blob; fails only on values that decoding would refuse.
pub fn encode(patches: &PackedPatches) -> Result<Vec<u8>, CodecError> {
    check(patches)?;
    let dim = u16::try_from(patches.dim)
        .map_err(|_| CodecError::Value(format!("{} is too long", patches.dim)))?;
    let mut bytes = Vec::with_capacity(HEADER + patches.len() * (8 + patches.dim) + TRAILER);
    bytes.extend_from_slice(&MAGIC);
    bytes.extend_from_slice(&VERSION.to_le_bytes());
    bytes.push(match patches.grid.stride {
        PoolingStride::Kernel => 0,
        PoolingStride::One => 1,
    });
    bytes.push(0);
    for value in [
        patches.grid.columns,
        patches.grid.rows,
        patches.grid.patch_px,
        dim,
    ] {
        bytes.extend_from_slice(&value.to_le_bytes());
    }
    for count in patches.counts {
        // Positions are u16, so `check` has bounded every count by 65,536.
        bytes.extend_from_slice(&(count as u32).to_le_bytes());
    }
    bytes.extend(patches.index.iter().flat_map(|v| v.to_le_bytes()));
    bytes.extend(patches.attention.iter().flat_map(|v| v.to_le_bytes()));
    bytes.extend(patches.factor.iter().flat_map(|v| v.to_le_bytes()));
    bytes.extend_from_slice(bytemuck::cast_slice(&patches.codes));
    let checksum = crc32fast::hash(&bytes);
    bytes.extend_from_slice(&checksum.to_le_bytes());
    Ok(bytes)
}

/// Reads a blob back.
pub fn decode(bytes: &[u8]) -> Result<PackedPatches, CodecError> {
    if bytes.len() < HEADER + TRAILER {
        return Err(CodecError::Length {
            found: bytes.len(),
            expected: HEADER + TRAILER,
        });
    }
    if bytes[..4] != MAGIC {
        return Err(CodecError::Magic);
    }
    let version = u16_at(bytes, 4);
    if version != VERSION {
        return Err(CodecError::Version(version));
    }
    let dim = u16_at(bytes, 14) as usize;
    let counts = [16, 20, 24].map(|at| u32_at(bytes, at) as usize);
    // At most 3 * 2^32 * 2^16: no overflow in 64 bits.
    let total: usize = counts.iter().sum();
    let expected = HEADER + total * (8 + dim) + TRAILER;
    if bytes.len() != expected {
        return Err(CodecError::Length {
            found: bytes.len(),
            expected,
        });
    }
    let (content, stored) = (
        &bytes[..bytes.len() - TRAILER],
        trailing_checksum(bytes).unwrap_or_default(),
    );
    let found = crc32fast::hash(content);
    if found != stored {
        return Err(CodecError::Checksum {
            found,
            expected: stored,
        });
    }
    let stride = match (bytes[6], bytes[7]) {
        (0, 0) => PoolingStride::Kernel,
        (1, 0) => PoolingStride::One,
        other => return Err(CodecError::Value(format!("stride {other:?} is not known"))),
    };
    let (index, rest) = content[HEADER..].split_at(total * 2);
    let (attention, rest) = rest.split_at(total * 2);
    let (factor, codes) = rest.split_at(total * 4);
    let patches = PackedPatches {
        grid: PatchGrid {
            columns: u16_at(bytes, 8),
            rows: u16_at(bytes, 10),
            patch_px: u16_at(bytes, 12),
            stride,
        },
        dim,
        counts,
        index: index
            .as_chunks()
            .0
            .iter()
            .map(|b| u16::from_le_bytes(*b))
            .collect(),
        attention: attention
            .as_chunks()
            .0
            .iter()
            .map(|b| f16::from_le_bytes(*b))
            .collect(),
        factor: factor
            .as_chunks()
            .0
            .iter()
            .map(|b| f32::from_le_bytes(*b))
            .collect(),
        codes: bytemuck::cast_slice(codes).to_vec(),
    };
    check(&patches)?;
    Ok(patches)
}

/// The checksum a blob carries in its last four bytes, unverified.
pub fn trailing_checksum(blob: &[u8]) -> Option<u32> {
    blob.last_chunk().map(|bytes| u32::from_le_bytes(*bytes))
}

/// Refuses what no extraction makes, so that later stages may rely on it.
fn check(patches: &PackedPatches) -> Result<(), CodecError> {
    let wrong = |what: String| Err(CodecError::Value(what));
    let total = patches.len();
    let lengths = [
        patches.index.len(),
        patches.attention.len(),
        patches.factor.len(),
    ];
    if lengths.iter().any(|&length| length != total) || patches.codes.len() != total * patches.dim {
        return wrong(format!(
            "{total} patches with {lengths:?} values and {} codes",
            patches.codes.len()
        ));
    }
    if patches.dim == 0
        || patches.grid.columns == 0
        || patches.grid.rows == 0
        || patches.grid.patch_px == 0
    {
        return wrong(format!(
            "an empty grid or descriptor: {:?}, length {}",
            patches.grid, patches.dim
        ));
    }
    for scale in 1..=SCALES {
        let (columns, rows) = patches.grid.pooled(scale);
        if let Some(index) = patches.index[patches.rows(scale)]
            .iter()
            .find(|&&i| i as usize >= columns * rows)
        {
            return wrong(format!(
                "position {index} at scale {scale} of a {columns}x{rows} grid"
            ));
        }
        if patches.counts[scale - 1] > columns * rows {
            return wrong(format!(
                "{} patches at scale {scale} of {columns}x{rows}",
                patches.counts[scale - 1]
            ));
        }
    }
    if !patches.attention.iter().all(|a| a.is_finite())
        || !patches.factor.iter().all(|f| f.is_finite() && *f >= 0.0)
    {
        return wrong("an attention or factor is not a finite number".into());
    }
    if patches.codes.contains(&i8::MIN) {
        return wrong("code -128 is never written".into());
    }
    Ok(())
}

/// A global descriptor as f32 bytes.
pub fn encode_f32(values: &[f32]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}

/// The inverse of [`encode_f32`]; `None` unless whole, finite numbers.
pub fn decode_f32(bytes: &[u8]) -> Option<Vec<f32>> {
    let (whole, rest) = bytes.as_chunks();
    let values: Vec<f32> = whole.iter().map(|b| f32::from_le_bytes(*b)).collect();
    (rest.is_empty() && values.iter().all(|v| v.is_finite())).then_some(values)
}

/// A pooled vector as f16 bytes, rounded to nearest.
pub fn encode_f16(values: &[f32]) -> Vec<u8> {
    values
        .iter()
        .flat_map(|v| f16::from_f32(*v).to_le_bytes())
        .collect()
}

/// The inverse of [`encode_f16`], widened; `None` unless whole, finite numbers.
pub fn decode_f16(bytes: &[u8]) -> Option<Vec<f32>> {
    let (whole, rest) = bytes.as_chunks();
    let halves: Vec<f16> = whole.iter().map(|b| f16::from_le_bytes(*b)).collect();
    (rest.is_empty() && halves.iter().all(|v| v.is_finite())).then(|| halves.to_f32_vec())
}

fn u16_at(bytes: &[u8], at: usize) -> u16 {
    u16::from_le_bytes([bytes[at], bytes[at + 1]])
}

fn u32_at(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]])
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn patches() -> impl Strategy<Value = PackedPatches> {
        let grid = (3u16..40, 3u16..40, 1u16..32, any::<bool>());
        (grid, 1usize..40, any::<u64>()).prop_map(
            |((columns, rows, patch_px, dense), dim, seed)| {
                use rand::{RngExt, SeedableRng};
                let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
                let stride = if dense {
                    PoolingStride::One
                } else {
                    PoolingStride::Kernel
                };
                let grid = PatchGrid {
                    columns,
                    rows,
                    patch_px,
                    stride,
                };
                let cells = [1, 2, 3]
                    .map(|scale| grid.pooled(scale))
                    .map(|(c, r)| c * r);
                let counts = cells.map(|n| random.random_range(0..=n.min(20)));
                let index: Vec<u16> = (0..3)
                    .flat_map(|s| {
                        (0..counts[s])
                            .map(|_| random.random_range(0..cells[s]) as u16)
                            .collect::<Vec<_>>()
                    })
                    .collect();
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
            },
        )
    }

    proptest! {
        #[test]
        fn what_is_written_is_read(patches in patches()) {
            let blob = encode(&patches).unwrap();
            prop_assert_eq!(blob.len(), HEADER + patches.len() * (8 + patches.dim) + TRAILER);
            prop_assert_eq!(decode(&blob).unwrap(), patches);
        }

        #[test]
        fn any_flipped_bit_is_noticed(patches in patches(), at in any::<prop::sample::Index>(), bit in 0u8..8) {
            let mut blob = encode(&patches).unwrap();
            let at = at.index(blob.len());
            blob[at] ^= 1 << bit;
            prop_assert!(decode(&blob).is_err());
        }

        #[test]
        fn cut_or_grown_blobs_are_refused(patches in patches(), keep in any::<prop::sample::Index>(), extra in 1usize..9) {
            let blob = encode(&patches).unwrap();
            prop_assert!(decode(&blob[..keep.index(blob.len())]).is_err());
            prop_assert!(decode(&[blob.as_slice(), &vec![0; extra]].concat()).is_err());
        }

        #[test]
        fn arbitrary_bytes_never_panic(bytes in prop::collection::vec(any::<u8>(), 0..200), sealed in any::<bool>()) {
            let mut bytes = bytes;
            if sealed && bytes.len() > HEADER + TRAILER {
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
                11, 0, 1, 0, 0x00, 0x3e, 0x00, 0x40, 0, 0, 0, 0x3f, 0, 0, 0x80, 0x3e, 127, 129, 1,
                255,
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
}
