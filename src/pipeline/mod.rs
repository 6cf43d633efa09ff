//! The only code that composes the stages; knows nothing of the web.
//!
//! A [`Service`] holds the store, the in-memory index of every map, the model and the matcher.
//! Three ways lead through it: [`Service::ingest`], [`Service::query`] and
//! [`Service::match_images`]. Each takes a ticket at the door (a bounded queue: who finds it full
//! is told so at once), decodes off the async threads, queues for the one compute worker, and
//! finishes in a blocking task. A caller that goes away drops its future, and with it everything
//! not yet begun; blocking work that has begun takes its ticket and its turn along and keeps them
//! until it ends.
//!
//! The store is the truth, the index a cache of it: a reference enters the index only after its
//! commit and leaves it right after its deletion; the few queries between the two skip a candidate
//! they no longer find.

mod admission;
mod blocking;
mod changes;
mod config;
mod error;
mod extraction;
mod ingest;
mod maps;
mod match_images;
mod patches;
mod query;
mod rehead;
mod service;
mod source;
mod startup;
mod timings;
mod trust;

pub use config::PipelineConfig;
pub use error::PipelineError;
pub use ingest::{IngestAnswer, IngestRequest};
pub use match_images::{MatchAnswer, MatchSide, Matched};
pub use query::{QueryAnswer, QueryOptions, QueryRequest, QueryResult};
pub use service::{Service, ServiceInfo};
pub use source::DescriptorSource;
pub use startup::Parts;
pub use timings::Timings;
pub use trust::Verdict;
