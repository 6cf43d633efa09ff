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

/// Bytes before the first patch.
const HEADER: usize = 28;

/// Bytes of a patch apart from its descriptor: position, attention and factor.
const PATCH: usize = 2 + 2 + 4;

/// Bytes of the checksum at the end.
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
        /// Checksum of the bytes at hand.
        found: u32,
        /// Checksum that the blob carries.
        expected: u32,
    },
    /// A value is out of its range.
    #[error("{0}")]
    Value(String),
}

/// Writes `patches` as a blob.
///
/// # Errors
/// They hold values that decoding would refuse.
pub fn encode(patches: &PackedPatches) -> Result<Vec<u8>, CodecError> {
    check(patches)?;
    let dim = u16::try_from(patches.dim)
        .map_err(|_| CodecError::Value(format!("{} is too long", patches.dim)))?;
    let grid = &patches.grid;
    let mut bytes = Vec::with_capacity(blob_bytes(patches.len(), patches.dim));
    bytes.extend_from_slice(&MAGIC);
    bytes.extend_from_slice(&VERSION.to_le_bytes());
    bytes.push(match grid.stride {
        PoolingStride::Kernel => 0,
        PoolingStride::One => 1,
    });
    bytes.push(0);
    for value in [grid.columns, grid.rows, grid.patch_px, dim] {
        bytes.extend_from_slice(&value.to_le_bytes());
    }
    for count in patches.counts {
        // Lossless: `check` allows no more patches than the grid has places, and their numbers
        // are u16.
        bytes.extend_from_slice(&(count as u32).to_le_bytes());
    }
    bytes.extend(patches.index.iter().flat_map(|value| value.to_le_bytes()));
    bytes.extend(
        patches
            .attention
            .iter()
            .flat_map(|value| value.to_le_bytes()),
    );
    bytes.extend(patches.factor.iter().flat_map(|value| value.to_le_bytes()));
    bytes.extend_from_slice(bytemuck::cast_slice(&patches.codes));
    let checksum = crc32fast::hash(&bytes);
    bytes.extend_from_slice(&checksum.to_le_bytes());
    Ok(bytes)
}

/// Bytes of a blob of `patches` patches whose descriptors have length `dim`.
fn blob_bytes(patches: usize, dim: usize) -> usize {
    HEADER + patches * (PATCH + dim) + TRAILER
}

/// Reads a blob back.
///
/// # Errors
/// The bytes are not a blob that [`encode`] wrote.
pub fn decode(bytes: &[u8]) -> Result<PackedPatches, CodecError> {
    let header = Header::read(bytes)?;
    let content = verify_checksum(bytes)?;
    let total: usize = header.counts.iter().sum();
    let (index, rest) = content[HEADER..].split_at(total * 2);
    let (attention, rest) = rest.split_at(total * 2);
    let (factor, codes) = rest.split_at(total * 4);
    let patches = PackedPatches {
        grid: PatchGrid {
            stride: header.stride()?,
            columns: header.columns,
            rows: header.rows,
            patch_px: header.patch_px,
        },
        dim: header.dim,
        counts: header.counts,
        index: chunks_of(index).map(u16::from_le_bytes).collect(),
        attention: chunks_of(attention).map(f16::from_le_bytes).collect(),
        factor: chunks_of(factor).map(f32::from_le_bytes).collect(),
        codes: bytemuck::cast_slice(codes).to_vec(),
    };
    check(&patches)?;
    Ok(patches)
}

/// The fields before the patches themselves.
struct Header {
    stride: [u8; 2],
    columns: u16,
    rows: u16,
    patch_px: u16,
    dim: usize,
    counts: [usize; SCALES],
}

impl Header {
    /// Reads the header, and checks that the blob is as long as it says.
    fn read(bytes: &[u8]) -> Result<Self, CodecError> {
        let wrong_length = |expected| CodecError::Length {
            found: bytes.len(),
            expected,
        };
        if bytes.len() < HEADER + TRAILER {
            return Err(wrong_length(HEADER + TRAILER));
        }
        if bytes[..4] != MAGIC {
            return Err(CodecError::Magic);
        }
        let version = u16_at(bytes, 4);
        if version != VERSION {
            return Err(CodecError::Version(version));
        }
        let header = Self {
            stride: [bytes[6], bytes[7]],
            columns: u16_at(bytes, 8),
            rows: u16_at(bytes, 10),
            patch_px: u16_at(bytes, 12),
            dim: u16_at(bytes, 14) as usize,
            counts: [16, 20, 24].map(|at| u32_at(bytes, at) as usize),
        };
        // At most 3 * 2^32 * 2^16 bytes, which does not overflow 64 bits.
        let expected = blob_bytes(header.counts.iter().sum(), header.dim);
        if bytes.len() != expected {
            return Err(wrong_length(expected));
        }
        Ok(header)
    }

    fn stride(&self) -> Result<PoolingStride, CodecError> {
        match self.stride {
            [0, 0] => Ok(PoolingStride::Kernel),
            [1, 0] => Ok(PoolingStride::One),
            [stride, zero] => {
                let what = format!("stride {:?} is not known", (stride, zero));
                Err(CodecError::Value(what))
            }
        }
    }
}

