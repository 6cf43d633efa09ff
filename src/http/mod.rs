//! The web surface over the pipeline.
//!
//! [`app`] turns an [`AppState`] into a router that tests call without a socket; [`serve()`] runs
//! it on a listener with the limits that only a connection knows. From the outside in, a request
//! passes: its id, span and metrics ([`observe`]); a net for panics; key and rate ([`auth`],
//! [`limits`]); the body within its bounds ([`body`]); the handler ([`routes`]). Every failure
//! leaves as problem+json ([`problem`]).
//!
//! The server answers `/livez` and `/readyz` from its first moment; everything that needs the
//! service answers `not_ready` until start-up puts it into the state.

pub mod auth;
pub mod body;
pub mod config;
mod examples;
pub mod limits;
pub mod observe;
pub mod openapi;
pub mod problem;
pub mod routes;
pub mod serve;

pub use config::{ApiKey, AuthConfig, HttpConfig, Role};
pub use serve::serve;

use crate::ops::metrics::Rejection;
use crate::ops::{Health, Metrics};
use crate::pipeline::Service;
use auth::Keys;
use axum::Router;
use axum::extract::DefaultBodyLimit;
use axum::middleware::from_fn_with_state;
use axum::response::{IntoResponse, Response};
use limits::{BodyMemory, RateLimits};
use placeformer_core::error::ErrorCode;
use placeformer_core::types::InvalidValue;
use problem::ApiError;
use std::any::Any;
use std::ops::Deref;
use std::sync::{Arc, OnceLock};
use tokio_util::sync::CancellationToken;
use tower_http::catch_panic::CatchPanicLayer;

/// What every handler shares; cheap to clone.
#[derive(Clone)]
pub struct AppState(Arc<Shared>);

/// The content of an [`AppState`].
pub struct Shared {
    /// Filled once start-up is through.
    service: OnceLock<Arc<Service>>,
    /// Limits and timeouts.
    pub http: HttpConfig,
    /// Largest image in bytes.
    pub max_image_bytes: usize,
    /// Accepted keys.
    pub keys: Keys,
    /// Paces of callers.
    pub rates: RateLimits,
    /// Budget for bodies under way.
    pub body_memory: BodyMemory,
    /// Measurements.
    pub metrics: Arc<Metrics>,
    /// Readiness.
    pub health: Arc<Health>,
    /// Cancelled when the time for draining is over: what is still running is answered with
    /// `shutting_down`.
    pub stopping: CancellationToken,
}

impl Deref for AppState {
    type Target = Shared;
    fn deref(&self) -> &Shared {
        &self.0
    }
}

impl AppState {
    /// A state without its service yet.
    pub fn new(
        http: HttpConfig,
        auth: &AuthConfig,
        max_image_bytes: usize,
        metrics: Arc<Metrics>,
        health: Arc<Health>,
    ) -> Result<Self, InvalidValue> {
        http.check()?;
        Ok(Self(Arc::new(Shared {
            service: OnceLock::new(),
            max_image_bytes,
            keys: Keys::new(auth)?,
            rates: RateLimits::new(auth, metrics.clone()),
            body_memory: BodyMemory::new(http.max_buffered_bytes, metrics.clone()),
            http,
            metrics,
            health,
            stopping: CancellationToken::new(),
        })))
    }

    /// Opens for requests. Only the first call counts.
    pub fn open(&self, service: Arc<Service>) {
        if self.service.set(service).is_err() {
            tracing::error!("the service was opened twice; the first one stays");
        }
        // Only now: who is told that the server is ready must not be refused by the next request.
        self.health.serving();
    }

    /// The service, if start-up is through.
    pub fn started(&self) -> Option<&Arc<Service>> {
        self.service.get()
    }

    /// The service; `not_ready` before start-up is through.
    pub fn service(&self) -> Result<&Arc<Service>, ApiError> {
        self.service.get().ok_or_else(|| {
            self.metrics.rejected(Rejection::NotReady);
            let reason = self
                .health
                .unready()
                .map_or("starting", |reason| reason.as_str());
            ApiError::new(
                ErrorCode::NotReady,
                format!("the server is not ready yet: {reason}"),
            )
        })
    }
}

/// The whole surface as one service.
pub fn app(state: AppState) -> Router {
    openapi::expect_routes(&state.metrics);
    let (router, _) = routes::all().split_for_parts();
    router
        .merge(routes::docs::swagger_ui())
        .layer(DefaultBodyLimit::disable())
        .layer(from_fn_with_state(state.clone(), auth::admit))
        .layer(CatchPanicLayer::custom(panicked))
        .layer(from_fn_with_state(state.clone(), observe::observe))
        .with_state(state)
}

fn panicked(cause: Box<dyn Any + Send>) -> Response {
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
