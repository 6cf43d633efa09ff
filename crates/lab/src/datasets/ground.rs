//! Parts of a data set that share no place: whole blocks of ground, and nothing in between.
//!
//! Split by image, a place would be learnt from one photo and recognised in the next. So the ground
//! is cut into square blocks, whole blocks are drawn, and what lies near the border between two
//! parts is given to neither.
//!
//! [`GroundPart`] is the one split that training and evaluation share by name: what is learnt from,
//! what decides which weights are kept, and what neither has seen, so that recall on it can be
//! reported.

use super::dataset::{Dataset, Item, Truth};
use super::error::DatasetError;
use super::neighbours::NeighbourGrid;
use crate::choice::Choice;
use placeformer_core::geography::MetricPoint;
use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use std::collections::{BTreeMap, BTreeSet};

/// How blocks of ground are drawn.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GroundSplit {
    /// Share of the images in the drawn blocks, between 0 and 1.
    pub share: f64,
    /// Side of a block in metres.
    pub block_m: f64,
    /// Images outside of the drawn blocks that are nearer than this to one inside, in metres, are
    /// left out.
    pub gap_m: f64,
    /// Decides which blocks are drawn.
    pub seed: u64,
}

/// A block: its group (a city) and its column and row.
type Block<'a> = (Option<&'a str>, i64, i64);

impl GroundSplit {
    /// What lies outside of the drawn blocks, and what lies inside. Images without a position are
    /// in neither, and of a query's positives only those in its part are known.
    ///
    /// # Errors
    /// A setting is out of range, no image has a position, or all lie in one block.
    pub fn split(&self, dataset: &Dataset) -> Result<(Dataset, Dataset), DatasetError> {
        self.check()?;
        let mut blocks: BTreeMap<Block<'_>, usize> = BTreeMap::new();
        for item in dataset.database.iter().chain(&dataset.queries) {
            if let Some(block) = self.block(item) {
                *blocks.entry(block).or_default() += 1;
            }
        }
        let too_few = match blocks.len() {
            0 => Some("no image has a position".to_owned()),
            1 => Some(format!(
                "all images lie in one block of {} m, so no place can be held out",
                self.block_m
            )),
            _ => None,
        };
        if let Some(reason) = too_few {
            let name = &dataset.name;
            return Err(DatasetError::Setting(format!("{name}: {reason}")));
        }

        let drawn = self.draw(&blocks);
        let is_inside = |item: &Item| self.block(item).is_some_and(|block| drawn.contains(&block));
        let inside = subset(dataset, is_inside);
        let both_sides = inside.database.iter().chain(&inside.queries);
        let taken: Vec<(&Item, MetricPoint)> = both_sides
            .filter_map(|item| Some((item, item.position?)))
            .collect();
        let points = taken.iter().map(|item| item.1);
        let grid = NeighbourGrid::new(self.gap_m.max(1e-3), points.enumerate());
        let is_apart = |item: &Item| match item.position {
            Some(point) => grid
                .within(point)
                .all(|near| taken[near].0.group != item.group),
            None => false,
        };
        let outside = subset(dataset, is_apart);
        Ok((outside, inside))
    }

    fn check(&self) -> Result<(), DatasetError> {
        if !(self.share > 0.0 && self.share < 1.0) {
            return Err(DatasetError::Setting(format!(
                "the share of places held out must lie between 0 and 1, and is {}",
                self.share
            )));
        }
        if !(self.block_m > 0.0 && self.block_m.is_finite() && self.gap_m >= 0.0) {
            return Err(DatasetError::Setting(format!(
                "blocks of {} metres cannot be held out",
                self.block_m
            )));
        }
        Ok(())
    }

    fn block<'a>(&self, item: &'a Item) -> Option<Block<'a>> {
        let point = item.position?;
        let along = |metres: f64| (metres / self.block_m).floor() as i64;
        Some((item.group.as_deref(), along(point.east), along(point.north)))
    }

    /// Blocks in a random order until they hold the share of the images; never all of them.
    fn draw<'a>(&self, blocks: &BTreeMap<Block<'a>, usize>) -> BTreeSet<Block<'a>> {
        let mut order: Vec<(Block<'a>, usize)> = blocks
            .iter()
            .map(|(&block, &images)| (block, images))
            .collect();
        order.shuffle(&mut ChaCha8Rng::seed_from_u64(self.seed));
        let wanted = self.share * order.iter().map(|block| block.1).sum::<usize>() as f64;
        order.pop();
        let mut images = 0;
        let until_enough = |block: &(Block<'a>, usize)| {
            let more = (images as f64) < wanted;
            images += block.1;
            more
        };
        let drawn = order.into_iter().take_while(until_enough);
        drawn.map(|(block, _)| block).collect()
    }
}

