//! The axes of the paper's ablation tables as one table: scale combinations, tau, caps, input size, exit block,
//! backbone, descriptor codec.
//!
//! Heads are bound to one backbone and exit block, so every row searches the mean patch token, which all have. Rows
//! that differ only after extraction share its result: scale combinations and codecs reuse the features of the base
//! settings; all rows of tau and of the caps are cut from one extraction that keeps every patch, which gives what a
//! separate extraction would (key patches come by attention descending, and both rules cut that order off).

use super::EvalError;
use super::datasets::{Dataset, Truth};
use super::features::{Describe, FeatureCache, Features, GlobalKind};
use super::measure::{RECALL_AT, first_hit, recall_at};
use super::run::{Answer, rerank_all, search_all};
use super::summary::{AtK, Both};
use crate::extract::{ExtractConfig, HeadChoice, Preset};
use crate::rerank::RerankConfig;
use crate::store::codec;
use crate::types::{ImageSize, PackedPatches, SCALES, ScaleSet};
use indicatif::{MultiProgress, ProgressBar};
use serde::Serialize;
use std::path::Path;
use std::sync::Arc;

/// One row of the table.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct AblationRow {
    /// What is varied.
    pub axis: &'static str,
    /// Its value; a star marks the base setting.
    pub setting: String,
    /// Recall in percent at 1, 5, 10, 20.
    pub recall: Both<AtK<Option<f64>>>,
    /// Mean seconds to describe one image.
    pub extract_seconds: f64,
    /// Mean seconds to re-rank one query.
    pub rerank_seconds: f64,
    /// Mean bytes of the key patches of one reference at rest.
    pub patch_bytes: f64,
}

/// What is done to key patches after extraction.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Cut {
    None,
    /// Only patches above tau, at most so many per scale.
    Limits {
        tau: f32,
        caps: [usize; SCALES],
    },
    /// Descriptor values of so many bits.
    Bits(u32),
}

struct Variant {
    axis: &'static str,
    setting: String,
    extract: ExtractConfig,
    rerank: RerankConfig,
    cut: Cut,
}

/// Settings of the run that the table varies.
pub struct Base<'a> {
    /// Extraction.
    pub extract: &'a ExtractConfig,
    /// Re-ranking.
    pub rerank: &'a RerankConfig,
    /// Candidates per query.
    pub candidates: usize,
    /// Backbones beside the base's, of those whose weights are at hand.
    pub backbones: &'a [Preset],
    /// Folder of the feature cache.
    pub cache: &'a Path,
    /// Bytes of key patches held in memory.
    pub memory_bytes: u64,
}

/// Loads the model for some settings.
pub type OpenModel<'a> = dyn Fn(&ExtractConfig) -> Result<Box<dyn Describe>, EvalError> + 'a;

/// Runs every row; `progress` shows where it stands.
pub fn ablate(
    dataset: &Dataset,
    base: &Base<'_>,
    open: &OpenModel<'_>,
    progress: &MultiProgress,
) -> Result<Vec<AblationRow>, EvalError> {
    let variants = variants(base)?;
    let bar = progress.add(ProgressBar::new(variants.len() as u64).with_message("settings"));
    let mut rows = Vec::new();
    // Neighbouring variants share their extraction, so one set of features at a time is enough.
    for group in variants.chunk_by(|a, b| a.extract == b.extract) {
        let features = Prepared::new(dataset, base, &group[0].extract, open, progress)?;
        for variant in group {
            rows.push(features.row(dataset, variant, progress)?);
            bar.inc(1);
        }
    }
    bar.finish_and_clear();
    Ok(rows)
}

struct Prepared {
    cache: FeatureCache,
    database: Features,
    queries: Features,
    answers: Vec<Answer>,
}

