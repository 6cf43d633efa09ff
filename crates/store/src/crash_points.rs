//! Named places at which the process can be made to die, for tests of durability.
//!
//! A store is only as good as its behaviour when the power goes between two writes. Tests
//! therefore start a real process with `PLACEFORMER_CRASH_AT=name` or `name:nth`. The process
//! aborts, without unwinding or flushing anything, when it reaches that place (for the nth time,
//! counting from 1).
//!
//! An environment variable must never be able to stop a production server. So the places exist
//! only with the cargo feature `crash-points`, which tests turn on and which release builds lack.
//! Without it the variable is never read and reaching a place compiles to nothing.

/// The environment variable that names the place to die at.
pub const VARIABLE: &str = "PLACEFORMER_CRASH_AT";

/// Whether this build has the places at all, that is, the feature `crash-points`.
pub const ENABLED: bool = cfg!(feature = "crash-points");

/// Jobs wait to be written, no transaction is open yet.
pub const BEFORE_BEGIN: &str = "before_begin";
/// A reference's metadata row is written, its descriptor is not.
pub const MID_INSERT: &str = "mid_insert";
/// Every job of the group has written, nothing is committed.
pub const BEFORE_COMMIT: &str = "before_commit";
/// The group is durable, the commit mark does not say so yet.
pub const AFTER_COMMIT: &str = "after_commit";
/// Half of the new commit mark is written.
pub const MID_MARK: &str = "mid_mark";
/// The commit mark is durable, the callers of the group have not been answered.
pub const AFTER_MARK: &str = "after_mark";
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
    MID_MARK,
    AFTER_MARK,
    MAP_DELETED,
    MID_PURGE,
    MID_REHEAD,
    MID_MIGRATION,
];

/// Does nothing: this build has no crash points.
#[cfg(not(feature = "crash-points"))]
#[inline(always)]
pub(crate) fn reach(_name: &str) {}

#[cfg(feature = "crash-points")]
pub(crate) use armed::reach;

#[cfg(feature = "crash-points")]
mod armed {
    use super::VARIABLE;
    use std::sync::OnceLock;
    use std::sync::atomic::{AtomicU64, Ordering};

    /// The place named by the environment variable.
    struct Armed {
        name: String,
        /// How many times it is still to be reached, the last of which is fatal.
        remaining: AtomicU64,
    }

    impl Armed {
        fn parse(setting: &str) -> Self {
            let (name, nth) = setting.split_once(':').unwrap_or((setting, "1"));
            Self {
                name: name.to_owned(),
                remaining: AtomicU64::new(nth.parse().unwrap_or(1)),
            }
        }

        /// Counts one arrival at `name`; true for the one at which the process has to die.
        fn is_due(&self, name: &str) -> bool {
            self.name == name && self.remaining.fetch_sub(1, Ordering::Relaxed) == 1
        }
    }

    /// Dies here if this is the place named by the environment, reached often enough.
    pub(crate) fn reach(name: &str) {
        static ARMED: OnceLock<Option<Armed>> = OnceLock::new();
        let armed = ARMED.get_or_init(|| {
            let setting = std::env::var(VARIABLE).ok()?;
            Some(Armed::parse(&setting))
        });
        if armed.as_ref().is_some_and(|armed| armed.is_due(name)) {
            std::process::abort();
        }
    }

    #[cfg(test)]
    mod tests {
        use super::*;

        #[test]
        fn a_setting_names_a_place_and_optionally_how_often_it_is_reached() {
            let first = Armed::parse("before_commit");
            assert!(!first.is_due("mid_purge"));
            assert!(first.is_due("before_commit"));
            let third = Armed::parse("mid_purge:3");
            let due = [(); 4].map(|()| third.is_due("mid_purge"));
            assert_eq!(due, [false, false, true, false]);
        }
    }
}
