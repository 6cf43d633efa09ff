//! The numbers by which rows refer to each other.
//!
//! To the engine they are all 64-bit integers, so a map's number passed for a reference's would
//! find some row and go unnoticed. Each kind is therefore a type of its own.

use crate::records::Cursor;
use rusqlite::ToSql;
use rusqlite::types::{FromSql, FromSqlResult, ToSqlOutput, ValueRef};

macro_rules! keys {
    ($($(#[$doc:meta])* $name:ident;)*) => {$(
        $(#[$doc])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
        pub(super) struct $name(i64);

        impl $name {
            /// The integer that the database keeps, which checksums cover.
            pub(super) fn value(self) -> i64 {
                self.0
            }
        }

        impl ToSql for $name {
            fn to_sql(&self) -> rusqlite::Result<ToSqlOutput<'_>> {
                self.0.to_sql()
            }
        }

        impl FromSql for $name {
            fn column_result(value: ValueRef<'_>) -> FromSqlResult<Self> {
                i64::column_result(value).map(Self)
            }
        }
    )*};
}

keys! {
    /// `map.number`.
    MapNumber;
    /// `reference.number`: ascending in the order of creation, never used twice.
    ReferenceNumber;
    /// `map.version`: one set of global vectors, all made by one head.
    Version;
}

impl MapNumber {
    /// Stands for the map of a reference whose row no longer says which.
    pub(super) const UNKNOWN: Self = Self(0);
}

impl ReferenceNumber {
    /// Less than every number, for scans that start at the beginning.
    pub(super) const BEFORE_ALL: Self = Self(i64::MIN);

    /// The reference at a cursor.
    pub(super) fn at(cursor: Cursor) -> Self {
        Self(cursor.number())
    }

    /// The place of this reference.
    pub(super) fn cursor(self) -> Cursor {
        Cursor::at(self.0)
    }
}
