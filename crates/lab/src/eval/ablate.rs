//! The axes of the paper's ablation tables as one table: scale combinations, tau, caps, input size,
//! exit block, backbone, descriptor codec.
//!
//! Heads are bound to one backbone and exit block, so every row searches the mean patch token,
//! which all have. Rows that differ only after extraction share its result: scale combinations and
//! codecs reuse the features of the base settings; all rows of tau and of the caps are cut from one
//! extraction that keeps every patch, which gives what a separate extraction would (key patches
//! come by attention descending, and both rules cut that order off).

mod cuts;
mod full_precision;

use super::EvalError;
use super::features::{Describe, FeatureCache, Features, GlobalKind};
use super::measure::{RECALL_AT, first_hit, recall_at};
use super::run::{Answer, rerank_all, search_all};
use super::summary::{AtK, Both};
use crate::datasets::{Dataset, Truth};
use cuts::{Codec, Components, Cut, SAMPLE, apply, unpack};
use indicatif::{MultiProgress, ProgressBar};
use placeformer_core::types::{ImageSize, SCALES, ScaleSet};
use placeformer_store::codec;
use placeformer_vision::extract::{ExtractConfig, HeadChoice, Preset};
use placeformer_vision::rerank::RerankConfig;
use serde::Serialize;
use std::cell::OnceCell;
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

struct Variant {
    axis: &'static str,
    setting: String,
    extract: ExtractConfig,
    rerank: RerankConfig,
    cut: Cut,
}

/// Settings of the run that the table varies.
#[derive(Clone, Copy)]
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

/// The table, and what it could not have.
pub struct Ablation {
    /// Rows, in the order of their axes.
    pub rows: Vec<AblationRow>,
    /// Rows that were left out, and why, in words.
    pub left_out: Vec<String>,
}

/// Runs every row; `progress` shows where it stands.
pub fn ablate(
    dataset: &Dataset,
    base: &Base<'_>,
    open: &OpenModel<'_>,
    progress: &MultiProgress,
) -> Result<Ablation, EvalError> {
    let variants = variants(base)?;
    let bar = progress.add(ProgressBar::new(variants.len() as u64).with_message("settings"));
    let mut table = Ablation {
        rows: Vec::new(),
        left_out: Vec::new(),
    };
    // Neighbouring variants share their extraction, so one set of features at a time is enough.
    for group in variants.chunk_by(|a, b| a.extract == b.extract) {
        let features = Prepared::new(dataset, base, &group[0].extract, open, progress)?;
        for variant in group {
            match features.row(dataset, variant, progress)? {
                Some(row) => table.rows.push(row),
                None => {
                    let name = format!("{} {}", variant.axis, variant.setting);
                    table.left_out.push(format!(
                        "{name}: its descriptors need more memory than is allowed"
                    ));
                }
            }
            bar.inc(1);
        }
    }
    bar.finish_and_clear();
    Ok(table)
}

