//! Tokens before the first trained block, kept on disk: the blocks before it never change, so every
//! image passes them once.
//!
//! An image has a file for each of its views: as it is, and under some variations of light and
//! viewpoint. It holds the tokens as half floats `[1 + n, dim]`, CLS first, and a CRC-32; a file
//! that is torn or damaged is computed again. Its name follows from the image's content and from
//! what made the tokens, so that runs can share a folder.

use super::augment::{Augmentation, augment};
use super::error::TrainError;
use super::model::Sample;
use super::triplets::{Side, TripletSet};
use candle_core::{Device, Tensor};
use half::f16;
use half::slice::HalfFloatSliceExt;
use placeformer_core::progress::{Progress, Task};
use placeformer_core::types::{ContentHash, ImageTensor};
use placeformer_vision::extract::{
    EncodedImage, Encoder, EncoderSpec, Precision, VitWeights, build_encoder, token_grid,
};
use placeformer_vision::image::{ImageConfig, load_tensor};
use rayon::prelude::*;
use std::collections::HashMap;
use std::fs;
use std::path::{Path, PathBuf};

type Result<T> = std::result::Result<T, TrainError>;

/// Images decoded together, and encoded together.
const BATCH: usize = 16;
/// Bytes of the checksum behind the tokens.
const CHECKSUM: usize = 4;

/// What the tokens are made of, and where they are kept.
pub struct TokenCacheConfig<'a> {
    /// Folder below which the tokens are kept.
    pub folder: &'a Path,
    /// First block that is trained; those before it make the tokens.
    pub first_block: usize,
    /// Arithmetic of the blocks before it.
    pub precision: Precision,
    /// Views of each image, the image itself included.
    pub views: usize,
    /// How the other views vary.
    pub augmentation: Augmentation,
}

/// The tokens of the images of some sets.
pub struct TokenCache {
    encoder: Box<dyn Encoder>,
    folder: PathBuf,
    dim: usize,
    /// Tokens of an image, CLS included.
    length: usize,
    views: usize,
    augmentation: Augmentation,
    /// Content hashes of the images, by their paths.
    images: HashMap<PathBuf, ContentHash>,
}

impl TokenCache {
    /// Prepares the cache of tokens of `weights` for images of the size of `spec`. Nothing is
    /// computed yet.
    ///
    /// # Errors
    /// No block comes before the first trained one, the folder cannot be made, or the encoder
    /// cannot.
    pub fn new(
        weights: &VitWeights,
        spec: &EncoderSpec,
        config: &TokenCacheConfig<'_>,
    ) -> Result<Self> {
        let spec = spec_before(config.first_block, spec)?;
        let encoder = build_encoder(weights, &spec, config.precision)?;
        Self::of_encoder(encoder, weights, config)
    }

    /// As [`TokenCache::new`], of an encoder that computes the blocks before the first trained one.
    pub(super) fn of_encoder(
        encoder: Box<dyn Encoder>,
        weights: &VitWeights,
        config: &TokenCacheConfig<'_>,
    ) -> Result<Self> {
        let spec = *encoder.spec();
        let name = format!(
            "{}:b{}:{}:{}",
            weights.content_hash(),
            spec.exit_block,
            spec.input_size,
            encoder.name()
        );
        let key = ContentHash::of(name.as_bytes()).to_string();
        let folder = config.folder.join(&key[..16]);
        fs::create_dir_all(&folder).map_err(io(&folder))?;
        let note = folder.join("tokens.txt");
        fs::write(&note, name).map_err(io(&note))?;
        Ok(Self {
            encoder,
            folder,
            dim: weights.geometry.dim,
            length: 1 + token_grid(&weights.geometry, &spec).len(),
            views: config.views.max(1),
            augmentation: config.augmentation,
            images: HashMap::new(),
        })
    }

    /// Where the tokens are kept.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Bytes that `images` images take on disk, each with all its views.
    pub fn bytes_of(&self, images: usize) -> u64 {
        (images * self.views * self.file_bytes()) as u64
    }

