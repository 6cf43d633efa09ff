//! The truth on disk: references, their metadata and descriptors.
//!
//! A place, once acknowledged, must survive anything short of losing the disk; and a damaged disk
//! must be noticed rather than believed.
//!
//! | module | holds |
//! |---|---|
//! | `traits` | what a store can do: [`ReadPlaces`], [`WritePlaces`], [`MaintainPlaces`] |
//! | `combined` | [`CombinedStore`], one store made of parts from several |
//! | `records` | what goes into a store and comes out of it |
//! | `config` | [`StoreConfig`], the settings of the embedded store |
//! | `error` | [`StoreError`] |
//! | [`codec`] | the bytes of key patches and vectors |
//! | `sqlite` | [`SqliteStore`]: one database with a checksum on every row |
//! | [`crash_points`] | places where tests let the process die between two writes |

pub mod codec;
mod combined;
mod config;
pub mod crash_points;
mod error;
mod records;
mod sqlite;
mod traits;

pub use combined::CombinedStore;
pub use config::StoreConfig;
pub use error::{EngineCause, StoreError};
pub use records::{
    Cursor, Damage, Footprint, GlobalRow, Inserted, MapInfo, NewHead, Page, Quarantined,
    ReferencePatch, VerifyReport,
};
pub use sqlite::{LostTail, SqliteStore};
pub use traits::{HeadExchange, MaintainPlaces, PlaceStore, ReadPlaces, WritePlaces};
