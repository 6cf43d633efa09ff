//! What operators watch and control: metrics, logs, health, memory and disk, reloading, shutdown.
//!
//! Nothing here knows the web or the stages. `pipeline` and `http` write into [`Metrics`] and
//! [`Health`], and the HTTP surface shows them.

pub mod disk;
pub mod health;
pub mod logging;
pub mod memory;
pub mod metrics;
pub mod reload;
pub mod shutdown;

pub use health::{Health, Unready};
pub use logging::{LogConfig, LogFormat};
pub use metrics::{Metrics, PipelineStage};
