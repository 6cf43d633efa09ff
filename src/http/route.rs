//! What a route is: the type of a row of the table [`ROUTES`](super::routes::ROUTES).
//!
//! A field without a default has to be written for every route, so a new route that forgets to say
//! who may call it, what its body is or how it fails does not compile.

use super::body::ImageUpload;
use super::config::Role;
use super::state::AppState;
use axum::http::Method;
use axum::routing::MethodRouter;
use placeformer_core::error::ErrorCode;
use serde_json::Value;
use utoipa_axum::router::UtoipaMethodRouter;

/// Everything about one method of one path.
pub struct Route {
    /// The method; a route for `GET` answers `HEAD`, too.
    pub method: Method,
    /// The path as the router matches it, its parameters in braces. It is also the label `route`
    /// of the metrics.
    pub path: &'static str,
    /// Who may call it.
    pub scope: Scope,
    /// Whether its answers are worth a line in the log.
    pub access_log: AccessLog,
    /// What its body is, and how large it may be.
    pub body: RequestBody,
    /// The codes that its own work can end with, beyond those that body, scope and layers bring
    /// along; [`Route::error_codes`] has all of them.
    pub own_errors: &'static [ErrorCode],
    /// Makes a realistic answer for the OpenAPI document; `None` if success has no body.
    pub answer_example: Option<fn() -> Value>,
    /// The code that answers.
    pub handler: Handler,
}

/// Who may call a route.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Scope {
    /// Anyone, without a key and without a bound on the rate.
    Public,
    /// Anyone, unless the settings protect the metrics: then a key is needed, of any role. With a key
    /// the metrics name its maps.
    Metrics,
    /// Holders of a key with this role, or anyone if the server has no keys. Their rate is bounded,
    /// and what they ask for needs the pipeline.
    Key(Role),
}

/// How loud the log is about the answers of a route.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum AccessLog {
    /// Only at level `debug`: supervisors and Prometheus call the route every few seconds.
    Quiet,
    /// A line at level `info` for each answer.
    Logged,
}

/// What a route reads from the body of a request.
pub enum RequestBody {
    /// Nothing.
    None,
    /// A JSON object without images, of at most
    /// [`MAX_JSON_BYTES`](super::body::MAX_JSON_BYTES).
    Json {
        /// Makes a realistic body for the OpenAPI document.
        example: fn() -> Value,
    },
    /// One file.
    File {
        /// Its largest size.
        max_bytes: usize,
        /// What it has to be, for the OpenAPI document, which adds the size.
        description: &'static str,
    },
    /// Images with parameters, each image of at most the configured size.
    Images(&'static ImageUpload),
}

/// The code behind a route.
pub enum Handler {
    /// An operation, which the OpenAPI document describes as the attributes of its function say.
    Operation(fn() -> UtoipaMethodRouter<AppState>),
    /// A page for people, which the document leaves out.
    Page(fn() -> MethodRouter<AppState>),
}

/// What goes wrong while any body is received and parsed.
const BODY_ERRORS: &[ErrorCode] = &[
    ErrorCode::MalformedRequest,
    ErrorCode::InvalidParameter,
    ErrorCode::RequestTimeout,
    ErrorCode::BodyTooLarge,
    ErrorCode::UnsupportedMediaType,
];

/// What goes wrong with a body of images beyond [`BODY_ERRORS`].
const IMAGE_ERRORS: &[ErrorCode] = &[
    ErrorCode::EmptyImage,
    ErrorCode::ImageTooLarge,
    ErrorCode::ImageUndecodable,
];

/// What the check of key and rate answers.
const KEY_ERRORS: &[ErrorCode] = &[
    ErrorCode::Unauthorized,
    ErrorCode::Forbidden,
    ErrorCode::RateLimited,
];

/// What the pipeline answers whatever it is asked for.
const PIPELINE_ERRORS: &[ErrorCode] = &[
    ErrorCode::NotReady,
    ErrorCode::Overloaded,
    ErrorCode::StorageLost,
];

/// What foreign web pages are answered, unless all they learn is how the service is.
const FOREIGN_PAGE_ERRORS: &[ErrorCode] = &[ErrorCode::HostNotAllowed, ErrorCode::CrossOrigin];

/// What the layers around every handler answer: the end of draining, and the net for panics.
const LAYER_ERRORS: &[ErrorCode] = &[ErrorCode::ShuttingDown, ErrorCode::Internal];

impl Route {
    /// Every code that a request to this route may be answered with, by status; of one status, the
    /// more particular code first.
    pub fn error_codes(&self) -> Vec<ErrorCode> {
        let body_errors: &[&[ErrorCode]] = match self.body {
            RequestBody::None => &[],
            RequestBody::Json { .. } | RequestBody::File { .. } => &[BODY_ERRORS],
            RequestBody::Images(_) => &[BODY_ERRORS, IMAGE_ERRORS],
        };
        let scope_errors: &[&[ErrorCode]] = match self.scope {
            // On a connection that is reserved for probes.
            Scope::Public if !self.is_health() => &[&[ErrorCode::Overloaded], FOREIGN_PAGE_ERRORS],
            Scope::Public => &[],
            // Where too much of other answers waits to be taken.
            Scope::Metrics => &[KEY_ERRORS, &[ErrorCode::Overloaded], FOREIGN_PAGE_ERRORS],
            Scope::Key(_) => &[KEY_ERRORS, PIPELINE_ERRORS, FOREIGN_PAGE_ERRORS],
        };
        let mut codes = body_errors.concat();
        codes.extend(self.own_errors);
        codes.extend(scope_errors.concat());
        codes.extend(LAYER_ERRORS);
        // A stable sort: codes of one status stay in the order of the groups.
        codes.sort_by_key(|code| code.status());
        codes
    }

    /// Whether it says no more than how the service is, so that anyone may ask, from anywhere.
    pub fn is_health(&self) -> bool {
        self.scope == Scope::Public && self.access_log == AccessLog::Quiet
    }

    /// The handler under its method, for the router.
    pub fn method_router(&self) -> MethodRouter<AppState> {
        match self.handler {
            Handler::Operation(operation) => {
                let (_, _, method_router) = operation();
                method_router
            }
            Handler::Page(page) => page(),
        }
    }

    /// Whether this route answers requests with `method`.
    pub fn answers(&self, method: &Method) -> bool {
        self.method == *method || (self.method == Method::GET && *method == Method::HEAD)
    }
}

impl Scope {
    /// The role that a key needs which is presented; `None` if nobody looks at it.
    pub fn role(self) -> Option<Role> {
        match self {
            Self::Public => None,
            Self::Metrics => Some(Role::Metrics),
            Self::Key(role) => Some(role),
        }
    }
}
