//! What no compiler checks: which module may use which, and that dashboards and alerts fit the
//! service's metrics.

mod architecture;
mod dashboards;
mod rust_source;
