//! Metrics, logs, health, shutdown.
