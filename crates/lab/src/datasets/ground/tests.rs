//! Parts share no place, keep their truth, and are the same every time.

use super::*;
use proptest::prelude::*;

fn item(name: String, east: f64, north: f64) -> Item {
    Item {
        position: Some(MetricPoint { east, north }),
        ..Item::new(name.clone(), name)
    }
}

/// A query and a reference at each of the points; they show each other.
fn dataset(points: &[(f64, f64)]) -> Dataset {
    let side = |side: &str| -> Vec<Item> {
        points
            .iter()
            .enumerate()
            .map(|(i, &(east, north))| item(format!("{side}{i}"), east, north))
            .collect()
    };
    Dataset {
        name: "field".into(),
        database: side("d"),
        queries: side("q"),
        truth: (0..points.len())
            .map(|i| Truth::Positives(vec![i]))
            .collect(),
        skipped: vec![],
        notes: vec![],
    }
}

fn split(share: f64) -> GroundSplit {
    GroundSplit {
        share,
        block_m: 100.0,
        gap_m: 25.0,
        seed: 3,
    }
}

/// The least squared distance between images of two parts.
fn nearest(a: &Dataset, b: &Dataset) -> f64 {
    let points = |part: &Dataset| -> Vec<MetricPoint> {
        let both = part.database.iter().chain(&part.queries);
        both.map(|item| item.position.unwrap()).collect()
    };
    let others = points(b);
    let squares = points(a).into_iter().flat_map(|p| {
        let square = move |q: &MetricPoint| {
            let east = p.east - q.east;
            let north = p.north - q.north;
            east * east + north * north
        };
        others.iter().map(square).collect::<Vec<f64>>()
    });
    squares.fold(f64::INFINITY, f64::min)
}

proptest! {
    #[test]
    fn no_image_outside_lies_within_the_gap_of_one_inside(
        points in prop::collection::vec((-500f64..500.0, -500f64..500.0), 2..80),
        share in 0.05f64..0.6,
    ) {
        let all = dataset(&points);
        let Ok((outside, inside)) = split(share).split(&all) else { return Ok(()) };
        prop_assert!(!inside.database.is_empty());
        prop_assert!(nearest(&outside, &inside) > 25.0 * 25.0);
        // What is in neither lies in the gap.
        prop_assert!(outside.database.len() + inside.database.len() <= all.database.len());
        for part in [&outside, &inside] {
            prop_assert_eq!(part.database.len(), part.queries.len());
            for (query, truth) in part.truth.iter().enumerate() {
                prop_assert_eq!(truth, &Truth::Positives(vec![query]));
            }
        }
    }

    #[test]
    fn the_named_parts_share_no_place(
        points in prop::collection::vec((0f64..4000.0, 0f64..4000.0), 20..120),
    ) {
        let all = dataset(&points);
        let parts: Result<Vec<Dataset>, _> =
            GroundPart::ALL.iter().map(|part| part.of(&all)).collect();
        let Ok(parts) = parts else { return Ok(()) };
        for (a, b) in [(0, 1), (0, 2), (1, 2)] {
            prop_assert!(nearest(&parts[a], &parts[b]) > 50.0 * 50.0);
        }
        prop_assert_eq!(&GroundPart::Selection.of(&all).unwrap(), &parts[1]);
    }
}

#[test]
fn the_share_is_met_and_one_block_cannot_be_split() {
    let grid: Vec<(f64, f64)> = (0..400)
        .map(|i| (f64::from(i % 20) * 100.0 + 50.0, f64::from(i / 20) * 100.0))
        .collect();
    let (outside, inside) = split(0.2).split(&dataset(&grid)).unwrap();
    assert_eq!((outside.database.len(), inside.database.len()), (320, 80));
    assert_eq!(split(0.2).split(&dataset(&grid)).unwrap().1, inside);
    let one_block = dataset(&[(1.0, 1.0), (2.0, 2.0)]);
    let error = split(0.2).split(&one_block).unwrap_err().to_string();
    assert!(error.contains("one block"), "{error}");
    assert!(split(0.0).split(&dataset(&grid)).is_err());
}

#[test]
fn the_named_parts_have_their_shares() {
    let grid: Vec<(f64, f64)> = (0..1600)
        .map(|i| (f64::from(i % 40) * 500.0 + 250.0, f64::from(i / 40) * 500.0))
        .collect();
    let all = dataset(&grid);
    let count = |part: GroundPart| part.of(&all).unwrap().database.len();
    assert_eq!(
        GroundPart::ALL
            .iter()
            .map(|&part| count(part))
            .collect::<Vec<_>>(),
        [960, 240, 400]
    );
}

#[test]
fn a_query_whose_positives_are_in_another_part_is_not_counted() {
    let mut all = dataset(&[(0.0, 0.0), (1000.0, 0.0)]);
    all.truth = vec![Truth::Positives(vec![0, 1]), Truth::Positives(vec![0])];
    let one = subset(&all, |item| item.name.ends_with('1'));
    assert_eq!(one.truth, [Truth::Unknown]);
    let both = subset(&all, |item| item.name.ends_with('0') || item.name == "d1");
    assert_eq!(both.truth, [Truth::Positives(vec![0, 1])]);
    all.truth[0] = Truth::NoMatch;
    assert_eq!(
        subset(&all, |item| item.name == "q0").truth,
        [Truth::NoMatch]
    );
}

#[test]
fn a_drive_is_split_by_its_order_with_gaps() {
    let drive: Vec<usize> = (0..100).collect();
    let part = |part: GroundPart| part.of_drive(&drive, 5);
    assert_eq!(part(GroundPart::Report), (75..100).collect::<Vec<_>>());
    assert_eq!(part(GroundPart::Selection), (56..70).collect::<Vec<_>>());
    assert_eq!(part(GroundPart::Train), (0..51).collect::<Vec<_>>());
    assert!(GroundPart::Train.of_drive(&drive[..4], 5).is_empty());
}
