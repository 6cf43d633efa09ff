//! The web surface over the pipeline.
