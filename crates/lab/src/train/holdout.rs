//! Keeping places back for validation.
//!
//! Split by image, a place would be learnt from one photo and recognised in the next. So whole
//! blocks of ground are held out, or the last part of a drive, and what lies between the two sides
//! is given to neither.

use super::error::TrainError;
use crate::datasets::{Dataset, Item, NeighbourGrid, Truth};
use placeformer_core::geography::MetricPoint;
use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use std::collections::BTreeMap;
use std::path::PathBuf;

/// How much is held out, and how.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Holdout {
    /// Share of the images to hold out, between 0 and 1.
    pub share: f64,
    /// Side of a block in metres.
    pub block_m: f64,
    /// Training images nearer than this to a held-out one, in metres, are left out.
    pub gap_m: f64,
    /// Frames left out between the two parts of a drive.
    pub gap_frames: usize,
    /// Decides which blocks are held out.
    pub seed: u64,
}

/// Frames of several drives, each in order.
pub type Drives = Vec<Vec<PathBuf>>;

/// A block: its group (a city) and its column and row.
type Block<'a> = (Option<&'a str>, i64, i64);

impl Holdout {
    fn check(&self) -> Result<(), TrainError> {
        if !(self.share > 0.0 && self.share < 1.0) {
            return Err(TrainError::Setting(format!(
                "the share of places held out must lie between 0 and 1, and is {}",
                self.share
            )));
        }
        if !(self.block_m > 0.0 && self.block_m.is_finite() && self.gap_m >= 0.0) {
            return Err(TrainError::Setting(format!(
                "blocks of {} metres cannot be held out",
                self.block_m
            )));
        }
        Ok(())
    }

    /// Splits a data set by blocks of ground into what is learnt from and what is held out. Images
    /// without a position are in neither.
    ///
    /// # Errors
    /// No image has a position, or all lie in one block.
    pub fn by_blocks(&self, dataset: &Dataset) -> Result<(Dataset, Dataset), TrainError> {
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
            let reason = format!("{}: {reason}", dataset.name);
            return Err(TrainError::NoTriplets(reason));
        }

        let held_out = self.draw(&blocks);
        let is_held_out = |item: &Item| {
            self.block(item)
                .is_some_and(|block| held_out.contains_key(&block))
        };
        let validation = subset(dataset, is_held_out);
        let both_sides = validation.database.iter().chain(&validation.queries);
        let kept_back: Vec<(&Item, MetricPoint)> = both_sides
            .filter_map(|item| Some((item, item.position?)))
            .collect();
        let points = kept_back.iter().map(|item| item.1);
        let grid = NeighbourGrid::new(self.gap_m.max(1e-3), points.enumerate());
        let is_apart = |item: &Item| match item.position {
            Some(point) => grid
                .within(point)
                .all(|near| kept_back[near].0.group != item.group),
            None => false,
        };
        let training = subset(dataset, is_apart);
        Ok((training, validation))
    }

    /// Splits drives (frames in order): the last share of each is held out, behind a gap.
    ///
    /// # Errors
    /// A setting is out of range.
    pub fn by_tails(&self, drives: &[Vec<PathBuf>]) -> Result<(Drives, Drives), TrainError> {
        self.check()?;
        let split = |drive: &Vec<PathBuf>| {
            let tail = drive.len() - (drive.len() as f64 * self.share).round() as usize;
            (
                drive[..tail.saturating_sub(self.gap_frames)].to_vec(),
                drive[tail..].to_vec(),
            )
        };
        Ok(drives.iter().map(split).unzip())
    }

    fn block<'a>(&self, item: &'a Item) -> Option<Block<'a>> {
        let point = item.position?;
        let along = |metres: f64| (metres / self.block_m).floor() as i64;
        Some((item.group.as_deref(), along(point.east), along(point.north)))
    }

    /// Blocks in a random order until they hold the share of the images; never all of them.
    fn draw<'a>(&self, blocks: &BTreeMap<Block<'a>, usize>) -> BTreeMap<Block<'a>, usize> {
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
        order.into_iter().take_while(until_enough).collect()
    }
}

