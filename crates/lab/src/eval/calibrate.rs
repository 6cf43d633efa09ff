//! From the answers to a data set to a [`Calibration`]: what the best answers were worth, with
//! their place in the database and without it.
//!
//! Unknown places come from the ground truth, where it says that a query has no match. Where a set
//! has none (or on demand) each query is asked twice: once as it is, and once with its own place
//! left out of the database (see [`OwnPlaces`](super::own_places::OwnPlaces)).

use super::answers::DatasetAnswers;
use super::error::EvalError;
use super::learn::{Lessons, order_unseen};
use super::measure::{self, CalibrationError, ReliabilityBin, ThresholdCheck, TopOne, Trusted};
use super::places::places_of;
use super::run::Answer;
use crate::datasets::{Dataset, Truth};
use placeformer_core::types::{
    Calibration, ConfidenceCurve, LearnedScore, ModelId, RerankId, ScoreKind,
};
use placeformer_models::built_in_calibration;
use placeformer_vision::rerank::{Ranking, RerankConfig};
use serde::Serialize;
use std::fmt::{self, Write};

/// Best answers with what is known about them, re-ranked and by distance alone.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct BestAnswers {
    /// After re-ranking.
    pub reranked: Vec<TopOne>,
    /// By global distance; of the same queries.
    pub global: Vec<TopOne>,
}

impl BestAnswers {
    /// Of the answers to `dataset` as they are, and of `left_out`: answers to the same queries
    /// when their own place was left out. Both are ordered by `score`. Queries of unknown truth
    /// are passed over.
    pub fn of(
        dataset: &Dataset,
        answers: &[Answer],
        left_out: &[Answer],
        score: ScoreKind,
    ) -> Self {
        let places = places_of(dataset);
        let mut best = Self::default();
        let is_known = |answer: &&Answer| dataset.truth[answer.query] != Truth::Unknown;
        for answer in answers.iter().filter(is_known) {
            let positives = dataset.truth[answer.query].positives();
            best.add(answer, places[answer.query], positives, score);
        }
        for answer in left_out.iter().filter(is_known) {
            best.add(answer, places[answer.query], &[], score);
        }
        best
    }

    fn add(&mut self, answer: &Answer, place: usize, positives: &[usize], score: ScoreKind) {
        let judged = |index: usize, distance: f32, evidence: Option<f64>| TopOne {
            place,
            evidence,
            global_distance: f64::from(distance),
            correct: positives.binary_search(&index).is_ok(),
            has_match: !positives.is_empty(),
        };
        if let Some(best) = answer.global.first() {
            self.global.push(judged(best.index, best.distance, None));
        }
        if let Some(best) = answer.reranked.first() {
            let evidence = score.evidence(best.value);
            self.reranked
                .push(judged(best.index, best.distance, Some(evidence)));
        }
    }
}

/// What a given curve comes to on some answers.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Applied {
    /// Mean gap between confidence and share of right answers, 0 to 1.
    pub expected_calibration_error: f64,
    /// What its threshold accepts.
    pub trusted: Trusted,
    /// The gap by confidence.
    pub bins: Vec<ReliabilityBin>,
}

impl Applied {
    /// Of `curve` on `answers`.
    pub fn of(curve: &ConfidenceCurve, answers: &[TopOne]) -> Self {
        let predictions = measure::predict(&curve.weights, answers);
        let bins = measure::reliability(&predictions);
        Self {
            expected_calibration_error: measure::calibration_error(&bins),
            trusted: measure::trusted(&predictions, curve.threshold),
            bins,
        }
    }
}

impl Applied {
    /// A line for people.
    pub fn text(&self) -> String {
        let Trusted {
            count,
            precision,
            recall,
            ..
        } = self.trusted;
        format!(
            "{count} answers trusted, precision {:.1}%, recall {:.1}%, ECE {:.3}",
            percent(precision),
            percent(recall),
            self.expected_calibration_error
        )
    }
}

/// The curve that the program carries for this model, for re-ranked answers or for the others.
pub fn shipped_curve(model: &ModelId, rerank: Option<&RerankId>) -> Option<ConfidenceCurve> {
    let shipped = built_in_calibration(model)?;
    let holds = rerank.is_none_or(|rerank| shipped.rerank() == rerank);
    holds.then(|| shipped.curve(rerank.is_some()).clone())
}