impl Prepared {
    fn new(
        dataset: &Dataset,
        base: &Base<'_>,
        extract: &ExtractConfig,
        open: &OpenModel<'_>,
        progress: &MultiProgress,
    ) -> Result<Self, EvalError> {
        let describer = open(extract)?;
        let cache = FeatureCache::open(base.cache, &*describer, base.memory_bytes)?;
        let images = (dataset.database.len() + dataset.queries.len()) as u64;
        let bar = progress.add(ProgressBar::new(images).with_message("images"));
        let side = |items, name| cache.describe_all(&*describer, items, name, GlobalKind::Mean, &bar);
        let (database, queries) = (side(&dataset.database, "database")?, side(&dataset.queries, "query")?);
        bar.finish_and_clear();
        let (answers, _) = search_all(&database, &queries, |_| base.candidates);
        Ok(Self { cache, database, queries, answers })
    }

    fn row(&self, dataset: &Dataset, variant: &Variant, progress: &MultiProgress) -> Result<AblationRow, EvalError> {
        let bar = progress.add(ProgressBar::new(self.answers.len() as u64).with_message(variant.setting.clone()));
        let patches = |features: &Features, index: usize| {
            let whole = self.cache.patches(features, index)?;
            Ok(match variant.cut {
                Cut::None => whole,
                cut => Arc::new(apply(&whole, cut)),
            })
        };
        let answers = self.answers.clone();
        let (answers, seconds) = rerank_all(&patches, &self.database, &self.queries, answers, &variant.rerank, &bar)?;
        bar.finish_and_clear();
        Ok(AblationRow {
            axis: variant.axis,
            setting: variant.setting.clone(),
            recall: Both {
                global: recall(dataset, &answers, Answer::global_ranking),
                reranked: Some(recall(dataset, &answers, Answer::reranked_ranking)),
            },
            extract_seconds: self.database.seconds.extract,
            rerank_seconds: seconds.rerank,
            patch_bytes: self.patch_bytes(variant)?,
        })
    }

    /// Mean size of what the store would keep.
    fn patch_bytes(&self, variant: &Variant) -> Result<f64, EvalError> {
        let bits = match variant.cut {
            Cut::None => return Ok(self.database.patch_bytes),
            Cut::Limits { .. } => 8,
            Cut::Bits(bits) => bits,
        };
        let (mut bytes, mut images) = (0.0, 0usize);
        for index in (0..self.database.len()).filter(|&index| self.database.global(index).is_some()) {
            let patches = apply(&*self.cache.patches(&self.database, index)?, variant.cut);
            let encoded = codec::encode(&patches).map_err(|error| EvalError::Setting(error.to_string()))?.len();
            bytes += encoded as f64 - patches.codes.len() as f64 * f64::from(8 - bits) / 8.0;
            images += 1;
        }
        Ok(bytes / images.max(1) as f64)
    }
}

fn recall(dataset: &Dataset, answers: &[Answer], ranking: fn(&Answer) -> Vec<usize>) -> AtK<Option<f64>> {
    let hit = |answer: &Answer| match &dataset.truth[answer.query] {
        Truth::Positives(positives) => Some(first_hit(&ranking(answer), positives)),
        Truth::NoMatch | Truth::Unknown => None,
    };
    let hits: Vec<Option<usize>> = answers.iter().filter_map(hit).collect();
    RECALL_AT.into_iter().map(|k| (k, recall_at(&hits, k))).collect()
}

/// The paper's table of patch sizes: single scales, joint scales, and sums.
const SCALE_ROWS: [&str; 12] =
    ["1", "2", "3", "1+2", "1+3", "2+3", "1+2+3", "1,2,3", "1,1+2", "1,2+3", "1+2,2+3", "1,1+2,2+3"];
const TAU_ROWS: [f32; 5] = [0.0, 0.5, 1.0, 1.5, 2.0];
const CAP_ROWS: [[usize; SCALES]; 5] =
    [[50, 25, 6], [100, 50, 12], [200, 100, 25], [400, 200, 50], [usize::MAX, usize::MAX, usize::MAX]];
const SIZE_ROWS: [(u32, u32); 4] = [(16, 12), (24, 18), (32, 24), (46, 34)];
/// Keeps every patch; as many as an extraction may be asked for.
const ALL_PATCHES: [usize; SCALES] = [1 << 16; SCALES];