    /// Bytes of tokens that the folder holds already, of whatever images.
    ///
    /// # Errors
    /// The folder cannot be read.
    pub fn bytes_held(&self) -> Result<u64> {
        let mut bytes = 0;
        for entry in fs::read_dir(&self.folder).map_err(io(&self.folder))? {
            let entry = entry.map_err(io(&self.folder))?;
            bytes += entry.metadata().map_err(io(&self.folder))?.len();
        }
        Ok(bytes)
    }

    fn file_bytes(&self) -> usize {
        self.length * self.dim * size_of::<f16>() + CHECKSUM
    }

    /// Computes what is missing of the images of `sets`; `varied` says of each set whether its
    /// images are needed in all views, or only as they are.
    ///
    /// # Errors
    /// An image cannot be read, the model fails, or a file cannot be written.
    pub fn fill(&mut self, sets: &[(&TripletSet, bool)], progress: &dyn Progress) -> Result<()> {
        let mut views: HashMap<&Path, usize> = HashMap::new();
        for (set, varied) in sets {
            let needed = if *varied { self.views } else { 1 };
            for path in set.queries.iter().chain(&set.database) {
                let views = views.entry(path).or_default();
                *views = needed.max(*views);
            }
        }
        let mut images: Vec<(&Path, usize)> = views.into_iter().collect();
        images.sort_unstable();
        let task = Task::begin(progress, "tokens", images.len() as u64);
        for batch in images.chunks(BATCH) {
            let read: Vec<(ContentHash, Vec<(PathBuf, ImageTensor)>)> = batch
                .par_iter()
                .map(|(path, views)| self.read(path, *views))
                .collect::<Result<_>>()?;
            let mut missing = Vec::new();
            for ((path, _), (hash, wanted)) in batch.iter().zip(read) {
                self.images.insert(path.to_path_buf(), hash);
                missing.extend(wanted);
            }
            for missing in missing.chunks(BATCH) {
                self.compute(missing)?;
            }
            task.add(batch.len() as u64);
        }
        Ok(())
    }

    /// The content hash of an image, and those of its views whose tokens are missing, with their
    /// files.
    fn read(
        &self,
        path: &Path,
        views: usize,
    ) -> Result<(ContentHash, Vec<(PathBuf, ImageTensor)>)> {
        let bytes = fs::read(path).map_err(io(path))?;
        let hash = ContentHash::of(&bytes);
        let files: Vec<PathBuf> = (0..views).map(|view| self.file_of(&hash, view)).collect();
        let is_missing = |file: &PathBuf| self.load(file).is_none();
        let missing: Vec<usize> = (0..views)
            .filter(|&view| is_missing(&files[view]))
            .collect();
        if missing.is_empty() {
            return Ok((hash, Vec::new()));
        }
        let size = self.encoder.spec().input_size;
        let image = load_tensor(&bytes, &ImageConfig::default(), size)
            .map_err(|error| TrainError::Setting(format!("{}: {error}", path.display())))?;
        let of_view = |view: usize| {
            let tensor = match view {
                0 => image.clone(),
                view => augment(&image, &self.augmentation, seed_of(&hash, view)),
            };
            (files[view].clone(), tensor)
        };
        Ok((hash, missing.into_iter().map(of_view).collect()))
    }

    /// Encodes images and writes their files.
    fn compute(&self, images: &[(PathBuf, ImageTensor)]) -> Result<()> {
        let tensors: Vec<ImageTensor> = images.iter().map(|(_, image)| image.clone()).collect();
        let encoded = self.encoder.encode(&tensors)?;
        for ((file, _), encoded) in images.iter().zip(&encoded) {
            // Written under another name first, so that a run that is killed leaves no torn file
            // under this one; whatever the disk makes of it, the checksum tells.
            let unfinished = file.with_extension(format!("{}.part", std::process::id()));
            fs::write(&unfinished, to_bytes(encoded)).map_err(io(&unfinished))?;
            fs::rename(&unfinished, file).map_err(io(file))?;
        }
        Ok(())
    }

