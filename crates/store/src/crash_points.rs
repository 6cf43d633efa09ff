//! Named places at which the process can be made to die, for tests of durability.
//!
//! A store is only as good as its behaviour when the power goes between two writes. Tests therefore
//! start the real process with `PLACEFORMER_CRASH_AT=name` or `name:nth` and it aborts, without
//! unwinding or flushing anything, when that place is reached (for the nth time, counting from 1).
//! Without the variable a place costs one load.

use std::sync::OnceLock;
use std::sync::atomic::{AtomicU64, Ordering};

/// The environment variable that arms a crash point.
pub const VARIABLE: &str = "PLACEFORMER_CRASH_AT";

/// Jobs are at hand, no transaction is open yet.
pub const BEFORE_BEGIN: &str = "before_begin";
/// A reference's metadata row is written, its descriptor is not.
pub const MID_INSERT: &str = "mid_insert";
/// Every job of the group has written, nothing is committed.
pub const BEFORE_COMMIT: &str = "before_commit";
/// The group is durable, nobody has been told.
pub const AFTER_COMMIT: &str = "after_commit";
/// A map is marked as deleted, its references still lie on disk.
pub const MAP_DELETED: &str = "map_deleted";
/// One batch of a deleted map is removed, uncommitted.
pub const MID_PURGE: &str = "mid_purge";
/// One batch of vectors for a new head is durable, the map still uses the old ones.
pub const MID_REHEAD: &str = "mid_rehead";
/// A migration has run, uncommitted.
pub const MID_MIGRATION: &str = "mid_migration";

/// Every crash point, for tests that walk through all.
pub const ALL: &[&str] = &[
    BEFORE_BEGIN,
    MID_INSERT,
    BEFORE_COMMIT,
    AFTER_COMMIT,
    MAP_DELETED,
    MID_PURGE,
    MID_REHEAD,
    MID_MIGRATION,
];

struct Armed {
    name: String,
    left: AtomicU64,
}

fn armed() -> Option<&'static Armed> {
    static ARMED: OnceLock<Option<Armed>> = OnceLock::new();
    ARMED
        .get_or_init(|| std::env::var(VARIABLE).ok().map(|setting| parse(&setting)))
        .as_ref()
}

fn parse(setting: &str) -> Armed {
    let (name, nth) = setting.split_once(':').unwrap_or((setting, "1"));
    Armed {
        name: name.to_owned(),
        left: AtomicU64::new(nth.parse().unwrap_or(1)),
    }
}

/// Dies here if this place is the armed one and its turn has come.
pub(super) fn reach(name: &str) {
    if let Some(armed) = armed()
        && armed.name == name
        && armed.left.fetch_sub(1, Ordering::Relaxed) == 1
    {
        std::process::abort();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn settings_name_a_place_and_optionally_its_turn() {
        let first = parse("before_commit");
        assert_eq!(
            (first.name.as_str(), first.left.into_inner()),
            ("before_commit", 1)
        );
        let third = parse("mid_purge:3");
        assert_eq!(
            (third.name.as_str(), third.left.into_inner()),
            ("mid_purge", 3)
        );
    }
}
