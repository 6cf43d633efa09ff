//! Pooled tokens of images, kept on disk: training a head encodes every image once, whatever is
//! tried afterwards and however often the encoding was interrupted.
//!
//! A folder for each way of pooling, found by its name's hash. In it are segments, one per process
//! that added something, so that two runs never write to one file: records of the image's SHA-256,
//! the vector, and a CRC-32. A segment is read up to its first damaged record, which is where a
//! killed process stopped.

use super::error::TrainError;
use placeformer_core::progress::Task;
use placeformer_core::types::{ContentHash, ImageTensor};
use placeformer_vision::extract::Extractor;
use placeformer_vision::image::{ImageConfig, load_tensor};
use rayon::prelude::*;
use std::collections::HashMap;
use std::fs::{self, File, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};

/// Images decoded together, and encoded together.
const BATCH: usize = 16;
/// Unreadable images named in the error.
const NAMED: usize = 5;

/// Images to their vectors.
type Encode<'a> = dyn Fn(&[ImageTensor]) -> Result<Vec<Vec<f32>>, TrainError> + 'a;

/// The bytes of an image to a tensor, or what is wrong with them.
type Decode<'a> = dyn Fn(&[u8]) -> Result<ImageTensor, String> + Sync + 'a;

/// An image as it was read.
struct FoundImage {
    /// SHA-256 of its content.
    hash: [u8; 32],
    /// `None` if its vector is known.
    tensor: Option<ImageTensor>,
}

/// The vectors of one way of pooling.
pub struct PooledCache {
    folder: PathBuf,
    dim: usize,
    known: HashMap<[u8; 32], Vec<f32>>,
    segment: Option<File>,
}

impl PooledCache {
    /// Opens the vectors of `extractor`'s tokens below `root`.
    ///
    /// # Errors
    /// The folder cannot be read or written.
    pub fn open(root: &Path, extractor: &Extractor) -> Result<Self, TrainError> {
        let aggregate = extractor.aggregate();
        let backbone = extractor.backbone();
        let size = extractor.input_size();
        // The encoder too: precisions compare well enough to search with, but a run repeats only on
        // the same bits.
        let name = format!("{backbone}:{size}:{}:{aggregate}", extractor.encoder_name());
        Self::named(root, &name, aggregate.pooled_dim(extractor.dim()))
    }

    fn named(root: &Path, name: &str, dim: usize) -> Result<Self, TrainError> {
        let folder = root.join(&ContentHash::of(name.as_bytes()).to_string()[..16]);
        let io = |source| TrainError::Io {
            path: folder.clone(),
            source,
        };
        fs::create_dir_all(&folder).map_err(io)?;
        fs::write(folder.join("pooled.txt"), name).map_err(io)?;
        let mut cache = Self {
            dim,
            known: HashMap::new(),
            segment: None,
            folder: folder.clone(),
        };
        for entry in fs::read_dir(&folder).map_err(io)? {
            let path = entry.map_err(io)?.path();
            if path.extension().is_some_and(|end| end == "pooled") {
                cache.read_segment(&fs::read(&path).map_err(io)?);
            }
        }
        Ok(cache)
    }

    /// The vectors `[images, dim]` of `images`, in their order; `task` advances by
    /// each image.
    ///
    /// # Errors
    /// An image cannot be read; all such images are found before the error is returned.
    pub fn pool(
        &mut self,
        extractor: &Extractor,
        images: &[PathBuf],
        task: &Task<'_>,
    ) -> Result<Vec<f32>, TrainError> {
        let limits = ImageConfig::default();
        let decode = |bytes: &[u8]| {
            load_tensor(bytes, &limits, extractor.input_size()).map_err(|e| e.to_string())
        };
        self.pool_with(
            images,
            &decode,
            &|tensors| Ok(extractor.pooled(tensors)?),
            task,
        )
    }

    fn pool_with(
        &mut self,
        images: &[PathBuf],
        decode: &Decode<'_>,
        encode: &Encode<'_>,
        task: &Task<'_>,
    ) -> Result<Vec<f32>, TrainError> {
        let mut rows = Vec::with_capacity(images.len() * self.dim);
        let mut unreadable = Vec::new();
        for batch in images.chunks(BATCH) {
            let found: Vec<Result<FoundImage, String>> = batch
                .par_iter()
                .map(|path| self.find(path, decode))
                .collect();
            let mut hashes = Vec::new();
            let mut missing = Vec::new();
            let mut tensors = Vec::new();
            for image in found {
                match image {
                    Ok(image) => {
                        hashes.push(image.hash);
                        if let Some(tensor) = image.tensor {
                            missing.push(image.hash);
                            tensors.push(tensor);
                        }
                    }
                    Err(reason) => unreadable.push(reason),
                }
            }
            if !tensors.is_empty() {
                self.add(missing, encode(&tensors)?)?;
            }
            for hash in &hashes {
                rows.extend(self.known.get(hash).into_iter().flatten());
            }
            task.add(batch.len() as u64);
        }
        if unreadable.is_empty() {
            Ok(rows)
        } else {
            Err(unreadable_images(&unreadable))
        }
    }

    /// Reads an image, and decodes it unless its vector is known.
    fn find(&self, path: &Path, decode: &Decode<'_>) -> Result<FoundImage, String> {
        let named = |reason: String| format!("{}: {reason}", path.display());
        let bytes = fs::read(path).map_err(|error| named(error.to_string()))?;
        let hash = ContentHash::of(&bytes).0;
        let tensor = if self.known.contains_key(&hash) {
            None
        } else {
            Some(decode(&bytes).map_err(named)?)
        };
        Ok(FoundImage { hash, tensor })
    }