/// A calibration with what only its maker wants to know.
#[derive(Debug, Clone, PartialEq)]
pub struct Fitted {
    /// What was fitted.
    pub calibration: Calibration,
    /// Calibration errors on the answers it was fitted on, re-ranked and by distance alone.
    pub in_sample_errors: [f64; 2],
    /// What the two thresholds are worth on places that had no say in them.
    pub checks: [ThresholdCheck; 2],
    /// S at which trust begins at the median distance of right answers, if candidates are ordered
    /// by S and it decides at all.
    pub spatial_score: Option<f64>,
    /// What the model's own curves come to on the same answers, if there are any.
    pub shipped: [Option<Applied>; 2],
}

/// What a calibration is fitted for.
#[derive(Debug, Clone, PartialEq)]
pub struct Purpose {
    /// The model.
    pub model: ModelId,
    /// The re-ranking.
    pub rerank: RerankConfig,
    /// Name of the data.
    pub data: String,
    /// Share of right answers that the threshold is chosen for.
    pub target_precision: f64,
    /// Seed of the cross-validation.
    pub seed: u64,
    /// Greatest distance of a positive in metres.
    pub radius_m: f64,
}

/// Fits everything that answers to `dataset` are ranked and trusted by: the score, if it is a
/// learned one, and both curves. The answers are ordered by S.
///
/// The curve of a learned score is fitted to what that score is worth on places that it has not
/// seen.
///
/// # Errors
/// All answers are right, or all are wrong; or the target is out of range.
pub fn fit(
    dataset: &Dataset,
    mut asked: DatasetAnswers,
    purpose: Purpose,
) -> Result<Fitted, EvalError> {
    let RerankConfig { score, scales, .. } = &purpose.rerank;
    let mut learned = None;
    match score {
        ScoreKind::Paper => {}
        ScoreKind::Fused => asked.order_by(&Ranking::Fused),
        ScoreKind::Learned => {
            let lessons = Lessons::of(dataset, &asked, scales, purpose.radius_m);
            order_unseen(dataset, &mut asked, &lessons, purpose.seed)?;
            learned = Some(lessons.learn(|_| true)?);
        }
    }
    let best = BestAnswers::of(dataset, &asked.answers, &asked.left_out, *score);
    calibrate(&best, purpose, learned)
}

/// Fits both curves. Where the re-ranking is by a learned score, the answers have been ordered by
/// scores that had not seen their places, and later ones will be by `learned_score`.
///
/// # Errors
/// All answers are right, or all are wrong; or the target is out of range.
fn calibrate(
    answers: &BestAnswers,
    purpose: Purpose,
    learned_score: Option<LearnedScore>,
) -> Result<Fitted, EvalError> {
    let Purpose {
        model,
        rerank,
        data,
        target_precision,
        seed,
        radius_m: _,
    } = purpose;
    let rerank = rerank.id();
    let one =
        |answers: &[TopOne]| measure::fit_curve(answers, target_precision, seed).map_err(unfit);
    let reranked = one(&answers.reranked)?;
    let global = one(&answers.global)?;
    let shipped = [
        shipped_curve(&model, Some(&rerank)).map(|curve| Applied::of(&curve, &answers.reranked)),
        shipped_curve(&model, None).map(|curve| Applied::of(&curve, &answers.global)),
    ];
    let spatial_score = match rerank.score() {
        ScoreKind::Paper => score_at_threshold(&reranked.curve, &answers.reranked),
        ScoreKind::Fused | ScoreKind::Learned => None,
    };
    let in_sample_errors = [reranked.in_sample_error, global.in_sample_error];
    let checks = [reranked.check, global.check];
    let calibration = Calibration::new(
        model,
        rerank,
        data,
        target_precision,
        [reranked.curve, global.curve],
    )
    .and_then(|calibration| match learned_score {
        Some(score) => calibration.with_score(score),
        None => Ok(calibration),
    })
    .map_err(|error| EvalError::Setting(error.to_string()))?;
    Ok(Fitted {
        calibration,
        in_sample_errors,
        checks,
        spatial_score,
        shipped,
    })
}

fn unfit(error: CalibrationError) -> EvalError {
    EvalError::Setting(format!(
        "{error}; add queries of places that the database does not show, or --leave-out always"
    ))
}

/// Solves the curve for S at its threshold and the median distance of right answers.
fn score_at_threshold(curve: &ConfidenceCurve, answers: &[TopOne]) -> Option<f64> {
    let mut distances: Vec<f64> = answers
        .iter()
        .filter(|a| a.correct)
        .map(|a| a.global_distance)
        .collect();
    distances.sort_unstable_by(f64::total_cmp);
    let median = *distances.get(distances.len() / 2)?;
    let weights = curve.weights;
    let odds = curve.threshold / (1.0 - curve.threshold);
    let score = ((odds.ln() - weights.bias - weights.distance * median) / weights.score).exp_m1();
    (weights.score > 0.0 && score.is_finite()).then_some(score.max(0.0))
}

