//! Reads the file of a photo, whatever has become of it since the folder was looked through.

use super::importer::Failure;
use rustix::fs::OFlags;
use std::fs::File;
use std::io::{self, Read};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;

/// Most bytes of a file that are read. Servers accept far fewer; without a limit, a film under a
/// photo's name would take all memory.
const MAX_BYTES: u64 = 256 << 20;

/// The bytes of a photo.
pub(super) fn read(path: &Path) -> Result<Vec<u8>, Failure> {
    let unreadable = |error: io::Error| Failure::unsent("unreadable_file", error.to_string());
    // Opening a pipe waits for a writer, unless it is told not to.
    let file = File::options()
        .read(true)
        .custom_flags(OFlags::NONBLOCK.bits().cast_signed())
        .open(path);
    let file = file.map_err(unreadable)?;
    let kind = file.metadata().map_err(unreadable)?;
    if !kind.is_file() {
        let detail = "it is a folder, pipe, socket or device";
        return Err(Failure::unsent("special_file", detail));
    }
    let mut bytes = Vec::new();
    let mut limited = file.take(MAX_BYTES + 1);
    limited.read_to_end(&mut bytes).map_err(unreadable)?;
    if bytes.len() as u64 > MAX_BYTES {
        let detail = format!("it has more than {MAX_BYTES} bytes");
        return Err(Failure::unsent("file_too_large", detail));
    }
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn refusal(path: &Path) -> String {
        read(path).err().unwrap().code().to_owned()
    }

    #[test]
    fn what_is_no_file_does_not_keep_the_import_waiting() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("a.jpg");
        std::fs::write(&file, b"photo").unwrap();
        assert_eq!(read(&file).ok().unwrap(), b"photo");
        let pipe = folder.path().join("pipe.jpg");
        let mode = rustix::fs::Mode::RUSR;
        rustix::fs::mknodat(rustix::fs::CWD, &pipe, rustix::fs::FileType::Fifo, mode, 0).unwrap();
        assert_eq!(refusal(&pipe), "special_file");
        assert_eq!(refusal(folder.path()), "special_file");
        assert_eq!(refusal(Path::new("/dev/zero")), "special_file");
        assert_eq!(refusal(&folder.path().join("gone.jpg")), "unreadable_file");
        let film = folder.path().join("film.jpg");
        File::create(&film).unwrap().set_len(MAX_BYTES + 1).unwrap();
        assert_eq!(refusal(&film), "file_too_large");
    }
}
