//! From the answers to a data set to a [`Calibration`]: what the best answers were worth, with
//! their place in the database and without it.
//!
//! Unknown places come from the ground truth, where it says that a query has no match. Where a set
//! has none (or on demand) each query is asked twice: once as it is, and once with its own place
//! left out of the database, which makes it a query without a match. Left out are its positives
//! and, where positions are known, everything within [`MARGIN`] times the radius, because a photo
//! just beyond the radius still shows the same street.

use super::EvalError;
use super::measure::{
    self, CalibrationError, FittedCurve, ReliabilityBin, ThresholdCheck, TopOne, Trusted,
};
use super::places::places_of;
use super::run::Answer;
use crate::datasets::{Dataset, NeighbourGrid, Truth};
use placeformer_core::types::{Calibration, ConfidenceCurve, ModelId, RerankId};
use placeformer_models::built_in_calibration;
use serde::Serialize;
use std::fmt::Write;

/// Radii around a query that belong to its place.
pub const MARGIN: f64 = 4.0;

/// When a query's own place is left out of the database.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum LeaveOut {
    /// Where the ground truth names no query without a match.
    Auto,
    /// Always, beside the queries that have no match anyway.
    Always,
    /// Never: queries without a match must come from the ground truth.
    Never,
}

/// For every query the database images that show its place, ascending.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct OwnPlaces(Vec<Vec<usize>>);

impl OwnPlaces {
    /// The places to leave out of `dataset`, whose positives lie within `radius_m`; `None` if none
    /// are to be.
    pub fn of(dataset: &Dataset, choice: LeaveOut, radius_m: f64) -> Option<Self> {
        let has_unknown = dataset.truth.contains(&Truth::NoMatch);
        let wanted = match choice {
            LeaveOut::Auto => !has_unknown,
            LeaveOut::Always => true,
            LeaveOut::Never => false,
        };
        wanted.then(|| {
            let located = dataset.database.iter().enumerate();
            let located = located.filter_map(|(index, item)| Some((index, item.position?)));
            let grid = NeighbourGrid::new(radius_m * MARGIN, located);
            Self(
                (0..dataset.queries.len())
                    .map(|query| own_place(dataset, &grid, query))
                    .collect(),
            )
        })
    }

    /// Parts widened answers to `dataset`: all as they would have been, and those whose place was
    /// left out.
    pub fn part_all(
        &self,
        dataset: &Dataset,
        answers: &[Answer],
        candidates: usize,
    ) -> (Vec<Answer>, Vec<Answer>) {
        let (mut as_they_are, mut left_out) = (Vec::new(), Vec::new());
        for answer in answers {
            let (with, without) = self.part(answer, candidates);
            as_they_are.push(with);
            if !dataset.truth[answer.query].positives().is_empty() {
                left_out.push(without);
            }
        }
        (as_they_are, left_out)
    }

    fn of_query(&self, query: usize) -> &[usize] {
        &self.0[query]
    }

    /// How many neighbours must be found so that `candidates` remain after a query's own place is
    /// left out.
    pub fn widened(&self, query: usize, candidates: usize) -> usize {
        candidates + self.of_query(query).len()
    }

    /// Keeps of a widened answer what one of its two halves needs: the nearest `candidates`, with
    /// and without the query's own place.
    pub fn trim(&self, answer: &mut Answer, candidates: usize) {
        let own = self.of_query(answer.query);
        let mut strangers = 0;
        let mut rank = 0;
        answer.global.retain(|neighbour| {
            rank += 1;
            let is_stranger = own.binary_search(&neighbour.index).is_err();
            strangers += usize::from(is_stranger);
            rank <= candidates || (is_stranger && strangers <= candidates)
        });
    }

    /// Parts a widened answer: as it would have been, and as it would have been without the query's
    /// own place.
    pub fn part(&self, answer: &Answer, candidates: usize) -> (Answer, Answer) {
        let own = self.of_query(answer.query);
        let half = |keep: &dyn Fn(usize) -> bool| {
            let global: Vec<_> = answer
                .global
                .iter()
                .filter(|one| keep(one.index))
                .take(candidates)
                .copied()
                .collect();
            let is_in = |index| global.iter().any(|one| one.index == index);
            let reranked = answer
                .reranked
                .iter()
                .filter(|one| is_in(one.index))
                .cloned()
                .collect();
            Answer {
                query: answer.query,
                global,
                reranked,
            }
        };
        (
            half(&|_| true),
            half(&|index| own.binary_search(&index).is_err()),
        )
    }
}

