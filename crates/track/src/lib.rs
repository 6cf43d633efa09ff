//! Where a vehicle is, from one photo after another.
//!
//! A single photo of a dull wall matches many walls of a map. A vehicle cannot jump, so what was
//! known a second ago tells most of them apart. This crate holds that knowledge as a probability
//! for each of a few hundred references of the map and one for being elsewhere (a discrete Bayes
//! filter): it moves with the vehicle, is weighed by what each photo shows, and travels with the
//! client in a token, so that no server keeps a state.
//!
//! The filter knows metres and seconds, and that it can be wrong: with each frame a share of its
//! belief is given up, because vehicles are towed, odometry fails and maps end.
//!
//! | module | holds |
//! |---|---|
//! | `ground` | positions in metres |
//! | `motion` | how likely a vehicle came from one place to another |
//! | `filter` | belief, prediction and posterior |
//! | `step` | one frame: what is expected, what is believed after |
//! | `evidence` | what a photo says about a place, from calibrated scores |
//! | `estimate` | position and heading with their accuracy, from weighted places |
//! | `token`, `key` | a track on its way: written, authenticated, read |

mod estimate;
mod evidence;
mod filter;
mod ground;
mod key;
mod motion;
mod step;
mod token;

pub use estimate::{Estimate, Sight, estimate};
pub use evidence::Evidence;
pub use filter::{Belief, FilterSettings, PLACE_RADIUS_M, Posterior, Prediction, predict};
pub use ground::{Place, Point};
pub use key::{KEY_BYTES, KeyError, TrackKey};
pub use motion::{Motion, Travel, Turn};
pub use step::{Expectation, Whereabouts};
pub use token::{Believed, LONGEST_TOKEN, MOST_PLACES, TokenError, Track};
