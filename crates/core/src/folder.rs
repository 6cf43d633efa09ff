//! Finds images on disk, in an order that does not depend on the file system.

use std::path::{Path, PathBuf};
use walkdir::WalkDir;

/// A folder, or something in it, could not be read.
#[derive(Debug, thiserror::Error)]
#[error("{}: {source}", path.display())]
pub struct FolderError {
    /// The folder or file.
    pub path: PathBuf,
    /// What the system said.
    pub source: std::io::Error,
}

const EXTENSIONS: [&str; 4] = ["jpg", "jpeg", "png", "webp"];

/// Every image below `folder` as (name, path), by name. The name is the path below `folder` with
/// `/` on every system.
///
/// Hidden files and folders are not looked at: file managers leave previews there.
pub fn list_images(folder: &Path) -> Result<Vec<(String, PathBuf)>, FolderError> {
    let visible = |entry: &walkdir::DirEntry| {
        entry.depth() == 0
            || !entry
                .file_name()
                .to_str()
                .is_some_and(|name| name.starts_with('.'))
    };
    let mut images = Vec::new();
    for entry in WalkDir::new(folder)
        .follow_links(true)
        .into_iter()
        .filter_entry(visible)
    {
        let entry = entry.map_err(|error| {
            let path = error.path().unwrap_or(folder).to_owned();
            FolderError {
                path,
                source: error.into(),
            }
        })?;
        if entry.file_type().is_file() && is_image(entry.path()) {
            images.push((relative_name(folder, entry.path()), entry.into_path()));
        }
    }
    images.sort_unstable();
    Ok(images)
}

/// The path below `folder`, with `/` on every system.
pub fn relative_name(folder: &Path, path: &Path) -> String {
    let below = path.strip_prefix(folder).unwrap_or(path);
    below
        .iter()
        .map(|part| part.to_string_lossy())
        .collect::<Vec<_>>()
        .join("/")
}

fn is_image(path: &Path) -> bool {
    path.extension()
        .and_then(|extension| extension.to_str())
        .is_some_and(|extension| {
            EXTENSIONS
                .iter()
                .any(|known| extension.eq_ignore_ascii_case(known))
        })
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
