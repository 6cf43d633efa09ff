//! What an entry of a folder is, if it is no image.

use super::name::relative_name;
use std::path::Path;
use walkdir::DirEntry;

/// File name endings of images, in lower case.
const IMAGES: [&str; 8] = ["jpg", "jpeg", "jpe", "jfif", "jif", "jfi", "png", "webp"];

/// Folders that systems and storage devices keep for themselves, in lower case. Some hold previews
/// of the photos beside them.
const SYSTEM_FOLDERS: [&str; 8] = [
    "@eadir",
    "#recycle",
    "@recycle",
    "$recycle.bin",
    "system volume information",
    "lost+found",
    "__macosx",
    "lost.dir",
];

/// Files that file managers keep in folders of photos, in lower case.
const SYSTEM_FILES: [&str; 4] = ["thumbs.db", "ehthumbs.db", "desktop.ini", "icon\r"];

/// An entry that is no image to be taken.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PassedOver {
    /// Its name, as of an image.
    pub name: String,
    /// Why.
    pub reason: PassReason,
    /// Whether photos may be lost by that: it is named like an image, or is a folder that cannot be
    /// read.
    pub is_loss: bool,
}

/// Why an entry is no image to be taken.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum PassReason {
    /// A file whose name ends otherwise; with the ending in lower case, if it has one.
    OtherFile(Option<String>),
    /// A hidden file or folder.
    Hidden,
    /// What macOS stores beside a photo under its name with `._` before it.
    ResourceFork,
    /// A file or folder that a system keeps for itself.
    System,
    /// A link to a folder.
    LinkedFolder,
    /// A link that leads nowhere or to itself; with what the system said.
    BrokenLink(String),
    /// A pipe, socket or device.
    SpecialFile,
    /// It cannot be read; with what the system said.
    Unreadable(String),
}

impl PassReason {
    /// Why an entry is to be passed over, if it is; of folders, whether to enter them.
    pub(super) fn of(entry: &DirEntry) -> Option<Self> {
        let name = entry.file_name().as_encoded_bytes();
        let kind = entry.file_type();
        if name.starts_with(b"._") && !kind.is_dir() {
            return Some(Self::ResourceFork);
        }
        if name.starts_with(b".") {
            return Some(Self::Hidden);
        }
        if is_system(entry) {
            return Some(Self::System);
        }
        if kind.is_dir() {
            return None;
        }
        if !kind.is_symlink() {
            return Self::of_file(entry.path(), kind);
        }
        match std::fs::metadata(entry.path()) {
            Ok(target) if target.is_dir() => Some(Self::LinkedFolder),
            Ok(target) => Self::of_file(entry.path(), target.file_type()),
            Err(error) => Some(Self::BrokenLink(error.to_string())),
        }
    }

    fn of_file(path: &Path, kind: std::fs::FileType) -> Option<Self> {
        if !kind.is_file() {
            return Some(Self::SpecialFile);
        }
        let extension = path.extension().map(|end| end.to_string_lossy());
        let other = || Self::OtherFile(extension.map(|end| end.to_lowercase()));
        (!is_image(path)).then(other)
    }

    /// Its stable name in reports.
    pub fn code(&self) -> &'static str {
        match self {
            Self::OtherFile(_) => "unsupported_file",
            Self::Hidden => "hidden",
            Self::ResourceFork => "resource_fork",
            Self::System => "system_entry",
            Self::LinkedFolder => "linked_folder",
            Self::BrokenLink(_) => "broken_link",
            Self::SpecialFile => "special_file",
            Self::Unreadable(_) => "unreadable",
        }
    }

    /// What it means, in words.
    pub fn detail(&self) -> String {
        match self {
            Self::OtherFile(_) => "it is not named like a JPEG, PNG or WebP".to_owned(),
            Self::Hidden => "it is hidden".to_owned(),
            Self::ResourceFork => "it is what macOS stores beside a photo".to_owned(),
            Self::System => "a system keeps it for itself".to_owned(),
            Self::LinkedFolder => "it is a link to a folder, which is not followed".to_owned(),
            Self::BrokenLink(cause) => format!("the link leads nowhere: {cause}"),
            Self::SpecialFile => "it is a pipe, socket or device".to_owned(),
            Self::Unreadable(cause) => format!("it cannot be read: {cause}"),
        }
    }
}

impl PassedOver {
    pub(super) fn new(folder: &Path, path: &Path, reason: PassReason) -> Self {
        let is_loss = match reason {
            PassReason::BrokenLink(_) | PassReason::SpecialFile => is_image(path),
            PassReason::Unreadable(_) => true,
            _ => false,
        };
        Self {
            name: relative_name(folder, path),
            reason,
            is_loss,
        }
    }

    /// A folder that cannot be listed, or a file that cannot be looked at.
    pub(super) fn unreadable(folder: &Path, error: walkdir::Error) -> Self {
        let path = error.path().unwrap_or(folder).to_owned();
        // The message of the walk repeats the path, unescaped.
        let cause = match error.into_io_error() {
            Some(error) => error.to_string(),
            None => "it contains itself".to_owned(),
        };
        Self::new(folder, &path, PassReason::Unreadable(cause))
    }
}

/// Whether an entry is neither hidden nor a system's own.
pub(super) fn is_visible_folder(entry: &DirEntry) -> bool {
    let name = entry.file_name().as_encoded_bytes();
    !name.starts_with(b".") && !is_system(entry)
}

fn is_system(entry: &DirEntry) -> bool {
    let known: &[&str] = match entry.file_type().is_dir() {
        true => &SYSTEM_FOLDERS,
        false => &SYSTEM_FILES,
    };
    let name = entry.file_name();
    known.iter().any(|known| name.eq_ignore_ascii_case(known))
}

pub(super) fn is_image(path: &Path) -> bool {
    let Some(extension) = path.extension().and_then(|extension| extension.to_str()) else {
        return false;
    };
    IMAGES
        .iter()
        .any(|known| known.eq_ignore_ascii_case(extension))
}
