//! A deterministic renderer of street scenes: the demo map and unlimited test images.
