//! Names of files as text.
//!
//! A file's name is bytes, a reference's external id is text without control characters. Replacing
//! what is not text by one sign would give two files the same name. So it is escaped, and the
//! escape itself too where a name contains it, so that no two files get the same name.

use std::fmt::Write;
use std::path::Path;

/// The path below `folder`, with `/` on every system; the whole path if it lies elsewhere.
///
/// Bytes that are not UTF-8, and control characters, become `\xNN`. All other names stay as they
/// are.
pub fn relative_name(folder: &Path, path: &Path) -> String {
    let below = path.strip_prefix(folder).unwrap_or(path);
    let mut name = String::new();
    for part in below {
        if !name.is_empty() {
            name.push('/');
        }
        push_escaped(&mut name, part.as_encoded_bytes());
    }
    name
}

fn push_escaped(name: &mut String, bytes: &[u8]) {
    for chunk in bytes.utf8_chunks() {
        let text = chunk.valid();
        for (at, character) in text.char_indices() {
            if character.is_control() || is_escape(&text.as_bytes()[at..]) {
                let mut buffer = [0; 4];
                push_bytes(name, character.encode_utf8(&mut buffer).as_bytes());
            } else {
                name.push(character);
            }
        }
        push_bytes(name, chunk.invalid());
    }
}

/// Whether these bytes begin with what looks like an escape.
fn is_escape(bytes: &[u8]) -> bool {
    match bytes {
        [b'\\', b'x', high, low, ..] => high.is_ascii_hexdigit() && low.is_ascii_hexdigit(),
        _ => false,
    }
}

fn push_bytes(name: &mut String, bytes: &[u8]) {
    for byte in bytes {
        // Writing to a string cannot fail.
        let _ = write!(name, "\\x{byte:02x}");
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::ffi::OsStr;
    use std::os::unix::ffi::OsStrExt;

    fn name_of(bytes: &[u8]) -> String {
        let folder = Path::new("/photos");
        relative_name(folder, &folder.join(OsStr::from_bytes(bytes)))
    }

    #[test]
    fn only_what_is_no_text_is_escaped() {
        let plain = "sub/caf\u{e9} e\u{301} \\ it's.jpg";
        assert_eq!(name_of(plain.as_bytes()), plain);
        assert_eq!(name_of(b"a\xe9.jpg"), "a\\xe9.jpg");
        assert_eq!(name_of(b"a\xea.jpg"), "a\\xea.jpg");
        assert_eq!(name_of(b"a\\xe9.jpg"), "a\\x5cxe9.jpg");
        assert_eq!(name_of(b"a\nb\x1b.jpg"), "a\\x0ab\\x1b.jpg");
        assert_eq!(name_of("\u{85}".as_bytes()), "\\xc2\\x85");
    }

    proptest! {
        #[test]
        fn no_two_names_become_one(
            a in prop::collection::vec(prop::sample::select(b"\\xe59\x00\xe9\xc3\n".to_vec()), 1..8),
            b in prop::collection::vec(prop::sample::select(b"\\xe59\x00\xe9\xc3\n".to_vec()), 1..8),
        ) {
            prop_assert_eq!(a == b, name_of(&a) == name_of(&b));
            prop_assert!(!name_of(&a).chars().any(char::is_control));
        }
    }
}
