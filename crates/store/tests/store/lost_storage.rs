//! The data directory removed, exchanged or written to by others while the store is open: nothing
//! is acknowledged that nobody would find again, and what can be read is.

use crate::places::{map, named_reference};
use crate::support::{config, create, database, fresh};
use placeformer_core::files::with_suffix;
use placeformer_store::{MaintainPlaces, ReadPlaces, SqliteStore, StoreError, WritePlaces};
use std::fs::{self, OpenOptions};
use std::io::Write;
use std::path::Path;
use std::process::Command;
use tempfile::TempDir;

/// A store with one reference, in a directory that can be moved.
struct Held {
    folder: TempDir,
    store: SqliteStore,
}

impl Held {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let store = SqliteStore::open(&folder.path().join("data"), &config()).unwrap();
        create(&store, named_reference(&map("city"), "0", 0));
        // As a server does at its start, which leaves a connection open.
        assert_eq!(store.maps().unwrap().len(), 1);
        Self { folder, store }
    }

    fn data(&self) -> std::path::PathBuf {
        self.folder.path().join("data")
    }

    /// No kind of write is acknowledged; returns why.
    #[track_caller]
    fn refuses_writes(&self) -> String {
        let id = self.store.list(None, None, 1).unwrap().references[0].id;
        let lost = |outcome: Result<(), StoreError>| match outcome {
            Err(StoreError::StorageLost { reason }) => reason,
            other => panic!("{other:?}"),
        };
        lost(self.store.delete(id).map(drop));
        lost(self.store.delete_map(&map("city")).map(drop));
        lost(self.store.set_calibration(&map("city"), None));
        lost(self.store.update(id, Default::default()).map(drop));
        lost(self.store.check_storage());
        let new = named_reference(&map("city"), "new", 1);
        lost(self.store.insert(new).map(drop))
    }

    #[track_caller]
    fn takes_writes(&self, seed: u64) {
        self.store.check_storage().unwrap();
        create(
            &self.store,
            named_reference(&map("city"), &seed.to_string(), seed),
        );
    }

    #[track_caller]
    fn answers(&self) {
        let references = self.store.list(None, None, 10).unwrap().references;
        assert!(!references.is_empty());
        for reference in references {
            self.store.patches(reference.id).unwrap();
        }
    }
}

#[test]
fn a_directory_moved_away_stops_writes_until_it_is_back() {
    let held = Held::new();
    let aside = held.folder.path().join("aside");
    for seed in 10..13 {
        fs::rename(held.data(), &aside).unwrap();
        assert!(held.refuses_writes().contains("cannot find"));
        held.answers();
        fs::rename(&aside, held.data()).unwrap();
        held.takes_writes(seed);
    }
    assert_eq!(held.store.map(&map("city")).unwrap().references, 4);
}

#[test]
fn a_removed_directory_stops_writes_while_reading_goes_on() {
    let held = Held::new();
    held.answers();
    fs::remove_dir_all(held.data()).unwrap();
    held.refuses_writes();
    held.answers();
    // A new directory of that name is not the old one, and nothing is made in it.
    fs::create_dir(held.data()).unwrap();
    held.refuses_writes();
    held.answers();
    let data = held.data();
    drop(held.store);
    assert_eq!(fs::read_dir(data).unwrap().count(), 0);
}

#[test]
fn another_store_in_its_place_is_neither_read_nor_written() {
    let held = Held::new();
    let (other, stranger) = fresh();
    create(&stranger, named_reference(&map("elsewhere"), "0", 5));
    drop(stranger);
    fs::rename(held.data(), held.folder.path().join("aside")).unwrap();
    fs::create_dir(held.data()).unwrap();
    for entry in fs::read_dir(other.path()).unwrap() {
        let path = entry.unwrap().path();
        fs::copy(&path, held.data().join(path.file_name().unwrap())).unwrap();
    }
    // A log beside it must survive the end of the store that does not own it.
    let log = with_suffix(&database(&held.data()), "-wal");
    fs::write(&log, "of the other store").unwrap();
    let before = fs::read(database(&held.data())).unwrap();
    held.refuses_writes();
    // As many readers at once as there may be: none of them opens the other database.
    std::thread::scope(|scope| {
        for _ in 0..8 {
            scope.spawn(|| {
                for _ in 0..20 {
                    let maps = held.store.maps().unwrap();
                    assert_eq!(maps[0].name, map("city"));
                }
            });
        }
    });
    let data = held.data();
    drop(held.store);
    assert_eq!(fs::read(database(&data)).unwrap(), before);
    assert_eq!(fs::read_to_string(log).unwrap(), "of the other store");
}

