//! A run by hand, from answers to the page.

use super::*;
use crate::datasets::Item;
use crate::eval::run::{Candidate, Neighbour, QuerySeconds};
use maud::html;
use placeformer_core::types::ModelId;
use placeformer_vision::extract::ExtractConfig;
use placeformer_vision::rerank::PairScore;

fn answer(query: usize, global: &[usize], reranked: &[(usize, u32)]) -> Answer {
    let candidate = |&(index, spatial_score): &(usize, u32)| {
        let score = PairScore {
            spatial_score,
            ..Default::default()
        };
        let distance = 0.5;
        Candidate::by_inliers(Neighbour { index, distance }, score)
    };
    Answer {
        query,
        global: global
            .iter()
            .enumerate()
            .map(|(rank, &index)| Neighbour {
                index,
                distance: rank as f32,
            })
            .collect(),
        reranked: reranked.iter().map(candidate).collect(),
    }
}

fn features(n: usize, seconds: f64) -> Features {
    let mut features = Features::empty_for_tests(n);
    features.dim = 256;
    features.pooled_dim = 384;
    features.patch_bytes = 1000.0;
    features.seconds.extract = seconds;
    features
}

#[test]
fn a_run_by_hand() {
    let truth = vec![
        Truth::Positives(vec![1]),
        Truth::Positives(vec![0, 2]),
        Truth::NoMatch,
        Truth::Unknown,
    ];
    let items = |n: usize| (0..n).map(|i| Item::new(i.to_string(), "x")).collect();
    let dataset = Dataset {
        name: "hand".into(),
        database: items(3),
        queries: items(4),
        truth,
        skipped: Vec::new(),
        notes: Vec::new(),
    };
    let answers = [
        answer(0, &[0, 1, 2], &[(1, 40), (0, 5)]),
        answer(1, &[0, 1, 2], &[(1, 9), (2, 8)]),
        answer(2, &[2, 1, 0], &[(2, 3)]),
        answer(3, &[2, 1, 0], &[(2, 99)]),
    ];
    let config = RunConfig {
        model: ModelId::new("m"),
        global: GlobalKind::Head,
        candidates: 3,
        extract: ExtractConfig::default(),
        rerank: Some(RerankConfig::default()),
        bootstrap: 100,
        seed: 1,
    };
    let seconds = QuerySeconds {
        search: 0.1,
        load: 0.2,
        rerank: 0.3,
    };
    let mut asked = DatasetAnswers {
        answers: answers.to_vec(),
        left_out: Vec::new(),
        seconds,
    };
    let database = features(3, 2.0);
    let queries = features(4, 9.0);
    let summary = summarise(&dataset, &database, &queries, &asked, config.clone(), None);
    assert_eq!(
        (
            summary.queries,
            summary.queries_with_match,
            summary.queries_without_match
        ),
        (4, 2, 1)
    );
    assert_eq!(
        (summary.recall.global[&1], summary.recall.global[&5]),
        (Some(50.0), Some(100.0))
    );
    assert_eq!(summary.recall.reranked.as_ref().unwrap()[&1], Some(50.0));
    // S = 40 is right, 9 wrong, 3 has no match; the unlabelled query does not count.
    let rejection = summary.rejection.reranked.as_ref().unwrap();
    assert_eq!(
        (rejection.curve.len(), rejection.recall_at_full_precision),
        (3, 50.0)
    );
    assert_eq!(summary.bytes_per_reference, 1024.0 + 768.0 + 1000.0);
    let json = serde_json::to_value(&summary).unwrap();
    assert_eq!(json["recall"]["global"]["1"], 50.0);
    assert_eq!(json["seconds"]["extract"], 2.0);
    assert_eq!(json["queries"], 4);
    for key in ["1", "5", "10", "20"] {
        assert!(json["recall"]["reranked"][key].is_number());
    }
    assert!(json["calibration"].is_null());
    let outcome = &summary.outcomes[1];
    assert_eq!(
        (outcome.global_rank, outcome.reranked_rank),
        (Some(1), Some(2))
    );
    assert_eq!(
        (outcome.spatial_score, outcome.positive_score),
        (Some(9), Some(8))
    );
    assert_eq!(summary.outcomes[2].reranked_rank, None);
    let text = crate::eval::report::text(&summary);
    assert!(
        text.contains("hand: 4 queries (2 with a match, 1 without) against 3 references"),
        "{text}"
    );
    let page = crate::eval::report::html(&summary, &dataset, &asked, &html! {});
    assert_eq!(page.matches("<svg").count(), 3);
    assert!(!page.contains("NaN") && !page.contains("src=\"http"));
    assert!(summary.given_calibration.is_none() && !page.contains("the one given"));

    // Asked again without its place, the first query still gets 30 inliers: nothing surer than 40
    // is wrong.
    let left_out = [answer(0, &[0, 2], &[(0, 30)]), answer(1, &[1], &[(1, 50)])];
    asked.left_out = left_out.to_vec();
    let given = calibration();
    let again = summarise(&dataset, &database, &queries, &asked, config, Some(&given));
    assert_eq!(
        (&again.recall.reranked, again.queries_left_out),
        (&summary.recall.reranked, 2)
    );
    let rejection = again.rejection.reranked.as_ref().unwrap();
    assert_eq!(
        (
            rejection.curve.len(),
            rejection.without_match,
            rejection.recall_at_full_precision
        ),
        (5, 3, 0.0)
    );
    let applied = again.given_calibration.as_ref().unwrap();
    // Confidences of S = 40, 9, 3 (one of them right), 30 and 50 (none right) at the flat 0.5 of
    // this curve.
    assert_eq!((applied.bins.len(), applied.bins[0].count), (1, 5));
    assert!(
        (applied.expected_calibration_error - 0.3).abs() < 1e-9,
        "{applied:?}"
    );
    assert!(crate::eval::report::text(&again).contains("of the calibration given"));
    let page = crate::eval::report::html(&again, &dataset, &asked, &html! {});
    assert!(page.contains("the one given") && page.contains("no match exists"));
}

fn calibration() -> Calibration {
    let curve = serde_json::json!({
        "weights": {"bias": 0.0, "score": 0.0, "distance": 0.0}, "threshold": 0.5, "right": 1, "wrong": 1,
        "without_match": 0, "precision": 1.0, "recall": 1.0, "expected_calibration_error": 0.0,
    });
    let curve: placeformer_core::types::ConfidenceCurve = serde_json::from_value(curve).unwrap();
    let curves = [curve.clone(), curve];
    Calibration::new(
        ModelId::new("m"),
        RerankConfig::default().id(),
        "d",
        0.9,
        curves,
    )
    .unwrap()
}