fn variants(base: &Base<'_>) -> Result<Vec<Variant>, EvalError> {
    let invalid = |error: crate::types::InvalidValue| EvalError::Setting(error.to_string());
    let extract = base.extract.effective().map_err(invalid)?;
    let bare = ExtractConfig { head: HeadChoice::None, ..extract.clone() };
    let mut rows = Rows { rerank: base.rerank, rows: Vec::new() };
    for text in SCALE_ROWS {
        let scales: Result<Vec<ScaleSet>, _> = text.split(',').map(str::parse).collect();
        let scales = scales.map_err(invalid)?;
        let star = scales == base.rerank.scales;
        rows.push("scales", text.replace(',', ", "), star, &extract, Cut::None);
        if let Some(row) = rows.rows.last_mut() {
            row.rerank.scales = scales;
        }
    }
    for bits in [8, 6, 4] {
        rows.push("codec", format!("int{bits}"), bits == 8, &extract, Cut::Bits(bits));
    }
    let every = ExtractConfig { tau: 0.0, caps: ALL_PATCHES, ..bare.clone() };
    for tau in TAU_ROWS {
        let cut = Cut::Limits { tau, caps: extract.caps };
        rows.push("tau", tau.to_string(), tau == extract.tau, &every, cut);
    }
    for caps in CAP_ROWS {
        let name = if caps[0] == usize::MAX { "none".into() } else { caps.map(|cap| cap.to_string()).join(" / ") };
        rows.push("caps", name, caps == extract.caps, &every, Cut::Limits { tau: extract.tau, caps });
    }
    let patch = extract.preset.geometry().patch as u32;
    for (columns, lines) in SIZE_ROWS {
        let size = ImageSize { width: columns * patch, height: lines * patch };
        let config = ExtractConfig { input_size: Some(size), ..bare.clone() };
        rows.push("input size", size.to_string(), extract.input_size == Some(size), &config, Cut::None);
    }
    let depth = extract.preset.geometry().depth;
    for block in depth / 2..depth {
        let config = ExtractConfig { exit_block: Some(block), attention_block: Some(block), ..bare.clone() };
        rows.push("exit block", block.to_string(), extract.exit_block == Some(block), &config, Cut::None);
    }
    for &preset in base.backbones {
        let own = ExtractConfig {
            preset,
            weights: extract.weights.clone().filter(|_| preset == extract.preset),
            head: HeadChoice::None,
            tau: extract.tau,
            caps: extract.caps,
            ..Default::default()
        };
        let config = own.effective().map_err(invalid)?;
        rows.push("backbone", preset.to_string(), preset == extract.preset, &config, Cut::None);
    }
    Ok(rows.rows)
}

struct Rows<'a> {
    rerank: &'a RerankConfig,
    rows: Vec<Variant>,
}

impl Rows<'_> {
    fn push(&mut self, axis: &'static str, setting: String, star: bool, extract: &ExtractConfig, cut: Cut) {
        let setting = if star { format!("{setting} *") } else { setting };
        self.rows.push(Variant { axis, setting, extract: extract.clone(), rerank: self.rerank.clone(), cut });
    }
}

fn apply(patches: &PackedPatches, cut: Cut) -> PackedPatches {
    match cut {
        Cut::None => patches.clone(),
        Cut::Limits { tau, caps } => limit(patches, tau, caps),
        Cut::Bits(bits) => coarsen(patches, bits),
    }
}

/// The patches above `tau`, at most `caps` per scale. Attention is kept in 16 bits, so tau is rounded likewise.
fn limit(patches: &PackedPatches, tau: f32, caps: [usize; SCALES]) -> PackedPatches {
    let tau = half::f16::from_f32(tau);
    let mut kept = PackedPatches {
        grid: patches.grid,
        dim: patches.dim,
        counts: [0; SCALES],
        index: Vec::new(),
        attention: Vec::new(),
        factor: Vec::new(),
        codes: Vec::new(),
    };
    for scale in 1..=SCALES {
        let rows = patches.rows(scale);
        let above = patches.attention[rows.clone()].iter().take_while(|&&attention| attention > tau).count();
        let rows = rows.start..rows.start + above.min(caps[scale - 1]);
        kept.counts[scale - 1] = rows.len();
        kept.index.extend_from_slice(&patches.index[rows.clone()]);
        kept.attention.extend_from_slice(&patches.attention[rows.clone()]);
        kept.factor.extend_from_slice(&patches.factor[rows.clone()]);
        kept.codes.extend_from_slice(&patches.codes[rows.start * patches.dim..rows.end * patches.dim]);
    }
    kept
}

