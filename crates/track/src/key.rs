//! The key that makes a token of a track one of this service's own.
//!
//! Every node that may be sent the next frame has to have the same key, so it can be given as a
//! file. A node that stands alone makes its own, once, in its data directory.

use placeformer_core::files::write_secret_atomically;
use ring::hmac::{self, HMAC_SHA256};
use ring::rand::{SecureRandom, SystemRandom};
use std::fmt;
use std::io::{ErrorKind, Read};
use std::path::{Path, PathBuf};

/// Bytes of a key, which a file has in hexadecimal.
pub const KEY_BYTES: usize = 32;

/// Longest file that is read: the hexadecimal digits and some white space.
const LONGEST_FILE_BYTES: u64 = 256;

/// Why there is no key.
#[derive(Debug, thiserror::Error)]
pub enum KeyError {
    /// The file cannot be read or written.
    #[error("the key of tracks in {} cannot be read or written", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// The file holds something else.
    #[error(
        "the key of tracks in {} is not 64 hexadecimal digits (openssl rand -hex 32)",
        path.display()
    )]
    NotAKey {
        /// The file.
        path: PathBuf,
    },
    /// The system gives no random bytes.
    #[error("the system has no random bytes for a key")]
    NoRandomness,
}

/// Authenticates tokens. Its bytes are never shown.
#[derive(Clone)]
pub struct TrackKey(hmac::Key);

impl fmt::Debug for TrackKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("TrackKey(..)")
    }
}

impl TrackKey {
    /// A key of these bytes.
    pub fn new(bytes: &[u8; KEY_BYTES]) -> Self {
        Self(hmac::Key::new(HMAC_SHA256, bytes))
    }

    /// A key that nobody else has: for a process whose tokens nobody keeps.
    ///
    /// # Errors
    /// The system has no random bytes.
    pub fn random() -> Result<Self, KeyError> {
        Ok(Self::new(&random_bytes()?))
    }

    /// The key in a file.
    ///
    /// # Errors
    /// The file cannot be read, or holds no key.
    pub fn read(path: &Path) -> Result<Self, KeyError> {
        let failed = |source| KeyError::File {
            path: path.to_owned(),
            source,
        };
        let mut text = String::new();
        std::fs::File::open(path)
            .map_err(failed)?
            .take(LONGEST_FILE_BYTES)
            .read_to_string(&mut text)
            .map_err(failed)?;
        let bytes = from_hex(text.trim()).ok_or_else(|| KeyError::NotAKey {
            path: path.to_owned(),
        })?;
        Ok(Self::new(&bytes))
    }

    /// The key in a file, which is made with a new one if it is not there. Only its owner can read
    /// it then.
    ///
    /// # Errors
    /// The file cannot be read or written, or holds no key; the system has no random bytes.
    pub fn read_or_create(path: &Path) -> Result<Self, KeyError> {
        match Self::read(path) {
            Err(KeyError::File { source, .. }) if source.kind() == ErrorKind::NotFound => {}
            found => return found,
        }
        let bytes = random_bytes()?;
        let text = to_hex(&bytes) + "\n";
        write_secret_atomically(path, text.as_bytes()).map_err(|source| KeyError::File {
            path: path.to_owned(),
            source,
        })?;
        Ok(Self::new(&bytes))
    }

    /// The tag of a message.
    pub(crate) fn sign(&self, message: &[u8]) -> hmac::Tag {
        hmac::sign(&self.0, message)
    }

    /// Whether a tag is that of the message; takes as long whichever byte differs.
    pub(crate) fn verifies(&self, message: &[u8], tag: &[u8]) -> bool {
        hmac::verify(&self.0, message, tag).is_ok()
    }
}

fn random_bytes() -> Result<[u8; KEY_BYTES], KeyError> {
    let mut bytes = [0; KEY_BYTES];
    let filled = SystemRandom::new().fill(&mut bytes);
    filled.map_err(|_| KeyError::NoRandomness)?;
    Ok(bytes)
}

fn to_hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

fn from_hex(text: &str) -> Option<[u8; KEY_BYTES]> {
    // A parser of numbers would take a sign, too.
    if text.len() != 2 * KEY_BYTES || !text.bytes().all(|digit| digit.is_ascii_hexdigit()) {
        return None;
    }
    let mut bytes = [0; KEY_BYTES];
    for (i, byte) in bytes.iter_mut().enumerate() {
        *byte = u8::from_str_radix(&text[2 * i..2 * i + 2], 16).ok()?;
    }
    Some(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::PermissionsExt;

    #[test]
    fn a_key_is_made_once_and_only_its_owner_can_read_it() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("track.key");
        assert!(TrackKey::read(&path).is_err());
        let made = TrackKey::read_or_create(&path).unwrap();
        let read = TrackKey::read_or_create(&path).unwrap();
        assert!(read.verifies(b"here", made.sign(b"here").as_ref()));
        let mode = std::fs::metadata(&path).unwrap().permissions().mode();
        assert_eq!(mode & 0o777, 0o600);
    }

    #[test]
    fn two_keys_differ() {
        let directory = tempfile::tempdir().unwrap();
        let key = |name: &str| TrackKey::read_or_create(&directory.path().join(name)).unwrap();
        assert!(!key("a").verifies(b"here", key("b").sign(b"here").as_ref()));
    }

    #[test]
    fn files_that_hold_no_key_are_refused_and_stay() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("track.key");
        let long = "a".repeat(1000);
        for text in ["", "secret", &"g".repeat(64), &"+1".repeat(32), &long] {
            std::fs::write(&path, text).unwrap();
            let refused = TrackKey::read_or_create(&path);
            assert!(matches!(refused, Err(KeyError::NotAKey { .. })), "{text}");
            assert_eq!(std::fs::read_to_string(&path).unwrap(), text);
        }
    }

    #[test]
    fn a_key_does_not_show_itself() {
        assert_eq!(format!("{:?}", TrackKey::new(&[7; 32])), "TrackKey(..)");
    }
}
