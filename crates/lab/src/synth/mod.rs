//! A deterministic renderer of street scenes: the demo map and unlimited test images.
//!
//! Real street photos may not be shipped, and noise would not tell a good matcher from a bad one.
//! This world has what makes place recognition hard: streets whose houses share a style, so that
//! global descriptors confuse them; details (windows, signs, doors) that settle it; true
//! perspective, so that two views of a front are related by a homography; and changes of viewpoint,
//! light and traffic between captures.
//!
//! A [`StreetWorld`] is endless and settled by its seed: streets of lots ([`scene`]), fronts and
//! objects painted in metres ([`facade`], [`props`]), drawn through a pinhole camera ([`raster`])
//! under a condition ([`light`]). The same seed gives the same bytes.

mod dataset;
mod facade;
mod light;
mod paint;
mod props;
mod random;
mod raster;
mod scene;
mod style;
mod texture;
mod world;

pub use dataset::{SynthError, TownOptions, TownSummary, write_town};
pub use light::Condition;
pub use world::{Capture, StreetWorld, Viewpoint};
