//! Query strings of every route that has options: parsed and checked whole, or refused with a row
//! of the error table. What is accepted is in range.
#![no_main]

use axum::http::Uri;
use libfuzzer_sys::fuzz_target;
use placeformer::http::body::read_query;
use placeformer::http::problem::ApiError;
use placeformer::http::routes::match_images::MatchParams;
use placeformer::http::routes::probes::ReadyParams;
use placeformer::http::routes::query::QueryParams;
use placeformer::http::routes::references::{ListParams, Listing, ReferenceParams};
use serde::de::DeserializeOwned;

const MAX_PAGE: usize = 1000;

fuzz_target!(|text: &str| {
    let Ok(uri) = Uri::builder().path_and_query(format!("/?{text}")).build() else {
        return;
    };
    if let Some(query) = accepted(&uri, QueryParams::checked) {
        if let Some(near) = query.options.filter.near {
            assert!(
                near.radius_m > 0.0 && near.centre.lat().abs() <= 90.0,
                "{near:?}"
            );
        }
        assert!(query.budget.is_none_or(|budget| !budget.is_zero()));
    }
    if let Some((_, fields)) = accepted(&uri, ReferenceParams::checked) {
        if let Some(point) = fields.location {
            assert!(
                point.lat().abs() <= 90.0 && point.lon().abs() <= 180.0,
                "{point:?}"
            );
        }
        assert!(
            fields
                .heading
                .is_none_or(|heading| (0.0..360.0).contains(&heading.degrees()))
        );
    }
    if let Some(Listing::Page { limit, .. }) =
        accepted(&uri, |params: ListParams| params.checked(MAX_PAGE))
    {
        assert!((1..=MAX_PAGE).contains(&limit));
    }
    accepted(&uri, |params: MatchParams| params.reference());
    accepted(&uri, |params: ReadyParams| Ok(params));
});

/// What is made of a query string; a refusal must be the client's fault.
fn accepted<P: DeserializeOwned, T>(
    uri: &Uri,
    check: impl FnOnce(P) -> Result<T, ApiError>,
) -> Option<T> {
    let outcome = read_query(uri).and_then(check);
    outcome
        .inspect_err(|error| assert!((400..500).contains(&error.code.status()), "{error:?}"))
        .ok()
}
