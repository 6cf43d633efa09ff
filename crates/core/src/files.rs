//! Files that are written whole or not at all, and the hashes of files.

use sha2::{Digest, Sha256};
use std::fs::{self, DirBuilder, File, OpenOptions, Permissions};
use std::io::{self, ErrorKind, Write};
use std::os::unix::fs::{DirBuilderExt, OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};

/// Who may enter a directory of data: its owner, and its group to read.
const PRIVATE_DIRECTORY: u32 = 0o750;

/// Who may open a file of data: its owner, and its group to read.
const PRIVATE_FILE: u32 = 0o640;

/// Who may open a secret: its owner.
const SECRET_FILE: u32 = 0o600;

/// Makes a directory, and those above it, that others than its owner and its group cannot enter,
/// whatever the umask says. One that is there stays as it is: its owner decided that.
///
/// # Errors
/// The system refuses.
pub fn create_private_directory(path: &Path) -> io::Result<()> {
    if path.is_dir() {
        return Ok(());
    }
    if let Some(above) = path.parent() {
        fs::create_dir_all(above)?;
    }
    match DirBuilder::new().mode(PRIVATE_DIRECTORY).create(path) {
        // The umask may have taken more than it should.
        Ok(()) => fs::set_permissions(path, Permissions::from_mode(PRIVATE_DIRECTORY)),
        Err(error) if error.kind() == ErrorKind::AlreadyExists && path.is_dir() => Ok(()),
        Err(error) => Err(error),
    }
}

/// Makes an empty file that others than its owner and its group cannot read, whatever the umask
/// says. One that is there stays as it is.
///
/// # Errors
/// The system refuses.
pub fn create_private_file(path: &Path) -> io::Result<()> {
    let mut options = OpenOptions::new();
    options.write(true).create_new(true).mode(PRIVATE_FILE);
    match options.open(path) {
        Ok(file) => file.set_permissions(Permissions::from_mode(PRIVATE_FILE)),
        Err(error) if error.kind() == ErrorKind::AlreadyExists => Ok(()),
        Err(error) => Err(error),
    }
}

/// SHA-256 of a file in lower-case hexadecimal. The file is streamed, not loaded whole.
///
/// # Errors
/// The file cannot be opened or read.
pub fn hash_file(path: &Path) -> io::Result<String> {
    let mut hasher = Sha256::new();
    io::copy(&mut File::open(path)?, &mut hasher)?;
    Ok(hex::encode(hasher.finalize()))
}

/// Writes `bytes` to a temporary file in the same directory, syncs it, and renames it to `path`.
/// After a crash there is the old file or the new one, and never a part of one.
///
/// # Errors
/// The directory cannot be written to, or the disk is full. The old file is then untouched.
pub fn write_atomically(path: &Path, bytes: &[u8]) -> io::Result<()> {
    replace_with(path, |part| write_and_sync(part, bytes))
}

/// As [`write_atomically`], for a file that others than its owner and its group cannot read.
///
/// # Errors
/// As [`write_atomically`].
pub fn write_private_atomically(path: &Path, bytes: &[u8]) -> io::Result<()> {
    replace_with(path, |part| {
        create_private_file(part)?;
        write_and_sync(part, bytes)
    })
}

/// As [`write_atomically`], for a secret: a file that nobody but its owner can read.
///
/// # Errors
/// As [`write_atomically`].
pub fn write_secret_atomically(path: &Path, bytes: &[u8]) -> io::Result<()> {
    replace_with(path, |part| {
        let mut options = OpenOptions::new();
        let mut file = options
            .write(true)
            .create_new(true)
            .mode(SECRET_FILE)
            .open(part)?;
        file.write_all(bytes)?;
        file.sync_all()
    })
}

/// Puts the file that `write` makes in the place of `path`.
fn replace_with(path: &Path, write: impl FnOnce(&Path) -> io::Result<()>) -> io::Result<()> {
    let part = with_suffix(path, &format!(".{}.part", std::process::id()));
    let written = write(&part).and_then(|()| rename_durably(&part, path));
    if written.is_err() {
        // The unfinished file is of no use to anyone. The caller needs the first error, so a
        // failure to remove it is not reported.
        let _ = fs::remove_file(&part);
    }
    written
}

fn write_and_sync(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let mut file = File::create(path)?;
    file.write_all(bytes)?;
    file.sync_all()
}

/// Renames a file and syncs its directory, so that the new name survives a power cut.
///
/// # Errors
/// The system refuses to rename the file or to sync the directory.
pub fn rename_durably(from: &Path, to: &Path) -> io::Result<()> {
    fs::rename(from, to)?;
    sync_directory(directory_of(to))
}

/// Syncs a directory, so that names created, renamed or removed in it survive a power cut.
///
/// # Errors
/// The directory cannot be opened or synced.
pub fn sync_directory(directory: &Path) -> io::Result<()> {
    File::open(directory)?.sync_all()
}

/// The directory that a file lies in: `.` for a bare file name.
pub fn directory_of(path: &Path) -> &Path {
    match path.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    }
}

/// `path` with `suffix` appended to its file name.
pub fn with_suffix(path: &Path, suffix: &str) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(suffix);
    name.into()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_is_replaced_whole_and_no_other_file_is_left() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("head.bin");
        for content in [&b"first"[..], b"second"] {
            write_atomically(&path, content).unwrap();
            assert_eq!(fs::read(&path).unwrap(), content);
        }
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[test]
    fn a_failed_write_keeps_the_old_file_and_removes_its_own() {
        let folder = tempfile::tempdir().unwrap();
        // A directory that is not empty cannot be replaced by a file.
        let path = folder.path().join("taken");
        fs::create_dir_all(path.join("inside")).unwrap();
        assert!(write_atomically(&path, b"new").is_err());
        assert!(path.join("inside").exists());
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[test]
    fn what_is_made_private_has_its_mode_and_what_was_there_keeps_its_own() {
        let mode = |path: &Path| fs::metadata(path).unwrap().permissions().mode() & 0o7777;
        let folder = tempfile::tempdir().unwrap();
        let directory = folder.path().join("a/b");
        let file = directory.join("c");
        create_private_directory(&directory).unwrap();
        create_private_file(&file).unwrap();
        assert_eq!((mode(&directory), mode(&file)), (0o750, 0o640));
        fs::write(&file, "kept").unwrap();
        fs::set_permissions(&directory, Permissions::from_mode(0o700)).unwrap();
        fs::set_permissions(&file, Permissions::from_mode(0o600)).unwrap();
        create_private_directory(&directory).unwrap();
        create_private_file(&file).unwrap();
        assert_eq!((mode(&directory), mode(&file)), (0o700, 0o600));
        assert_eq!(fs::read(&file).unwrap(), b"kept");
        assert!(create_private_directory(&file).is_err());
    }

    #[test]
    fn a_bare_file_name_lies_in_the_current_directory() {
        assert_eq!(directory_of(Path::new("head.bin")), Path::new("."));
        assert_eq!(directory_of(Path::new("a/head.bin")), Path::new("a"));
    }

    #[test]
    fn the_hash_of_a_file_is_that_of_its_bytes() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("abc");
        fs::write(&path, b"abc").unwrap();
        let expected = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad";
        assert_eq!(hash_file(&path).unwrap(), expected);
    }
}
