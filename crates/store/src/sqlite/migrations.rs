//! The schema's history, carried in the program and applied forward only.
//!
//! Each migration runs in a transaction of its own together with the row that records it, so that a
//! crash leaves it applied or not, never half. A database that is ahead of this release, or whose
//! past differs, is refused untouched.

use super::engine::failed;
use crate::{StoreError, crash_points};
use rusqlite::{Connection, TransactionBehavior, params};

/// Every migration, oldest first; its version is its place, counting from 1.
const MIGRATIONS: &[(&str, &str)] = &[
    (
        "initial",
        include_str!("../../../../migrations/sqlite/0001_initial.sql"),
    ),
    (
        "map_head",
        include_str!("../../../../migrations/sqlite/0002_map_head.sql"),
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
    let migrating = failed("migrating it");
    let applied = history(connection)?;
    let supported = migrations.len() as i64;
    if let Some(&(found, _)) = applied.last()
        && found > supported
    {
        return Err(StoreError::SchemaTooNew { found, supported });
    }
    for (place, (name, sql)) in migrations.iter().enumerate() {
        let (version, checksum) = (place as i64 + 1, i64::from(crc32fast::hash(sql.as_bytes())));
        match applied.iter().find(|(applied, _)| *applied == version) {
            Some((_, same)) if *same == checksum => continue,
            Some(_) => return Err(StoreError::MigrationChanged { version }),
            None => {}
        }
        tracing::info!(version, name, "migrating the store");
        let transaction = connection
            .transaction_with_behavior(TransactionBehavior::Immediate)
            .map_err(&migrating)?;
        transaction.execute_batch(HISTORY).map_err(&migrating)?;
        transaction.execute_batch(sql).map_err(&migrating)?;
        transaction
            .execute(
                "INSERT INTO schema_migration (version, name, checksum) VALUES (?1, ?2, ?3)",
                params![version, name, checksum],
            )
            .map_err(&migrating)?;
        crash_points::reach(crash_points::MID_MIGRATION);
        transaction.commit().map_err(&migrating)?;
    }
    Ok(())
}

/// Versions and checksums applied so far, ascending; empty for a new database.
fn history(connection: &Connection) -> Result<Vec<(i64, i64)>, StoreError> {
    let reading = failed("reading its schema history");
    if !connection
        .table_exists(None, "schema_migration")
        .map_err(&reading)?
    {
        return Ok(Vec::new());
    }
    let mut statement = connection
        .prepare("SELECT version, checksum FROM schema_migration ORDER BY version")
        .map_err(&reading)?;
    let rows = statement
        .query_map([], |row| Ok((row.get(0)?, row.get(1)?)))
        .map_err(&reading)?;
    rows.collect::<Result<_, _>>().map_err(&reading)
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
