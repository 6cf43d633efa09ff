//! The axes of the paper's ablation tables as one table: scale combinations, tau, caps, input
//! size, exit block, backbone, descriptor codec; and what candidates are ordered by. A learned
//! score is learned from the other places of the same data set (five-fold).
//!
//! Heads are bound to one backbone and exit block, so every row searches the mean patch token,
//! which all have. Rows that differ only after extraction share its result: scale combinations and
//! codecs reuse the features of the base settings; all rows of tau and of the caps are cut from one
//! extraction that keeps every patch, which gives what a separate extraction would (key patches
//! come by attention descending, and both rules cut that order off).

mod cuts;
mod full_precision;
mod variants;

pub use variants::Base;

use super::answers::DatasetAnswers;
use super::error::EvalError;
use super::features::{Describe, FeatureCache, Features, GlobalKind};
use super::learn::{Lessons, order_unseen};
use super::measure::{RECALL_AT, first_hit, recall_at};
use super::run::{Answer, rerank_all, search_all};
use super::summary::{AtK, Both};
use crate::datasets::{Dataset, Truth};
use cuts::{Codec, Components, Cut, SAMPLE, apply, unpack};
use placeformer_core::progress::{Progress, Task};
use placeformer_core::types::ScoreKind;
use placeformer_store::codec;
use placeformer_vision::extract::ExtractConfig;
use placeformer_vision::rerank::{Ranking, RerankConfig};
use serde::Serialize;
use std::cell::OnceCell;
use std::sync::Arc;
use variants::{Variant, variants};

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

/// Loads the model for some settings.
pub type OpenModel<'a> = dyn Fn(&ExtractConfig) -> Result<Box<dyn Describe>, EvalError> + 'a;

/// The table, and what it could not have.
pub struct Ablation {
    /// Rows, in the order of their axes.
    pub rows: Vec<AblationRow>,
    /// Rows that were left out, and why, in words.
    pub left_out: Vec<String>,
}

/// Runs every row of the table; `progress` is told of the settings done, and of the images and
/// queries of each.
///
/// # Errors
/// A setting is out of range, a model cannot be opened, or the cache cannot be read or written.
pub fn ablate(
    dataset: &Dataset,
    base: &Base<'_>,
    open: &OpenModel<'_>,
    progress: &dyn Progress,
) -> Result<Ablation, EvalError> {
    let variants = variants(base)?;
    let settings = Task::begin(progress, "settings", variants.len() as u64);
    let mut table = Ablation {
        rows: Vec::new(),
        left_out: Vec::new(),
    };
    // Neighbouring variants share their extraction, so one set of features at a time is enough.
    for group in variants.chunk_by(|a, b| a.extract == b.extract) {
        let features = Prepared::new(dataset, base, &group[0].extract, open, progress)?;
        for variant in group {
            match features.row(dataset, variant, progress)? {
                Ok(row) => table.rows.push(row),
                Err(reason) => {
                    let Variant { axis, setting, .. } = variant;
                    table.left_out.push(format!("{axis} {setting}: {reason}"));
                }
            }
            settings.add(1);
        }
    }
    Ok(table)
}

/// A described data set with the answers of its global search, for all variants of one extraction.
struct Prepared {
    describer: Box<dyn Describe>,
    memory_bytes: u64,
    radius_m: f64,
    cache: FeatureCache,
    database: Features,
    queries: Features,
    answers: Vec<Answer>,
    components: OnceCell<Components>,
}

/// The answers of a variant, and what they cost.
struct Measured {
    answers: Vec<Answer>,
    /// Mean seconds to re-rank one query.
    rerank_seconds: f64,
    /// Mean bytes of the key patches of one reference.
    patch_bytes: f64,
}

impl Prepared {
    fn new(
        dataset: &Dataset,
        base: &Base<'_>,
        extract: &ExtractConfig,
        open: &OpenModel<'_>,
        progress: &dyn Progress,
    ) -> Result<Self, EvalError> {
        let describer = open(extract)?;
        let cache = FeatureCache::open(base.cache, &*describer, base.memory_bytes)?;
        let images = dataset.database.len() + dataset.queries.len();
        let task = Task::begin(progress, "images", images as u64);
        let describe =
            |items, side| cache.describe_all(&*describer, items, side, GlobalKind::Mean, &task);
        let database = describe(&dataset.database, "database")?;
        let queries = describe(&dataset.queries, "query")?;
        let (answers, _) = search_all(&database, &queries, |_| base.candidates);
        Ok(Self {
            describer,
            memory_bytes: base.memory_bytes,
            radius_m: base.radius_m,
            cache,
            database,
            queries,
            answers,
            components: OnceCell::new(),
        })
    }

