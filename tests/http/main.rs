//! The service through its HTTP surface, with a real store and descriptors that need no weights.

#[path = "../common/mod.rs"]
mod common;

use common::{service as support, small_disk};

mod admission;
mod backup;
mod bounds;
mod calibration;
mod connection;
mod damage;
mod disk;
mod errors;
mod index_rebuild;
mod killed;
mod logs;
mod photo_metadata;
mod process;
mod rehead;
mod routes;
mod surface;
