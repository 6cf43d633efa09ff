//! The schema's history, carried in the program and applied forward only.
//!
//! Each migration runs in a transaction of its own together with the row that records it, so that
//! a crash leaves it applied or not, never half. A database that is ahead of this release, or
//! whose past differs, is refused untouched.

use super::engine::failed;
use crate::crash_points;
use crate::error::StoreError;
use rusqlite::{Connection, TransactionBehavior, named_params};

/// Name and SQL of every migration, oldest first. Its version is its place, counting from 1.
const MIGRATIONS: &[(&str, &str)] = &[
    (
        "initial",
        include_str!("../../../../migrations/sqlite/0001_initial.sql"),
    ),
    (
        "map_head",
        include_str!("../../../../migrations/sqlite/0002_map_head.sql"),
    ),
    (
        "commit_count",
        include_str!("../../../../migrations/sqlite/0003_commit_count.sql"),
    ),
    (
        "altitude",
        include_str!("../../../../migrations/sqlite/0004_altitude.sql"),
    ),
];

const HISTORY: &str = "CREATE TABLE IF NOT EXISTS schema_migration (
    version    INTEGER PRIMARY KEY,
    name       TEXT    NOT NULL,
    checksum   INTEGER NOT NULL,
    applied_at TEXT    NOT NULL DEFAULT (strftime('%Y-%m-%dT%H:%M:%SZ', 'now'))
) STRICT";

/// Brings the database to this release's schema.
pub(super) fn apply(connection: &mut Connection) -> Result<(), StoreError> {
    apply_all(connection, MIGRATIONS)
}

fn apply_all(connection: &mut Connection, migrations: &[(&str, &str)]) -> Result<(), StoreError> {
    let applied = history(connection).map_err(failed("reading its schema history"))?;
    let supported = migrations.len() as i64;
    if let Some(newest) = applied.last()
        && newest.version > supported
    {
        return Err(StoreError::SchemaTooNew {
            found: newest.version,
            supported,
        });
    }
    for (version, (name, sql)) in (1..).zip(migrations) {
        let checksum = i64::from(crc32fast::hash(sql.as_bytes()));
        match applied.iter().find(|applied| applied.version == version) {
            Some(applied) if applied.checksum == checksum => {}
            Some(_) => return Err(StoreError::MigrationChanged { version }),
            None => {
                tracing::info!(version, name, "migrating the store");
                run(connection, version, name, sql, checksum).map_err(failed("migrating it"))?;
            }
        }
    }
    Ok(())
}

/// Runs one migration and records it.
fn run(
    connection: &mut Connection,
    version: i64,
    name: &str,
    sql: &str,
    checksum: i64,
) -> rusqlite::Result<()> {
    let transaction = connection.transaction_with_behavior(TransactionBehavior::Immediate)?;
    transaction.execute_batch(HISTORY)?;
    transaction.execute_batch(sql)?;
    transaction.execute(
        "INSERT INTO schema_migration (version, name, checksum)
         VALUES (:version, :name, :checksum)",
        named_params! { ":version": version, ":name": name, ":checksum": checksum },
    )?;
    crash_points::reach(crash_points::MID_MIGRATION);
    transaction.commit()
}

/// A migration that the database has been through.
struct Applied {
    version: i64,
    /// CRC-32 of its SQL.
    checksum: i64,
}

/// The migrations applied so far, ascending; none for a new database.
fn history(connection: &Connection) -> rusqlite::Result<Vec<Applied>> {
    if !connection.table_exists(None, "schema_migration")? {
        return Ok(Vec::new());
    }
    let sql = "SELECT version, checksum FROM schema_migration ORDER BY version";
    let mut statement = connection.prepare(sql)?;
    let rows = statement.query_map([], |row| {
        Ok(Applied {
            version: row.get("version")?,
            checksum: row.get("checksum")?,
        })
    })?;
    rows.collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const TWO: &[(&str, &str)] = &[("a", "CREATE TABLE a (x)"), ("b", "CREATE TABLE b (x)")];

    #[test]
    fn migrations_apply_once_and_in_order() {
        let mut connection = Connection::open_in_memory().unwrap();
        apply_all(&mut connection, &TWO[..1]).unwrap();
        apply_all(&mut connection, TWO).unwrap();
        apply_all(&mut connection, TWO).unwrap();
        assert_eq!(history(&connection).unwrap().len(), 2);
        assert!(connection.table_exists(None, "b").unwrap());
    }

    #[test]
    fn a_newer_or_different_past_is_refused() {
        let mut connection = Connection::open_in_memory().unwrap();
        apply_all(&mut connection, TWO).unwrap();
        let newer = apply_all(&mut connection, &TWO[..1]);
        assert!(matches!(
            newer,
            Err(StoreError::SchemaTooNew {
                found: 2,
                supported: 1
            })
        ));
        let other = [TWO[0], ("b", "CREATE TABLE other (x)")];
        assert!(matches!(
            apply_all(&mut connection, &other),
            Err(StoreError::MigrationChanged { version: 2 })
        ));
    }

    #[test]
    fn a_failing_migration_leaves_nothing_behind() {
        let mut connection = Connection::open_in_memory().unwrap();
        let broken = [TWO[0], ("b", "CREATE TABLE c (x); CREATE TABLE c (x)")];
        assert!(apply_all(&mut connection, &broken).is_err());
        assert!(!connection.table_exists(None, "c").unwrap());
        apply_all(&mut connection, TWO).unwrap();
    }
}
