//! The checksum that every row carries.
//!
//! It covers each column with a tag for its presence and its length, so that no two different rows
//! share their bytes. It covers the row's number and the table's name as well, so that a row
//! cannot pass for another.

/// A CRC-32 of a row, fed column by column.
pub(super) struct RowChecksum(crc32fast::Hasher);

impl RowChecksum {
    /// Begins the checksum of a row of `table`.
    pub(super) fn of(table: &str) -> Self {
        Self(crc32fast::Hasher::new()).bytes(table.as_bytes())
    }

    pub(super) fn bytes(mut self, value: &[u8]) -> Self {
        self.0.update(&(value.len() as u64).to_le_bytes());
        self.0.update(value);
        self
    }

    pub(super) fn integer(self, value: i64) -> Self {
        self.bytes(&value.to_le_bytes())
    }

    pub(super) fn optional(mut self, value: Option<impl AsRef<[u8]>>) -> Self {
        self.0.update(&[u8::from(value.is_some())]);
        match value {
            Some(value) => self.bytes(value.as_ref()),
            None => self,
        }
    }

    /// The value of the row's `checksum` column.
    pub(super) fn finish(self) -> i64 {
        i64::from(self.0.finalize())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of_columns(first: Option<&str>, second: Option<&str>) -> i64 {
        RowChecksum::of("t")
            .optional(first)
            .optional(second)
            .finish()
    }

    #[test]
    fn columns_that_join_to_the_same_text_differ() {
        assert_ne!(
            of_columns(Some("ab"), Some("c")),
            of_columns(Some("a"), Some("bc"))
        );
        assert_ne!(of_columns(Some(""), None), of_columns(None, Some("")));
        assert_ne!(of_columns(Some("a"), None), of_columns(None, Some("a")));
    }

    #[test]
    fn tables_differ() {
        let of = |table| RowChecksum::of(table).integer(7).finish();
        assert_ne!(of("map"), of("patches"));
    }
}
