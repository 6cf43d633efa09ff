//! The positions file: a table of where, in which direction and when photos were taken.
//!
//! It comes from spreadsheets and scripts of all kinds. `table` reads it whatever its encoding,
//! delimiter and headings are; `matching` finds the photo that a row means.

mod matching;
mod table;

use super::timezone::ClockZone;
use anyhow::{Context, ensure};
use matching::PhotoNames;
pub(super) use matching::folder_of;
use placeformer_core::printable::Printable;
use placeformer_core::types::{Altitude, GeoPoint, Heading, Timestamp};
use std::collections::{BTreeSet, HashMap};
use std::path::Path;

/// What a row says of its photo.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Row {
    pub(super) location: Option<GeoPoint>,
    pub(super) alt: Option<Altitude>,
    pub(super) heading: Option<Heading>,
    pub(super) captured_at: Option<Timestamp>,
}

/// The rows of a positions file that concern an import.
#[derive(Debug, Default)]
pub(super) struct Positions {
    /// By the name of their photo.
    rows: HashMap<String, Row>,
    /// What rows that match no photo call it.
    pub(super) unmatched: BTreeSet<String>,
    /// How many rows name a file that lies outside the imported folder.
    pub(super) elsewhere: usize,
    /// How the columns were read.
    pub(super) columns: String,
}

impl Positions {
    /// Reads a file and finds the photo of each row among `photos`, which are named by their path
    /// below `folder`. Times without an offset are in `zone`.
    ///
    /// # Errors
    /// The file cannot be read, it or a row says nothing that can be understood, or two rows mean
    /// the same photo.
    pub(super) fn read(
        path: &Path,
        folder: &Path,
        photos: &[(String, std::path::PathBuf)],
        zone: Option<&ClockZone>,
    ) -> anyhow::Result<Self> {
        let read = || -> anyhow::Result<Self> {
            let table = table::read(&std::fs::read(path)?, zone)?;
            let names = PhotoNames::new(folder, path, photos);
            let mut positions = Self {
                columns: table.columns,
                ..Self::default()
            };
            for row in table.rows {
                positions.assign(&names, row)?;
            }
            Ok(positions)
        };
        read().with_context(|| format!("cannot use {}", Printable(path.display())))
    }

    fn assign(&mut self, names: &PhotoNames<'_>, row: table::NamedRow) -> anyhow::Result<()> {
        let table::NamedRow { line, file, row } = row;
        match names.find(&file) {
            Some(photo) => {
                let earlier = self.rows.insert(photo.to_owned(), row);
                let shown = Printable(&file);
                ensure!(
                    earlier.is_none(),
                    "line {line}: \"{shown}\" has a row already"
                );
            }
            None if names.lies_elsewhere(&file) => self.elsewhere += 1,
            None => {
                let shown = Printable(&file).to_string();
                let is_new = self.unmatched.insert(file);
                ensure!(is_new, "line {line}: \"{shown}\" has a row already");
            }
        }
        Ok(())
    }

    /// The row of a photo; an empty one if there is none.
    pub(super) fn row(&self, photo: &str) -> Row {
        self.rows.get(photo).copied().unwrap_or_default()
    }
}

#[cfg(test)]
mod tests;
