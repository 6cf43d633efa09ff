//! The number of the last acknowledged commit, kept outside the log.
//!
//! The newest commits lie in the write-ahead log until they are folded into the database. To the
//! engine, a log that was cut short or deleted while no process had it open is a log that ended
//! there, so the database opens without a complaint and without what was acknowledged. Therefore
//! the database counts its commits, and the count is written to the small file `commit-mark` as
//! well, and synced, before anyone is answered. A database that has not reached its mark has lost
//! commits.
//!
//! The file has two slots, each in a disk block of its own, which are written in turn. A write that
//! is torn by a power cut spoils the slot of a commit that nobody was told of; the other slot still
//! has the commit before it. The database may be ahead of the mark by the commit under way, never
//! behind.

use super::directory::io;
use super::sequence::Progress;
use crate::crash_points;
use crate::error::StoreError;
use placeformer_core::files::write_private_atomically;
use std::fs::{File, OpenOptions};
use std::io::ErrorKind;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use time::OffsetDateTime;

/// Name of the file inside the data directory.
pub(super) const MARK: &str = "commit-mark";

/// First bytes of a slot: what it is, and its version.
const MAGIC: &[u8; 8] = b"PFMARK01";

/// Bytes from one slot to the next. No disk has larger blocks that it writes in one go.
const SLOT_STRIDE: usize = 4096;

/// Bytes of a slot: the magic, four numbers, a CRC-32 of all that.
const SLOT_BYTES: usize = 8 + 4 * 8 + 4;

/// How far a store had come when it last acknowledged a write.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct CommitMark {
    pub progress: Progress,
    /// When, in microseconds since 1970, UTC.
    pub at: i64,
}

/// What lies where the mark of a store should be.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Found {
    /// No file.
    Nothing,
    /// A file in which neither slot is whole.
    Unreadable,
    /// The newer of the slots that are whole.
    Mark(CommitMark),
}

impl CommitMark {
    pub(super) fn now(progress: Progress) -> Self {
        let nanoseconds = OffsetDateTime::now_utc().unix_timestamp_nanos();
        Self {
            progress,
            at: i64::try_from(nanoseconds / 1000).unwrap_or(i64::MAX),
        }
    }

    /// The mark in the file of `directory`.
    pub(super) fn read(directory: &Path) -> Result<Found, StoreError> {
        let path = directory.join(MARK);
        let bytes = match std::fs::read(&path) {
            Ok(bytes) => bytes,
            Err(error) if error.kind() == ErrorKind::NotFound => return Ok(Found::Nothing),
            Err(error) => return Err(io("cannot read", &path)(error)),
        };
        let newest = bytes
            .chunks(SLOT_STRIDE)
            .take(2)
            .filter_map(Self::decode)
            .max_by_key(|mark| mark.progress.commits);
        Ok(newest.map_or(Found::Unreadable, Found::Mark))
    }

    fn encode(&self) -> [u8; SLOT_BYTES] {
        let Progress {
            store,
            commits,
            references,
        } = self.progress;
        let mut slot = [0; SLOT_BYTES];
        slot[..8].copy_from_slice(MAGIC);
        for (number, at) in [store, commits, references, self.at].iter().zip(1..) {
            slot[8 * at..][..8].copy_from_slice(&number.to_le_bytes());
        }
        let checksum = crc32fast::hash(&slot[..SLOT_BYTES - 4]);
        slot[SLOT_BYTES - 4..].copy_from_slice(&checksum.to_le_bytes());
        slot
    }

    fn decode(slot: &[u8]) -> Option<Self> {
        let slot = slot.get(..SLOT_BYTES)?;
        let (content, checksum) = slot.split_at(SLOT_BYTES - 4);
        let is_whole = checksum == crc32fast::hash(content).to_le_bytes();
        if !is_whole || content[..8] != *MAGIC {
            return None;
        }
        let number = |at: usize| {
            let mut bytes = [0; 8];
            bytes.copy_from_slice(&content[8 * at..][..8]);
            i64::from_le_bytes(bytes)
        };
        Some(Self {
            progress: Progress {
                store: number(1),
                commits: number(2),
                references: number(3),
            },
            at: number(4),
        })
    }

    /// Where in the file the slot for this mark begins.
    fn offset(&self) -> u64 {
        let slot = self.progress.commits.rem_euclid(2) as u64;
        slot * SLOT_STRIDE as u64
    }

    /// What a database that has come as far as `found` lacks of this mark; none if nothing.
    pub(super) fn missing(&self, found: Option<Progress>, directory: &Path) -> Option<StoreError> {
        let marked = self.progress;
        let commits = found.map_or(0, |found| found.commits);
        if marked.commits <= commits {
            return None;
        }
        let references = found.map_or(1, |found| found.references);
        let at = OffsetDateTime::from_unix_timestamp_nanos(i128::from(self.at) * 1000);
        Some(StoreError::LostCommits {
            directory: directory.to_owned(),
            lost: marked.commits - commits,
            marked: marked.commits,
            references: (marked.references - references).max(0),
            at: at.unwrap_or(OffsetDateTime::UNIX_EPOCH),
        })
    }
}