struct Prepared {
    describer: Box<dyn Describe>,
    memory_bytes: u64,
    cache: FeatureCache,
    database: Features,
    queries: Features,
    answers: Vec<Answer>,
    components: OnceCell<Components>,
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
        let side =
            |items, name| cache.describe_all(&*describer, items, name, GlobalKind::Mean, &bar);
        let (database, queries) = (
            side(&dataset.database, "database")?,
            side(&dataset.queries, "query")?,
        );
        bar.finish_and_clear();
        let (answers, _) = search_all(&database, &queries, |_| base.candidates);
        let (memory_bytes, components) = (base.memory_bytes, OnceCell::new());
        Ok(Self {
            describer,
            memory_bytes,
            cache,
            database,
            queries,
            answers,
            components,
        })
    }

    /// None where a row needs more memory than is allowed.
    fn row(
        &self,
        dataset: &Dataset,
        variant: &Variant,
        progress: &MultiProgress,
    ) -> Result<Option<AblationRow>, EvalError> {
        let bar = progress
            .add(ProgressBar::new(self.answers.len() as u64).with_message(variant.setting.clone()));
        let (cache, components) = (&self.cache, self.components(variant.cut)?);
        let patches = |features: &Features, index: usize| {
            let whole = cache.patches(features, index)?;
            Ok(match variant.cut {
                Cut::None => whole,
                cut => Arc::new(apply(&whole, cut, components)?),
            })
        };
        let (answers, rerank_seconds, patch_bytes) = if variant.cut == Cut::FullPrecision {
            let (describer, bound) = (&*self.describer, self.memory_bytes);
            match full_precision::rerank_all(
                describer,
                dataset,
                &self.answers,
                &variant.rerank,
                bound,
                &bar,
            )? {
                None => return Ok(None),
                Some(full) => (
                    full.answers,
                    full.seconds,
                    self.database.patch_bytes + full.extra_bytes,
                ),
            }
        } else {
            let answers = self.answers.clone();
            let (answers, seconds) = rerank_all(
                &patches,
                &self.database,
                &self.queries,
                answers,
                &variant.rerank,
                &bar,
            )?;
            (answers, seconds.rerank, self.patch_bytes(variant)?)
        };
        bar.finish_and_clear();
        Ok(Some(AblationRow {
            axis: variant.axis,
            setting: variant.setting.clone(),
            recall: Both {
                global: recall(dataset, &answers, Answer::global_ranking),
                reranked: Some(recall(dataset, &answers, Answer::reranked_ranking)),
            },
            extract_seconds: self.database.seconds.extract,
            rerank_seconds,
            patch_bytes,
        }))
    }

    /// The components that `cut` needs, from the database's own key patches: no label is looked at.
    fn components(&self, cut: Cut) -> Result<Option<&Components>, EvalError> {
        let Cut::Codec(Codec::Components(count)) = cut else {
            return Ok(None);
        };
        if let Some(found) = self.components.get() {
            return Ok(Some(found));
        }
        let readable: Vec<usize> = (0..self.database.len())
            .filter(|&index| self.database.global(index).is_some())
            .collect();
        // Some of every image rather than all of a few.
        let each = SAMPLE.div_ceil(readable.len().max(1));
        let (mut sample, mut dim) = (Vec::new(), 0);
        for index in readable {
            let patches = self.cache.patches(&self.database, index)?;
            dim = patches.dim;
            let step = patches.len().div_ceil(each).max(1);
            sample.extend(unpack(&patches).step_by(step).flatten());
        }
        Ok(Some(
            self.components
                .get_or_init(|| Components::of(&sample, dim, count)),
        ))
    }

    /// Mean size of what the store would keep.
    fn patch_bytes(&self, variant: &Variant) -> Result<f64, EvalError> {
        let bits = match variant.cut {
            Cut::None | Cut::FullPrecision => return Ok(self.database.patch_bytes),
            Cut::Limits { .. } => 8,
            Cut::Codec(codec) => codec.bits(),
        };
        let components = self.components(variant.cut)?;
        let (mut bytes, mut images) = (0.0, 0usize);
        for index in (0..self.database.len()).filter(|&index| self.database.global(index).is_some())
        {
            let patches = apply(
                &*self.cache.patches(&self.database, index)?,
                variant.cut,
                components,
            )?;
            let encoded = codec::encode(&patches)
                .map_err(|error| EvalError::Setting(error.to_string()))?
                .len();
            bytes += encoded as f64 - patches.codes.len() as f64 * f64::from(8 - bits) / 8.0;
            images += 1;
        }
        Ok(bytes / images.max(1) as f64)
    }
}

fn recall(
    dataset: &Dataset,
    answers: &[Answer],
    ranking: fn(&Answer) -> Vec<usize>,
) -> AtK<Option<f64>> {
    let hit = |answer: &Answer| match &dataset.truth[answer.query] {
        Truth::Positives(positives) => Some(first_hit(&ranking(answer), positives)),
        Truth::NoMatch | Truth::Unknown => None,
    };
    let hits: Vec<Option<usize>> = answers.iter().filter_map(hit).collect();
    RECALL_AT
        .into_iter()
        .map(|k| (k, recall_at(&hits, k)))
        .collect()
}

/// The paper's table of patch sizes: single scales, joint scales, and sums.
const SCALE_ROWS: [&str; 12] = [
    "1",
    "2",
    "3",
    "1+2",
    "1+3",
    "2+3",
    "1+2+3",
    "1,2,3",
    "1,1+2",
    "1,2+3",
    "1+2,2+3",
    "1,1+2,2+3",
];
const TAU_ROWS: [f32; 5] = [0.0, 0.5, 1.0, 1.5, 2.0];
const CAP_ROWS: [[usize; SCALES]; 5] = [
    [50, 25, 6],
    [100, 50, 12],
    [200, 100, 25],
    [400, 200, 50],
    [usize::MAX, usize::MAX, usize::MAX],
];
const SIZE_ROWS: [(u32, u32); 4] = [(16, 12), (24, 18), (32, 24), (46, 34)];
const CODEC_ROWS: [Codec; 4] = [
    Codec::INT8,
    Codec::Bits(6),
    Codec::Bits(4),
    Codec::Components(128),
];
/// Keeps every patch; as many as an extraction may be asked for.
const ALL_PATCHES: [usize; SCALES] = [1 << 16; SCALES];

