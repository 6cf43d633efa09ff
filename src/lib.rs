//! PlaceFormer: which mapped place does this photo show?
//!
//! The way of the data:
//!
//! ```text
//! bytes --image--> RGB tensor --extract--> Descriptor { global [256], key patches at 3 scales }
//!                                             |
//!         ingest: Descriptor + metadata --store--> committed, then searchable
//!         query:  global --search--> 100 candidates --store--> their key patches --rerank--> ranked places
//! ```
//!
//! This package is the service and its command line:
//!
//! | module | holds |
//! |---|---|
//! | [`http`] | the web surface over the pipeline |
//! | [`pipeline`] | the only code that composes the stages |
//! | [`config`], [`ops`] | settings; metrics, logs, health, shutdown |
//! | [`server`] | settings to a running server |
//! | [`cli`] | one file per subcommand |
//!
//! It stands on the crates of the workspace, whose dependencies Cargo keeps one-way:
//!
//! | crate | holds |
//! |---|---|
//! | `placeformer-core` | types, the one table of error codes, durable files, geography |
//! | `placeformer-kernels` | SIMD inner loops with scalar twins; the only `unsafe` code |
//! | `placeformer-vision` | the stages `image`, `extract`, `search` and `rerank`: pure computation |
//! | `placeformer-track` | where a vehicle is, from one photo after another, and its token |
//! | `placeformer-models` | where the weights of a preset come from |
//! | `placeformer-store` | references and their descriptors on disk |
//! | `placeformer-lab` | data sets, evaluation, training, drawn streets, benchmarks |
//!
//! `tests/project/architecture.rs` keeps what Cargo cannot: `http -> pipeline`, and axum only in
//! `http`.

pub mod cli;
pub mod config;
pub mod http;
pub mod ops;
pub mod pipeline;
pub mod server;
