//! A query's own place, which is left out of the database to make the query one without a match.
//!
//! Left out are its positives and, where positions are known, everything within [`MARGIN`] times
//! the radius, because a photo just beyond the radius still shows the same street.
//!
//! Asking everything twice would re-rank nearly the same candidates twice. Instead a query is asked
//! once, for as many candidates as both answers need (a widened answer), which is then parted into
//! the two.

use super::run::Answer;
use crate::choice::Choice;
use crate::datasets::{Dataset, NeighbourGrid, Truth};

/// Radii around a query that belong to its place.
pub const MARGIN: f64 = 4.0;

/// When a query's own place is left out of the database.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LeaveOut {
    /// Where the ground truth names no query without a match.
    Auto,
    /// Always, beside the queries that have no match anyway.
    Always,
    /// Never: queries without a match must come from the ground truth.
    Never,
}

impl Choice for LeaveOut {
    const ALL: &'static [Self] = &[Self::Auto, Self::Always, Self::Never];

    fn as_str(self) -> &'static str {
        match self {
            Self::Auto => "auto",
            Self::Always => "always",
            Self::Never => "never",
        }
    }

    fn description(self) -> &'static str {
        match self {
            Self::Auto => "Where the ground truth names no query without a match",
            Self::Always => "Always, beside the queries that have no match anyway",
            Self::Never => "Never: queries without a match must come from the ground truth",
        }
    }
}

/// For every query the database images that show its place, ascending.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct OwnPlaces(pub(super) Vec<Vec<usize>>);

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
        if !wanted {
            return None;
        }
        let database = dataset.database.iter().enumerate();
        let located = database.filter_map(|(index, item)| Some((index, item.position?)));
        let grid = NeighbourGrid::new(radius_m * MARGIN, located);
        let places = (0..dataset.queries.len()).map(|query| own_place(dataset, &grid, query));
        Some(Self(places.collect()))
    }

    /// Parts widened answers to `dataset`: all as they would have been, and those whose place was
    /// left out.
    pub fn part_all(
        &self,
        dataset: &Dataset,
        answers: &[Answer],
        candidates: usize,
    ) -> (Vec<Answer>, Vec<Answer>) {
        let mut as_they_are = Vec::new();
        let mut left_out = Vec::new();
        for answer in answers {
            let (with, without) = self.part(answer, candidates);
            as_they_are.push(with);
            if !dataset.truth[answer.query].positives().is_empty() {
                left_out.push(without);
            }
        }
        (as_they_are, left_out)
    }

    pub(super) fn of_query(&self, query: usize) -> &[usize] {
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
        let with_place = half(&|_| true);
        let without_place = half(&|index| own.binary_search(&index).is_err());
        (with_place, without_place)
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