fn own_place(dataset: &Dataset, grid: &NeighbourGrid, query: usize) -> Vec<usize> {
    let Truth::Positives(positives) = &dataset.truth[query] else {
        return Vec::new();
    };
    let item = &dataset.queries[query];
    let around = item
        .position
        .into_iter()
        .flat_map(|position| grid.within(position));
    let mut own: Vec<usize> = around
        .filter(|&index| dataset.database[index].group == item.group)
        .collect();
    own.extend(positives);
    own.sort_unstable();
    own.dedup();
    own
}

/// Best answers with what is known about them, re-ranked and by distance alone.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct BestAnswers {
    /// After re-ranking.
    pub reranked: Vec<TopOne>,
    /// By global distance; of the same queries.
    pub global: Vec<TopOne>,
}

impl BestAnswers {
    /// Of the answers to `dataset` as they are, and of `left_out`: answers to the same queries when
    /// their own place was left out. Queries of unknown truth are passed over.
    pub fn of(dataset: &Dataset, answers: &[Answer], left_out: &[Answer]) -> Self {
        let places = places_of(dataset);
        let mut best = Self::default();
        let is_known = |answer: &&Answer| dataset.truth[answer.query] != Truth::Unknown;
        for answer in answers.iter().filter(is_known) {
            best.add(
                answer,
                places[answer.query],
                dataset.truth[answer.query].positives(),
            );
        }
        for answer in left_out.iter().filter(is_known) {
            best.add(answer, places[answer.query], &[]);
        }
        best
    }

