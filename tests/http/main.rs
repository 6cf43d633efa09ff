//! The service through its HTTP surface, with a real store and descriptors that need no weights.

#[path = "../support/mod.rs"]
mod support;

mod admission;
mod connection;
mod errors;
mod surface;
