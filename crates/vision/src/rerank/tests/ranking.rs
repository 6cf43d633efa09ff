//! Candidates loaded, scored and sorted, with and without a deadline.

use super::{Noise, random_patches};
use crate::rerank::{RerankConfig, Reranked, Reranker};
use placeformer_core::types::{Deadline, PackedPatches};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

/// Candidates of which the third shows the query's place; the fifth cannot be loaded.
fn rerank_five(deadline: Option<Deadline>) -> Reranked<&'static str> {
    let query = random_patches([100, 40, 20], 64, &mut Noise(1));
    let load = |i: usize| match i {
        2 => Ok(Arc::new(query.clone())),
        4 => Err("gone"),
        _ => Ok(Arc::new(random_patches([0; 3], 64, &mut Noise(2)))),
    };
    Reranker::new(RerankConfig::default()).rerank(&query, 5, load, deadline)
}

#[test]
fn candidates_are_ranked_by_score_then_global_order_and_failures_listed() {
    let Reranked::Complete { ranked, failed } =
        rerank_five(Some(Deadline::after(Duration::from_secs(600))))
    else {
        panic!("there was time")
    };
    assert_eq!(
        ranked.iter().map(|r| r.candidate).collect::<Vec<_>>(),
        [2, 0, 1, 3]
    );
    assert_eq!(ranked[0].score.spatial_score, 100 + 140 + 60);
    assert_eq!(failed, [(4, "gone")]);
}

#[test]
fn a_passed_deadline_leaves_the_global_order() {
    assert!(matches!(
        rerank_five(Some(Deadline::after(Duration::ZERO))),
        Reranked::DeadlinePassed
    ));
    assert!(matches!(rerank_five(None), Reranked::Complete { .. }));
}

#[test]
fn a_deadline_that_passes_midway_stops_the_loading() {
    let query = random_patches([10, 4, 2], 16, &mut Noise(1));
    let deadline = Deadline::after(Duration::from_millis(30));
    let loads = AtomicUsize::new(0);
    let load = |_| -> Result<Box<PackedPatches>, ()> {
        loads.fetch_add(1, Ordering::Relaxed);
        std::thread::sleep(Duration::from_millis(40));
        Ok(Box::new(query.clone()))
    };
    let reranked =
        Reranker::new(RerankConfig::default()).rerank(&query, 10_000, load, Some(deadline));
    assert!(matches!(reranked, Reranked::DeadlinePassed));
    assert!(loads.into_inner() < 1000);
}