    fn add(&mut self, answer: &Answer, place: usize, positives: &[usize]) {
        let judged = |index: usize, distance: f32, spatial_score: Option<f64>| TopOne {
            place,
            spatial_score,
            global_distance: f64::from(distance),
            correct: positives.binary_search(&index).is_ok(),
            has_match: !positives.is_empty(),
        };
        if let Some(best) = answer.global.first() {
            self.global.push(judged(best.index, best.distance, None));
        }
        if let Some(best) = answer.reranked.first() {
            let score = f64::from(best.score.spatial_score);
            self.reranked
                .push(judged(best.index, best.distance, Some(score)));
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
    /// S at which trust begins at the median distance of right answers, if S decides at all.
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
    pub rerank: RerankId,
    /// Name of the data.
    pub data: String,
    /// Share of right answers that the threshold is chosen for.
    pub target_precision: f64,
    /// Seed of the cross-validation.
    pub seed: u64,
}

/// Fits both curves.
pub fn calibrate(answers: &BestAnswers, purpose: Purpose) -> Result<Fitted, EvalError> {
    let Purpose {
        model,
        rerank,
        data,
        target_precision,
        seed,
    } = purpose;
    let one =
        |answers: &[TopOne]| measure::fit_curve(answers, target_precision, seed).map_err(unfit);
    let (reranked, global): (FittedCurve, FittedCurve) =
        (one(&answers.reranked)?, one(&answers.global)?);
    let shipped = [
        shipped_curve(&model, Some(&rerank)).map(|curve| Applied::of(&curve, &answers.reranked)),
        shipped_curve(&model, None).map(|curve| Applied::of(&curve, &answers.global)),
    ];
    let spatial_score = score_at_threshold(&reranked.curve, &answers.reranked);
    let (in_sample_errors, checks) = (
        [reranked.in_sample_error, global.in_sample_error],
        [reranked.check, global.check],
    );
    let calibration = Calibration::new(
        model,
        rerank,
        data,
        target_precision,
        [reranked.curve, global.curve],
    )
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
    /// The table a person reads.
    pub fn text(&self) -> String {
        let mut out = String::new();
        let calibration = &self.calibration;
        // Writing into a String cannot fail.
        let _ = writeln!(
            out,
            "calibration of {}\nre-ranked by {}",
            calibration.model(),
            calibration.rerank()
        );
        let _ = writeln!(
            out,
            "fitted on {}, for {:.1}% precision\n",
            calibration.data(),
            percent(calibration.target_precision())
        );
        let _ = writeln!(
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
        );
        let names = [("re-ranked", true), ("global", false)];
        for ((name, reranked), in_sample) in names.into_iter().zip(self.in_sample_errors) {
            let curve = calibration.curve(reranked);
            let _ = writeln!(
                out,
                "{name:<12}{:>7}{:>7}{:>10}{:>11.3}{:>10.1}%{:>7.1}%{:>14.3}{in_sample:>11.3}",
                curve.right,
                curve.wrong,
                curve.without_match,
                curve.threshold,
                percent(curve.precision),
                percent(curve.recall),
                curve.expected_calibration_error
            );
        }
        for ((name, _), check) in names.into_iter().zip(&self.checks) {
            let _ = writeln!(
                out,
                "{name}: on places that had no say in its threshold {} answers are trusted ({} places), precision 95% \
                 [{:.1}%, {:.1}%]",
                check.count,
                check.places,
                percent(check.interval[0]),
                percent(check.interval[1])
            );
        }
        for ((name, _), applied) in names.into_iter().zip(&self.shipped) {
            let Some(Applied {
                expected_calibration_error,
                trusted,
                ..
            }) = applied
            else {
                continue;
            };
            let _ = writeln!(
                out,
                "{name}, the model's own curve on the same answers: threshold {:.3}, precision {:.1}%, recall {:.1}%, \
                 ECE {expected_calibration_error:.3}",
                trusted.threshold,
                percent(trusted.precision),
                percent(trusted.recall)
            );
        }
        if let Some(score) = self.spatial_score {
            let _ = writeln!(
                out,
                "re-ranked answers at the usual distance are trusted from S = {score:.0} on"
            );
        }
        for (name, reranked) in names {
            if calibration.curve(reranked).threshold >= 1.0 {
                let _ = writeln!(
                    out,
                    "warning: {name}: no threshold reaches the precision asked for; nothing is trusted"
                );
            }
        }
        out
    }
}

fn percent(share: f64) -> f64 {
    share * 100.0
}

#[cfg(test)]
mod tests {
    use super::super::run::{Candidate, Neighbour};
    use super::*;
    use crate::datasets::Item;
    use placeformer_core::geography::MetricPoint;
    use placeformer_vision::rerank::PairScore;

    fn dataset(truth: Vec<Truth>, references: usize) -> Dataset {
        let items = |n: usize| (0..n).map(|i| Item::new(i.to_string(), "x")).collect();
        let queries = items(truth.len());
        let (skipped, notes) = (Vec::new(), Vec::new());
        Dataset {
            name: "d".into(),
            database: items(references),
            queries,
            truth,
            skipped,
            notes,
        }
    }

    /// Nearest first: 0, 1, 2, ...; re-ranked: last first.
    fn answer(query: usize, references: usize) -> Answer {
        let global: Vec<_> = (0..references)
            .map(|index| Neighbour {
                index,
                distance: index as f32 / 10.0,
            })
            .collect();
        let candidate = |one: &Neighbour| Candidate {
            index: one.index,
            distance: one.distance,
            score: PairScore {
                spatial_score: 10 * one.index as u32,
                combinations: Vec::new(),
            },
        };
        let reranked = global.iter().rev().map(candidate).collect();
        Answer {
            query,
            global,
            reranked,
        }
    }

    #[test]
    fn places_are_left_out_only_where_nothing_is_unknown() {
        let known = dataset(vec![Truth::Positives(vec![1])], 3);
        let mixed = dataset(vec![Truth::Positives(vec![1]), Truth::NoMatch], 3);
        assert_eq!(
            OwnPlaces::of(&known, LeaveOut::Auto, 25.0),
            Some(OwnPlaces(vec![vec![1]]))
        );
        assert_eq!(OwnPlaces::of(&known, LeaveOut::Never, 25.0), None);
        assert_eq!(OwnPlaces::of(&mixed, LeaveOut::Auto, 25.0), None);
        assert_eq!(
            OwnPlaces::of(&mixed, LeaveOut::Always, 25.0),
            Some(OwnPlaces(vec![vec![1], vec![]]))
        );
    }

    #[test]
    fn a_place_reaches_beyond_the_radius_but_not_into_another_city() {
        let mut set = dataset(vec![Truth::Positives(vec![0])], 4);
        let at = |east| Some(MetricPoint { east, north: 0.0 });
        for (index, east) in [10.0, 90.0, 110.0, 20.0].into_iter().enumerate() {
            set.database[index].position = at(east);
        }
        set.queries[0].position = at(0.0);
        set.database[3].group = Some("elsewhere".into());
        assert_eq!(
            OwnPlaces::of(&set, LeaveOut::Auto, 25.0),
            Some(OwnPlaces(vec![vec![0, 1]]))
        );
    }

    #[test]
    fn a_widened_answer_parts_into_what_two_searches_would_have_found() {
        let set = dataset(vec![Truth::Positives(vec![0, 3])], 6);
        let own = OwnPlaces::of(&set, LeaveOut::Auto, 25.0).unwrap();
        assert_eq!(own.widened(0, 2), 4);
        let mut wide = answer(0, 4);
        own.trim(&mut wide, 2);
        let kept: Vec<usize> = wide.global_ranking();
        assert_eq!(kept, [0, 1, 2]);
        let (with, without) = own.part(&answer(0, 4), 2);
        assert_eq!(
            (with.global_ranking(), with.reranked_ranking()),
            (vec![0, 1], vec![1, 0])
        );
        assert_eq!(
            (without.global_ranking(), without.reranked_ranking()),
            (vec![1, 2], vec![2, 1])
        );
        let (as_it_is, left_out) = own.part_all(&set, &[answer(0, 4)], 2);
        let best = BestAnswers::of(&set, &as_it_is, &left_out);
        let seen = |one: &TopOne| (one.spatial_score, one.correct, one.has_match);
        assert_eq!(
            best.global.iter().map(seen).collect::<Vec<_>>(),
            [(None, true, true), (None, false, false)]
        );
        let reranked: Vec<_> = best.reranked.iter().map(seen).collect();
        assert_eq!(
            reranked,
            [(Some(10.0), false, true), (Some(20.0), false, false)]
        );
    }

    #[test]
    fn both_curves_are_fitted_and_the_table_names_them() {
        let one = |query: usize, spatial_score: Option<f64>| {
            let has_match = query.is_multiple_of(2);
            let noise = query as f64 / 200.0;
            let global_distance = if has_match { 0.4 } else { 0.8 } + noise;
            let spatial_score =
                spatial_score.map(|score| if has_match { 80.0 + score } else { score });
            TopOne {
                place: query,
                spatial_score,
                global_distance,
                correct: has_match && query != 4,
                has_match,
            }
        };
        let answers = BestAnswers {
            reranked: (0..60)
                .map(|query| one(query, Some(query as f64)))
                .collect(),
            global: (0..60).map(|query| one(query, None)).collect(),
        };
        let purpose = Purpose {
            model: ModelId::new("m"),
            rerank: RerankId::new("r"),
            data: "made up".into(),
            target_precision: 0.9,
            seed: 1,
        };
        let fitted = calibrate(&answers, purpose.clone()).unwrap();
        let curve = fitted.calibration.curve(true);
        assert_eq!(
            (curve.right, curve.wrong, curve.without_match),
            (29, 31, 30)
        );
        assert!(curve.precision >= 0.85 && curve.recall > 0.8, "{curve:?}");
        assert!(
            curve.weights.confidence(Some(100.0), 0.5) > 0.8
                && curve.weights.confidence(Some(5.0), 0.9) < 0.2
        );
        assert_eq!(fitted.shipped, [None, None]);
        let text = fitted.text();
        assert!(
            text.contains("re-ranked") && text.contains("global") && text.contains("made up"),
            "{text}"
        );
        assert!(
            text.contains("no say in its threshold") && text.contains("places), precision 95%"),
            "{text}"
        );
        let json = serde_json::to_string(&fitted.calibration).unwrap();
        assert_eq!(
            serde_json::from_str::<Calibration>(&json).unwrap(),
            fitted.calibration
        );
        let only_right = BestAnswers {
            reranked: answers.reranked[..1].to_vec(),
            ..answers
        };
        assert!(
            calibrate(&only_right, purpose)
                .unwrap_err()
                .to_string()
                .contains("--leave-out")
        );
    }
}
