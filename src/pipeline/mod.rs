//! The only code that composes the stages; knows nothing of the web.
//!
//! A [`Service`] has the store, the in-memory index of every map, the model and the matcher. Three
//! paths lead through it: [`Service::ingest`], [`Service::query`] and [`Service::match_images`].
//! Each takes a place in a bounded queue, and is refused at once if the queue is full. It then
//! decodes the image off the async threads, waits for the one compute worker, and finishes in a
//! blocking task. Wherever requests wait, callers take turns, so that one that sends many does not
//! keep the others from being answered. A caller that goes away drops its future, and with it
//! everything that has not begun; blocking work that has begun keeps its place in the queue and
//! its permit until it ends.
//!
//! The store is the truth and the index is a cache of it. A reference enters the index only after
//! its commit and leaves it right after its deletion. A query between the two finds a candidate in
//! the index that is no longer in the store, and skips it.
//!
//! | module | what it does |
//! |---|---|
//! | `query`, `ingest`, `match_images` | the three paths, each in the order of its steps |
//! | `reranking` | a query's candidates in the order of their key patches |
//! | `changes`, `rehead` | changing and deleting references and maps; another head for a map |
//! | `service`, `startup` | the state they share, and how it is built from the store |
//! | `extraction` | decoding and the compute worker |
//! | `caller`, `fair` | who a request is from; permits for which callers take turns |
//! | `admission`, `blocking` | bounds on waiting and on threads |
//! | `maps`, `patches` | index and locks of each map; cache of key patches |
//! | `tracks` | queries that continue one another |
//! | `calibrations` | how far the best answer can be trusted |

mod admission;
mod blocking;
mod calibrations;
mod caller;
mod changes;
mod config;
mod error;
mod extraction;
mod fair;
mod ingest;
mod maps;
mod match_images;
mod patches;
mod query;
mod rehead;
mod reranking;
mod service;
mod source;
mod startup;
mod timings;
mod tracks;

pub use calibrations::{MatchConfidence, UnmatchedReason};
pub use caller::{Caller, network_of};
pub use config::PipelineConfig;
pub use error::PipelineError;
pub use ingest::{FieldSource, FieldSources, IngestAnswer, IngestRequest};
pub use match_images::{MatchAnswer, MatchTarget, MatchedPair};
pub use query::{QueryAnswer, QueryOptions, QueryRequest, QueryResult};
pub use reranking::RankedScore;
pub use service::{Service, ServiceInfo};
pub use source::DescriptorSource;
pub use startup::Parts;
pub use timings::Timings;
pub use tracks::{FrameError, TrackAnswer, TrackConfig, TrackOptions};
