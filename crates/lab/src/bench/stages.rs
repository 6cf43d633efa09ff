//! The rows: each stage of a query, and all of them together.

use super::candidates::dequantised;
use super::filled::FilledStore;
use super::limits::Limits;
use super::measure::{median, paired};
use super::scenes::{CANDIDATES, PHOTO_SIZE, RerankScene, index_entry, photo, street, unit_vector};
use super::service::{MeasuredService, ServiceError, StartService};
use super::{Row, baselines};
use bytes::Bytes;
use placeformer_core::types::{
    ContentHash, ImageSize, ImageTensor, MapName, NewReference, ReferenceFields, ReferenceFilter,
    ReferenceId,
};
use placeformer_kernels::scan::ROW_BYTES;
use placeformer_store::{Inserted, ReadPlaces, SqliteStore, StoreConfig, StoreError, WritePlaces};
use placeformer_vision::extract::{
    CandleEncoder, Encoder, EncoderSpec, ExtractError, Extractor, Geometry, Precision, VitWeights,
    build_encoder,
};
use placeformer_vision::image::{ImageConfig, ImageError, load_tensor};
use placeformer_vision::search::{IndexEntry, MapIndex};
use rayon::prelude::*;
use std::path::PathBuf;
use std::sync::Arc;

/// The rows there are, in the order they are measured. `search_10m` takes 14 GB and runs only when
/// it is named.
pub const NAMES: [&str; 19] = [
    "decode_resize_1080p",
    "extract",
    "extract_batch8",
    "extract_f32",
    "extract_bf16",
    "extract_mixed",
    "extract_int8",
    "load_100",
    "rerank_100",
    "rerank_100_at_15",
    "rerank_100_at_0",
    "search_10k",
    "search_100k",
    "search_1m",
    "search_10m",
    "query_1m",
    "commit",
    "ingest",
    "rehead_100k",
];

/// Neighbours asked for.
const NEAREST: usize = 100;
/// References of the whole query.
const QUERY_REFERENCES: u64 = 1_000_000;
/// Size of drawn references.
pub const REFERENCE_SIZE: ImageSize = ImageSize {
    width: 640,
    height: 480,
};