impl Fitted {
    /// What candidates are ordered by.
    ///
    /// # Errors
    /// The score of `rerank` is a learned one, and none was fitted.
    pub fn ranking(&self, rerank: &RerankConfig) -> Result<Ranking<'_>, EvalError> {
        match rerank.score {
            ScoreKind::Paper => Ok(Ranking::Paper),
            ScoreKind::Fused => Ok(Ranking::Fused),
            ScoreKind::Learned => {
                let learned = self.calibration.learned_score().map(Ranking::Learned);
                learned.ok_or_else(|| EvalError::Setting("no score was learned".into()))
            }
        }
    }
}

/// The two curves of a calibration: their names, and whether each is of re-ranked answers.
const CURVES: [(&str, bool); 2] = [("re-ranked", true), ("global", false)];

impl Fitted {
    /// The table a person reads.
    pub fn text(&self) -> String {
        let mut out = String::new();
        // Writing into a `String` cannot fail.
        let _ = self.write_curves(&mut out);
        let _ = self.write_checks(&mut out);
        let _ = self.write_advice(&mut out);
        out
    }

    /// What was fitted, a line for each curve.
    fn write_curves(&self, out: &mut String) -> fmt::Result {
        let calibration = &self.calibration;
        writeln!(out, "calibration of {}", calibration.model())?;
        writeln!(out, "re-ranked by {}", calibration.rerank())?;
        writeln!(
            out,
            "fitted on {}, for {:.1}% precision\n",
            calibration.data(),
            percent(calibration.target_precision())
        )?;
        writeln!(
            out,
            "{:<12}{:>7}{:>7}{:>10}{:>11}{:>11}{:>8}{:>14}{:>11}",
            "",
            "right",
            "wrong",
            "unknown",
            "threshold",
            "precision",
            "recall",
            "ECE 5-fold",
            "in-sample"
        )?;
        for ((name, reranked), in_sample) in CURVES.into_iter().zip(self.in_sample_errors) {
            let curve = calibration.curve(reranked);
            writeln!(
                out,
                "{name:<12}{:>7}{:>7}{:>10}{:>11.3}{:>10.1}%{:>7.1}%{:>14.3}{in_sample:>11.3}",
                curve.right,
                curve.wrong,
                curve.without_match,
                curve.threshold,
                percent(curve.precision),
                percent(curve.recall),
                curve.expected_calibration_error
            )?;
        }
        Ok(())
    }

    /// What the thresholds are worth on places that had no say in them, and what the model's own
    /// curves come to.
    fn write_checks(&self, out: &mut String) -> fmt::Result {
        for ((name, _), check) in CURVES.into_iter().zip(&self.checks) {
            writeln!(
                out,
                "{name}: on places that had no say in its threshold {} answers are trusted \
                 ({} places), precision 95% [{:.1}%, {:.1}%]",
                check.count,
                check.places,
                percent(check.interval[0]),
                percent(check.interval[1])
            )?;
        }
        for ((name, _), applied) in CURVES.into_iter().zip(&self.shipped) {
            let Some(applied) = applied else {
                continue;
            };
            let trusted = applied.trusted;
            writeln!(
                out,
                "{name}, the model's own curve on the same answers: threshold {:.3}, \
                 precision {:.1}%, recall {:.1}%, ECE {:.3}",
                trusted.threshold,
                percent(trusted.precision),
                percent(trusted.recall),
                applied.expected_calibration_error
            )?;
        }
        Ok(())
    }

    /// The score from which on answers are trusted, and a warning where none are.
    fn write_advice(&self, out: &mut String) -> fmt::Result {
        if let Some(score) = self.spatial_score {
            writeln!(
                out,
                "re-ranked answers at the usual distance are trusted from S = {score:.0} on"
            )?;
        }
        for (name, reranked) in CURVES {
            if self.calibration.curve(reranked).threshold >= 1.0 {
                writeln!(
                    out,
                    "warning: {name}: no threshold reaches the precision asked for; \
                     nothing is trusted"
                )?;
            }
        }
        Ok(())
    }
}

fn percent(share: f64) -> f64 {
    share * 100.0
}

#[cfg(test)]
mod tests;
