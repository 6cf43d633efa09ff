//! The rows: each stage of a query, and all of them together.

use super::filled::FilledStore;
use super::limits::Limits;
use super::measure::{median, paired};
use super::scenes::{CANDIDATES, CAPS, DIM, RerankScene, index_entry, photo, street, unit_vector};
use super::{Row, baselines};
use crate::extract::{
    CandleEncoder, Encoder, EncoderSpec, ExtractError, Extractor, Geometry, Precision, VitWeights, build_encoder,
};
use crate::image::{ImageConfig, ImageError, load_tensor};
use crate::ops::{Health, Metrics};
use crate::pipeline::{Parts, PipelineConfig, PipelineError, QueryOptions, QueryRequest, Service};
use crate::rerank::{RerankConfig, Reranked, Reranker};
use crate::search::{IndexEntry, MapIndex};
use crate::store::{Inserted, PlaceStore, SqliteStore, StoreConfig, StoreError};
use crate::types::{
    ContentHash, GLOBAL_DIM, ImageSize, ImageTensor, MapName, NewReference, PackedPatches, ReferenceFields,
    ReferenceFilter, ReferenceId, ScaleSet,
};
use bytes::Bytes;
use rayon::prelude::*;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// The rows there are, in the order they are measured. `search_10m` takes 14 GB and runs only when it is named.
pub const NAMES: [&str; 15] = [
    "decode_resize_1080p",
    "extract",
    "extract_batch8",
    "extract_f32",
    "extract_bf16",
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
];