/// The images of `dataset` that `keep` keeps; their truth is not carried over.
fn subset(dataset: &Dataset, keep: impl Fn(&Item) -> bool) -> Dataset {
    let kept =
        |items: &[Item]| -> Vec<Item> { items.iter().filter(|item| keep(item)).cloned().collect() };
    let queries = kept(&dataset.queries);
    Dataset {
        name: dataset.name.clone(),
        database: kept(&dataset.database),
        truth: vec![Truth::Unknown; queries.len()],
        queries,
        skipped: vec![],
        notes: vec![],
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn item(name: String, east: f64, north: f64) -> Item {
        Item {
            position: Some(MetricPoint { east, north }),
            ..Item::new(name.clone(), name)
        }
    }

    fn dataset(points: &[(f64, f64)]) -> Dataset {
        let side = |side: &str| -> Vec<Item> {
            points
                .iter()
                .enumerate()
                .map(|(i, &(east, north))| item(format!("{side}{i}"), east, north))
                .collect()
        };
        let database = side("d");
        let queries = side("q");
        let truth = vec![Truth::Unknown; queries.len()];
        Dataset {
            name: "field".into(),
            database,
            queries,
            truth,
            skipped: vec![],
            notes: vec![],
        }
    }

    fn holdout(share: f64) -> Holdout {
        Holdout {
            share,
            block_m: 100.0,
            gap_m: 25.0,
            gap_frames: 15,
            seed: 3,
        }
    }

    proptest! {
        #[test]
        fn no_training_image_lies_within_the_gap_of_a_held_out_one(
            points in prop::collection::vec((-500f64..500.0, -500f64..500.0), 2..80),
            share in 0.05f64..0.6,
        ) {
            let all = dataset(&points);
            let Ok((training, validation)) = holdout(share).by_blocks(&all) else { return Ok(()) };
            prop_assert!(!validation.database.is_empty());
            for learnt in training.database.iter().chain(&training.queries) {
                for held_out in validation.database.iter().chain(&validation.queries) {
                    let a = learnt.position.unwrap();
                    let b = held_out.position.unwrap();
                    let east = a.east - b.east;
                    let north = a.north - b.north;
                    prop_assert!(east * east + north * north > 25.0 * 25.0);
                }
            }
            // What is in neither lies in the gap.
            prop_assert!(training.database.len() + validation.database.len() <= all.database.len());
            prop_assert_eq!(validation.database.len(), validation.queries.len());
        }
    }

    #[test]
    fn the_share_is_met_and_one_block_cannot_be_split() {
        let grid: Vec<(f64, f64)> = (0..400)
            .map(|i| (f64::from(i % 20) * 100.0 + 50.0, f64::from(i / 20) * 100.0))
            .collect();
        let (training, validation) = holdout(0.2).by_blocks(&dataset(&grid)).unwrap();
        assert_eq!(
            (training.database.len(), validation.database.len()),
            (320, 80)
        );
        assert_eq!(
            holdout(0.2).by_blocks(&dataset(&grid)).unwrap().1,
            validation
        );
        assert!(
            holdout(0.2)
                .by_blocks(&dataset(&[(1.0, 1.0), (2.0, 2.0)]))
                .is_err()
        );
        assert!(holdout(0.0).by_blocks(&dataset(&grid)).is_err());
    }

    #[test]
    fn the_end_of_each_drive_is_held_out_behind_a_gap() {
        let drive: Vec<PathBuf> = (0..100).map(|i| PathBuf::from(format!("{i}"))).collect();
        let (training, validation) = holdout(0.2)
            .by_tails(&[drive.clone(), drive[..10].to_vec()])
            .unwrap();
        assert_eq!((training[0].len(), validation[0].len()), (65, 20));
        assert_eq!(validation[0][0], drive[80]);
        assert_eq!((training[1].len(), validation[1].len()), (0, 2));
    }
}