#[test]
fn every_single_file_that_is_missing_or_another_stops_writes() {
    for name in [
        "placeformer.db",
        "placeformer.db-wal",
        "placeformer.db-shm",
        "LOCK",
        "commit-mark",
    ] {
        let held = Held::new();
        let path = held.data().join(name);
        let aside = held.folder.path().join("aside");
        fs::rename(&path, &aside).unwrap();
        assert!(held.refuses_writes().contains(name), "{name}");
        fs::copy(&aside, &path).unwrap();
        assert!(held.refuses_writes().contains(name), "{name}");
        fs::rename(&aside, &path).unwrap();
        held.takes_writes(20);
    }
}

#[test]
fn a_file_that_others_write_to_stops_writes() {
    let append = |path: &Path| {
        let mut file = OpenOptions::new().append(true).open(path).unwrap();
        file.write_all(b"more").unwrap();
    };
    let overwrite = |path: &Path| {
        let content = fs::read(path).unwrap();
        // As `cp` does: the file is cut, and then filled.
        fs::write(path, content).unwrap();
    };
    let cut = |path: &Path| {
        let file = OpenOptions::new().write(true).open(path).unwrap();
        file.set_len(100).unwrap();
    };
    for name in ["placeformer.db", "placeformer.db-wal"] {
        for (how, change) in [
            ("append", &append as &dyn Fn(&Path)),
            ("overwrite", &overwrite),
            ("cut", &cut),
        ] {
            let held = Held::new();
            // Longer than the steps in which file systems note the time.
            std::thread::sleep(std::time::Duration::from_millis(30));
            change(&held.data().join(name));
            let new = named_reference(&map("city"), "new", 1);
            match held.store.insert(new) {
                Err(StoreError::StorageLost { reason }) => {
                    assert!(reason.contains("another program"), "{reason}");
                }
                other => panic!("{how} {name}: {other:?}"),
            }
            assert!(held.store.check_storage().is_err(), "{how} {name}");
        }
    }
}

#[test]
fn no_backup_is_made_of_a_store_that_was_exchanged() {
    let held = Held::new();
    fs::rename(held.data(), held.folder.path().join("aside")).unwrap();
    let target = held.folder.path().join("backup");
    let error = held.store.backup(&target).unwrap_err();
    assert!(matches!(error, StoreError::StorageLost { .. }), "{error}");
    assert!(!target.exists());
}

#[test]
fn a_read_only_mount_stops_writes_until_it_can_be_written_again() {
    let held = Held::new();
    let data = held.data();
    let run = |program: &str, arguments: &[&str]| {
        let output = Command::new(program)
            .args(arguments)
            .arg(&data)
            .output()
            .unwrap();
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        output.status.success().then_some(()).ok_or(said)
    };
    // The same files, seen through a mount that is read-only.
    let path = data.to_str().unwrap().to_owned();
    if let Err(reason) = run("mount", &["--bind", &path]) {
        println!("SKIPPED: this process may not mount: {reason}");
        return;
    }
    if let Err(reason) = run("mount", &["-o", "remount,ro,bind"]) {
        run("umount", &[]).unwrap();
        println!("SKIPPED: this process may not mount read-only: {reason}");
        return;
    }
    let refused = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
        assert!(held.refuses_writes().contains("read-only"));
        held.answers();
    }));
    run("umount", &[]).unwrap();
    refused.unwrap();
    held.takes_writes(30);
}

#[test]
fn writes_of_many_at_once_are_all_refused_or_all_kept() {
    let held = Held::new();
    let aside = held.folder.path().join("aside");
    let kept = std::thread::scope(|scope| {
        let writers: Vec<_> = (0..4u64)
            .map(|writer| {
                let store = &held.store;
                scope.spawn(move || {
                    let mut kept = Vec::new();
                    for step in 0..40 {
                        let seed = 1000 * (writer + 1) + step;
                        let new = named_reference(&map("city"), &seed.to_string(), seed);
                        match store.insert(new) {
                            Ok(_) => kept.push(seed),
                            Err(StoreError::StorageLost { .. }) => {}
                            Err(other) => panic!("{other}"),
                        }
                    }
                    kept
                })
            })
            .collect();
        for _ in 0..10 {
            fs::rename(held.data(), &aside).unwrap();
            std::thread::yield_now();
            fs::rename(&aside, held.data()).unwrap();
            std::thread::sleep(std::time::Duration::from_millis(3));
        }
        let kept = writers
            .into_iter()
            .flat_map(|writer| writer.join().unwrap());
        kept.collect::<Vec<_>>()
    });
    let data = held.data();
    drop(held.store);
    let store = SqliteStore::open(&data, &config()).unwrap();
    for seed in kept {
        let external_id = seed.to_string().parse().unwrap();
        let found = store.find_external(&map("city"), &external_id).unwrap();
        assert!(found.is_some(), "acknowledged {seed} is lost");
    }
    assert_eq!(store.verify().unwrap().engine_errors, [""; 0]);
}
