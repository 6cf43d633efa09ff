//! Exact nearest neighbours among the global descriptors of one map.
//!
//! A query must see every reference of a map, because an approximate index loses the very places
//! that re-ranking would have saved. It must do so within milliseconds for a million references,
//! while references are added and removed. The scan is limited by memory bandwidth, so it reads
//! int8 codes, a quarter of the bytes; `scan` proves why the result is exact nevertheless.
//!
//! References are kept in blocks of 4096. A sealed block never changes, so a search takes the list
//! of them and scans without a lock while the index moves on. New references go to one open block,
//! the tail; a search scans it under a read lock, for some 40 microseconds at most. A full tail is
//! sealed and moved to the list. So a search sees the index as it was at one instant, and no change
//! has to wait for a search to finish.
//!
//! A removal copies a bitmap of 512 bytes, and the names of 64 blocks if a search holds the list.
//! Two blocks that are at most half full are merged, which costs each removal a constant share of
//! one copy. An id above all earlier ones, as those of the store are, is inserted without a
//! look-up. The ids of the store ascend in the order of insertion, so blocks are mostly sorted
//! already and their ranges disjoint. That makes operations fast, but nothing depends on it.
//!
//! | module | holds |
//! |---|---|
//! | `index` | [`MapIndex`]: what a map's users call |
//! | `build` | [`IndexBuilder`]: an index from references that arrive one after another |
//! | `list`, `sealed`, `block` | the blocks, their list, and which rows of them are removed |
//! | `scan`, `nearest` | one query against blocks: bounds first, then exact distances |
//! | `near` | the references around some points, by position alone |
//! | `filter` | the geographic and time filter, prepared for a query |
//! | `entry`, `quantised` | a reference as it is given, and its vector as int8 codes |

mod block;
mod build;
mod entry;
mod filter;
mod index;
mod list;
mod near;
mod nearest;
mod quantised;
mod scan;
mod sealed;
#[cfg(test)]
mod tests;

pub use build::IndexBuilder;
pub use entry::{IndexEntry, LocatedReference, Neighbour};
pub use index::MapIndex;
