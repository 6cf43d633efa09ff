//! From the answers to a data set to a [`LearnedScore`]: what tells the right candidates from the
//! wrong ones.
//!
//! Every answer gives examples: its right candidates, and of the wrong ones those that a ranking
//! by S or by global distance would put first, because the others are told apart by anything.
//! Photos that show the query's own street from too far away or in another direction are neither
//! right nor wrong, and left out. Answers with the query's own place left out of the database give
//! wrong ones only.

use super::answers::DatasetAnswers;
use super::error::EvalError;
use super::measure::{FOLDS, LabelledRows, folds_of, logistic_regression};
use super::own_places::{LeaveOut, OwnPlaces};
use super::places::places_of;
use super::run::{Answer, Candidate};
use crate::datasets::{Dataset, Truth};
use placeformer_core::types::{InvalidValue, LearnedScore, ScaleSet, ScoreTerm};
use placeformer_vision::rerank::{Evidence, Ranking, feature_names, feature_vectors};

/// Wrong candidates of an answer that are learned from: so many by each of the two rankings.
const HARDEST: usize = 25;

/// The penalty on squared weights. Among tens of thousands of examples it decides nothing but
/// between features that say the same.
const RIDGE: f64 = 10.0;

/// Examples of one answer.
struct Lesson {
    query: usize,
    /// `[n, features]`.
    features: Vec<f64>,
    /// `[n]`.
    right: Vec<bool>,
}

/// What a score is learned from.
pub struct Lessons {
    names: Vec<String>,
    lessons: Vec<Lesson>,
}

impl Lessons {
    /// The examples in answers to `dataset` whose positives lie within `radius_m`, re-ranked over
    /// these combinations of scales.
    pub fn of(
        dataset: &Dataset,
        asked: &DatasetAnswers,
        scales: &[ScaleSet],
        radius_m: f64,
    ) -> Self {
        let own = OwnPlaces::of(dataset, LeaveOut::Always, radius_m);
        let mut lessons = Vec::new();
        for answer in &asked.answers {
            if let Truth::Unknown = dataset.truth[answer.query] {
                continue;
            }
            let positives = dataset.truth[answer.query].positives();
            let around = own
                .as_ref()
                .map_or(&[][..], |own| own.of_query(answer.query));
            lessons.push(lesson(answer, positives, around));
        }
        for answer in &asked.left_out {
            lessons.push(lesson(answer, &[], &[]));
        }
        Self {
            names: feature_names(scales),
            lessons,
        }
    }

    /// Learns from the answers to the queries that `is_wanted` lets through.
    ///
    /// # Errors
    /// [`EvalError::OneSided`] if no candidate is right, or none is wrong.
    pub fn learn(&self, is_wanted: impl Fn(usize) -> bool) -> Result<LearnedScore, EvalError> {
        let mut rows = LabelledRows {
            width: self.names.len(),
            ..Default::default()
        };
        for lesson in self.lessons.iter().filter(|it| is_wanted(it.query)) {
            rows.features.extend(&lesson.features);
            rows.right.extend(&lesson.right);
        }
        let right = rows.right.iter().filter(|&&right| right).count();
        if right == 0 || right == rows.right.len() {
            let total = rows.right.len();
            return Err(EvalError::OneSided { right, total });
        }
        let moments = rows.moments();
        for row in rows.features.chunks_exact_mut(rows.width) {
            for (value, (mean, deviation)) in row.iter_mut().zip(&moments) {
                *value = (*value - mean) / deviation;
            }
        }
        let (bias, weights) = logistic_regression(&rows, RIDGE);
        let terms = self.names.iter().zip(moments).zip(weights);
        let term = |((name, (mean, deviation)), weight): ((&String, (f64, f64)), f64)| ScoreTerm {
            feature: name.clone(),
            mean: rounded(mean),
            deviation: rounded(deviation),
            weight: rounded(weight),
        };
        LearnedScore::new(rounded(bias), terms.map(term).collect()).map_err(unusable)
    }
}

fn unusable(error: InvalidValue) -> EvalError {
    EvalError::Setting(format!("what was learned cannot be used: {error}"))
}

/// To seven digits, so that a file shows what is meant.
fn rounded(value: f64) -> f64 {
    // What `format!` writes, `parse` reads.
    format!("{value:.6e}").parse().unwrap_or(value)
}

/// The examples of an answer. `around` are the references around the query, ascending.
fn lesson(answer: &Answer, positives: &[usize], around: &[usize]) -> Lesson {
    let is_right = |index: usize| positives.binary_search(&index).is_ok();
    let is_wrong = |index: usize| around.binary_search(&index).is_err() && !is_right(index);
    let candidates: Vec<Evidence<'_>> = answer.reranked.iter().map(evidence).collect();
    let vectors = feature_vectors(&candidates);
    let nearest = answer.global.iter().map(|neighbour| neighbour.index);
    let mut hardest: Vec<usize> = nearest.filter(|&it| is_wrong(it)).take(HARDEST).collect();
    let first = answer.reranked.iter().map(|candidate| candidate.index);
    hardest.extend(first.filter(|&it| is_wrong(it)).take(HARDEST));
    let mut lesson = Lesson {
        query: answer.query,
        features: Vec::new(),
        right: Vec::new(),
    };
    for (candidate, vector) in answer.reranked.iter().zip(vectors) {
        let right = is_right(candidate.index);
        if right || hardest.contains(&candidate.index) {
            lesson.features.extend(vector);
            lesson.right.push(right);
        }
    }
    lesson
}

