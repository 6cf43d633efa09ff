//! Bodies of `POST /query` in all three forms: taken apart whole or refused with a row of the error
//! table.
//!
//! The first byte chooses the content type, the rest is the body.
#![no_main]

use axum::body::Body;
use axum::http::Request;
use libfuzzer_sys::fuzz_target;
use placeformer::http::body::read_upload;
use placeformer::http::routes::query::{QueryParams, UPLOAD};
use placeformer::http::{AppState, AuthConfig, HttpConfig};
use placeformer::ops::{Health, Metrics};
use std::sync::{Arc, LazyLock};

const CONTENT_TYPES: [&str; 4] = [
    "multipart/form-data; boundary=X",
    "application/json",
    "image/jpeg",
    "multipart/form-data; boundary=--",
];

static STATE: LazyLock<AppState> = LazyLock::new(|| {
    let metrics = Arc::new(Metrics::new().expect("series register"));
    AppState::new(
        HttpConfig::default(),
        &AuthConfig::default(),
        1 << 20,
        metrics,
        Arc::new(Health::default()),
    )
    .expect("the defaults are valid")
});
static RUNTIME: LazyLock<tokio::runtime::Runtime> = LazyLock::new(|| {
    tokio::runtime::Builder::new_current_thread()
        .enable_time()
        .build()
        .expect("a runtime starts")
});

fuzz_target!(|bytes: &[u8]| {
    let Some((choice, body)) = bytes.split_first() else {
        return;
    };
    let request = Request::post("/query")
        .header(
            "content-type",
            CONTENT_TYPES[usize::from(*choice) % CONTENT_TYPES.len()],
        )
        .body(Body::from(body.to_vec()))
        .expect("the request is well formed");
    let upload = RUNTIME.block_on(read_upload::<QueryParams>(&STATE, request, &UPLOAD));
    if let Ok(mut upload) = upload {
        if let Ok(image) = upload.take("image") {
            assert!(!image.is_empty() && image.len() <= body.len());
        }
    }
});
