//! CSV files of the data sets: columns by name, errors by line, Windows line ends and byte-order
//! marks tolerated.

use super::error::DatasetError;
use std::path::{Path, PathBuf};

/// A whole CSV file with a header.
pub(super) struct Table {
    path: PathBuf,
    headers: Vec<String>,
    rows: Vec<csv::StringRecord>,
}

/// A column found in a table.
#[derive(Clone, Copy)]
pub(super) struct Column(usize);

impl Table {
    /// Reads `path` whole; every row must have as many fields as the header.
    pub(super) fn read(path: &Path) -> Result<Self, DatasetError> {
        let bytes = std::fs::read(path).map_err(DatasetError::io(path))?;
        let bytes = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(&bytes);
        let mut reader = csv::ReaderBuilder::new()
            .trim(csv::Trim::All)
            .from_reader(bytes);
        let record_error = |error: csv::Error| DatasetError::Record {
            path: path.to_owned(),
            line: error.position().map_or(1, csv::Position::line),
            reason: error.to_string(),
        };
        let headers = reader
            .headers()
            .map_err(record_error)?
            .iter()
            .map(str::to_owned)
            .collect();
        let rows = reader
            .records()
            .collect::<Result<_, _>>()
            .map_err(record_error)?;
        Ok(Self {
            path: path.to_owned(),
            headers,
            rows,
        })
    }

    /// The column called `name`.
    pub(super) fn column(&self, name: &str) -> Result<Column, DatasetError> {
        self.optional_column(name)
            .ok_or_else(|| DatasetError::Record {
                path: self.path.clone(),
                line: 1,
                reason: format!(
                    "there is no column {name:?}; the columns are {}",
                    self.headers.join(", ")
                ),
            })
    }

    /// The column called `name`, if there is one.
    pub(super) fn optional_column(&self, name: &str) -> Option<Column> {
        self.headers
            .iter()
            .position(|header| header == name)
            .map(Column)
    }

    /// All rows in the order of the file.
    pub(super) fn rows(&self) -> impl Iterator<Item = Row<'_>> {
        self.rows.iter().map(|record| Row {
            table: self,
            record,
        })
    }
}

/// One row.
#[derive(Clone, Copy)]
pub(super) struct Row<'t> {
    table: &'t Table,
    record: &'t csv::StringRecord,
}

impl<'t> Row<'t> {
    /// The text of a field.
    pub(super) fn text(self, column: Column) -> &'t str {
        self.record.get(column.0).unwrap_or("")
    }

    /// A finite number.
    pub(super) fn number(self, column: Column) -> Result<f64, DatasetError> {
        let text = self.text(column);
        match text.parse::<f64>() {
            Ok(value) if value.is_finite() => Ok(value),
            _ => Err(self.error(format!(
                "{} {text:?} is not a number",
                self.table.headers[column.0]
            ))),
        }
    }

    /// `True`, `False`, `1`, `0` in any case.
    pub(super) fn flag(self, column: Column) -> Result<bool, DatasetError> {
        match self.text(column).to_ascii_lowercase().as_str() {
            "true" | "1" => Ok(true),
            "false" | "0" => Ok(false),
            other => Err(self.error(format!(
                "{} {other:?} is neither true nor false",
                self.table.headers[column.0]
            ))),
        }
    }

    /// An error that names this row.
    pub(super) fn error(self, reason: String) -> DatasetError {
        let line = self.record.position().map_or(1, csv::Position::line);
        DatasetError::Record {
            path: self.table.path.clone(),
            line,
            reason,
        }
    }
}
