//! What the integration tests share.
//!
//! | module | holds |
//! |---|---|
//! | [`noise`] | random numbers and pictures, the same for the same seed |
//! | [`photo`] | photos that say about themselves where and when they were taken |
//! | [`places`] | made-up references for tests of the store and the index |
//! | [`program`] | the compiled program, run as a user would run it |
//! | [`service`] | a whole service inside the test, with descriptors that need no weights |
//! | [`small_disk`] | a file system that fills up soon |
//! | [`weights`] | made-up weights of a transformer |
#![allow(dead_code, reason = "each test binary uses its own part")]

pub mod noise;
pub mod photo;
pub mod places;
pub mod program;
pub mod service;
pub mod small_disk;
pub mod weights;
