//! Tracks: queries that continue one another.
//!
//! A frame brings the token of the previous answer, in which is where the vehicle was thought to
//! be. From there its motion leads to the places in reach. They are compared with the photo beside
//! the candidates of the global search, the likeliest of them at least, and what the photo says
//! decides among all. The filter itself is in the crate `placeformer-track`; here are its inputs
//! and outputs.
//!
//! A query without a track goes the same way with nothing known before, because the places around
//! its best answer say where exactly it was taken.

mod config;
mod frame;
mod localise;

pub use config::TrackConfig;
pub use frame::{FrameError, TrackOptions};

pub(super) use frame::Frame;
pub(super) use localise::{Localisation, Sighting};

/// What is known of a track after a frame.
#[derive(Debug, Clone, PartialEq)]
pub struct TrackAnswer {
    /// To be sent with the next frame.
    pub token: String,
    /// Probability that the vehicle is where the first result shows it.
    pub probability: f64,
    /// Whether it is more likely at no known place.
    pub lost: bool,
    /// Frames so far.
    pub frames: u32,
}