/// Neighbours asked for.
const NEAREST: usize = 100;
/// References of the whole query.
const QUERY_REFERENCES: u64 = 1_000_000;
/// Size of drawn references.
pub const REFERENCE_SIZE: ImageSize = ImageSize { width: 640, height: 480 };

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
    /// From the pipeline.
    #[error(transparent)]
    Pipeline(#[from] PipelineError),
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
pub struct Bench {
    /// The model with its head.
    pub extractor: Arc<Extractor>,
    /// The same weights, for the baseline and for batches.
    pub weights: VitWeights,
    /// What the model computes.
    pub spec: EncoderSpec,
    /// The machine's limits.
    pub limits: Limits,
    /// An empty folder for a store and files.
    pub folder: PathBuf,
    /// Paired runs of a row that takes long; short rows take more.
    pub rounds: usize,
}

impl Bench {
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
            other => Err(BenchError::UnknownRow { name: other.to_owned() }),
        }
    }

    fn decode(&self) -> Result<Row, BenchError> {
        let (bytes, size) = (photo()?, self.spec.input_size);
        let (ours, plain) =
            (load_tensor(&bytes, &ImageConfig::default(), size)?.data, baselines::load_tensor(&bytes, size)?);
        let off = ours.iter().zip(&plain).map(|(a, b)| f64::from((a - b).abs())).sum::<f64>() / ours.len() as f64;
        agree("decode_resize_1080p", off < 0.03, || format!("pixels differ by {off} on average"))?;
        let times = paired(
            5 * self.rounds,
            || load_tensor(&bytes, &ImageConfig::default(), size),
            || baselines::load_tensor(&bytes, size),
        );
        Ok(Row::new("decode_resize_1080p", "image crate", times, None))
    }

    fn extract(&self, name: &str, precision: Precision, batch: usize) -> Result<Row, BenchError> {
        let ours = build_encoder(&self.weights, &self.spec, precision)?;
        let plain = CandleEncoder::new(&self.weights, &self.spec)?;
        let images = (0..batch as u64)
            .map(|place| load_tensor(&street(place, 0, REFERENCE_SIZE)?, &ImageConfig::default(), self.spec.input_size))
            .collect::<Result<Vec<ImageTensor>, _>>()?;
        let (a, b) = (ours.encode(&images[..1])?, plain.encode(&images[..1])?);
        let cosine = cosine(&a[0].tokens, &b[0].tokens);
        agree("extract", cosine > 0.995, || format!("the tokens' cosine is {cosine}"))?;
        let (ours_ms, plain_ms) = paired(self.rounds, || ours.encode(&images), || plain.encode(&images));
        let times = (ours_ms / batch as f64, plain_ms / batch as f64);
        let (layers, attention) = encoder_operations(&self.weights.geometry, &self.spec);
        let (of_layers, of_attention) = self.limits.encoder_giga_operations(&ours.name());
        let limit = Limits::milliseconds(layers, of_layers) + Limits::milliseconds(attention, of_attention);
        let baseline = format!("candle f32 (ours: {})", ours.name());
        Ok(Row::new(name, &baseline, times, Some(limit)))
    }

    fn load(&self) -> Result<Row, BenchError> {
        let (store, ids) = self.store_of_streets()?;
        let files = self.folder.join("plain");
        let kept = |path: &Path| {
            let path = path.to_owned();
            move |source| BenchError::Io { path: path.clone(), source }
        };
        std::fs::create_dir_all(&files).map_err(kept(&files))?;
        for id in &ids {
            let patches = store.patches(*id)?;
            let floats = |(code, row): (&i8, usize)| (f32::from(*code) * patches.factor[row]).to_le_bytes();
            let rows = (0..patches.codes.len()).map(|at| at / patches.dim);
            let bytes: Vec<u8> = patches.codes.iter().zip(rows).flat_map(floats).collect();
            let path = files.join(id.to_string());
            std::fs::write(&path, bytes).map_err(kept(&path))?;
        }
        let plain = |id: &ReferenceId| {
            let bytes = std::fs::read(files.join(id.to_string())).unwrap_or_default();
            bytes.as_chunks::<4>().0.iter().map(|value| f32::from_le_bytes(*value)).collect::<Vec<f32>>()
        };
        let times = paired(
            10 * self.rounds,
            || ids.par_iter().map(|id| store.patches(*id).map_or(0, |patches| patches.len())).sum::<usize>(),
            || ids.par_iter().map(|id| plain(id).len()).sum::<usize>(),
        );
        Ok(Row::new("load_100", "one f32 file per reference", times, None))
    }

    fn rerank(&self, name: &'static str, share: f64) -> Result<Row, BenchError> {
        let scene = RerankScene::new(share);
        let query = PackedPatches::quantise(&scene.query);
        let candidates: Vec<_> = scene.candidates.iter().map(PackedPatches::quantise).collect();
        let reranker = Reranker::new(RerankConfig::default());
        let ours = || match reranker.rerank(&query, candidates.len(), |i| Ok::<_, ()>(&candidates[i]), None) {
            Reranked::Complete { ranked, .. } => ranked.iter().map(|r| r.score.spatial_score as usize).sum(),
            Reranked::DeadlinePassed => 0,
        };
        let (our_inliers, plain_inliers): (usize, usize) = (ours(), baselines::rerank(&scene)?);
        agree(name, our_inliers as f64 >= 0.97 * plain_inliers as f64, || {
            format!("{our_inliers} inliers, the baseline finds {plain_inliers}")
        })?;
        let times = paired(self.rounds, ours, || baselines::rerank(&scene));
        let limit = self.limits.int8_gops.map(|giga| Limits::milliseconds(matching_operations(), giga));
        Ok(Row::new(name, "f32 GEMM and plain RANSAC", times, limit))
    }

    fn search(&self, name: &'static str, size: u64) -> Result<Row, BenchError> {
        // The baseline's own copy of ten million vectors would not fit beside ours: it scans a tenth, ten times.
        let parts = size.div_ceil(1_000_000);
        let (index, vectors) = random_index(size, size / parts);
        let queries: Vec<Vec<f32>> = (0..32).map(|seed| unit_vector(u64::MAX - seed)).collect();
        let open = ReferenceFilter::default();
        if parts == 1 {
            let ours: Vec<f32> = index.search(&queries[0], NEAREST, &open).iter().map(|n| n.distance).collect();
            let plain = baselines::nearest(&vectors, &queries[0], NEAREST);
            let same = ours.iter().zip(&plain).all(|(a, b)| (a - b.0.sqrt()).abs() < 1e-5);
            agree(name, same, || "the distances differ".into())?;
        }
        let (mut ours_turn, mut plain_turn) = (queries.iter().cycle(), queries.iter().cycle());
        let mut next = || ours_turn.next().map_or(&[][..], Vec::as_slice);
        let mut next_plain = || plain_turn.next().map_or(&[][..], Vec::as_slice);
        let rounds = if size > 100_000 { 3 * self.rounds } else { 20 * self.rounds };
        let times = paired(
            rounds,
            || index.search(next(), NEAREST, &open),
            || {
                let query = next_plain();
                (0..parts).map(|_| baselines::nearest(&vectors, query, NEAREST).len()).sum::<usize>()
            },
        );
        let bytes = size as f64 * GLOBAL_DIM as f64;
        // What fits the caches is not limited by memory.
        let limit = (size >= 1_000_000).then(|| Limits::milliseconds(bytes, self.limits.read_gbytes));
        Ok(Row::new(name, "f32 scan", times, limit))
    }

    /// A photo through the whole service at a million references, against the sum of the plain stages.
    fn query(&self) -> Result<Row, BenchError> {
        let setup = |error: &dyn std::fmt::Display| BenchError::Setup(error.to_string());
        let runtime = tokio::runtime::Runtime::new().map_err(|error| setup(&error))?;
        let (store, ids) = self.store_of_streets()?;
        let service = self.service(store, QUERY_REFERENCES - ids.len() as u64)?;
        let map: MapName = street_map();
        let photo = Bytes::from(photo()?);
        let ours = || {
            let request = QueryRequest { map: map.clone(), image: photo.clone(), options: QueryOptions::default() };
            runtime.block_on(service.query(request))
        };
        let answer = ours()?;
        agree("query_1m", answer.reranked, || "the answer was not re-ranked".into())?;
        let vectors: Vec<f32> = (0..QUERY_REFERENCES).into_par_iter().flat_map_iter(unit_vector).collect();
        let (plain, scene, query) =
            (CandleEncoder::new(&self.weights, &self.spec)?, RerankScene::new(0.15), unit_vector(1));
        let baseline = || -> Result<usize, BenchError> {
            let data = baselines::load_tensor(&photo, self.spec.input_size)?;
            let encoded = plain.encode(&[ImageTensor { size: self.spec.input_size, data }])?;
            let found = baselines::nearest(&vectors, &query, NEAREST);
            Ok(encoded.len() + found.len() + baselines::rerank(&scene)?)
        };
        baseline()?;
        let times = paired(self.rounds, ours, baseline);
        Ok(Row::new("query_1m", "the baselines in sequence", times, None))
    }

    /// A service over `store` with `extra` made-up references in each map.
    fn service(&self, store: SqliteStore, extra: u64) -> Result<Arc<Service>, BenchError> {
        let metrics = Metrics::new().map_err(|error| BenchError::Setup(error.to_string()))?;
        Ok(Service::start(Parts {
            store: Arc::new(FilledStore::new(store, extra)?),
            source: self.extractor.clone(),
            image: ImageConfig::default(),
            rerank: RerankConfig::default(),
            pipeline: PipelineConfig { deadline_ms: 600_000, ..PipelineConfig::default() },
            metrics: Arc::new(metrics),
            health: Arc::new(Health::default()),
        })?)
    }

    /// A store with a map of [`CANDIDATES`] drawn streets, made at the first call.
    fn store_of_streets(&self) -> Result<(SqliteStore, Vec<ReferenceId>), BenchError> {
        let store = SqliteStore::open(&self.folder.join("store"), &StoreConfig::default())?;
        fill_with_streets(&store, &self.extractor, CANDIDATES as u64)?;
        let page = store.list(Some(&street_map()), None, CANDIDATES)?;
        Ok((store, page.references.into_iter().map(|reference| reference.id).collect()))
    }
}

