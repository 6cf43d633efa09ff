//! The web surface over the pipeline.
//!
//! [`app`] turns an [`AppState`] into a router that tests call without a socket; [`serve()`] runs
//! it on a listener with the limits that only a connection knows.
//!
//! Everything that depends on path and method is written once, as a row of the table
//! [`routes::ROUTES`]: who may call the route, what its body is, which errors it ends with, and
//! whether its answers are logged. Router, authorisation, OpenAPI document and observation all
//! read that table.
//!
//! A request passes these layers, from the outside in:
//!
//! 1. [`observe`] gives it an id and a span, and afterwards measures and logs its answer;
//! 2. a net turns a panic into an answer ([`router`]);
//! 3. [`reserved`] lets only probes through if it came over a connection that is kept for them;
//! 4. [`cross_origin`] refuses it if a browser sent it for a foreign web page;
//! 5. [`authorise`] checks its key ([`api_keys`], [`failed_keys`]) and the rate of its caller
//!    ([`rate_limits`]), and passes on who that is and which maps it may use ([`access`],
//!    [`map_scope`]);
//! 6. the handler ([`routes`]) reads the body within its bounds ([`body`], [`memory_budget`]) and
//!    calls the pipeline. Bodies are taken apart, and answers written as JSON ([`answer`]), on
//!    threads of their own ([`codec`]), so that no large one holds up the others.
//!
//! Every failure leaves as `application/problem+json` ([`problem`]).
//!
//! The server answers `/livez` and `/readyz` from its first moment. Everything that needs the
//! pipeline answers `not_ready` until start-up puts the service into the state ([`state`]).

pub mod access;
pub mod answer;
pub mod api_keys;
pub mod auth;
pub mod authorise;
pub mod body;
pub mod codec;
pub mod config;
pub mod connection_info;
pub mod cross_origin;
mod examples;
pub mod failed_keys;
pub mod map_scope;
pub mod memory_budget;
pub mod observe;
pub mod openapi;
pub mod problem;
pub mod rate_limits;
pub mod reserved;
pub mod route;
pub mod router;
pub mod routes;
pub mod serve;
pub mod state;

pub use config::{ApiKey, AuthConfig, HttpConfig, KeyHashes, Role};
pub use map_scope::MapPattern;
pub use router::app;
pub use serve::tls::{Certificate, TlsError};
pub use serve::{serve, serve_encrypted};
pub use state::AppState;
