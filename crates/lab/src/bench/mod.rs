//! Every stage measured beside what one would write first, in the same run, and as a share of the
//! machine's limit.
//!
//! | module | holds |
//! |---|---|
//! | `limits` | arithmetic and memory bandwidth that this machine reaches at most |
//! | `measure` | ours and the baseline in turn, so that what disturbs one disturbs the other |
//! | [`scenes`], `streets` | the inputs: a drawn photo, key patches with planted inliers, a map |
//! | [`baselines`] | the plain implementations |
//! | `context`, `rows` | what all measurements share; from a name to its measurement |
//! | `decode`, `extract`, `search`, `candidates`, `track`, `query` | the measurements of queries |
//! | `ingest`, `rehead` | those of maps |
//! | [`filled`] | a store that shows more references than it holds |
//! | `service` | the whole service, which the caller passes in |
//!
//! The Criterion benchmarks use the same inputs and baselines.

pub mod baselines;
mod candidates;
mod context;
mod decode;
mod error;
mod extract;
pub mod filled;
mod ingest;
mod limits;
mod measure;
mod names;
mod query;
mod rehead;
mod row;
mod rows;
pub mod scenes;
mod search;
mod service;
mod streets;
mod track;

pub use candidates::store_scene;
pub use context::Bench;
pub use error::BenchError;
pub use limits::Limits;
pub use names::NAMES;
pub use row::BenchRow;
pub use service::{MeasuredService, ServiceError, StartService};
pub use streets::{REFERENCE_SIZE, fill_with_streets, street_map};