/// Every row; where no row of an axis is the base setting, it is added.
fn variants(base: &Base<'_>) -> Result<Vec<Variant>, EvalError> {
    let invalid =
        |error: placeformer_core::types::InvalidValue| EvalError::Setting(error.to_string());
    let extract = base.extract.effective().map_err(invalid)?;
    let bare = ExtractConfig {
        head: HeadChoice::None,
        ..extract.clone()
    };
    let mut rows = Rows {
        rerank: base.rerank,
        rows: Vec::new(),
    };
    rows.scales(&extract).map_err(invalid)?;
    rows.push("codec", "f32".into(), false, &extract, Cut::FullPrecision);
    for codec in CODEC_ROWS {
        rows.push(
            "codec",
            codec.name(),
            codec == Codec::INT8,
            &extract,
            Cut::Codec(codec),
        );
    }
    let every = ExtractConfig {
        tau: 0.0,
        caps: ALL_PATCHES,
        ..bare.clone()
    };
    for tau in with_base(TAU_ROWS, extract.tau) {
        let cut = Cut::Limits {
            tau,
            caps: extract.caps,
        };
        rows.push("tau", tau.to_string(), tau == extract.tau, &every, cut);
    }
    for caps in with_base(CAP_ROWS, extract.caps) {
        let name = if caps[0] == usize::MAX {
            "none".into()
        } else {
            caps.map(|cap| cap.to_string()).join(" / ")
        };
        rows.push(
            "caps",
            name,
            caps == extract.caps,
            &every,
            Cut::Limits {
                tau: extract.tau,
                caps,
            },
        );
    }
    let patch = extract.preset.geometry().patch as u32;
    let sizes = SIZE_ROWS.map(|(columns, lines)| {
        Some(ImageSize {
            width: columns * patch,
            height: lines * patch,
        })
    });
    for input_size in with_base(sizes, extract.input_size) {
        let config = ExtractConfig {
            input_size,
            ..bare.clone()
        };
        let name = input_size.map_or_else(|| "preset".to_owned(), |size| size.to_string());
        rows.push(
            "input size",
            name,
            extract.input_size == input_size,
            &config,
            Cut::None,
        );
    }
    let depth = extract.preset.geometry().depth;
    for exit_block in with_base((depth / 2..depth).map(Some), extract.exit_block) {
        let is_base = extract.exit_block == exit_block;
        // At the base's exit its own attention is looked at, which may be that of another block.
        let attention_block = if is_base {
            extract.attention_block
        } else {
            exit_block
        };
        let config = ExtractConfig {
            exit_block,
            attention_block,
            ..bare.clone()
        };
        let name = exit_block.map_or_else(|| "preset".to_owned(), |block| block.to_string());
        rows.push("exit block", name, is_base, &config, Cut::None);
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
        let config = if preset == extract.preset {
            bare.clone()
        } else {
            own.effective().map_err(invalid)?
        };
        rows.push(
            "backbone",
            preset.to_string(),
            preset == extract.preset,
            &config,
            Cut::None,
        );
    }
    Ok(rows.rows)
}

/// The settings of an axis, with the base's own if it is none of them.
fn with_base<T: PartialEq + Clone>(settings: impl IntoIterator<Item = T>, base: T) -> Vec<T> {
    let mut all: Vec<T> = settings.into_iter().collect();
    if !all.contains(&base) {
        all.push(base);
    }
    all
}

struct Rows<'a> {
    rerank: &'a RerankConfig,
    rows: Vec<Variant>,
}

impl Rows<'_> {
    fn scales(
        &mut self,
        extract: &ExtractConfig,
    ) -> Result<(), placeformer_core::types::InvalidValue> {
        let parse = |text: &str| {
            text.split(',')
                .map(str::parse)
                .collect::<Result<Vec<ScaleSet>, _>>()
        };
        let settings = SCALE_ROWS
            .into_iter()
            .map(parse)
            .collect::<Result<Vec<_>, _>>()?;
        for scales in with_base(settings, self.rerank.scales.clone()) {
            let name = scales
                .iter()
                .map(ToString::to_string)
                .collect::<Vec<_>>()
                .join(", ");
            self.push(
                "scales",
                name,
                scales == self.rerank.scales,
                extract,
                Cut::None,
            );
            if let Some(row) = self.rows.last_mut() {
                row.rerank.scales = scales;
            }
        }
        Ok(())
    }

    fn push(
        &mut self,
        axis: &'static str,
        setting: String,
        star: bool,
        extract: &ExtractConfig,
        cut: Cut,
    ) {
        let setting = if star {
            format!("{setting} *")
        } else {
            setting
        };
        self.rows.push(Variant {
            axis,
            setting,
            extract: extract.clone(),
            rerank: self.rerank.clone(),
            cut,
        });
    }
}

#[cfg(test)]
mod tests;