/// The map that [`fill_with_streets`] fills.
pub fn street_map() -> MapName {
    // Proven by the name itself, which is within the allowed letters.
    "streets".parse().unwrap_or_else(|_| unreachable!("a constant name of letters"))
}

/// Brings the map of drawn streets in `store` up to `count` references.
///
/// # Errors
/// Drawing, extraction or storing fails.
pub fn fill_with_streets(store: &SqliteStore, extractor: &Extractor, count: u64) -> Result<(), BenchError> {
    const BATCH: u64 = 8;
    let map = street_map();
    let there = store.maps()?.into_iter().find(|info| info.name == map).map_or(0, |info| info.references);
    for from in (there..count).step_by(BATCH as usize) {
        let photos = (from..count.min(from + BATCH))
            .into_par_iter()
            .map(|place| street(place, 0, REFERENCE_SIZE))
            .collect::<Result<Vec<_>, _>>()?;
        let images = photos
            .iter()
            .map(|bytes| load_tensor(bytes, &ImageConfig::default(), extractor.input_size()))
            .collect::<Result<Vec<_>, _>>()?;
        let new = extractor.extract(&images)?.into_iter().zip(&photos).map(|(descriptor, bytes)| NewReference {
            map: map.clone(),
            fields: ReferenceFields::default(),
            content_hash: ContentHash::of(bytes),
            model: extractor.model_id().clone(),
            descriptor,
        });
        store.insert_many(new.collect()).into_iter().try_for_each(|stored| stored.map(|_: Inserted| ()))?;
    }
    Ok(())
}

