//! The plainest layout: two folders and a CSV of accepted pairs.
//!
//! `query,reference`, one pair a row; an empty reference says that no match exists. Names are paths
//! below the two folders. A query the file does not mention stays [`Truth::Unknown`]: it is
//! searched but not counted.

use super::dataset::{Dataset, Item, Truth};
use super::error::DatasetError;
use super::positions;
use super::table::Table;
use placeformer_core::folder::list_images;
use std::collections::HashMap;
use std::path::Path;

/// Reads the images of both folders, the pairs between them, and positions from a `positions.csv`
/// in the folder of the pairs.
///
/// # Errors
/// A folder or file cannot be read, the pairs contradict each other or name images that are not
/// there, or one side has no image.
pub fn load_pairs(
    database_dir: &Path,
    queries_dir: &Path,
    ground_truth: &Path,
) -> Result<Dataset, DatasetError> {
    let mut database = items(database_dir)?;
    let mut queries = items(queries_dir)?;
    if let Some(folder) = ground_truth.parent() {
        positions::locate(folder, [&mut database, &mut queries])?;
    }
    let mut labels = Labels::new(database_dir, queries_dir, &database, &queries, ground_truth);
    let table = Table::read(ground_truth)?;
    let query_column = table.column("query")?;
    let reference_column = table.column("reference")?;
    for row in table.rows() {
        labels
            .add(row.text(query_column), row.text(reference_column))
            .map_err(|reason| row.error(reason))?;
    }
    let (truth, notes) = labels.finish()?;
    let name = ground_truth
        .parent()
        .and_then(Path::file_name)
        .map_or("csv".into(), |name| name.to_string_lossy());
    Dataset {
        name: name.into_owned(),
        database,
        queries,
        truth,
        skipped: Vec::new(),
        notes,
    }
    .checked(database_dir)
}

fn items(folder: &Path) -> Result<Vec<Item>, DatasetError> {
    Ok(list_images(folder)?
        .into_iter()
        .map(|(name, path)| Item::new(name, path))
        .collect())
}

/// Collects the rows of a ground truth, and the names in it that no image has.
struct Labels<'a> {
    folders: [&'a Path; 2],
    ground_truth: &'a Path,
    database: HashMap<&'a str, usize>,
    queries: HashMap<&'a str, usize>,
    truth: Vec<Truth>,
    unknown: [Vec<String>; 2],
}

