//! From pixels to recognised places: what images are accepted, that extraction gives what the
//! reference implementation gives, and that a town is recognised.

#[path = "../common/mod.rs"]
mod common;

mod allocations;
mod golden;
mod golden_extract;
mod image_containers;
mod image_exif;
mod image_golden;
mod image_inputs;
mod image_limits;
mod jpeg;
mod pictures;
mod town;
