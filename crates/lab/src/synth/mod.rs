//! A deterministic renderer of street scenes: the demo map and unlimited test images.
//!
//! Real street photos may not be shipped, and noise would not tell a good matcher from a bad one.
//! This world has what makes place recognition hard: streets whose houses share a style, so that
//! global descriptors confuse them; details (windows, signs, doors) that decide it; true
//! perspective, so that two views of a front are related by a homography; and changes of viewpoint,
//! light and traffic between captures.
//!
//! A [`StreetWorld`] is endless and follows from its seed: the same seed gives the same bytes.
//!
//! | module | holds |
//! |---|---|
//! | `world` | places, cameras, and the picture of a place |
//! | `scene`, `objects` | streets of lots, and what stands on them |
//! | `style` | what the houses of a street have in common |
//! | `facade`, `ground_floor`, `window` | fronts of houses, painted in metres |
//! | `props`, `vehicle`, `lettering` | objects, painted in metres |
//! | `paint`, `texture`, `random` | brushes, textures, and seeded randomness |
//! | `visible`, `raster` | what a pinhole camera sees, and its drawing |
//! | `light` | sky, sun, lamps, and what a lens makes of them |
//! | `dataset` | a town as a folder of images and tables |

mod dataset;
mod facade;
mod ground_floor;
mod lettering;
mod light;
mod objects;
mod paint;
mod props;
mod random;
mod raster;
mod scene;
mod style;
mod texture;
mod vehicle;
mod visible;
mod window;
mod world;

pub use dataset::{SynthError, TownOptions, TownSummary, write_town};
pub use light::Condition;
pub use world::{Capture, StreetWorld, Viewpoint};
