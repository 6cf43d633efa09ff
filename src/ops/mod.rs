//! What operators see and touch: metrics, logs, health, memory, shutdown.
//!
//! Nothing here knows the web or the stages; `pipeline` and `http` write into [`Metrics`] and
//! [`Health`], the HTTP surface reads them out.

pub mod disk;
pub mod health;
pub mod logging;
pub mod memory;
pub mod metrics;
pub mod shutdown;

pub use health::{Health, Unready};
pub use logging::{LogConfig, LogFormat};
pub use metrics::{Metrics, Stage};