    fn add(&mut self, hashes: Vec<[u8; 32]>, vectors: Vec<Vec<f32>>) -> Result<(), TrainError> {
        let io = |source| TrainError::Io {
            path: self.folder.clone(),
            source,
        };
        let segment = match &mut self.segment {
            Some(segment) => segment,
            none => none.insert(new_segment(&self.folder).map_err(io)?),
        };
        let mut bytes = Vec::new();
        for (hash, vector) in hashes.into_iter().zip(vectors) {
            let start = bytes.len();
            bytes.extend(hash);
            vector
                .iter()
                .for_each(|value| bytes.extend(value.to_le_bytes()));
            let checksum = crc32fast::hash(&bytes[start..]);
            bytes.extend(checksum.to_le_bytes());
            self.known.insert(hash, vector);
        }
        segment.write_all(&bytes).map_err(io)
    }

    fn read_segment(&mut self, bytes: &[u8]) {
        for record in bytes.chunks_exact(32 + self.dim * 4 + 4) {
            let (content, checksum) = record.split_at(record.len() - 4);
            if crc32fast::hash(content).to_le_bytes() != checksum {
                break;
            }
            let (hash, values) = content.split_at(32);
            let Ok(hash) = <[u8; 32]>::try_from(hash) else {
                break;
            };
            let vector = values
                .as_chunks::<4>()
                .0
                .iter()
                .map(|value| f32::from_le_bytes(*value))
                .collect();
            self.known.insert(hash, vector);
        }
    }
}

/// A file of this process alone.
fn new_segment(folder: &Path) -> std::io::Result<File> {
    let mut number = 0;
    loop {
        let path = folder.join(format!("{}-{number}.pooled", std::process::id()));
        match OpenOptions::new().write(true).create_new(true).open(path) {
            Err(error) if error.kind() == std::io::ErrorKind::AlreadyExists => number += 1,
            other => return other,
        }
    }
}

/// Names the first few.
fn unreadable_images(reasons: &[String]) -> TrainError {
    let named = reasons[..reasons.len().min(NAMED)].join("; ");
    let more = if reasons.len() > NAMED {
        "; and others"
    } else {
        ""
    };
    TrainError::Setting(format!(
        "{} images cannot be read: {named}{more}",
        reasons.len()
    ))
}

#[cfg(test)]
mod tests {
    use super::*;
    use placeformer_core::progress::Silent;
    use placeformer_core::types::ImageSize;
    use std::cell::Cell;

    /// Pools each "image" to its first two bytes, counting the images encoded.
    fn pool(
        root: &Path,
        images: &[PathBuf],
        encoded: &Cell<usize>,
    ) -> Result<Vec<f32>, TrainError> {
        let decode = |bytes: &[u8]| match bytes {
            [a, b, ..] => Ok(ImageTensor {
                size: ImageSize {
                    width: 2,
                    height: 1,
                },
                data: vec![f32::from(*a), f32::from(*b)],
            }),
            _ => Err("too short".to_owned()),
        };
        let encode = |tensors: &[ImageTensor]| {
            encoded.set(encoded.get() + tensors.len());
            Ok(tensors.iter().map(|tensor| tensor.data.clone()).collect())
        };
        PooledCache::named(root, "a way of pooling", 2)?.pool_with(
            images,
            &decode,
            &encode,
            &Task::begin(&Silent, "describing", images.len() as u64),
        )
    }

    #[test]
    fn what_is_known_is_not_encoded_again_and_a_torn_record_is() {
        let root = tempfile::tempdir().unwrap();
        let images: Vec<PathBuf> = (0..40u8)
            .map(|i| {
                let path = root.path().join(format!("{i}.jpg"));
                fs::write(&path, [i, 100 + i]).unwrap();
                path
            })
            .collect();
        let cache = root.path().join("cache");
        let encoded = Cell::new(0);
        let expected: Vec<f32> = (0..40).flat_map(|i| [i as f32, 100.0 + i as f32]).collect();
        assert_eq!(
            pool(&cache, &images[..20], &encoded).unwrap(),
            expected[..40]
        );
        assert_eq!(pool(&cache, &images, &encoded).unwrap(), expected);
        assert_eq!(encoded.get(), 40);
        // A process killed while writing leaves half a record; another damage costs what follows it
        // in its segment.
        let folder = fs::read_dir(&cache)
            .unwrap()
            .next()
            .unwrap()
            .unwrap()
            .path();
        let mut segments: Vec<PathBuf> = fs::read_dir(&folder)
            .unwrap()
            .map(|entry| entry.unwrap().path())
            .collect();
        segments.retain(|path| {
            path.extension()
                .is_some_and(|extension| extension == "pooled")
        });
        assert_eq!(segments.len(), 2);
        for segment in segments {
            let bytes = fs::read(&segment).unwrap();
            fs::write(&segment, &bytes[..bytes.len() - 3]).unwrap();
        }
        assert_eq!(pool(&cache, &images, &encoded).unwrap(), expected);
        assert_eq!(encoded.get(), 42);
    }

    #[test]
    fn every_unreadable_image_is_found_before_the_run_gives_up() {
        let root = tempfile::tempdir().unwrap();
        let good = root.path().join("a");
        let short = root.path().join("b");
        let absent = root.path().join("c");
        fs::write(&good, [1, 2]).unwrap();
        fs::write(&short, [1]).unwrap();
        let error = pool(
            &root.path().join("cache"),
            &[good, short, absent],
            &Cell::new(0),
        )
        .unwrap_err()
        .to_string();
        assert!(
            error.contains("2 images") && error.contains("too short"),
            "{error}"
        );
    }
}
