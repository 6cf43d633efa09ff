//! A descriptor as the cache keeps it.

use crate::eval::error::EvalError;
use placeformer_core::types::Descriptor;
use placeformer_store::codec;
use serde::Serialize;

/// Mean seconds per image of the stages before the search.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct ExtractionSeconds {
    /// Decoding and resizing.
    pub decode: f64,
    /// The model.
    pub extract: f64,
}

/// A descriptor with what it cost.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Record {
    pub(super) seconds: ExtractionSeconds,
    /// Length of the encoded key patches.
    pub(super) blob_bytes: usize,
    pub(super) descriptor: Descriptor,
}

/// Marks a record, and its version.
const MAGIC: &[u8; 8] = b"PFFEAT01";
/// Bytes before the vectors: magic, two times in seconds, two lengths.
const HEADER: usize = 8 + 2 * 8 + 2 * 4;

impl Record {
    /// Magic, seconds, lengths, global and pooled vectors, key patches as the store encodes them,
    /// CRC-32 of it all.
    pub(super) fn encode(&mut self) -> Result<Vec<u8>, EvalError> {
        let blob = codec::encode(&self.descriptor.patches)
            .map_err(|error| EvalError::Setting(error.to_string()))?;
        self.blob_bytes = blob.len();
        let mut bytes = MAGIC.to_vec();
        bytes.extend(self.seconds.decode.to_le_bytes());
        bytes.extend(self.seconds.extract.to_le_bytes());
        bytes.extend((self.descriptor.global.len() as u32).to_le_bytes());
        bytes.extend((self.descriptor.pooled.len() as u32).to_le_bytes());
        for value in self.descriptor.global.iter().chain(&self.descriptor.pooled) {
            bytes.extend(value.to_le_bytes());
        }
        bytes.extend(blob);
        bytes.extend(crc32fast::hash(&bytes).to_le_bytes());
        Ok(bytes)
    }

    /// `None` unless every byte is as it was written.
    pub(super) fn decode(bytes: &[u8]) -> Option<Self> {
        let (content, checksum) = bytes.split_last_chunk::<4>()?;
        if crc32fast::hash(content) != u32::from_le_bytes(*checksum) || !content.starts_with(MAGIC)
        {
            return None;
        }
        let seconds = ExtractionSeconds {
            decode: f64::from_le_bytes(array_at(content, 8)?),
            extract: f64::from_le_bytes(array_at(content, 16)?),
        };
        let global = u32::from_le_bytes(array_at(content, 24)?) as usize;
        let pooled = u32::from_le_bytes(array_at(content, 28)?) as usize;
        let vector_bytes = global.checked_add(pooled)?.checked_mul(4)?;
        let (vectors, blob) = content.get(HEADER..)?.split_at_checked(vector_bytes)?;
        let mut values = vectors
            .as_chunks::<4>()
            .0
            .iter()
            .map(|bytes| f32::from_le_bytes(*bytes));
        Some(Self {
            seconds,
            blob_bytes: blob.len(),
            descriptor: Descriptor {
                global: values.by_ref().take(global).collect(),
                pooled: values.collect(),
                patches: codec::decode(blob).ok()?,
            },
        })
    }
}

/// The `N` bytes from `at` on.
fn array_at<const N: usize>(bytes: &[u8], at: usize) -> Option<[u8; N]> {
    bytes.get(at..at + N)?.try_into().ok()
}
