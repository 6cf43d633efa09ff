//! `/openapi.json` and `/docs`: the surface, for programs and for people, without a network.

use crate::http::{AppState, openapi};
use axum::Router;
use axum::http::header;
use axum::response::{IntoResponse, Response};
use utoipa_swagger_ui::{Config, SwaggerUi};

/// The OpenAPI document
///
/// This description, as JSON (OpenAPI 3.1).
#[utoipa::path(get, path = "/openapi.json", operation_id = "openapi_json", tag = "service", responses(
    (status = 200, description = "The document.", body = Object, content_type = "application/json"),
))]
pub async fn openapi_json() -> Response {
    (
        [(header::CONTENT_TYPE, "application/json")],
        openapi::document_text(),
    )
        .into_response()
}

/// The page that shows the document and tries requests.
pub fn swagger_ui() -> Router<AppState> {
    Router::from(
        SwaggerUi::new("/docs").config(Config::from("/openapi.json").try_it_out_enabled(true)),
    )
}
