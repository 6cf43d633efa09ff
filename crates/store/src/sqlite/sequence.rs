//! Numbers that are never used twice, so that what is left of a deleted row cannot pass for a part
//! of a new one; and the count of commits, by which a database knows how far it has come.

use super::keys::{ReferenceNumber, Version};
use rusqlite::types::FromSql;
use rusqlite::{Connection, named_params};

/// Takes the next number for a reference.
pub(super) fn next_reference(connection: &Connection) -> rusqlite::Result<ReferenceNumber> {
    next(connection, "reference")
}

/// Takes the next version of global vectors.
pub(super) fn next_version(connection: &Connection) -> rusqlite::Result<Version> {
    next(connection, "version")
}

fn next<T: FromSql>(connection: &Connection, name: &str) -> rusqlite::Result<T> {
    connection
        .prepare_cached(
            "UPDATE sequence SET next = next + 1 WHERE name = ?1 RETURNING next - 1 AS taken",
        )?
        .query_row([name], |row| row.get("taken"))
}

/// How far a database has come.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Progress {
    /// Drawn at random when the store was made.
    pub store: i64,
    /// Groups of writes that were committed.
    pub commits: i64,
    /// The next number of a reference.
    pub references: i64,
}

/// How far this database has come; none if it is of a release that did not count, or has no schema.
pub(super) fn progress(connection: &Connection) -> rusqlite::Result<Option<Progress>> {
    if !connection.table_exists(None, "sequence")? {
        return Ok(None);
    }
    let sql = "SELECT (SELECT next FROM sequence WHERE name = 'store') AS store,
                      (SELECT next FROM sequence WHERE name = 'commit') AS commits,
                      (SELECT next FROM sequence WHERE name = 'reference') AS taken";
    connection.prepare_cached(sql)?.query_row([], |row| {
        let store: Option<i64> = row.get("store")?;
        let commits: Option<i64> = row.get("commits")?;
        let references: Option<i64> = row.get("taken")?;
        Ok(store.zip(commits).map(|(store, commits)| Progress {
            store,
            commits,
            references: references.unwrap_or(1),
        }))
    })
}

/// Counts one more commit, inside its transaction.
pub(super) fn count_commit(connection: &Connection) -> rusqlite::Result<Option<Progress>> {
    connection
        .prepare_cached("UPDATE sequence SET next = next + 1 WHERE name = 'commit'")?
        .execute([])?;
    progress(connection)
}

/// Whether the database was closed when it had come as far as it has, so that nothing of it can lie
/// in a log.
pub(super) fn is_closed(connection: &Connection) -> rusqlite::Result<bool> {
    let sql = "SELECT count(*) = 2 AND min(next) = max(next) AS closed
               FROM sequence WHERE name IN ('commit', 'closed')";
    connection.query_row(sql, [], |row| row.get("closed"))
}

/// Says in the database that it is open.
pub(super) fn set_open(connection: &Connection) -> rusqlite::Result<()> {
    let sql = "UPDATE sequence SET next = -1 WHERE name = 'closed'";
    connection.execute(sql, []).map(drop)
}

/// Says in the database that it is closed as it is now.
pub(super) fn set_closed(connection: &Connection) -> rusqlite::Result<()> {
    let sql = "UPDATE sequence SET next = (SELECT next FROM sequence WHERE name = 'commit')
               WHERE name = 'closed'";
    connection.execute(sql, []).map(drop)
}

/// Goes on behind what was lost: no number that a lost commit took is taken again.
pub(super) fn skip_to(
    connection: &Connection,
    commits: i64,
    references: i64,
) -> rusqlite::Result<()> {
    let transaction = connection.unchecked_transaction()?;
    let raise = "UPDATE sequence SET next = max(next, :least) WHERE name = :name";
    for (name, least) in [("commit", commits), ("reference", references)] {
        transaction.execute(raise, named_params! { ":name": name, ":least": least })?;
    }
    transaction.commit()
}
