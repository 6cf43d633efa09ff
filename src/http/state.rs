//! What all handlers share.

use super::auth::Auth;
use super::codec::CodecThreads;
use super::config::{AuthConfig, HttpConfig};
use super::cross_origin::CrossOriginRules;
use super::failed_keys::FailedKeys;
use super::memory_budget::{BufferKind, MemoryBudget};
use super::problem::ApiError;
use crate::ops::metrics::Rejection;
use crate::ops::{Health, Metrics};
use crate::pipeline::Service;
use placeformer_core::error::ErrorCode;
use placeformer_core::types::InvalidValue;
use std::ops::Deref;
use std::sync::{Arc, OnceLock, PoisonError, RwLock};
use tokio_util::sync::CancellationToken;

/// Bytes of answers of `/metrics` kept in memory at once, some hundred of them.
const MAX_UNSENT_METRICS_BYTES: usize = 16 << 20;

/// What every handler shares; cheap to clone.
#[derive(Clone)]
pub struct AppState(Arc<SharedState>);

/// The content of an [`AppState`].
pub struct SharedState {
    /// Set once start-up is through.
    service: OnceLock<Arc<Service>>,
    /// Limits and timeouts of connections and bodies.
    pub http: HttpConfig,
    /// Largest image in bytes.
    pub max_image_bytes: usize,
    /// Keys and rates, replaced when their settings change.
    auth: RwLock<Arc<Auth>>,
    /// Who presented keys that are not known.
    pub failed_keys: FailedKeys,
    /// How much memory the bodies of all requests may take together.
    pub body_budget: MemoryBudget,
    /// How much memory answers may take together until their clients have taken them.
    pub answer_budget: MemoryBudget,
    /// The same for the answers of `/metrics`, which have to come through when others do not.
    pub metrics_budget: MemoryBudget,
    /// Where bodies are taken apart and answers are written.
    pub codec: CodecThreads,
    /// Which names and web pages may be used.
    pub cross_origin: CrossOriginRules,
    /// Measurements, shared with the pipeline.
    pub metrics: Arc<Metrics>,
    /// Readiness, shared with the pipeline.
    pub health: Arc<Health>,
    /// Cancelled when the time for draining is over: requests that still run are then answered
    /// with `shutting_down`.
    pub stopping: CancellationToken,
}

impl Deref for AppState {
    type Target = SharedState;

    fn deref(&self) -> &SharedState {
        &self.0
    }
}

impl AppState {
    /// A state that has no service yet.
    ///
    /// # Errors
    /// A setting of the surface, or a configured key, is not valid.
    pub fn new(
        http: HttpConfig,
        auth: &AuthConfig,
        max_image_bytes: usize,
        metrics: Arc<Metrics>,
        health: Arc<Health>,
    ) -> Result<Self, InvalidValue> {
        http.check()?;
        let budget = |kind, bytes| MemoryBudget::new(kind, bytes, metrics.clone());
        let shared = SharedState {
            service: OnceLock::new(),
            max_image_bytes,
            auth: RwLock::new(Arc::new(Auth::new(auth, metrics.clone())?)),
            failed_keys: FailedKeys::new(metrics.clone()),
            body_budget: budget(BufferKind::Bodies, http.max_buffered_bytes),
            answer_budget: budget(BufferKind::Answers, http.max_unsent_bytes),
            metrics_budget: budget(BufferKind::Answers, MAX_UNSENT_METRICS_BYTES),
            codec: CodecThreads::new(http.codec_threads),
            cross_origin: CrossOriginRules::new(&http)?,
            http,
            metrics,
            health,
            stopping: CancellationToken::new(),
        };
        Ok(Self(Arc::new(shared)))
    }

    /// Lets requests through to `service`. Only the first call counts.
    pub fn open(&self, service: Arc<Service>) {
        if self.service.set(service).is_err() {
            tracing::error!("the service was opened twice; the first one stays");
        }
        // Readiness comes last: a client that is told that the server is ready must not have its
        // next request refused.
        self.health.serving();
    }

    /// The keys and rates in force.
    pub fn auth(&self) -> Arc<Auth> {
        // The lock is held for one assignment only, which leaves the value whole.
        let auth = self.auth.read().unwrap_or_else(PoisonError::into_inner);
        auth.clone()
    }

    /// Puts other keys and rates in force, from the next request on; false if nothing has changed.
    ///
    /// # Errors
    /// They are not valid, or would open the service to everyone; the old ones stay in force.
    pub fn renew_auth(&self, config: &AuthConfig) -> Result<bool, InvalidValue> {
        let Some(renewed) = self.auth().renewed(config)? else {
            return Ok(false);
        };
        *self.auth.write().unwrap_or_else(PoisonError::into_inner) = Arc::new(renewed);
        Ok(true)
    }

    /// The service, if start-up is through.
    pub fn started(&self) -> Option<&Arc<Service>> {
        self.service.get()
    }

    /// The service.
    ///
    /// # Errors
    /// `not_ready` before start-up is through.
    pub fn service(&self) -> Result<&Arc<Service>, ApiError> {
        self.service.get().ok_or_else(|| self.not_ready())
    }

    fn not_ready(&self) -> ApiError {
        self.metrics.rejected(Rejection::NotReady);
        let reason = match self.health.unready() {
            Some(reason) => reason.as_str(),
            None => "starting",
        };
        let detail = format!("the server is not ready yet: {reason}");
        ApiError::new(ErrorCode::NotReady, detail)
    }
}
