//! One file per group of routes; each handler parses, calls the pipeline, and shapes the answer.

pub mod docs;
pub mod info;
pub mod maps;
pub mod match_images;
pub mod ops;
pub mod query;
pub mod references;
pub mod shapes;

use super::AppState;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

/// Every documented route.
pub fn all() -> OpenApiRouter<AppState> {
    OpenApiRouter::new()
        .routes(routes!(references::create, references::list))
        .routes(routes!(
            references::get,
            references::update,
            references::delete
        ))
        .routes(routes!(query::query))
        .routes(routes!(match_images::match_images))
        .routes(routes!(maps::list))
        .routes(routes!(maps::get, maps::delete))
        .routes(routes!(maps::calibrate, maps::uncalibrate))
        .routes(routes!(maps::rehead, maps::unhead))
        .routes(routes!(info::info))
        .routes(routes!(ops::livez))
        .routes(routes!(ops::readyz))
        .routes(routes!(ops::metrics))
        .routes(routes!(docs::openapi_json))
}