fn agree(row: &'static str, yes: bool, difference: impl FnOnce() -> String) -> Result<(), BenchError> {
    if yes { Ok(()) } else { Err(BenchError::Disagree { row, difference: difference() }) }
}

/// Median cosine of corresponding rows.
fn cosine(a: &[f32], b: &[f32]) -> f64 {
    let dot = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum::<f64>();
    let rows = a.chunks_exact(DIM).zip(b.chunks_exact(DIM));
    median(rows.map(|(a, b)| dot(a, b) / (dot(a, a) * dot(b, b)).sqrt()).collect())
}

/// An index of `size` random references, and the first `copied` vectors once more.
fn random_index(size: u64, copied: u64) -> (MapIndex, Vec<f32>) {
    let entries: Vec<IndexEntry> = (0..size).into_par_iter().map(index_entry).collect();
    let vectors = entries[..copied as usize].iter().flat_map(|entry| entry.global.iter().copied()).collect();
    (MapIndex::build(entries), vectors)
}

/// Multiply-adds of the transformer up to its last block, each counted as two operations: of its linear layers, and of
/// attention.
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

/// Multiply-adds of comparing the key patches of every pair of scales that occurs, once each.
fn matching_operations() -> f64 {
    let mut pairs = std::collections::BTreeSet::new();
    for scales in ScaleSet::paper_default() {
        scales.scales().for_each(|a| pairs.extend(scales.scales().map(|b| (a, b))));
    }
    let products: usize = pairs.into_iter().map(|(a, b)| CAPS[a - 1] * CAPS[b - 1]).sum();
    2.0 * (CANDIDATES * products * DIM) as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::extract::Preset;

    #[test]
    fn operations_are_those_of_the_published_model() {
        let preset = Preset::Dinov2Vits14;
        let whole = EncoderSpec {
            input_size: ImageSize { width: 224, height: 224 },
            exit_block: 11,
            token_norm: true,
            attention_block: 11,
        };
        // 257 tokens, 12 blocks: 11.0 GFLOP of linear layers, 1.2 of attention, 0.1 of the embedding.
        let (layers, attention) = encoder_operations(&preset.geometry(), &whole);
        assert!((10.9e9..11.3e9).contains(&layers) && (1.1e9..1.3e9).contains(&attention), "{layers} {attention}");
    }

    #[test]
    fn each_pair_of_scales_is_counted_once() {
        // 1x1, 1x2, 2x1, 2x2, 2x3, 3x2, 3x3.
        let pairs: usize = 400 * 400 + 2 * 400 * 200 + 200 * 200 + 2 * 200 * 50 + 50 * 50;
        assert_eq!(matching_operations(), 2.0 * (100 * pairs * 384) as f64);
    }
}
