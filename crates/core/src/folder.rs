//! Finds images on disk, in an order that does not depend on the file system.

use std::path::{Path, PathBuf};
use walkdir::{DirEntry, WalkDir};

/// A folder, or something in it, could not be read.
#[derive(Debug, thiserror::Error)]
#[error("{}: {source}", path.display())]
pub struct FolderError {
    /// The folder or file.
    pub path: PathBuf,
    /// What the system said.
    pub source: std::io::Error,
}

/// File name endings of images, in lower case.
const EXTENSIONS: [&str; 4] = ["jpg", "jpeg", "png", "webp"];

/// Every image below `folder` as (name, path), by name. The name is the path below `folder` with
/// `/` on every system.
///
/// Links are followed. Hidden files and folders are not looked at, because file managers leave
/// previews there.
///
/// # Errors
/// The folder or something below it cannot be read.
pub fn list_images(folder: &Path) -> Result<Vec<(String, PathBuf)>, FolderError> {
    let entries = WalkDir::new(folder)
        .follow_links(true)
        .into_iter()
        .filter_entry(is_visible);
    let mut images = Vec::new();
    for entry in entries {
        let entry = entry.map_err(|error| FolderError {
            path: error.path().unwrap_or(folder).to_owned(),
            source: error.into(),
        })?;
        if entry.file_type().is_file() && is_image(entry.path()) {
            let name = relative_name(folder, entry.path());
            images.push((name, entry.into_path()));
        }
    }
    images.sort_unstable();
    Ok(images)
}

/// Whether an entry is the folder asked for, or not hidden.
fn is_visible(entry: &DirEntry) -> bool {
    let is_root = entry.depth() == 0;
    let name = entry.file_name().as_encoded_bytes();
    is_root || !name.starts_with(b".")
}

/// The path below `folder`, with `/` on every system; the whole path if it lies elsewhere.
pub fn relative_name(folder: &Path, path: &Path) -> String {
    let below = path.strip_prefix(folder).unwrap_or(path);
    let parts: Vec<_> = below.iter().map(|part| part.to_string_lossy()).collect();
    parts.join("/")
}

fn is_image(path: &Path) -> bool {
    let Some(extension) = path.extension().and_then(|extension| extension.to_str()) else {
        return false;
    };
    EXTENSIONS
        .iter()
        .any(|known| known.eq_ignore_ascii_case(extension))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn images_are_listed_by_name_whatever_their_case_and_depth() {
        let root = tempfile::tempdir().unwrap();
        for name in [
            "b/2.JPG",
            "a.png",
            "b/1.jpeg",
            "notes.txt",
            ".hidden/x.jpg",
            "b/.y.jpg",
            "z.webp",
        ] {
            let path = root.path().join(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, b"x").unwrap();
        }
        let names: Vec<String> = list_images(root.path())
            .unwrap()
            .into_iter()
            .map(|(name, _)| name)
            .collect();
        assert_eq!(names, ["a.png", "b/1.jpeg", "b/2.JPG", "z.webp"]);
    }

    #[test]
    fn a_missing_folder_is_named() {
        let error = list_images(Path::new("/nowhere/at/all")).unwrap_err();
        assert!(error.to_string().contains("/nowhere/at/all"), "{error}");
    }
}