/// Why a row could not be measured.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum BenchError {
    /// No such row.
    #[error("there is no row {name:?}; there are {}", NAMES.join(", "))]
    UnknownRow {
        /// What was asked for.
        name: String,
    },
    /// Ours and the baseline do not compute the same.
    #[error("{row}: ours and the baseline disagree: {difference}")]
    Disagree {
        /// The row.
        row: &'static str,
        /// How.
        difference: String,
    },
    /// A quotient of two times that is not a number, such as where none passed.
    #[error(
        "{row}: {ours_ms} ms beside {baseline_ms} ms with a limit of {limit_ms} ms cannot be compared"
    )]
    NotComparable {
        /// The row.
        row: String,
        /// Ours.
        ours_ms: f64,
        /// The baseline's.
        baseline_ms: f64,
        /// The limit.
        limit_ms: f64,
    },
    /// From the image room.
    #[error(transparent)]
    Image(#[from] ImageError),
    /// From the baseline's decoder.
    #[error("the baseline's decoder: {0}")]
    BaselineImage(#[from] image::ImageError),
    /// From the extract room.
    #[error(transparent)]
    Extract(#[from] ExtractError),
    /// From the baseline's matrix product.
    #[error("the baseline's matrix product: {0}")]
    Candle(#[from] candle_core::Error),
    /// From the store.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// From the whole service.
    #[error("the service: {0}")]
    Service(ServiceError),
    /// Working files could not be kept.
    #[error("cannot use {}: {source}", path.display())]
    Io {
        /// The folder or file.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// The run time or the metrics could not be set up.
    #[error("cannot set the service up: {0}")]
    Setup(String),
}

/// Everything a run needs.
pub struct Bench<'a> {
    /// The model with its head.
    pub extractor: Arc<Extractor>,
    /// The same weights, for the baseline and for batches.
    pub weights: VitWeights,
    /// What the model computes.
    pub spec: EncoderSpec,
    /// The machine's limits.
    pub limits: Limits,
    /// A folder for a store and files; streets that an earlier run drew there are used again.
    pub folder: PathBuf,
    /// Paired runs of a row that takes long; short rows take more.
    pub rounds: usize,
    /// Starts the service of the rows that measure all of it.
    pub services: &'a dyn StartService,
}

impl Bench<'_> {
    /// Measures one row.
    ///
    /// # Errors
    /// The name is unknown, a stage fails, or ours and the baseline disagree about the result.
    pub fn row(&self, name: &str) -> Result<Row, BenchError> {
        match name {
            "decode_resize_1080p" => self.decode(),
            "extract" => self.extract(name, self.extractor.config().precision, 1),
            "extract_batch8" => self.extract(name, self.extractor.config().precision, 8),
            "extract_f32" => self.extract(name, Precision::F32, 1),
            "extract_bf16" => self.extract(name, Precision::Bf16, 1),
            "extract_mixed" => self.extract(name, Precision::Mixed, 1),
            "extract_int8" => self.extract(name, Precision::Int8, 1),
            "load_100" => self.load(),
            "rerank_100" => self.rerank("rerank_100", 0.4),
            "rerank_100_at_15" => self.rerank("rerank_100_at_15", 0.15),
            "rerank_100_at_0" => self.rerank("rerank_100_at_0", 0.0),
            "search_10k" => self.search("search_10k", 10_000),
            "search_100k" => self.search("search_100k", 100_000),
            "search_1m" => self.search("search_1m", 1_000_000),
            "search_10m" => self.search("search_10m", 10_000_000),
            "query_1m" => self.query(),
            "commit" => self.commit(),
            "ingest" => self.ingest(),
            "rehead_100k" => self.rehead(),
            other => Err(BenchError::UnknownRow {
                name: other.to_owned(),
            }),
        }
    }

    fn decode(&self) -> Result<Row, BenchError> {
        let (bytes, size) = (photo()?, self.spec.input_size);
        let (ours, plain) = (
            load_tensor(&bytes, &ImageConfig::default(), size)?.data,
            baselines::load_tensor(&bytes, size)?,
        );
        let off = ours
            .iter()
            .zip(&plain)
            .map(|(a, b)| f64::from((a - b).abs()))
            .sum::<f64>()
            / ours.len() as f64;
        agree("decode_resize_1080p", off < 0.03, || {
            format!("pixels differ by {off} on average")
        })?;
        let times = paired(
            5 * self.rounds,
            || load_tensor(&bytes, &ImageConfig::default(), size),
            || baselines::load_tensor(&bytes, size),
        );
        Row::new(
            "decode_resize_1080p",
            "image crate",
            times,
            self.decode_limit_ms(bytes.len()),
        )
    }

    /// Milliseconds of memory traffic: the photo is read, its pixels written and read again, the
    /// tensor written.
    fn decode_limit_ms(&self, photo_bytes: usize) -> f64 {
        let pixels = |size: ImageSize| 3.0 * f64::from(size.width) * f64::from(size.height);
        self.limits.memory_ms(
            photo_bytes as f64 + 2.0 * pixels(PHOTO_SIZE) + 4.0 * pixels(self.spec.input_size),
        )
    }

    /// Milliseconds of reading what a scan reads of each reference. Memory is the limit of large
    /// maps; one that fits the caches may beat it.
    fn search_limit_ms(&self, references: u64) -> f64 {
        self.limits.memory_ms(references as f64 * ROW_BYTES as f64)
    }

    /// Milliseconds that an encoder of this name takes for one image at least.
    fn encode_limit_ms(&self, encoder: &str) -> f64 {
        let (layers, attention) = encoder_operations(&self.weights.geometry, &self.spec);
        let (of_layers, of_attention) = self
            .limits
            .encoder_giga_operations(encoder, self.spec.blocks());
        Limits::milliseconds(layers, of_layers) + Limits::milliseconds(attention, of_attention)
    }

    fn extract(&self, name: &str, precision: Precision, batch: usize) -> Result<Row, BenchError> {
        let ours = build_encoder(&self.weights, &self.spec, precision)?;
        let plain = CandleEncoder::new(&self.weights, &self.spec)?;
        let images = (0..batch as u64)
            .map(|place| {
                load_tensor(
                    &street(place, 0, REFERENCE_SIZE)?,
                    &ImageConfig::default(),
                    self.spec.input_size,
                )
            })
            .collect::<Result<Vec<ImageTensor>, _>>()?;
        let (a, b) = (ours.encode(&images[..1])?, plain.encode(&images[..1])?);
        let cosine = cosine(&a[0].tokens, &b[0].tokens, self.weights.geometry.dim);
        agree("extract", cosine > 0.995, || {
            format!("the tokens' cosine is {cosine}")
        })?;
        let (ours_ms, plain_ms) = paired(
            self.rounds,
            || ours.encode(&images),
            || plain.encode(&images),
        );
        let times = (ours_ms / batch as f64, plain_ms / batch as f64);
        let limit = self.encode_limit_ms(&ours.name());
        let baseline = format!("candle f32 (ours: {})", ours.name());
        Row::new(name, &baseline, times, limit)
    }

    fn search(&self, name: &'static str, size: u64) -> Result<Row, BenchError> {
        // The baseline's own copy of ten million vectors would not fit beside ours: it scans a
        // tenth, ten times.
        let parts = size.div_ceil(1_000_000);
        let (index, vectors) = random_index(size, size / parts);
        let queries: Vec<Vec<f32>> = (0..32).map(|seed| unit_vector(u64::MAX - seed)).collect();
        let open = ReferenceFilter::default();
        if parts == 1 {
            let ours: Vec<f32> = index
                .search(&queries[0], NEAREST, &open)
                .iter()
                .map(|n| n.distance)
                .collect();
            let plain = baselines::nearest(&vectors, &queries[0], NEAREST);
            let same = ours
                .iter()
                .zip(&plain)
                .all(|(a, b)| (a - b.0.sqrt()).abs() < 1e-5);
            agree(name, same, || "the distances differ".into())?;
        }
        let (mut ours_turn, mut plain_turn) = (queries.iter().cycle(), queries.iter().cycle());
        let mut next = || ours_turn.next().map_or(&[][..], Vec::as_slice);
        let mut next_plain = || plain_turn.next().map_or(&[][..], Vec::as_slice);
        let rounds = if size > 100_000 {
            3 * self.rounds
        } else {
            20 * self.rounds
        };
        let times = paired(
            rounds,
            || index.search(next(), NEAREST, &open),
            || {
                let query = next_plain();
                (0..parts)
                    .map(|_| baselines::nearest(&vectors, query, NEAREST).len())
                    .sum::<usize>()
            },
        );
        Row::new(name, "f32 scan", times, self.search_limit_ms(size))
    }

    /// A photo through the whole service at a million references, against the sum of the plain
    /// stages.
    fn query(&self) -> Result<Row, BenchError> {
        let (store, ids) = self.store_of_streets()?;
        let photo = Bytes::from(photo()?);
        // What the service will compare the photo with: random vectors are far from it, so that the
        // streets are nearest.
        let scene = self.scene_of(&photo, &store, &ids)?;
        let service = self.service(store, QUERY_REFERENCES - ids.len() as u64)?;
        let map: MapName = street_map();
        let ours = || service.query(&map, &photo);
        let reranked = ours().map_err(BenchError::Service)?;
        agree("query_1m", reranked, || {
            "the answer was not re-ranked".into()
        })?;
        let vectors: Vec<f32> = (0..QUERY_REFERENCES)
            .into_par_iter()
            .flat_map_iter(unit_vector)
            .collect();
        let (plain, query) = (
            CandleEncoder::new(&self.weights, &self.spec)?,
            unit_vector(1),
        );
        let baseline = || -> Result<usize, BenchError> {
            let data = baselines::load_tensor(&photo, self.spec.input_size)?;
            let encoded = plain.encode(&[ImageTensor {
                size: self.spec.input_size,
                data,
            }])?;
            let found = baselines::nearest(&vectors, &query, NEAREST);
            Ok(encoded.len() + found.len() + baselines::rerank(&scene)?)
        };
        baseline()?;
        let times = paired(self.rounds, ours, baseline);
        let limit = self.decode_limit_ms(photo.len())
            + self.encode_limit_ms(&self.extractor.encoder_name())
            + self.search_limit_ms(QUERY_REFERENCES)
            + self.limits.candidates_ms(&scene.query, &scene.candidates);
        Row::new("query_1m", "the baselines in sequence", times, limit)
    }

    /// The photo's key patches and those of the references it is compared with, in full precision.
    fn scene_of(
        &self,
        photo: &[u8],
        store: &SqliteStore,
        ids: &[ReferenceId],
    ) -> Result<RerankScene, BenchError> {
        let tensor = load_tensor(photo, &ImageConfig::default(), self.spec.input_size)?;
        let described = self.extractor.extract_full(&[tensor])?;
        let query = described.into_iter().map(|(_, patches)| patches).next();
        let query =
            query.ok_or_else(|| BenchError::Setup("one image gave no descriptor".into()))?;
        let candidates: Result<Vec<_>, StoreError> = ids
            .iter()
            .map(|id| store.patches(*id).map(|patches| dequantised(&patches)))
            .collect();
        Ok(RerankScene {
            query,
            candidates: candidates?,
        })
    }

    /// A folder of this name without anything in it.
    pub(super) fn new_folder(&self, name: &str) -> Result<PathBuf, BenchError> {
        let path = self.folder.join(name);
        let failed = |source| BenchError::Io {
            path: path.clone(),
            source,
        };
        if path.exists() {
            std::fs::remove_dir_all(&path).map_err(failed)?;
        }
        std::fs::create_dir_all(&path).map_err(failed)?;
        Ok(path)
    }

    /// A service over `store` with `extra` made-up references in each map.
    pub(super) fn service(
        &self,
        store: SqliteStore,
        extra: u64,
    ) -> Result<Box<dyn MeasuredService>, BenchError> {
        let store = FilledStore::around(store, extra)?;
        self.services
            .start(store, self.extractor.clone())
            .map_err(BenchError::Service)
    }

    /// A store with a map of [`CANDIDATES`] drawn streets, made at the first call.
    pub(super) fn store_of_streets(&self) -> Result<(SqliteStore, Vec<ReferenceId>), BenchError> {
        let store = SqliteStore::open(&self.folder.join("store"), &StoreConfig::default())?;
        fill_with_streets(&store, &self.extractor, CANDIDATES as u64)?;
        let page = store.list(Some(&street_map()), None, CANDIDATES)?;
        Ok((
            store,
            page.references
                .into_iter()
                .map(|reference| reference.id)
                .collect(),
        ))
    }
}

/// The map that [`fill_with_streets`] fills.
pub fn street_map() -> MapName {
    // Proven by the name itself, which is within the allowed letters.
    "streets"
        .parse()
        .unwrap_or_else(|_| unreachable!("a constant name of letters"))
}

/// Brings the map of drawn streets in `store` up to `count` references.
///
/// # Errors
/// Drawing, extraction or storing fails.
pub fn fill_with_streets(
    store: &SqliteStore,
    extractor: &Extractor,
    count: u64,
) -> Result<(), BenchError> {
    const BATCH: u64 = 8;
    let map = street_map();
    let there = match store.maps()?.into_iter().find(|info| info.name == map) {
        Some(info) if info.model == *extractor.model_id() => info.references,
        // Of a model that was measured before.
        Some(_) => store.delete_map(&map).map(|_| 0)?,
        None => 0,
    };
    for from in (there..count).step_by(BATCH as usize) {
        let photos = (from..count.min(from + BATCH))
            .into_par_iter()
            .map(|place| street(place, 0, REFERENCE_SIZE))
            .collect::<Result<Vec<_>, _>>()?;
        let images = photos
            .iter()
            .map(|bytes| load_tensor(bytes, &ImageConfig::default(), extractor.input_size()))
            .collect::<Result<Vec<_>, _>>()?;
        let new =
            extractor
                .extract(&images)?
                .into_iter()
                .zip(&photos)
                .map(|(descriptor, bytes)| NewReference {
                    map: map.clone(),
                    fields: ReferenceFields::default(),
                    content_hash: ContentHash::of(bytes),
                    model: extractor.model_id().clone(),
                    descriptor,
                });
        store
            .insert_many(new.collect())
            .into_iter()
            .try_for_each(|stored| stored.map(|_: Inserted| ()))?;
    }
    Ok(())
}

pub(super) fn agree(
    row: &'static str,
    yes: bool,
    difference: impl FnOnce() -> String,
) -> Result<(), BenchError> {
    if yes {
        Ok(())
    } else {
        Err(BenchError::Disagree {
            row,
            difference: difference(),
        })
    }
}

/// Median cosine of corresponding rows.
fn cosine(a: &[f32], b: &[f32], dim: usize) -> f64 {
    let dot = |a: &[f32], b: &[f32]| {
        a.iter()
            .zip(b)
            .map(|(a, b)| f64::from(*a) * f64::from(*b))
            .sum::<f64>()
    };
    let rows = a.chunks_exact(dim).zip(b.chunks_exact(dim));
    median(
        rows.map(|(a, b)| dot(a, b) / (dot(a, a) * dot(b, b)).sqrt())
            .collect(),
    )
}

/// An index of `size` random references, and the first `copied` vectors once more.
fn random_index(size: u64, copied: u64) -> (MapIndex, Vec<f32>) {
    let entries: Vec<IndexEntry> = (0..size).into_par_iter().map(index_entry).collect();
    let vectors = entries[..copied as usize]
        .iter()
        .flat_map(|entry| entry.global.iter().copied())
        .collect();
    (MapIndex::build(entries), vectors)
}

/// Multiply-adds of the transformer up to its last block, each counted as two operations: of its
/// linear layers, and of attention.
fn encoder_operations(geometry: &Geometry, spec: &EncoderSpec) -> (f64, f64) {
    let (columns, rows) = geometry.grid(spec.input_size);
    let (dim, patches) = (geometry.dim as f64, (columns * rows) as f64);
    let tokens = patches + 1.0;
    let embedding = patches * (3 * geometry.patch * geometry.patch) as f64 * dim;
    let linear = tokens * dim * (4.0 * dim + 2.0 * geometry.mlp_dim as f64);
    let attention = 2.0 * tokens * tokens * dim;
    let blocks = 2.0 * spec.blocks() as f64;
    (2.0 * embedding + blocks * linear, blocks * attention)
}

#[cfg(test)]
mod tests {
    use super::*;
    use placeformer_vision::extract::Preset;

    #[test]
    fn operations_are_those_of_the_published_model() {
        let preset = Preset::Dinov2Vits14;
        let whole = EncoderSpec {
            input_size: ImageSize {
                width: 224,
                height: 224,
            },
            exit_block: 11,
            token_norm: true,
            attention_block: 11,
        };
        // 257 tokens, 12 blocks: 11.0 GFLOP of linear layers, 1.2 of attention, 0.1 of the
        // embedding.
        let (layers, attention) = encoder_operations(&preset.geometry(), &whole);
        assert!(
            (10.9e9..11.3e9).contains(&layers) && (1.1e9..1.3e9).contains(&attention),
            "{layers} {attention}"
        );
    }
}