/// The bytes that the checksum covers, if they are those that were written.
fn verify_checksum(bytes: &[u8]) -> Result<&[u8], CodecError> {
    let content = &bytes[..bytes.len() - TRAILER];
    let found = crc32fast::hash(content);
    let expected = trailing_checksum(bytes).unwrap_or_default();
    if found == expected {
        Ok(content)
    } else {
        Err(CodecError::Checksum { found, expected })
    }
}

/// The checksum a blob carries in its last four bytes, unverified.
pub fn trailing_checksum(blob: &[u8]) -> Option<u32> {
    blob.last_chunk().map(|bytes| u32::from_le_bytes(*bytes))
}

/// Refuses what no extraction makes, so that later stages may rely on it.
fn check(patches: &PackedPatches) -> Result<(), CodecError> {
    check_lengths(patches)?;
    check_grid(patches)?;
    let attention_is_finite = patches.attention.iter().all(|value| value.is_finite());
    let is_factor = |value: &f32| value.is_finite() && *value >= 0.0;
    if !attention_is_finite || !patches.factor.iter().all(is_factor) {
        let what = "an attention or factor is not a finite number";
        return Err(CodecError::Value(what.into()));
    }
    if patches.codes.contains(&i8::MIN) {
        return Err(CodecError::Value("code -128 is never written".into()));
    }
    Ok(())
}

/// Checks that every patch has one value of each kind.
fn check_lengths(patches: &PackedPatches) -> Result<(), CodecError> {
    let total = patches.len();
    let codes = patches.codes.len();
    let lengths = [
        patches.index.len(),
        patches.attention.len(),
        patches.factor.len(),
    ];
    if lengths == [total; 3] && codes == total * patches.dim {
        return Ok(());
    }
    let what = format!("{total} patches with {lengths:?} values and {codes} codes");
    Err(CodecError::Value(what))
}

/// Checks that every patch lies in the grid of its scale.
fn check_grid(patches: &PackedPatches) -> Result<(), CodecError> {
    let grid = &patches.grid;
    let dim = patches.dim;
    if dim == 0 || grid.columns == 0 || grid.rows == 0 || grid.patch_px == 0 {
        let what = format!("an empty grid or descriptor: {grid:?}, length {dim}");
        return Err(CodecError::Value(what));
    }
    for scale in 1..=SCALES {
        let (columns, rows) = grid.pooled(scale);
        let places = columns * rows;
        let indices = &patches.index[patches.rows(scale)];
        if let Some(index) = indices.iter().find(|&&index| index as usize >= places) {
            let what = format!("position {index} at scale {scale} of a {columns}x{rows} grid");
            return Err(CodecError::Value(what));
        }
        let count = patches.counts[scale - 1];
        if count > places {
            let what = format!("{count} patches at scale {scale} of {columns}x{rows}");
            return Err(CodecError::Value(what));
        }
    }
    Ok(())
}

/// A global descriptor as f32 bytes.
pub fn encode_f32(values: &[f32]) -> Vec<u8> {
    values
        .iter()
        .flat_map(|value| value.to_le_bytes())
        .collect()
}

/// The inverse of [`encode_f32`]; `None` unless the bytes are whole, finite numbers.
pub fn decode_f32(bytes: &[u8]) -> Option<Vec<f32>> {
    let (chunks, rest) = bytes.as_chunks();
    let values: Vec<f32> = chunks
        .iter()
        .map(|chunk| f32::from_le_bytes(*chunk))
        .collect();
    let is_valid = rest.is_empty() && values.iter().all(|value| value.is_finite());
    is_valid.then_some(values)
}

/// A pooled vector as f16 bytes, rounded to nearest.
pub fn encode_f16(values: &[f32]) -> Vec<u8> {
    values
        .iter()
        .flat_map(|value| f16::from_f32(*value).to_le_bytes())
        .collect()
}

/// The inverse of [`encode_f16`], widened; `None` unless the bytes are whole, finite numbers.
pub fn decode_f16(bytes: &[u8]) -> Option<Vec<f32>> {
    let (chunks, rest) = bytes.as_chunks();
    let halves: Vec<f16> = chunks
        .iter()
        .map(|chunk| f16::from_le_bytes(*chunk))
        .collect();
    let is_valid = rest.is_empty() && halves.iter().all(|half| half.is_finite());
    is_valid.then(|| halves.to_f32_vec())
}

/// Whole chunks of `N` bytes.
fn chunks_of<const N: usize>(bytes: &[u8]) -> impl Iterator<Item = [u8; N]> {
    let (chunks, _rest) = bytes.as_chunks();
    chunks.iter().copied()
}

fn u16_at(bytes: &[u8], at: usize) -> u16 {
    u16::from_le_bytes([bytes[at], bytes[at + 1]])
}

fn u32_at(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]])
}

#[cfg(test)]
mod tests;
