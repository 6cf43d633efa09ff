//! PlaceFormer: which mapped place does this photo show?
//!
//! The way of the data, and the rooms it passes through:
//!
//! ```text
//! bytes --image--> RGB tensor --extract--> Descriptor { global [256], key patches at 3 scales }
//!                                             |
//!         ingest: Descriptor + metadata --store--> committed, then searchable
//!         query:  global --search--> 100 candidates --store--> their key patches --rerank--> ranked places
//! ```
//!
//! | module | holds |
//! |---|---|
//! | [`types`] | the nouns: identifiers, locations, descriptors, references |
//! | [`error`] | the one table of error codes |
//! | [`kernels`] | SIMD inner loops with scalar twins; the only `unsafe` code |
//! | [`image`], [`extract`], [`search`], [`store`], [`rerank`] | the five stages; none imports another |
//! | [`pipeline`] | the only code that composes the stages |
//! | [`http`] | the web surface over the pipeline |
//! | [`config`], [`ops`] | settings; metrics, logs, health, shutdown |
//! | [`eval`], [`train`] | recall on data sets; learning the head and the backbone |
//! | [`synth`], [`draw`] | the street renderer behind the demo map; pictures of matches |
//! | [`mod@bench`] | every stage beside a plain implementation and the machine's limit |
//! | [`cli`] | one file per subcommand |
//!
//! Imports point one way, `http -> pipeline -> stages -> {types, error, kernels}`;
//! `tests/architecture.rs` fails on a back edge.
#![deny(unsafe_code)]
#![warn(missing_docs)]

pub mod bench;
pub mod cli;
pub mod config;
pub mod draw;
pub mod error;
pub mod eval;
pub mod extract;
pub mod http;
pub mod image;
#[allow(
    unsafe_code,
    reason = "the one room for it: SIMD kernels, each with a scalar twin"
)]
pub mod kernels;
pub mod ops;
pub mod pipeline;
pub mod rerank;
pub mod search;
pub mod store;
pub mod synth;
pub mod train;
pub mod types;
