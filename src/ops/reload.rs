//! When to read files again that a running server uses, such as keys and certificates.
//!
//! Two things ask for it: SIGHUP, which is how operators ask a daemon, and a change of the files
//! themselves, because secrets that are mounted into a container are replaced without a signal.
//! Whoever reads the files decides what to do with them; this only says when. A reader that finds
//! the new content broken keeps the old: while a file is being written it is broken for a moment,
//! and the end of the writing is a change again.

use std::fs::Metadata;
use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;
use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio::sync::watch;
use tokio::task::spawn_blocking;
use tokio::time::{MissedTickBehavior, interval};

/// Time between two looks at the files.
const LOOK_INTERVAL: Duration = Duration::from_secs(2);

/// Watches `files` and SIGHUP. The value counts the reasons to read the files again, so that a
/// receiver's `changed` resolves after each. Files that change together count once.
///
/// Call this before the files are read for the first time: then no change falls between. A file may
/// be missing, be replaced by a rename or be reached through symbolic links. Without files only
/// SIGHUP counts. The watching ends when the last receiver is dropped.
///
/// # Errors
/// The handler of SIGHUP cannot be installed.
///
/// # Panics
/// Outside a runtime of tokio.
pub fn watch(files: Vec<PathBuf>) -> io::Result<watch::Receiver<u64>> {
    watch_every(files, LOOK_INTERVAL)
}

fn watch_every(files: Vec<PathBuf>, look_interval: Duration) -> io::Result<watch::Receiver<u64>> {
    let hangups = signal(SignalKind::hangup())?;
    let seen = identities(&files);
    let (sender, receiver) = watch::channel(0);
    let watched = Watched {
        files: files.into(),
        seen,
    };
    tokio::spawn(tick(sender, watched, hangups, look_interval));
    Ok(receiver)
}

/// Files, and what they were when they were last looked at.
struct Watched {
    files: Arc<[PathBuf]>,
    seen: Vec<Option<Identity>>,
}

impl Watched {
    /// Looks at the files on a blocking thread, because they may be on a disk that hangs. Returns
    /// whether any is another than at the last look.
    async fn have_changed(&mut self) -> bool {
        let files = self.files.clone();
        // It fails only if the runtime ends, and then there is nobody left to tell.
        let Ok(found) = spawn_blocking(move || identities(&files)).await else {
            return false;
        };
        let changed = found != self.seen;
        self.seen = found;
        changed
    }
}

async fn tick(
    sender: watch::Sender<u64>,
    mut watched: Watched,
    mut hangups: Signal,
    look_interval: Duration,
) {
    let mut looks = interval(look_interval);
    looks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        let is_due = tokio::select! {
            () = sender.closed() => return,
            Some(()) = hangups.recv() => {
                tracing::info!(signal = "SIGHUP", "reading files again");
                // What the signal is about must not count a second time at the next look.
                watched.have_changed().await;
                true
            }
            _ = looks.tick() => watched.have_changed().await,
        };
        if is_due {
            sender.send_modify(|count| *count += 1);
        }
    }
}

/// What tells one content of a path from the next without reading it. The time of the last change
/// of the inode is part of it, because it cannot be set: `cp -p` and `mv` keep the other time.
#[derive(Debug, PartialEq, Eq)]
struct Identity {
    device: u64,
    inode: u64,
    bytes: u64,
    modified: (i64, i64),
    changed: (i64, i64),
}

impl From<Metadata> for Identity {
    fn from(metadata: Metadata) -> Self {
        Self {
            device: metadata.dev(),
            inode: metadata.ino(),
            bytes: metadata.size(),
            modified: (metadata.mtime(), metadata.mtime_nsec()),
            changed: (metadata.ctime(), metadata.ctime_nsec()),
        }
    }
}

/// The identity of each file; `None` for one that is missing or cannot be looked at.
fn identities(files: &[PathBuf]) -> Vec<Option<Identity>> {
    let identity = |path: &PathBuf| Path::metadata(path).ok().map(Identity::from);
    files.iter().map(identity).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    const OFTEN: Duration = Duration::from_millis(5);

    #[tokio::test]
    async fn every_way_of_replacing_a_file_is_noticed() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("key.pem");
        let other = folder.path().join("other.pem");
        let link = folder.path().join("link.pem");
        std::os::unix::fs::symlink(&path, &link).unwrap();
        let mut changes = watch_every(vec![link.clone()], OFTEN).unwrap();
        fs::write(&path, "appeared").unwrap();
        changes.changed().await.unwrap();
        fs::write(&path, "longer than it was").unwrap();
        changes.changed().await.unwrap();
        fs::write(&other, "longer than it was").unwrap();
        fs::rename(&other, &path).unwrap();
        changes.changed().await.unwrap();
        fs::write(&other, "behind another link").unwrap();
        let next = folder.path().join("next.pem");
        std::os::unix::fs::symlink(&other, &next).unwrap();
        fs::rename(&next, &link).unwrap();
        changes.changed().await.unwrap();
        fs::remove_file(&link).unwrap();
        changes.changed().await.unwrap();
    }

    #[tokio::test]
    async fn a_hangup_is_a_reason_without_any_file() {
        let mut changes = watch(Vec::new()).unwrap();
        let mut sender = std::process::Command::new("sh");
        let sent = sender.args(["-c", "kill -HUP $PPID"]).status().unwrap();
        assert!(sent.success());
        changes.changed().await.unwrap();
        assert_eq!(*changes.borrow(), 1);
    }
}