impl<'a> Labels<'a> {
    fn new(
        database_dir: &'a Path,
        queries_dir: &'a Path,
        database: &'a [Item],
        queries: &'a [Item],
        ground_truth: &'a Path,
    ) -> Self {
        let by_name = |items: &'a [Item]| {
            items
                .iter()
                .enumerate()
                .map(|(i, item)| (item.name.as_str(), i))
                .collect()
        };
        Self {
            folders: [queries_dir, database_dir],
            ground_truth,
            database: by_name(database),
            queries: by_name(queries),
            truth: vec![Truth::Unknown; queries.len()],
            unknown: [Vec::new(), Vec::new()],
        }
    }

    /// Takes one row; the error says how it contradicts an earlier one.
    fn add(&mut self, query: &str, reference: &str) -> Result<(), String> {
        let Some(&index) = self.queries.get(query) else {
            self.unknown[0].push(query.to_owned());
            return Ok(());
        };
        let contradiction = || {
            Err(format!(
                "{query:?} has both a reference and an empty row, which says it has none"
            ))
        };
        if reference.is_empty() {
            if matches!(self.truth[index], Truth::Positives(_)) {
                return contradiction();
            }
            self.truth[index] = Truth::NoMatch;
            return Ok(());
        }
        let Some(&positive) = self.database.get(reference) else {
            self.unknown[1].push(reference.to_owned());
            return Ok(());
        };
        match &mut self.truth[index] {
            Truth::NoMatch => return contradiction(),
            Truth::Positives(positives) => positives.push(positive),
            unknown @ Truth::Unknown => *unknown = Truth::Positives(vec![positive]),
        }
        Ok(())
    }

    /// The truth of every query, and notes about it.
    fn finish(self) -> Result<(Vec<Truth>, Vec<String>), DatasetError> {
        for (mut names, folder) in self.unknown.into_iter().zip(self.folders) {
            names.sort_unstable();
            names.dedup();
            if let Some(example) = names.first().cloned() {
                return Err(DatasetError::UnknownImages {
                    path: self.ground_truth.to_owned(),
                    folder: folder.to_owned(),
                    count: names.len(),
                    example,
                });
            }
        }
        let mut truth = self.truth;
        for entry in &mut truth {
            if let Truth::Positives(positives) = entry {
                *entry = Truth::from_positives(std::mem::take(positives));
            }
        }
        let unlabelled = truth
            .iter()
            .filter(|entry| **entry == Truth::Unknown)
            .count();
        let mut notes = Vec::new();
        if unlabelled > 0 {
            notes.push(format!(
                "{unlabelled} queries are not in the ground truth: searched, but not counted"
            ));
        }
        Ok((truth, notes))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn folder(files: &[&str], csv: &[u8]) -> tempfile::TempDir {
        let root = tempfile::tempdir().unwrap();
        for name in files {
            let path = root.path().join(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, b"x").unwrap();
        }
        std::fs::write(root.path().join("ground_truth.csv"), csv).unwrap();
        root
    }

    fn load(root: &Path) -> Result<Dataset, DatasetError> {
        load_pairs(
            &root.join("database"),
            &root.join("queries"),
            &root.join("ground_truth.csv"),
        )
    }

    const FILES: [&str; 6] = [
        "database/a.jpg",
        "database/deep/b.jpg",
        "queries/1.jpg",
        "queries/2.jpg",
        "queries/3.jpg",
        "queries/4.jpg",
    ];

    #[test]
    fn pairs_no_match_and_unlabelled_are_told_apart() {
        // A byte-order mark, Windows line ends, a repeated pair, references out of order.
        let csv = b"\xef\xbb\xbfquery,reference\r\n1.jpg,deep/b.jpg\r\n1.jpg,a.jpg\r\n1.jpg,a.jpg\r\n2.jpg,\r\n4.jpg,a.jpg\r\n";
        let dataset = load(folder(&FILES, csv).path()).unwrap();
        let expected = [
            Truth::Positives(vec![0, 1]),
            Truth::NoMatch,
            Truth::Unknown,
            Truth::Positives(vec![0]),
        ];
        assert_eq!(dataset.truth, expected);
        assert_eq!(dataset.queries_with_match(), 2);
        assert_eq!(dataset.notes.len(), 1);
    }

    #[test]
    fn names_nobody_has_contradictions_and_missing_columns_are_errors() {
        for (csv, part) in [
            (&b"query,reference\n1.jpg,zzz.jpg\n"[..], "zzz.jpg"),
            (b"query,reference\n9.jpg,a.jpg\n", "9.jpg"),
            (b"query,reference\n1.jpg,a.jpg\n1.jpg,\n", "line 3"),
            (b"query,reference\n1.jpg,\n1.jpg,a.jpg\n", "line 3"),
            (b"query,ref\n1.jpg,a.jpg\n", "\"reference\""),
            (b"query,reference\n1.jpg\n", "line 2"),
        ] {
            let error = load(folder(&FILES, csv).path()).unwrap_err().to_string();
            assert!(error.contains(part), "{error}");
        }
    }

    #[test]
    fn an_empty_side_is_an_error() {
        let root = folder(
            &["queries/1.jpg", "database/readme.txt"],
            b"query,reference\n",
        );
        assert!(matches!(
            load(root.path()),
            Err(DatasetError::Empty {
                side: "database",
                ..
            })
        ));
    }
}
