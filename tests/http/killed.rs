//! A hundred times: the server is killed while many clients add references, and started again on
//! what is left.
//!
//! What it has acknowledged must be there, in the listing, in the index and on the disk; what it
//! has not may be there or not, but never in part.

use crate::process::{Server, store_config};
use crate::support::picture;
use placeformer_store::{MaintainPlaces, SqliteStore, crash_points};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

const ROUNDS: u64 = 100;
const CLIENTS: u64 = 4;
/// Where adding and deleting can die; heads and migrations are not changed here.
const WRITE_POINTS: [&str; 6] = [
    crash_points::BEFORE_BEGIN,
    crash_points::MID_INSERT,
    crash_points::BEFORE_COMMIT,
    crash_points::AFTER_COMMIT,
    crash_points::MAP_DELETED,
    crash_points::MID_PURGE,
];
/// Maps that the clients fill.
const MAPS: u64 = 3;

/// What the clients of all rounds were told.
#[derive(Default)]
struct Told {
    /// Acknowledged references by id: map and seed of the picture.
    there: BTreeMap<String, (u64, u64)>,
    /// Acknowledged deletions.
    gone: Vec<String>,
    /// Sent to be deleted, not acknowledged: all of a set are there, or none.
    uncertain: Vec<Vec<String>>,
}

impl Told {
    fn merge(&mut self, other: Self) {
        self.there.extend(other.there);
        self.gone.extend(other.gone);
        self.uncertain.extend(other.uncertain);
    }
}

/// One client: adds references, takes some away, until the server is gone.
fn use_server(server: &Server, client: u64, next_seed: &AtomicU64) -> Told {
    let mut told = Told::default();
    loop {
        let seed = next_seed.fetch_add(1, Ordering::Relaxed);
        let map = seed % MAPS;
        let path = format!("/references?map=map-{map}&external_id={seed}&lat=1&lon={client}");
        let Some((status, answer)) = server.post(&path, picture(seed)) else {
            return told;
        };
        assert_eq!(status, 201, "{answer}");
        let id = answer["id"].as_str().unwrap().to_owned();
        if seed.is_multiple_of(7) {
            match server.delete(&format!("/references/{id}")) {
                Some((status, _)) => {
                    assert_eq!(status, 204);
                    told.gone.push(id);
                }
                None => {
                    told.uncertain.push(vec![id]);
                    return told;
                }
            }
        } else {
            told.there.insert(id, (map, seed));
        }
    }
}

/// Another client: fills maps of its own and deletes each whole.
fn make_and_delete_maps(server: &Server, round: u64, next_seed: &AtomicU64) -> Told {
    let mut told = Told::default();
    for nth in 0.. {
        let map = format!("doomed-{round}-{nth}");
        let mut ids = Vec::new();
        for _ in 0..4 {
            let seed = next_seed.fetch_add(1, Ordering::Relaxed);
            let path = format!("/references?map={map}&external_id={seed}");
            let Some((status, answer)) = server.post(&path, picture(seed)) else {
                return told;
            };
            assert_eq!(status, 201, "{answer}");
            ids.push(answer["id"].as_str().unwrap().to_owned());
        }
        match server.delete(&format!("/maps/{map}")) {
            Some((status, answer)) => {
                assert_eq!(status, 200, "{answer}");
                told.gone.append(&mut ids);
            }
            None => {
                told.uncertain.push(ids);
                return told;
            }
        }
    }
    told
}

