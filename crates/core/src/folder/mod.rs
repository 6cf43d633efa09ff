//! Finds images on disk, in an order that does not depend on the file system.
//!
//! A folder of photos holds more than photos: links that lead nowhere, previews of file managers,
//! videos, pipes. [`list_images`] is for data sets, which must be whole: it fails on what it cannot
//! read. [`scan_folder`] is for imports, which take what there is: it says of every other entry why
//! it is none.

mod entry;
mod name;

pub use entry::{PassReason, PassedOver};
pub use name::relative_name;

use crate::printable::Printable;
use entry::{is_image, is_visible_folder};
use std::path::{Path, PathBuf};
use walkdir::WalkDir;

/// A folder, or something in it, could not be read.
#[derive(Debug, thiserror::Error)]
#[error("{}: {source}", Printable(path.display()))]
pub struct FolderError {
    /// The folder or file.
    pub path: PathBuf,
    /// What the system said.
    pub source: std::io::Error,
}

/// Every image below `folder` as (name, path), by name. The name is that of [`relative_name`].
///
/// Links are followed. Hidden files and folders, and folders of previews, are not looked at.
///
/// # Errors
/// The folder or something below it cannot be read.
pub fn list_images(folder: &Path) -> Result<Vec<(String, PathBuf)>, FolderError> {
    let entries = WalkDir::new(folder)
        .follow_links(true)
        .into_iter()
        .filter_entry(|entry| entry.depth() == 0 || is_visible_folder(entry));
    let mut images = Vec::new();
    for entry in entries {
        let entry = entry.map_err(|error| walk_error(folder, error))?;
        if entry.file_type().is_file() && is_image(entry.path()) {
            let name = relative_name(folder, entry.path());
            images.push((name, entry.into_path()));
        }
    }
    images.sort_unstable();
    Ok(images)
}

/// What was found in a folder.
#[derive(Debug, Default)]
pub struct FolderScan {
    /// The images as (name, path), by name. No two have the same name.
    pub images: Vec<(String, PathBuf)>,
    /// Everything else, by name.
    pub passed_over: Vec<PassedOver>,
}

/// Looks through `folder` and the folders below it. Links to files are followed, links to folders
/// are not, so that no file is found twice. If `folder` is a file, it is the only image, whatever
/// its name ends with.
///
/// # Errors
/// `folder` itself cannot be read, or is neither a folder nor a file.
pub fn scan_folder(folder: &Path) -> Result<FolderScan, FolderError> {
    let fail = |source| FolderError {
        path: folder.to_owned(),
        source,
    };
    let kind = std::fs::metadata(folder).map_err(fail)?;
    if kind.is_file() {
        let name = relative_name(folder.parent().unwrap_or(folder), folder);
        return Ok(FolderScan {
            images: vec![(name, folder.to_owned())],
            passed_over: Vec::new(),
        });
    }
    if !kind.is_dir() {
        let reason = "it is neither a folder nor a file";
        return Err(fail(std::io::Error::other(reason)));
    }
    let mut scan = FolderScan::default();
    let mut walk = WalkDir::new(folder).into_iter();
    while let Some(entry) = walk.next() {
        match entry {
            Ok(entry) if entry.depth() == 0 => {}
            Ok(entry) => {
                if scan.take(folder, &entry) {
                    walk.skip_current_dir();
                }
            }
            Err(error) if error.depth() == 0 => return Err(walk_error(folder, error)),
            Err(error) => scan.passed_over.push(PassedOver::unreadable(folder, error)),
        }
    }
    scan.images.sort_unstable();
    scan.passed_over
        .sort_unstable_by(|a, b| a.name.cmp(&b.name));
    Ok(scan)
}

impl FolderScan {
    /// Sorts an entry in; says whether it is a folder that is not to be entered.
    fn take(&mut self, folder: &Path, entry: &walkdir::DirEntry) -> bool {
        let is_folder = entry.file_type().is_dir();
        match PassReason::of(entry) {
            Some(reason) => {
                let passed = PassedOver::new(folder, entry.path(), reason);
                self.passed_over.push(passed);
                is_folder
            }
            None if is_folder => false,
            None => {
                let name = relative_name(folder, entry.path());
                self.images.push((name, entry.path().to_owned()));
                false
            }
        }
    }
}

fn walk_error(folder: &Path, error: walkdir::Error) -> FolderError {
    FolderError {
        path: error.path().unwrap_or(folder).to_owned(),
        source: error.into(),
    }
}

#[cfg(test)]
mod tests;
