//! What no compiler checks: which module may use which, that x86 code stays in its modules, and that
//! dashboards and alerts fit the service's metrics.

mod architecture;
mod dashboards;
mod rust_source;
mod x86_modules;
