//! What researchers and map builders use beside the service. A server runs without it.
//!
//! | module | holds |
//! |---|---|
//! | [`datasets`] | readers for the data sets of the field |
//! | [`eval`] | recall, calibration and reports |
//! | [`train`] | learning the head and the backbone |
//! | [`synth`] | the street renderer behind the demo map |
//! | [`draw`] | pictures of matches |
//! | [`mod@bench`] | every stage beside a plain implementation and the machine's limit |
//! | [`choice`] | what callers parse from a name |

pub mod bench;
pub mod choice;
pub mod datasets;
pub mod draw;
pub mod eval;
pub mod synth;
pub mod train;

// Named for a feature of it that candle's products gain from; see the workspace's manifest.
use gemm as _;
