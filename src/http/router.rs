//! The whole surface as one service: the rows of the route table inside their layers.

use super::problem::ApiError;
use super::routes::ROUTES;
use super::routes::docs::DocumentText;
use super::state::AppState;
use super::{authorise, cross_origin, observe, openapi, reserved};
use axum::extract::DefaultBodyLimit;
use axum::middleware::from_fn_with_state;
use axum::response::{IntoResponse, Response};
use axum::{Extension, Router};
use placeformer_core::error::ErrorCode;
use std::any::Any;
use tower::util::option_layer;
use tower_http::catch_panic::CatchPanicLayer;

/// The surface over `state`, complete with its layers.
pub fn app(state: AppState) -> Router {
    openapi::expect_documented_answers(&state.metrics);
    let mut router = Router::new();
    for route in ROUTES {
        router = router.route(route.path, route.method_router());
    }
    // The last layer added is the outermost. Bodies are bounded where they are read, because only
    // there their kind is known.
    router
        .layer(Extension(DocumentText(openapi::document_text())))
        .layer(DefaultBodyLimit::disable())
        .layer(from_fn_with_state(state.clone(), authorise::authorise))
        .layer(option_layer(state.cross_origin.cors()))
        .layer(from_fn_with_state(
            state.clone(),
            cross_origin::refuse_foreign_pages,
        ))
        .layer(from_fn_with_state(state.clone(), reserved::keep_for_probes))
        .layer(CatchPanicLayer::custom(answer_panic))
        .layer(from_fn_with_state(state.clone(), observe::observe))
        .with_state(state)
}

/// The answer to a request whose handler panicked with `cause`.
fn answer_panic(cause: Box<dyn Any + Send>) -> Response {
    let text = cause
        .downcast_ref::<&str>()
        .copied()
        .or_else(|| cause.downcast_ref::<String>().map(String::as_str));
    tracing::error!(panic = text.unwrap_or("unknown"), "a handler panicked");
    ApiError::new(
        ErrorCode::Internal,
        "the server failed; the log names the cause under this request's id",
    )
    .into_response()
}
