//! Pictures of matches: both images, attention, key patches, inlier lines.