/// Everything that was promised is there, and nothing is there in part.
fn check(server: &Server, told: &Told, recent: &[String], round: u64) {
    let mut listed = BTreeMap::new();
    let mut cursor = String::new();
    loop {
        let (status, page) = server
            .get(&format!("/references?limit=1000{cursor}"))
            .unwrap();
        assert_eq!(status, 200, "round {round}: {page}");
        for reference in page["references"].as_array().unwrap() {
            listed.insert(
                reference["id"].as_str().unwrap().to_owned(),
                reference.clone(),
            );
        }
        let Some(next) = page["next"].as_str() else {
            break;
        };
        cursor = format!("&cursor={next}");
    }
    for (id, (map, seed)) in &told.there {
        let there = listed
            .get(id)
            .unwrap_or_else(|| panic!("round {round}: acknowledged {id} is lost"));
        assert_eq!(
            there["external_id"],
            seed.to_string(),
            "round {round}: {there}"
        );
        assert_eq!(there["map"], format!("map-{map}"), "round {round}: {there}");
    }
    for id in &told.gone {
        assert!(
            !listed.contains_key(id),
            "round {round}: deleted {id} is back"
        );
    }
    for ids in &told.uncertain {
        let there = ids.iter().filter(|id| listed.contains_key(*id)).count();
        assert!(
            there == 0 || there == ids.len(),
            "round {round}: {there} of {ids:?} are there"
        );
    }
    // Acknowledged or not: what is listed can be found by its picture, down to its patches.
    let strangers = listed.keys().filter(|id| !told.there.contains_key(*id));
    for id in strangers.chain(recent.iter().filter(|id| told.there.contains_key(*id))) {
        let (map, seed) = (
            listed[id]["map"].as_str().unwrap(),
            listed[id]["external_id"].as_str().unwrap(),
        );
        let (status, answer) = server
            .post(
                &format!("/query?map={map}&top_k=1&candidates=5"),
                picture(seed.parse().unwrap()),
            )
            .unwrap();
        assert_eq!(status, 200, "round {round}: {answer}");
        let best = &answer["results"][0];
        assert_eq!(best["reference_id"], id.as_str(), "round {round}: {answer}");
        assert!(
            best["spatial_score"].as_u64().unwrap() > 100,
            "round {round}: {answer}"
        );
    }
    for map in server.get("/maps").unwrap().1["maps"].as_array().unwrap() {
        let count = listed
            .values()
            .filter(|reference| reference["map"] == map["name"])
            .count();
        assert_eq!(map["references"], count, "round {round}: {map}");
    }
}

#[test]
fn a_hundred_kills_lose_nothing_that_was_acknowledged() {
    let directory = tempfile::tempdir().unwrap();
    let master_seed = 20_261_123;
    println!("seed {master_seed}");
    let (mut told, mut recent, next_seed) = (Told::default(), Vec::new(), AtomicU64::new(0));
    for round in 0..ROUNDS {
        let mut random = ChaCha8Rng::seed_from_u64(master_seed + round);
        // Every third round dies at a named write point, the others at a random moment.
        let point = WRITE_POINTS[random.random_range(0..WRITE_POINTS.len())];
        let point = (round % 3 == 0).then(|| format!("{point}:{}", random.random_range(1..12)));
        let mut server = Server::start(directory.path(), None);
        check(&server, &told, &recent, round);
        if point.is_some() {
            // Checked by a server without the point, because going on with what was interrupted may
            // reach it, too.
            server.kill();
            server = Server::start(directory.path(), point);
        }
        let this_round = std::thread::scope(|scope| {
            let (server, next_seed) = (&server, &next_seed);
            let mut clients: Vec<_> = (0..CLIENTS)
                .map(|client| scope.spawn(move || use_server(server, client, next_seed)))
                .collect();
            clients.push(scope.spawn(move || make_and_delete_maps(server, round, next_seed)));
            std::thread::sleep(Duration::from_millis(random.random_range(0..120)));
            server.kill();
            let mut all = Told::default();
            clients
                .into_iter()
                .for_each(|client| all.merge(client.join().unwrap()));
            all
        });
        recent = this_round.there.keys().cloned().collect();
        told.merge(this_round);
    }
    println!(
        "{} references acknowledged and kept, {} deleted",
        told.there.len(),
        told.gone.len()
    );
    assert!(
        told.there.len() > 100,
        "hardly anything was written: {}",
        told.there.len()
    );
    let server = Server::start(directory.path(), None);
    check(&server, &told, &recent, ROUNDS);
    server.kill();
    let report = SqliteStore::open(directory.path(), &store_config())
        .unwrap()
        .verify()
        .unwrap();
    assert_eq!((report.damaged, report.engine_errors), (vec![], vec![]));
}