/// The images of `dataset` that `keep` keeps. A query whose positives are all gone is unknown: its
/// place is elsewhere, but it is not a place that nothing shows.
fn subset(dataset: &Dataset, keep: impl Fn(&Item) -> bool) -> Dataset {
    let mut new_index = vec![None; dataset.database.len()];
    let mut database = Vec::new();
    for (item, new_index) in dataset.database.iter().zip(&mut new_index) {
        if keep(item) {
            *new_index = Some(database.len());
            database.push(item.clone());
        }
    }
    let truth_in_part = |truth: &Truth| match truth {
        Truth::Positives(positives) => {
            let kept = positives.iter().filter_map(|&index| new_index[index]);
            match kept.collect::<Vec<usize>>() {
                kept if kept.is_empty() => Truth::Unknown,
                kept => Truth::from_positives(kept),
            }
        }
        other => other.clone(),
    };
    let sides = dataset.queries.iter().zip(&dataset.truth);
    let (queries, truth) = sides
        .filter(|(item, _)| keep(item))
        .map(|(item, truth)| (item.clone(), truth_in_part(truth)))
        .unzip();
    Dataset {
        name: dataset.name.clone(),
        database,
        queries,
        truth,
        skipped: vec![],
        notes: vec![],
    }
}

/// A part of the one split that training and evaluation share.
///
/// Blocks of 500 m are drawn: first a quarter of the images to report on, then a fifth of the rest
/// to select by. Between two parts lie 50 m, twice the distance up to which two images count as one
/// place.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum GroundPart {
    /// What is learnt from.
    Train,
    /// What decides which weights are kept and when a run ends.
    Selection,
    /// What neither has seen.
    Report,
}

/// Of all images, those to report on.
const REPORT_SHARE: f64 = 0.25;
/// Of the others, those to select by.
const SELECTION_SHARE: f64 = 0.2;

impl GroundPart {
    /// The images of `dataset` in this part. Equal data sets have equal parts.
    ///
    /// # Errors
    /// No image has a position, or all that could be split lie in one block.
    pub fn of(self, dataset: &Dataset) -> Result<Dataset, DatasetError> {
        let split = |share: f64, seed: u64| GroundSplit {
            share,
            block_m: 500.0,
            gap_m: 50.0,
            seed,
        };
        let (rest, report) = split(REPORT_SHARE, 1).split(dataset)?;
        if self == Self::Report {
            return Ok(report);
        }
        let (train, selection) = split(SELECTION_SHARE, 2).split(&rest)?;
        match self {
            Self::Selection => Ok(selection),
            Self::Train | Self::Report => Ok(train),
        }
    }

    /// The frames of a drive in this part: the last quarter is to report on, and a fifth of what
    /// comes before is to select by. `gap` frames lie between two parts.
    pub fn of_drive<T: Clone>(self, drive: &[T], gap: usize) -> Vec<T> {
        let tail = |length: usize, share: f64| length - (length as f64 * share).round() as usize;
        let report = tail(drive.len(), REPORT_SHARE);
        let rest = &drive[..report.saturating_sub(gap)];
        let selection = tail(rest.len(), SELECTION_SHARE);
        let part = match self {
            Self::Report => &drive[report..],
            Self::Selection => &rest[selection..],
            Self::Train => &rest[..selection.saturating_sub(gap)],
        };
        part.to_vec()
    }
}

impl Choice for GroundPart {
    const ALL: &'static [Self] = &[Self::Train, Self::Selection, Self::Report];

    fn as_str(self) -> &'static str {
        match self {
            Self::Train => "train",
            Self::Selection => "selection",
            Self::Report => "report",
        }
    }

    fn description(self) -> &'static str {
        match self {
            Self::Train => "Three fifths of the images, in blocks of 500 m: learnt from",
            Self::Selection => {
                "A fifth of what is not to report on: decides which weights are kept"
            }
            Self::Report => "A quarter that training and selection never see",
        }
    }
}

#[cfg(test)]
mod tests;