    /// The row of `variant`, or why it is left out.
    fn row(
        &self,
        dataset: &Dataset,
        variant: &Variant,
        progress: &dyn Progress,
    ) -> Result<Result<AblationRow, String>, EvalError> {
        let queries = self.answers.len() as u64;
        let task = Task::begin(progress, variant.setting.clone(), queries);
        let measured = match variant.cut {
            Cut::FullPrecision => match self.in_full_precision(dataset, variant, &task)? {
                Some(measured) => measured,
                None => {
                    let reason = "its descriptors need more memory than is allowed";
                    return Ok(Err(reason.to_owned()));
                }
            },
            cut => match self.cut(dataset, variant, cut, &task) {
                Err(error @ EvalError::OneSided { .. }) => return Ok(Err(error.to_string())),
                measured => measured?,
            },
        };
        let answers = &measured.answers;
        Ok(Ok(AblationRow {
            axis: variant.axis,
            setting: variant.setting.clone(),
            recall: Both {
                global: recall(dataset, answers, Answer::global_ranking),
                reranked: Some(recall(dataset, answers, Answer::reranked_ranking)),
                tracked: None,
            },
            extract_seconds: self.database.seconds.extract,
            rerank_seconds: measured.rerank_seconds,
            patch_bytes: measured.patch_bytes,
        }))
    }

    /// Re-ranks with what `cut` leaves of the stored key patches.
    fn cut(
        &self,
        dataset: &Dataset,
        variant: &Variant,
        cut: Cut,
        task: &Task<'_>,
    ) -> Result<Measured, EvalError> {
        let components = self.components(cut)?;
        let cache = &self.cache;
        let patches = |features: &Features, index: usize| {
            let whole = cache.patches(features, index)?;
            match cut {
                Cut::None => Ok(whole),
                cut => Ok(Arc::new(apply(&whole, cut, components)?)),
            }
        };
        let (answers, seconds) = rerank_all(
            &patches,
            &self.database,
            &self.queries,
            self.answers.clone(),
            &variant.rerank,
            task,
        )?;
        let answers = ordered(dataset, answers, &variant.rerank, self.radius_m)?;
        Ok(Measured {
            answers,
            rerank_seconds: seconds.rerank,
            patch_bytes: self.patch_bytes(variant)?,
        })
    }

    /// Re-ranks with descriptors as the model gives them; `None` if they do not fit in memory.
    fn in_full_precision(
        &self,
        dataset: &Dataset,
        variant: &Variant,
        task: &Task<'_>,
    ) -> Result<Option<Measured>, EvalError> {
        let full = full_precision::rerank_all(
            &*self.describer,
            dataset,
            &self.answers,
            &variant.rerank,
            self.memory_bytes,
            task,
        )?;
        Ok(full.map(|full| Measured {
            answers: full.answers,
            rerank_seconds: full.seconds,
            patch_bytes: self.database.patch_bytes + full.extra_bytes,
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
        let mut sample = Vec::new();
        let mut dim = 0;
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
        let mut bytes = 0.0;
        let mut images = 0usize;
        for index in 0..self.database.len() {
            if self.database.global(index).is_none() {
                continue;
            }
            let stored = self.cache.patches(&self.database, index)?;
            let patches = apply(&stored, variant.cut, components)?;
            let encoded = codec::encode(&patches)
                .map_err(|error| EvalError::Setting(error.to_string()))?
                .len();
            // The codec writes 8 bits a value; those that `bits` does without are taken off.
            bytes += encoded as f64 - patches.codes.len() as f64 * f64::from(8 - bits) / 8.0;
            images += 1;
        }
        Ok(bytes / images.max(1) as f64)
    }
}

/// The answers in the order of the configured score.
fn ordered(
    dataset: &Dataset,
    answers: Vec<Answer>,
    rerank: &RerankConfig,
    radius_m: f64,
) -> Result<Vec<Answer>, EvalError> {
    let mut asked = DatasetAnswers {
        answers,
        ..Default::default()
    };
    match rerank.score {
        ScoreKind::Paper => {}
        ScoreKind::Fused => asked.order_by(&Ranking::Fused),
        ScoreKind::Learned => {
            let lessons = Lessons::of(dataset, &asked, &rerank.scales, radius_m);
            order_unseen(dataset, &mut asked, &lessons, 0)?;
        }
    }
    Ok(asked.answers)
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

#[cfg(test)]
mod tests;
