//! The service through its HTTP surface, with a real store and descriptors that need no weights.

#[path = "../common/mod.rs"]
mod common;

use common::{service as support, small_disk};

mod admission;
mod backup;
mod bounds;
mod calibration;
mod connection;
mod cross_origin;
mod crowds;
mod damage;
mod disk;
mod errors;
mod fairness;
mod index_rebuild;
mod inputs;
mod keys;
mod killed;
mod listener;
mod logs;
mod lost_storage;
mod off_thread;
mod photo_metadata;
mod process;
mod rehead;
mod routes;
mod scores;
mod slow_clients;
mod surface;
mod tls;
mod tracks;
mod uninformative;