    /// The file of a view: its name says all that the tokens depend on besides the folder.
    fn file_of(&self, hash: &ContentHash, view: usize) -> PathBuf {
        let name = match view {
            0 => format!("{hash}.tokens"),
            view => {
                let strength = format!("{:?}", self.augmentation);
                let strength = ContentHash::of(strength.as_bytes()).to_string();
                format!("{hash}.{view}-{}.tokens", &strength[..8])
            }
        };
        self.folder.join(name)
    }

    /// The half floats of a file, unless it is not there or not whole.
    fn load(&self, file: &Path) -> Option<Vec<u8>> {
        let mut bytes = fs::read(file).ok()?;
        if bytes.len() != self.file_bytes() {
            return None;
        }
        let checksum = bytes.split_off(bytes.len() - CHECKSUM);
        (crc32fast::hash(&bytes).to_le_bytes() == checksum[..]).then_some(bytes)
    }

    /// Tokens `[samples, 1 + n, dim]` of images that were filled in. A sample's variation chooses
    /// the view.
    ///
    /// # Errors
    /// An image was not filled in, or its file has been damaged since.
    pub(super) fn tokens(&self, set: &TripletSet, samples: &[Sample]) -> Result<Tensor> {
        let mut values = Vec::with_capacity(samples.len() * self.length * self.dim);
        for sample in samples {
            let path = &set.images(sample.side)[sample.index];
            let damaged = || {
                let reason = format!("the tokens of {} are not in the cache", path.display());
                TrainError::Setting(reason)
            };
            let hash = self.images.get(path).ok_or_else(damaged)?;
            let view = sample
                .variation
                .map_or(0, |seed| (seed % self.views as u64) as usize);
            let bytes = self.load(&self.file_of(hash, view)).ok_or_else(damaged)?;
            let (pairs, _) = bytes.as_chunks::<2>();
            let halves: Vec<f16> = pairs.iter().map(|&pair| f16::from_le_bytes(pair)).collect();
            let start = values.len();
            values.resize(start + halves.len(), 0.0);
            halves.convert_to_f32_slice(&mut values[start..]);
        }
        let shape = (samples.len(), self.length, self.dim);
        Ok(Tensor::from_vec(values, shape, &Device::Cpu)?)
    }
}

/// What computes the tokens before block `first` of an encoder of `spec`.
///
/// # Errors
/// No block comes before it.
pub(super) fn spec_before(first: usize, spec: &EncoderSpec) -> Result<EncoderSpec> {
    let last = first.checked_sub(1).ok_or_else(|| {
        TrainError::Setting("where all blocks are trained, no tokens can be cached".into())
    })?;
    Ok(EncoderSpec {
        exit_block: last,
        attention_block: last,
        token_norm: false,
        ..*spec
    })
}

/// How many different images two sets have.
pub fn distinct_images(sets: &[&TripletSet]) -> usize {
    let both_sides = sets
        .iter()
        .flat_map(|set| [set.images(Side::Query), set.images(Side::Database)]);
    let paths: std::collections::HashSet<&PathBuf> = both_sides.flatten().collect();
    paths.len()
}

/// The seed of the variation of a view, which follows from the image and the number of the view.
fn seed_of(hash: &ContentHash, view: usize) -> u64 {
    let text = format!("{hash}.{view}");
    let digits = ContentHash::of(text.as_bytes()).to_string();
    u64::from_str_radix(&digits[..16], 16).unwrap_or(view as u64)
}

/// CLS token and patch tokens as half floats, and their checksum.
fn to_bytes(encoded: &EncodedImage) -> Vec<u8> {
    let values = encoded.cls_token.iter().chain(&encoded.tokens);
    let mut bytes: Vec<u8> = values
        .flat_map(|&value| f16::from_f32(value).to_le_bytes())
        .collect();
    bytes.extend(crc32fast::hash(&bytes).to_le_bytes());
    bytes
}

fn io(path: &Path) -> impl FnOnce(std::io::Error) -> TrainError + '_ {
    |source| TrainError::Io {
        path: path.to_owned(),
        source,
    }
}
