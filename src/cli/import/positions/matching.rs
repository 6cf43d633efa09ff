//! Finds the photo that a row of a positions file means.
//!
//! A row may name a photo by its path below the imported folder, below the folder of the table, or
//! from the root; by its end, if only one photo's path ends so; and in another Unicode
//! normalisation, because macOS decomposes accents and others do not.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use unicode_normalization::UnicodeNormalization;

/// The photos of an import, by everything that a row may call them.
pub(super) struct PhotoNames<'a> {
    /// By their name as it is.
    exact: HashMap<&'a str, &'a str>,
    /// By their composed name; `None` where several photos have the same.
    composed: HashMap<String, Option<&'a str>>,
    /// By each composed end of their path; `None` where several photos have the same.
    ends: HashMap<String, Option<&'a str>>,
    /// The imported folder, as it was given and as it really is, with a slash at the end.
    folders: Vec<String>,
    /// The folder of the table.
    table_folder: PathBuf,
    /// Folders that relative paths may begin at: that of the table and the current one, as
    /// `folders` are.
    bases: Vec<String>,
}

impl<'a> PhotoNames<'a> {
    pub(super) fn new(folder: &Path, table: &Path, photos: &'a [(String, PathBuf)]) -> Self {
        let table_folder = folder_of(table);
        let bases = [table_folder, Path::new(".")];
        let mut names = Self {
            exact: HashMap::new(),
            composed: HashMap::new(),
            ends: HashMap::new(),
            folders: folder_spellings(folder),
            table_folder: table_folder.to_owned(),
            bases: bases.into_iter().flat_map(folder_spellings).collect(),
        };
        for (name, _) in photos {
            names.exact.insert(name, name);
            let composed = compose(name);
            for (at, _) in composed.match_indices('/') {
                add(&mut names.ends, &composed[at + 1..], name);
            }
            add(&mut names.ends, &composed, name);
            add(&mut names.composed, &composed, name);
        }
        names
    }

    /// The name of the photo that `file` means, if it means exactly one.
    pub(super) fn find(&self, file: &str) -> Option<&'a str> {
        let file = normalise(file);
        if let Some(name) = self.below_folder(&file) {
            return self.whole(name);
        }
        let from_base = |base: &String| {
            let path = normalise(&format!("{base}{file}"));
            self.whole(self.below_folder(&path)?)
        };
        let from_bases = || self.bases.iter().find_map(from_base);
        let found = self.whole(&file).or_else(from_bases);
        // What exists elsewhere is another file, however it ends.
        if found.is_some() || self.exists_elsewhere(&file) {
            return found;
        }
        self.by_end(&file)
    }

    /// What an absolute path is below the imported folder, if it lies there.
    fn below_folder<'p>(&self, path: &'p str) -> Option<&'p str> {
        let below = |folder: &String| path.strip_prefix(folder.as_str());
        self.folders.iter().find_map(below)
    }

    fn whole(&self, name: &str) -> Option<&'a str> {
        let composed = || *self.composed.get(&compose(name))?;
        self.exact.get(name).copied().or_else(composed)
    }

    /// Of a path from the root of another machine, the end counts; of any other, all of it.
    fn by_end(&self, file: &str) -> Option<&'a str> {
        let file = compose(file);
        let mut rest = file.as_str();
        loop {
            if let Some(found) = self.ends.get(rest) {
                return *found;
            }
            if !is_absolute(&file) {
                return None;
            }
            rest = rest.split_once('/')?.1;
        }
    }

    /// Whether `file` names a file that exists and is not in the imported folder, so that the row
    /// is for another import.
    pub(super) fn lies_elsewhere(&self, file: &str) -> bool {
        self.exists_elsewhere(&normalise(file))
    }

    fn exists_elsewhere(&self, file: &str) -> bool {
        let path = self.table_folder.join(file);
        let Ok(path) = path.canonicalize() else {
            return false;
        };
        let is_inside = |folder: &String| path.starts_with(folder);
        path.is_file() && !self.folders.iter().any(is_inside)
    }
}

/// Notes that `key` means `name`, or that it means several photos.
fn add<'a>(names: &mut HashMap<String, Option<&'a str>>, key: &str, name: &'a str) {
    names
        .entry(key.to_owned())
        .and_modify(|known| *known = None)
        .or_insert(Some(name));
}

fn compose(text: &str) -> String {
    text.nfc().collect()
}

/// Whether a path begins at a root, or at a drive of Windows.
fn is_absolute(file: &str) -> bool {
    file.starts_with('/') || file.get(1..3) == Some(":/")
}

/// A path without `.`, doubled slashes, and `..` that leads back out of what stands before.
fn normalise(file: &str) -> String {
    let mut parts: Vec<&str> = Vec::new();
    for part in file.split('/') {
        match part {
            "" | "." => {}
            ".." if parts.last().is_some_and(|last| *last != "..") => {
                parts.pop();
            }
            _ => parts.push(part),
        }
    }
    let root = if file.starts_with('/') { "/" } else { "" };
    format!("{root}{}", parts.join("/"))
}

/// The folder in which a file lies.
pub(in crate::cli::import) fn folder_of(file: &Path) -> &Path {
    let parent = file.parent().unwrap_or(file);
    if parent.as_os_str().is_empty() {
        Path::new(".")
    } else {
        parent
    }
}

/// A folder's absolute paths, with a slash at the end: as it was given, and without links.
fn folder_spellings(folder: &Path) -> Vec<String> {
    let given = std::path::absolute(folder).ok();
    let real = folder.canonicalize().ok();
    let spelled = |path: PathBuf| Some(normalise(path.to_str()?) + "/");
    let mut spellings: Vec<String> = [given, real]
        .into_iter()
        .flatten()
        .filter_map(spelled)
        .collect();
    spellings.dedup();
    spellings
}