fn evidence(candidate: &Candidate) -> Evidence<'_> {
    Evidence {
        score: &candidate.score,
        distance: candidate.distance,
    }
}

/// Orders every answer by a score that was learned from the answers to other places, so that the
/// order says what the score is worth elsewhere.
///
/// # Errors
/// [`EvalError::OneSided`] if the other places of some answer have no right candidate, or no wrong
/// one.
pub fn order_unseen(
    dataset: &Dataset,
    asked: &mut DatasetAnswers,
    lessons: &Lessons,
    seed: u64,
) -> Result<(), EvalError> {
    let places = places_of(dataset);
    let is_right = |query: usize| !dataset.truth[query].positives().is_empty();
    let asked_for: Vec<(usize, bool)> = (0..dataset.queries.len())
        .map(|query| (places[query], is_right(query)))
        .collect();
    let fold_of = folds_of(&asked_for, FOLDS, seed);
    for fold in 0..FOLDS {
        let answers = asked.answers.iter_mut().chain(&mut asked.left_out);
        let own: Vec<&mut Answer> = answers.filter(|it| fold_of[it.query] == fold).collect();
        if own.is_empty() {
            continue;
        }
        let score = lessons.learn(|query| fold_of[query] != fold)?;
        for answer in own {
            answer.order_by(&Ranking::Learned(&score));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::super::run::Neighbour;
    use super::*;
    use crate::datasets::Item;
    use placeformer_vision::rerank::{
        CombinationFeatures, CombinationScore, PairFeatures, PairScore,
    };

    /// Ten queries; of each the reference with its own number is the place. It has the second most
    /// inliers, but the largest cosine; all are equally near.
    fn asked() -> (Dataset, DatasetAnswers) {
        let items = |n: usize| (0..n).map(|i| Item::new(i.to_string(), "x")).collect();
        let dataset = Dataset {
            name: "d".into(),
            database: items(10),
            queries: items(10),
            truth: (0..10).map(|i| Truth::Positives(vec![i])).collect(),
            skipped: Vec::new(),
            notes: Vec::new(),
        };
        let answers = (0..10).map(answer).collect();
        let asked = DatasetAnswers {
            answers,
            ..Default::default()
        };
        (dataset, asked)
    }

    fn answer(query: usize) -> Answer {
        let neighbour = |index| Neighbour {
            index,
            distance: 0.5,
        };
        let global: Vec<Neighbour> = (0..10).map(neighbour).collect();
        let candidate = |&neighbour: &Neighbour| {
            let is_place = neighbour.index == query;
            let louder = neighbour.index == (query + 3) % 10;
            let inliers = if louder { 50 } else { 30 } + (neighbour.index % 3) as u32;
            let score = PairScore {
                spatial_score: inliers,
                combinations: vec![CombinationScore {
                    scales: ScaleSet::new(&[1]).unwrap(),
                    matches: 100,
                    inliers,
                }],
                features: PairFeatures {
                    combinations: vec![CombinationFeatures {
                        match_cosine: if is_place { 0.8 } else { 0.6 },
                        homography: None,
                    }],
                },
            };
            Candidate::by_inliers(neighbour, score)
        };
        let mut answer = Answer {
            query,
            reranked: global.iter().map(candidate).collect(),
            global,
        };
        answer.order_by(&Ranking::Paper);
        answer
    }

    fn right(dataset: &Dataset, asked: &DatasetAnswers) -> usize {
        let is_right = |answer: &&Answer| {
            let best = answer.reranked[0].index;
            dataset.truth[answer.query].positives().contains(&best)
        };
        asked.answers.iter().filter(is_right).count()
    }

    #[test]
    fn what_inliers_do_not_tell_is_learned_from_other_places() {
        let (dataset, mut asked) = asked();
        assert_eq!(right(&dataset, &asked), 0);
        let scales = [ScaleSet::new(&[1]).unwrap()];
        let lessons = Lessons::of(&dataset, &asked, &scales, 25.0);
        order_unseen(&dataset, &mut asked, &lessons, 1).unwrap();
        assert_eq!(right(&dataset, &asked), 10);
        let best = &asked.answers[0].reranked[0];
        assert!(best.value > asked.answers[0].reranked[1].value);
    }

    #[test]
    fn the_same_answers_give_the_same_score_and_nothing_to_tell_apart_none() {
        let (dataset, asked) = asked();
        let scales = [ScaleSet::new(&[1]).unwrap()];
        let lessons = Lessons::of(&dataset, &asked, &scales, 25.0);
        let score = lessons.learn(|_| true).unwrap();
        assert_eq!(lessons.learn(|_| true).unwrap(), score);
        score.check_features(&feature_names(&scales)).unwrap();
        let text = serde_json::to_string(&score).unwrap();
        assert_eq!(serde_json::from_str::<LearnedScore>(&text).unwrap(), score);
        assert!(lessons.learn(|_| false).is_err());
    }
}
