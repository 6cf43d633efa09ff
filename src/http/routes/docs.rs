//! `/openapi.json` and `/docs`: the surface, for programs and for people, without a network.

use axum::Extension;
use axum::extract::Path;
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Redirect, Response};
use std::sync::{Arc, LazyLock};
use utoipa_swagger_ui::Config;

/// The OpenAPI document, as the router passes it to [`openapi_json`].
#[derive(Debug, Clone, Copy)]
pub struct DocumentText(pub &'static str);

/// The settings of Swagger UI, which is compiled in.
static UI_CONFIG: LazyLock<Arc<Config<'static>>> =
    LazyLock::new(|| Arc::new(Config::from("/openapi.json").try_it_out_enabled(true)));

/// The OpenAPI document
///
/// This description, as JSON (OpenAPI 3.1).
#[utoipa::path(
    get,
    path = "/openapi.json",
    operation_id = "openapi_json",
    tag = "service",
    responses(
        (
            status = 200,
            description = "The document.",
            body = Object,
            content_type = "application/json",
        ),
    ),
)]
pub async fn openapi_json(Extension(DocumentText(text)): Extension<DocumentText>) -> Response {
    ([(header::CONTENT_TYPE, "application/json")], text).into_response()
}

/// `/docs`: leads to the page, whose own links are relative to `/docs/`.
pub async fn redirect_to_ui() -> Redirect {
    Redirect::to("/docs/")
}

/// The page that shows the document and tries requests.
pub async fn ui_index() -> Response {
    embedded_file("index.html")
}

/// A script, style or picture of the page.
pub async fn ui_file(Path(file): Path<String>) -> Response {
    embedded_file(&file)
}

fn embedded_file(name: &str) -> Response {
    let file = match utoipa_swagger_ui::serve(name, UI_CONFIG.clone()) {
        Ok(Some(file)) => file,
        Ok(None) => return StatusCode::NOT_FOUND.into_response(),
        Err(error) => {
            tracing::error!(%error, file = name, "a file of the page at /docs cannot be made");
            return StatusCode::INTERNAL_SERVER_ERROR.into_response();
        }
    };
    let mut headers = HeaderMap::new();
    if let Ok(kind) = HeaderValue::try_from(file.content_type) {
        headers.insert(header::CONTENT_TYPE, kind);
    }
    if file.gzpipped {
        headers.insert(header::CONTENT_ENCODING, HeaderValue::from_static("gzip"));
    }
    (headers, file.bytes).into_response()
}
