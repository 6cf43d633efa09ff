//! A quarter of the ground on one side of a data set, to be held out.
//!
//! What is fitted on some places is judged on others. A quarter at one side of the ground has a
//! border with the rest in one direction only, and is easily named.

use super::dataset::Dataset;
use crate::choice::Choice;
use placeformer_core::geography::MetricPoint;

/// Which quarter.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Quarter {
    /// The easternmost quarter of the queries.
    East,
    /// The westernmost.
    West,
    /// The northernmost.
    North,
    /// The southernmost.
    South,
}

impl Choice for Quarter {
    const ALL: &'static [Self] = &[Self::East, Self::West, Self::North, Self::South];

    fn as_str(self) -> &'static str {
        match self {
            Self::East => "east-quarter",
            Self::West => "west-quarter",
            Self::North => "north-quarter",
            Self::South => "south-quarter",
        }
    }

    fn description(self) -> &'static str {
        match self {
            Self::East => "The easternmost quarter of the queries",
            Self::West => "The westernmost quarter of the queries",
            Self::North => "The northernmost quarter of the queries",
            Self::South => "The southernmost quarter of the queries",
        }
    }
}

/// The queries of a data set in two parts, ascending.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Parted {
    /// Those to fit on.
    pub rest: Vec<usize>,
    /// Those held out.
    pub held_out: Vec<usize>,
}

impl Quarter {
    /// Parts the queries of `dataset`. Those nearer than `gap_m` metres to the border are in
    /// neither part if they belong to the rest, and so are those without a position. `None` if a
    /// part has no query.
    pub fn part(self, dataset: &Dataset, gap_m: f64) -> Option<Parted> {
        let queries = dataset.queries.iter().enumerate();
        let depths: Vec<(usize, f64)> = queries
            .filter_map(|(query, item)| Some((query, self.depth(item.position?))))
            .collect();
        let mut sorted: Vec<f64> = depths.iter().map(|&(_, depth)| depth).collect();
        sorted.sort_unstable_by(f64::total_cmp);
        let border = *sorted.get(sorted.len() * 3 / 4)?;
        let those = |wanted: &dyn Fn(f64) -> bool| {
            let wanted = depths.iter().filter(|&&(_, depth)| wanted(depth));
            wanted.map(|&(query, _)| query).collect::<Vec<usize>>()
        };
        let parted = Parted {
            rest: those(&|depth| depth < border - gap_m),
            held_out: those(&|depth| depth >= border),
        };
        let is_whole = !parted.rest.is_empty() && !parted.held_out.is_empty();
        is_whole.then_some(parted)
    }

    /// Metres in the direction of the quarter.
    fn depth(self, position: MetricPoint) -> f64 {
        match self {
            Self::East => position.east,
            Self::West => -position.east,
            Self::North => position.north,
            Self::South => -position.north,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::dataset::{Item, Truth};
    use super::*;

    /// Eight queries on a diagonal, 10 m apart in both directions, and one without a position.
    fn dataset() -> Dataset {
        let query = |i: usize| {
            let mut item = Item::new(i.to_string(), "x");
            let along = i as f64 * 10.0;
            item.position = (i < 8).then_some(MetricPoint {
                east: along,
                north: -along,
            });
            item
        };
        Dataset {
            name: "d".into(),
            database: Vec::new(),
            queries: (0..9).map(query).collect(),
            truth: vec![Truth::NoMatch; 9],
            skipped: Vec::new(),
            notes: Vec::new(),
        }
    }

    #[test]
    fn a_quarter_lies_on_its_side_behind_a_gap() {
        for (quarter, held_out, rest) in [
            (Quarter::East, vec![6, 7], vec![0, 1, 2, 3, 4]),
            (Quarter::South, vec![6, 7], vec![0, 1, 2, 3, 4]),
            (Quarter::West, vec![0, 1], vec![3, 4, 5, 6, 7]),
            (Quarter::North, vec![0, 1], vec![3, 4, 5, 6, 7]),
        ] {
            let parted = quarter.part(&dataset(), 15.0).unwrap();
            assert_eq!(parted, Parted { rest, held_out }, "{quarter:?}");
        }
    }

    #[test]
    fn without_positions_or_beyond_the_gap_nothing_is_parted() {
        let mut without = dataset();
        without
            .queries
            .iter_mut()
            .for_each(|item| item.position = None);
        assert_eq!(Quarter::East.part(&without, 0.0), None);
        assert_eq!(Quarter::East.part(&dataset(), 1e3), None);
    }
}
