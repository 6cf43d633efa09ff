//! One frame after the other, as the service does it.

use super::layout::{Layout, by_name};
use super::{SequenceRun, measures};
use crate::datasets::Truth;
use crate::eval::error::EvalError;
use crate::eval::run::Answer;
use placeformer_core::types::ScoreKind;
use placeformer_track::{
    Belief, Estimate, Evidence, Expectation, MOST_PLACES, Motion, Place, Sight, Travel,
    Whereabouts, estimate,
};
use placeformer_vision::rerank::PairScore;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::collections::HashMap;
use std::time::{Duration, Instant};

/// What is added to the error of odometry in metres.
const ODOMETRY_FLOOR_M: f64 = 1.0;

/// What came of one frame.
#[derive(Debug, Clone)]
pub(super) struct Frame {
    /// Database indices, best first.
    pub(super) ranking: Vec<usize>,
    /// Right answers, ascending.
    pub(super) positives: Vec<usize>,
    /// Whether it is known what is right.
    pub(super) is_judged: bool,
    /// Probability that the first is right.
    pub(super) probability: f64,
    /// Whether the vehicle is thought to be at no known place.
    pub(super) is_lost: bool,
    /// Accuracy and error in metres of the estimated position, where positions are known.
    pub(super) estimated: Option<Estimated>,
    /// Error in metres of the first answer's position, where positions are known.
    pub(super) error_of_best_m: Option<f64>,
    /// Time that the filter took.
    pub(super) step: Duration,
}

/// An estimated position.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Estimated {
    /// What the estimate says, in metres.
    pub(super) accuracy_m: f64,
    /// How far it is from the truth.
    pub(super) error_m: f64,
}

impl Frame {
    /// Whether the first answer is right.
    pub(super) fn is_right(&self) -> bool {
        let best = self.ranking.first();
        best.is_some_and(|best| self.positives.binary_search(best).is_ok())
    }
}

/// What a photo says about one reference.
#[derive(Debug, Clone, Copy)]
struct Scored {
    index: usize,
    /// What its S counts for in a calibration; absent where nothing was re-ranked.
    evidence: Option<f64>,
    distance: f64,
}

/// A data set to be driven through.
pub(super) struct Drive<'a> {
    run: &'a SequenceRun<'a>,
    layout: &'a Layout,
    evidence: Evidence<'a>,
    answers: HashMap<usize, &'a Answer>,
}

impl<'a> Drive<'a> {
    pub(super) fn new(run: &'a SequenceRun<'a>, layout: &'a Layout) -> Self {
        let answers = run.answers.answers.iter();
        Self {
            run,
            layout,
            evidence: Evidence::new(run.curve),
            answers: answers.map(|answer| (answer.query, answer)).collect(),
        }
    }

    /// The queries that have an answer, in the order of their names.
    pub(super) fn order(&self) -> Vec<usize> {
        let mut order = by_name(&self.run.dataset.queries);
        order.retain(|query| self.answers.contains_key(query));
        order
    }

    /// Every frame by itself: the best answer with its confidence.
    pub(super) fn alone(&self, order: &[usize]) -> Vec<Frame> {
        order.iter().map(|&query| self.alone_frame(query)).collect()
    }

    fn alone_frame(&self, query: usize) -> Frame {
        let scored = self.scored(query);
        let weights = &self.run.curve.weights;
        let best = scored.first();
        let confidence = best.map_or(0.0, |best| weights.confidence(best.evidence, best.distance));
        let ranking = scored.iter().map(|scored| scored.index).collect();
        self.frame(query, ranking, confidence)
    }

    fn frame(&self, query: usize, ranking: Vec<usize>, probability: f64) -> Frame {
        let truth = &self.run.dataset.truth[query];
        let best = ranking.first();
        Frame {
            error_of_best_m: best.and_then(|&best| self.layout.error_m(query, best)),
            ranking,
            positives: truth.positives().to_vec(),
            is_judged: *truth != Truth::Unknown,
            probability,
            is_lost: false,
            estimated: None,
            step: Duration::ZERO,
        }
    }

    /// The candidates of a query with their scores, best first.
    fn scored(&self, query: usize) -> Vec<Scored> {
        let Some(answer) = self.answers.get(&query) else {
            return Vec::new();
        };
        if answer.reranked.is_empty() {
            let by_distance = answer.global.iter().map(|neighbour| Scored {
                index: neighbour.index,
                evidence: None,
                distance: f64::from(neighbour.distance),
            });
            return by_distance.collect();
        }
        let by_score = answer.reranked.iter().map(|candidate| Scored {
            index: candidate.index,
            evidence: Some(evidence(&candidate.score)),
            distance: f64::from(candidate.distance),
        });
        by_score.collect()
    }

    /// Follows the queries in this order as one track.
    pub(super) fn follow(&self, order: &[usize]) -> Result<Vec<Frame>, EvalError> {
        let mut odometry = Odometry::new(self.run, self.layout);
        let mut frames = Vec::with_capacity(order.len());
        let mut known: Option<(usize, Belief)> = None;
        for &query in order {
            let previous = known.as_ref().map(|(before, belief)| (belief, *before));
            let motion = match previous {
                Some((_, before)) => odometry.motion(before, query)?,
                None => Motion::STILL,
            };
            let belief = previous.map(|(belief, _)| belief);
            let (frame, belief) = self.step(query, belief, &motion)?;
            frames.push(frame);
            known = Some((query, belief));
        }
        Ok(frames)
    }

