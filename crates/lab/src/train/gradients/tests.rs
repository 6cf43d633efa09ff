//! Two passes give what one gives, whatever the size of the groups.

use super::*;
use crate::train::head::{HeadModel, PooledTokens};
use crate::train::loss::{Pairs, info_nce};
use crate::train::spots::in_groups;
use crate::train::triplets::Side;
use std::path::PathBuf;

const DIM: usize = 6;
const IMAGES: usize = 10;

fn set() -> TripletSet {
    let images: Vec<PathBuf> = (0..IMAGES).map(|i| PathBuf::from(i.to_string())).collect();
    let pair = |image: usize| (image / 2 * 2) as u32;
    TripletSet {
        positives: (0..IMAGES).map(|image| vec![pair(image)]).collect(),
        near: (0..IMAGES)
            .map(|image| vec![pair(image), pair(image) + 1])
            .collect(),
        queries: images.clone(),
        database: images,
        spots: in_groups(IMAGES, 2),
    }
}

fn values(count: usize, factor: usize) -> Vec<f32> {
    (0..count)
        .map(|i| ((i * factor + 5) % 97) as f32 / 48.0 - 1.0)
        .collect()
}

fn model() -> HeadModel {
    let tokens =
        || PooledTokens::new(DIM, values(IMAGES * DIM, 7919), values(IMAGES * DIM, 7919)).unwrap();
    HeadModel::new(&values(8 * DIM, 31), &[0.1; 8], tokens(), tokens()).unwrap()
}

#[test]
fn groups_of_any_size_give_the_gradients_of_the_whole() {
    let set = set();
    let head = model();
    let bound = head.bound(&set);
    let samples: Vec<Sample> = (0..IMAGES)
        .map(|index| Sample {
            side: Side::Query,
            index,
            variation: None,
        })
        .collect();
    let images: Vec<(Side, u32)> = (0..IMAGES as u32).map(|i| (Side::Query, i)).collect();
    let pairs = Pairs::of(&set.spots, &images).unwrap();
    let loss = |descriptors: &Tensor| info_nce(descriptors, &pairs, 0.1);
    let (expected_loss, expected) = gradients(&bound, &set, &samples, IMAGES, &loss).unwrap();
    assert!(expected.length().unwrap() > 0.1);
    for at_once in [1, 3, 4, 9] {
        let (value, found) = gradients(&bound, &set, &samples, at_once, &loss).unwrap();
        assert!((value - expected_loss).abs() < 1e-5, "{at_once}");
        for (name, expected) in &expected.0 {
            let difference = (found.get(name).unwrap() - expected).unwrap();
            let worst: f32 = difference
                .abs()
                .unwrap()
                .max_all()
                .unwrap()
                .to_scalar()
                .unwrap();
            assert!(worst < 1e-5, "{at_once} {name}: {worst}");
        }
        // The same bits every time, whichever thread was first.
        let (_, again) = gradients(&bound, &set, &samples, at_once, &loss).unwrap();
        for (name, found) in &found.0 {
            let bits = |tensor: &Tensor| tensor.flatten_all().unwrap().to_vec1::<f32>().unwrap();
            assert_eq!(bits(found), bits(again.get(name).unwrap()));
        }
    }
}

#[test]
fn clipping_shortens_what_is_too_long_and_nothing_else() {
    let gradients = || {
        let tensor = |values: &[f32]| Tensor::new(values, &candle_core::Device::Cpu).unwrap();
        Gradients(BTreeMap::from([
            ("a".to_owned(), tensor(&[3.0, 0.0])),
            ("b".to_owned(), tensor(&[4.0])),
        ]))
    };
    let mut short = gradients();
    short.clip(6.0).unwrap();
    assert_eq!(short.length().unwrap(), 5.0);
    let mut long = gradients();
    long.clip(1.0).unwrap();
    assert!((long.length().unwrap() - 1.0).abs() < 1e-6);
    assert_eq!(long.get("b").unwrap().to_vec1::<f32>().unwrap(), [0.8]);
}

#[test]
fn results_come_in_order_and_the_first_error_ends_the_work() {
    let items: Vec<u32> = (0..9).collect();
    let mut seen = Vec::new();
    each_in_parallel(
        &items,
        |item| Ok(item * 2),
        |double| {
            seen.push(double);
            Ok(())
        },
    )
    .unwrap();
    assert_eq!(seen, (0..9).map(|item| item * 2).collect::<Vec<_>>());
    let failed = each_in_parallel(
        &items,
        |item| match item {
            3 => Err(TrainError::Setting("three".into())),
            item => Ok(*item),
        },
        |_| Ok(()),
    );
    assert!(failed.unwrap_err().to_string().contains("three"));
}