/// The same patches with codes of fewer bits: what a smaller codec would give back.
fn coarsen(patches: &PackedPatches, bits: u32) -> PackedPatches {
    let mut coarse = patches.clone();
    let steps = f32::from((1i16 << (bits - 1)) - 1);
    for (code, factor) in coarse.codes.chunks_mut(patches.dim.max(1)).zip(&mut coarse.factor) {
        for value in code.iter_mut() {
            *value = (f32::from(*value) / 127.0 * steps).round() as i8;
        }
        *factor *= 127.0 / steps;
    }
    coarse
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::types::{PatchGrid, PoolingStride};
    use half::f16;

    fn patches() -> PackedPatches {
        PackedPatches {
            grid: PatchGrid { columns: 8, rows: 6, patch_px: 14, stride: PoolingStride::Kernel },
            dim: 2,
            counts: [3, 2, 1],
            index: vec![9, 4, 7, 1, 0, 2],
            attention: [3.0, 2.0, 1.0, 1.5, 0.5, 0.2].map(f16::from_f32).to_vec(),
            factor: vec![0.1, 0.2, 0.3, 0.4, 0.5, 0.6],
            codes: vec![127, 1, 64, -127, 5, 127, 127, 0, -127, 9, 127, 11],
        }
    }

    #[test]
    fn limits_cut_each_scale_for_itself() {
        let cut = limit(&patches(), 1.0, [400, 1, 50]);
        assert_eq!((cut.counts, cut.index.as_slice()), ([2, 1, 0], &[9, 4, 1][..]));
        assert_eq!(cut.codes, [127, 1, 64, -127, 127, 0]);
        assert_eq!(cut.factor, [0.1, 0.2, 0.4]);
        assert_eq!(limit(&patches(), 0.0, [usize::MAX; SCALES]), patches());
    }

    #[test]
    fn coarse_codes_stay_within_half_a_step() {
        assert_eq!(coarsen(&patches(), 8), patches());
        let (fine, coarse) = (patches(), coarsen(&patches(), 4));
        for (row, (a, b)) in fine.codes.chunks(2).zip(coarse.codes.chunks(2)).enumerate() {
            assert!(b.iter().all(|code| code.abs() <= 7));
            for (a, b) in a.iter().zip(b) {
                let (a, b) = (f32::from(*a) * fine.factor[row], f32::from(*b) * coarse.factor[row]);
                assert!((a - b).abs() <= coarse.factor[row] / 2.0 + 1e-5, "{a} {b}");
            }
        }
    }

    #[test]
    fn each_axis_has_its_base_row_and_extractions_are_shared() {
        let (extract, rerank) = (ExtractConfig::default(), RerankConfig::default());
        let base = Base {
            extract: &extract,
            rerank: &rerank,
            candidates: 100,
            backbones: &[Preset::Dinov2Vits14],
            cache: Path::new("."),
            memory_bytes: 0,
        };
        let variants = variants(&base).unwrap();
        for axis in ["scales", "codec", "tau", "caps", "input size", "exit block", "backbone"] {
            let stars = variants.iter().filter(|v| v.axis == axis && v.setting.ends_with('*')).count();
            assert_eq!(stars, 1, "{axis}");
        }
        let extractions = variants.chunk_by(|a, b| a.extract == b.extract).count();
        assert_eq!(extractions, 1 + 1 + SIZE_ROWS.len() + 6 + 1);
        assert!(variants.iter().all(|v| v.extract.encoder_spec().is_ok()));
    }
}