/// The open file.
pub(super) struct MarkFile {
    file: File,
    path: PathBuf,
}

impl MarkFile {
    /// Opens the file that is there.
    pub(super) fn open(directory: &Path) -> Result<Self, StoreError> {
        let path = directory.join(MARK);
        let file = OpenOptions::new().read(true).write(true).open(&path);
        Ok(Self {
            file: file.map_err(io("cannot open", &path))?,
            path,
        })
    }

    /// Makes the file with `mark` in it, in the place of any that is there, and opens it. Its room
    /// is taken once and for all, so that a full disk never keeps a mark from being written.
    pub(super) fn create(directory: &Path, mark: &CommitMark) -> Result<Self, StoreError> {
        let path = directory.join(MARK);
        // Bytes that are not zero, so that no file system leaves holes that it fills later.
        let mut content = vec![0xff; 2 * SLOT_STRIDE];
        content[mark.offset() as usize..][..SLOT_BYTES].copy_from_slice(&mark.encode());
        write_private_atomically(&path, &content).map_err(io("cannot write", &path))?;
        Self::open(directory)
    }

    /// Makes `mark` durable.
    pub(super) fn record(&self, mark: &CommitMark) -> Result<(), StoreError> {
        let (slot, offset) = (mark.encode(), mark.offset());
        let write = || {
            if crash_points::ENABLED {
                self.file.write_all_at(&slot[..SLOT_BYTES / 2], offset)?;
                crash_points::reach(crash_points::MID_MARK);
            }
            self.file.write_all_at(&slot, offset)?;
            self.file.sync_data()
        };
        write().map_err(|error: std::io::Error| StoreError::StorageLost {
            reason: format!("cannot write {}: {error}", self.path.display()),
        })?;
        crash_points::reach(crash_points::AFTER_MARK);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn mark(commits: i64) -> CommitMark {
        CommitMark {
            progress: Progress {
                store: -7,
                commits,
                references: 3 * commits,
            },
            at: 1_700_000_000_000_000 + commits,
        }
    }

    #[test]
    fn the_newest_of_two_slots_counts() {
        let folder = tempfile::tempdir().unwrap();
        assert_eq!(CommitMark::read(folder.path()).unwrap(), Found::Nothing);
        let file = MarkFile::create(folder.path(), &mark(4)).unwrap();
        assert_eq!(
            CommitMark::read(folder.path()).unwrap(),
            Found::Mark(mark(4))
        );
        for commits in 5..9 {
            file.record(&mark(commits)).unwrap();
            let read = CommitMark::read(folder.path()).unwrap();
            assert_eq!(read, Found::Mark(mark(commits)));
        }
    }

    #[test]
    fn a_mark_that_is_made_anew_hides_none_that_was_higher() {
        let folder = tempfile::tempdir().unwrap();
        let file = MarkFile::create(folder.path(), &mark(8)).unwrap();
        file.record(&mark(9)).unwrap();
        MarkFile::create(folder.path(), &mark(3)).unwrap();
        assert_eq!(
            CommitMark::read(folder.path()).unwrap(),
            Found::Mark(mark(3))
        );
    }

    proptest! {
        #[test]
        fn a_torn_write_leaves_the_mark_before_it(commits in 1i64..1000, torn in 0..SLOT_BYTES) {
            let folder = tempfile::tempdir().unwrap();
            let file = MarkFile::create(folder.path(), &mark(commits)).unwrap();
            file.record(&mark(commits + 1)).unwrap();
            let next = mark(commits + 2);
            file.file.write_all_at(&next.encode()[..torn], next.offset()).unwrap();
            let read = CommitMark::read(folder.path()).unwrap();
            prop_assert_eq!(read, Found::Mark(mark(commits + 1)));
        }

        #[test]
        fn no_flipped_bit_makes_another_mark(commits in 0i64..1000, bit in 0..8 * SLOT_BYTES) {
            let mut slot = mark(commits).encode();
            slot[bit / 8] ^= 1 << (bit % 8);
            prop_assert_eq!(CommitMark::decode(&slot), None);
        }

        #[test]
        fn bytes_that_are_no_mark_are_none(bytes in prop::collection::vec(any::<u8>(), 0..9000)) {
            let folder = tempfile::tempdir().unwrap();
            std::fs::write(folder.path().join(MARK), bytes).unwrap();
            let read = CommitMark::read(folder.path()).unwrap();
            prop_assert_eq!(read, Found::Unreadable);
        }
    }
}