    /// One frame, and what is believed after it.
    fn step(
        &self,
        query: usize,
        belief: Option<&Belief>,
        motion: &Motion,
    ) -> Result<(Frame, Belief), EvalError> {
        let mut scored = self.scored(query);
        let began = Instant::now();
        let candidates: Vec<usize> = scored.iter().map(|scored| scored.index).collect();
        let found = self.named(candidates.iter().copied());
        let expected = match belief {
            None => Expectation::at_the_start(found, self.evidence.prior()),
            Some(belief) => {
                let in_reach = self.named(self.in_reach(belief, motion).into_iter());
                Expectation::after(belief, motion, found, in_reach)
            }
        };
        let supported = expected.supported(&candidates);
        let mut took = began.elapsed();
        scored.extend(self.score(query, &supported)?);

        let began = Instant::now();
        let ratio = |scored: &Scored| {
            let ratio = self.evidence.log_ratio(scored.evidence, scored.distance);
            (scored.index, ratio)
        };
        let whereabouts = expected.weigh(scored.iter().map(ratio));
        let density = |scored: &Scored| whereabouts.density(scored.index).unwrap_or(0.0);
        scored.sort_by(|a, b| density(b).total_cmp(&density(a)));
        let likeliest = whereabouts.likeliest(MOST_PLACES);
        let kept: f64 = likeliest.iter().map(|(_, probability)| probability).sum();
        took += began.elapsed();

        let places = self.layout.places();
        let believed = likeliest.iter().map(|&(index, p)| (places[index], p));
        let belief = Belief::new(believed.collect(), (1.0 - kept).max(0.0));
        let ranking: Vec<usize> = scored.iter().map(|scored| scored.index).collect();
        let probability = whereabouts.probability(ranking.first().copied());
        let frame = Frame {
            is_lost: whereabouts.is_lost(),
            estimated: self.estimated(query, &whereabouts, ranking.first().copied()),
            step: took,
            ..self.frame(query, ranking, probability)
        };
        Ok((frame, belief))
    }

    fn named(&self, references: impl Iterator<Item = usize>) -> Vec<(usize, Place)> {
        let places = self.layout.places();
        references.map(|index| (index, places[index])).collect()
    }

    fn in_reach(&self, belief: &Belief, motion: &Motion) -> Vec<usize> {
        let reach_m = motion.reach_m();
        let places = self.layout.places();
        let is_near = |place: &Place| {
            let mut believed = belief.places().iter();
            believed.any(|(from, _)| from.point.distance_m(place.point) <= reach_m)
        };
        (0..places.len())
            .filter(|&index| is_near(&places[index]))
            .collect()
    }

    /// Scores the references that only the track leads to.
    fn score(&self, query: usize, references: &[usize]) -> Result<Vec<Scored>, EvalError> {
        let described = self.run.described;
        let candidates = described.compare(query, references, self.run.rerank)?;
        let scored = candidates
            .into_iter()
            .map(|(index, distance, score)| Scored {
                index,
                evidence: score.as_ref().map(evidence),
                distance: f64::from(distance),
            });
        Ok(scored.collect())
    }

    fn estimated(
        &self,
        query: usize,
        whereabouts: &Whereabouts<usize>,
        best: Option<usize>,
    ) -> Option<Estimated> {
        let origin = self.layout.query(query)?;
        let sight = |(index, weight): (usize, f64)| {
            Some(Sight {
                point: self.layout.on_earth(index, origin)?,
                heading: self.layout.heading(index),
                alt: None,
                weight,
            })
        };
        let sights: Vec<Sight> = whereabouts.probabilities().filter_map(sight).collect();
        let best = self.layout.on_earth(best?, origin)?;
        let found: Estimate = estimate(best, &sights)?;
        Some(Estimated {
            accuracy_m: found.accuracy_m,
            error_m: measures::from_origin_m(found.point),
        })
    }
}

/// What the vehicle knows of its way.
struct Odometry<'a> {
    run: &'a SequenceRun<'a>,
    layout: &'a Layout,
    random: ChaCha8Rng,
}

impl<'a> Odometry<'a> {
    fn new(run: &'a SequenceRun<'a>, layout: &'a Layout) -> Self {
        Self {
            run,
            layout,
            random: ChaCha8Rng::seed_from_u64(run.options.seed),
        }
    }

    fn motion(&mut self, from: usize, to: usize) -> Result<Motion, EvalError> {
        let options = &self.run.options;
        let way_m = self.layout.way_m(from, to);
        let travel = match (options.odometry_error, way_m) {
            (Some(error), Some(way_m)) => {
                // The sum of twelve uniform numbers is close to normal.
                let normal: f64 = (0..12).map(|_| self.random.random_range(-0.5..0.5)).sum();
                Travel::Measured {
                    distance_m: (way_m * (1.0 + error * normal)).max(0.0),
                    sigma_m: error * way_m + ODOMETRY_FLOOR_M,
                }
            }
            _ => Travel::Within {
                reach_m: options.frame_seconds * options.max_speed_mps,
            },
        };
        Motion::new(travel, None).map_err(|error| EvalError::Setting(error.to_string()))
    }
}

/// What the S of a pair counts for in a calibration.
fn evidence(score: &PairScore) -> f64 {
    ScoreKind::Paper.evidence(f64::from(score.spatial_score))
}
