//! The service through its HTTP surface, with a real store and descriptors that need no weights.

#[path = "../common/small_disk.rs"]
mod small_disk;
#[path = "../support/mod.rs"]
mod support;

mod admission;
mod backup;
mod bounds;
mod calibration;
mod connection;
mod damage;
mod disk;
mod errors;
mod killed;
mod logs;
mod process;
mod rehead;
mod routes;
mod surface;
