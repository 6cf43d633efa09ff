//! Query strings of all routes that have options: parsed whole or refused with a row of the error table.
#![no_main]

use axum::http::Uri;
use libfuzzer_sys::fuzz_target;
use placeformer::http::body::read_query;
use placeformer::http::routes::query::QueryParams;

fuzz_target!(|text: &str| {
    if let Ok(uri) = Uri::builder().path_and_query(format!("/query?{text}")).build() {
        if let Ok(params) = read_query::<QueryParams>(&uri) {
            let _ = format!("{params:?}");
        }
    }
});
