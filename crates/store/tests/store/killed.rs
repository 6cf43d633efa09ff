//! A process killed between two writes.
//!
//! With the feature `crash-points` the process dies at every named place, and what it leaves is
//! checked. Without it, it must not die at any.

use crate::places::{MODEL, map, named_reference, reference};
use crate::support::{create, open};
use placeformer_core::types::{GLOBAL_DIM, ModelId, NewReference, ReferenceId};
use placeformer_store::{
    MaintainPlaces, NewHead, ReadPlaces, SqliteStore, WritePlaces, crash_points,
};
use std::io::Write;
use std::path::Path;
use std::process::{Command, Output};

/// Tells a test process to be the child, and where.
const DIRECTORY: &str = "PLACEFORMER_TEST_DIRECTORY";

/// The head that the map gets.
const HEAD: &[u8] = b"stands for the head that the map keeps";

/// Prints a line for the parent. The test harness captures what `println!` prints, so it is
/// written to the standard output itself.
fn print(line: &str) {
    std::io::stdout()
        .write_all(format!("{line}\n").as_bytes())
        .unwrap();
}

/// Not a test of its own: what the process does that the test below kills.
#[test]
fn child_that_writes_until_it_is_killed() {
    let Some(directory) = std::env::var_os(DIRECTORY) else {
        return;
    };
    let store = open(Path::new(&directory));
    std::thread::scope(|scope| {
        for writer in 0..4u64 {
            let store = &store;
            scope.spawn(move || {
                for step in 0..12 {
                    let seed = writer * 100 + step;
                    let created = create(
                        store,
                        named_reference(&map("lasting"), &format!("photo {seed}"), seed),
                    );
                    print(&format!("\nstored {} {seed}", created.id));
                    create(store, reference(&map("doomed"), 1000 + seed));
                }
            });
        }
    });
    print("\nrehead");
    let head = NewHead {
        model: ModelId::new("new"),
        file: Some(HEAD.to_vec()),
    };
    store
        .replace_globals(&map("lasting"), head, &mut |pooled: &[f32]| {
            pooled[..GLOBAL_DIM].to_vec()
        })
        .unwrap();
    print("\nreheaded");
    store.delete_map(&map("doomed")).unwrap();
    print("\ndeleted");
}

/// The process that is killed, for other tests.
#[cfg(feature = "crash-points")]
pub struct Child;

#[cfg(feature = "crash-points")]
impl Child {
    /// Runs it in `directory` with a crash point armed; what it printed.
    pub fn run(directory: &Path, armed: &str) -> String {
        String::from_utf8_lossy(&run_child(directory, armed).stdout).into_owned()
    }
}

/// Runs the child in `directory` with a crash point armed.
fn run_child(directory: &Path, armed: &str) -> Output {
    Command::new(std::env::current_exe().unwrap())
        .args([
            "--exact",
            "killed::child_that_writes_until_it_is_killed",
            "--nocapture",
        ])
        .env(DIRECTORY, directory)
        .env(crash_points::VARIABLE, armed)
        .output()
        .unwrap()
}

#[test]
#[cfg(feature = "crash-points")]
fn nothing_acknowledged_is_lost_and_nothing_is_half_there_wherever_the_process_dies() {
    for &point in crash_points::ALL {
        for nth in [1, 2, 5] {
            let directory = tempfile::tempdir().unwrap();
            let armed = format!("{point}:{nth}");
            let output = run_child(directory.path(), &armed);
            let printed = String::from_utf8_lossy(&output.stdout).into_owned();
            if nth == 1 {
                assert!(
                    !output.status.success(),
                    "{point} is never reached: {printed}"
                );
            }
            check_what_is_left(directory.path(), &printed, &armed);
        }
    }
}

#[test]
#[cfg(not(feature = "crash-points"))]
fn a_build_without_crash_points_ignores_the_variable() {
    for &point in crash_points::ALL {
        let directory = tempfile::tempdir().unwrap();
        let output = run_child(directory.path(), point);
        let printed = String::from_utf8_lossy(&output.stdout).into_owned();
        assert!(output.status.success(), "{point}: {printed}");
        assert!(printed.contains("\ndeleted"), "{point}: {printed}");
        check_what_is_left(directory.path(), &printed, point);
    }
}

/// Checks the store that a process left: everything it printed is there, and nothing in part.
fn check_what_is_left(directory: &Path, printed: &str, point: &str) {
    let store = open(directory);
    check_acknowledged(&store, printed, point);
    check_head(&store, printed, point);
    assert!(
        !printed.contains("\ndeleted") || store.map(&map("doomed")).is_err(),
        "{point}"
    );
    for reference in store.list(None, None, 10_000).unwrap().references {
        store
            .patches(reference.id)
            .unwrap_or_else(|error| panic!("{point}: {error}"));
    }
    let report = store.verify().unwrap();
    assert_eq!(report.damaged, [], "{point}");
    assert_eq!(report.engine_errors, [] as [String; 0], "{point}");
    // The store still takes writes.
    let model = match store.map(&map("lasting")) {
        Ok(info) => info.model,
        Err(_) => ModelId::new(MODEL),
    };
    let new = NewReference {
        model,
        ..reference(&map("lasting"), 99_999)
    };
    create(&store, new);
}

/// Every reference whose insert returned is there, with its patches.
pub fn check_acknowledged(store: &SqliteStore, printed: &str, point: &str) {
    let lines = printed.lines();
    for line in lines.filter_map(|line| line.strip_prefix("stored ")) {
        let (id, seed) = line.split_once(' ').unwrap();
        let id: ReferenceId = id.parse().unwrap();
        let seed: u64 = seed.parse().unwrap();
        let new = named_reference(&map("lasting"), &format!("photo {seed}"), seed);
        let found = store
            .get(id)
            .unwrap_or_else(|error| panic!("{point}: {error}"));
        assert_eq!(found.fields, new.fields, "{point}");
        assert_eq!(found.content_hash, new.content_hash, "{point}");
        assert_eq!(
            store.patches(id).unwrap(),
            new.descriptor.patches,
            "{point}"
        );
    }
}

/// The map has its old head or the new one, with all the vectors of that head.
fn check_head(store: &SqliteStore, printed: &str, point: &str) {
    let Ok(info) = store.map(&map("lasting")) else {
        return;
    };
    let mut vectors = 0;
    store
        .scan_globals(&info.name, &mut |_| vectors += 1)
        .unwrap();
    assert_eq!(vectors, info.references, "{point}");
    let has_new_head = info.model.as_str() == "new";
    let may_have_old_head = info.model.as_str() == MODEL && !printed.contains("reheaded");
    assert!(has_new_head || may_have_old_head, "{point}: {}", info.model);
    // The head comes with the vectors that it made, whole, or neither does.
    let head = has_new_head.then(|| HEAD.to_vec());
    assert_eq!(store.head(&info.name).unwrap(), head, "{point}");
}
