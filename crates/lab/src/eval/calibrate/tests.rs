use super::super::run::{Candidate, Neighbour};
use super::*;
use crate::datasets::Item;
use crate::eval::own_places::{LeaveOut, OwnPlaces};
use placeformer_core::geography::MetricPoint;
use placeformer_vision::rerank::PairScore;

fn dataset(truth: Vec<Truth>, references: usize) -> Dataset {
    let items = |n: usize| (0..n).map(|i| Item::new(i.to_string(), "x")).collect();
    let queries = items(truth.len());
    let skipped = Vec::new();
    let notes = Vec::new();
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
    let candidate = |one: &Neighbour| {
        let score = PairScore {
            spatial_score: 10 * one.index as u32,
            ..Default::default()
        };
        Candidate::by_inliers(*one, score)
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
    let best = BestAnswers::of(&set, &as_it_is, &left_out, ScoreKind::Paper);
    let seen = |one: &TopOne| (one.evidence, one.correct, one.has_match);
    assert_eq!(
        best.global.iter().map(seen).collect::<Vec<_>>(),
        [(None, true, true), (None, false, false)]
    );
    let reranked: Vec<_> = best.reranked.iter().map(seen).collect();
    assert_eq!(
        reranked,
        [
            (Some(11f64.ln()), false, true),
            (Some(21f64.ln()), false, false)
        ]
    );
}

#[test]
fn both_curves_are_fitted_and_the_table_names_them() {
    let one = |query: usize, spatial_score: Option<f64>| {
        let has_match = query.is_multiple_of(2);
        let noise = query as f64 / 200.0;
        let global_distance = if has_match { 0.4 } else { 0.8 } + noise;
        let bonus = if has_match { 80.0 } else { 0.0 };
        let evidence = spatial_score.map(|score| (bonus + score).ln_1p());
        TopOne {
            place: query,
            evidence,
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
        rerank: RerankConfig::default(),
        data: "made up".into(),
        target_precision: 0.9,
        seed: 1,
        radius_m: 25.0,
    };
    let fitted = calibrate(&answers, purpose.clone(), None).unwrap();
    let curve = fitted.calibration.curve(true);
    assert_eq!(
        (curve.right, curve.wrong, curve.without_match),
        (29, 31, 30)
    );
    assert!(curve.precision >= 0.85 && curve.recall > 0.8, "{curve:?}");
    assert!(
        curve.weights.confidence(Some(100.0f64.ln_1p()), 0.5) > 0.8
            && curve.weights.confidence(Some(5.0f64.ln_1p()), 0.9) < 0.2
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
        calibrate(&only_right, purpose, None)
            .unwrap_err()
            .to_string()
            .contains("--leave-out")
    );
}
