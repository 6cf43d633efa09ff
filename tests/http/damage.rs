//! A damaged database behind a running service: what can be read is answered, the rest is reported.

use crate::support::{App, FakeSource};
use placeformer_store::{MaintainPlaces, SqliteStore, StoreConfig};
use rand::{RngExt, SeedableRng};
use rusqlite::Connection;
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use tempfile::TempDir;

/// Small pages, so that tables and indexes of a few hundred references have several.
const PAGE: usize = 4096;

fn store_config() -> StoreConfig {
    StoreConfig {
        reserve_bytes: 1 << 20,
        page_bytes: PAGE as u32,
        ..StoreConfig::default()
    }
}

fn open(directory: &Arc<TempDir>) -> App {
    App::open(directory.clone(), FakeSource::new("fake-1"), |config| {
        config.store = store_config()
    })
}

fn database(directory: &Path) -> PathBuf {
    directory.join("placeformer.db")
}

/// Stores `count` references named by their seeds and closes the service; returns their identities.
async fn stored(directory: &Arc<TempDir>, count: u64) -> Vec<String> {
    let app = open(directory);
    let mut ids = Vec::new();
    for seed in 0..count {
        let answer = app
            .post_png(&format!("/references?map=m&external_id={seed}"), seed)
            .await;
        ids.push(answer.created()["id"].as_str().unwrap().to_owned());
    }
    ids
}

fn change(directory: &Path, sql: &str) {
    let connection = Connection::open(database(directory)).unwrap();
    assert!(connection.execute(sql, []).unwrap() > 0, "{sql}");
    connection.close().unwrap();
}

/// The value of an unlabelled series.
async fn metric(app: &App, name: &str) -> u64 {
    let text = app.get("/metrics").await.text;
    let line = text
        .lines()
        .find(|line| line.starts_with(&format!("{name} ")))
        .unwrap();
    line.rsplit(' ').next().unwrap().parse().unwrap()
}

/// Whether one reference is served, by every way to ask for it. They must agree, and refuse it as
/// damaged or not at all.
async fn is_served(app: &App, id: &str, seed: u64, what: &str) -> bool {
    let shown = app.get(&format!("/references/{id}")).await;
    let matched = app
        .post_png(&format!("/match?reference_id={id}"), seed)
        .await;
    let found = app.post_png("/query?map=m&top_k=1", seed).await;
    for answer in [&shown, &matched, &found] {
        // Where an index lost its entry nobody can tell it from one that never was; the query has
        // reported it.
        let lost = answer.json["code"] == "reference_not_found";
        assert!(
            answer.status == 200 || answer.json["code"] == "corrupt_record" || lost,
            "{what}: {}",
            answer.text
        );
    }
    let first = found.json["results"][0]["reference_id"] == id;
    // What a query answers is readable, and what is readable one by one a query answers.
    assert_eq!(
        first,
        shown.status == 200 && matched.status == 200,
        "{what}: {id}: {}",
        found.text
    );
    first
}

#[tokio::test(flavor = "multi_thread")]
async fn one_unreadable_page_costs_only_the_references_on_it() {
    let pristine = Arc::new(tempfile::tempdir().unwrap());
    let ids = stored(&pristine, 200).await;
    let content = std::fs::read(database(pristine.path())).unwrap();
    for table in [
        "reference",
        "reference_by_id",
        "global_vector",
        "patches",
        "pooled_vector",
    ] {
        let directory = Arc::new(tempfile::tempdir().unwrap());
        let mut damaged = content.clone();
        damaged[last_leaf(&content, root_page(pristine.path(), table))] = 0;
        std::fs::write(database(directory.path()), damaged).unwrap();
        let app = open(&directory);
        let mut served = 0;
        let asked: Vec<(u64, &String)> = (0..)
            .zip(&ids)
            .filter(|(seed, _)| seed % 20 == 0 || *seed == 199)
            .collect();
        for &(seed, id) in &asked {
            // A reference leaves the index when it is first met, so the second answer is the steady
            // one.
            app.post_png("/query?map=m&top_k=1", seed).await;
            served += usize::from(is_served(&app, id, seed, table).await);
        }
        let listed = app.get("/references?map=m&limit=1000").await.ok()["references"]
            .as_array()
            .unwrap()
            .len();
        // No query needs the pooled vectors.
        let whole = table == "pooled_vector";
        assert_eq!(
            served == asked.len(),
            whole,
            "{table}: {served} of {} are served",
            asked.len()
        );
        assert!(
            served * 3 >= asked.len(),
            "{table}: only {served} of {} are served",
            asked.len()
        );
        assert!(listed >= 100, "{table}: only {listed} are listed");
        assert_eq!(
            metric(&app, "placeformer_corrupt_records_total").await > 0,
            !whole,
            "{table}"
        );
    }
}

/// The page a table or index starts at, from 1.
fn root_page(directory: &Path, table: &str) -> usize {
    let connection = Connection::open(database(directory)).unwrap();
    let sql = "SELECT rootpage FROM sqlite_master WHERE name = ?1";
    connection
        .query_row(sql, [table], |row| row.get::<_, i64>(0))
        .unwrap() as usize
}

/// Where the last leaf below `page` begins in the file. Fails where the tree is a single page.
fn last_leaf(content: &[u8], page: usize) -> usize {
    const INTERIOR: [u8; 2] = [2, 5];
    let mut at = (page - 1) * PAGE;
    assert!(
        INTERIOR.contains(&content[at]),
        "the whole tree is one page"
    );
    while INTERIOR.contains(&content[at]) {
        let right_most = u32::from_be_bytes(content[at + 8..at + 12].try_into().unwrap());
        at = (right_most as usize - 1) * PAGE;
    }
    at
}

#[tokio::test(flavor = "multi_thread")]
async fn a_bit_flipped_anywhere_costs_no_reference_that_can_still_be_read() {
    let pristine = Arc::new(tempfile::tempdir().unwrap());
    let ids = stored(&pristine, 6).await;
    let content = std::fs::read(database(pristine.path())).unwrap();
    let seed = 20_250_301;
    println!("seed {seed}");
    let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
    let (mut refused, mut hurt, mut whole) = (0, 0, 0);
    for round in 0..40 {
        // Every other time where a page describes itself, which a flip anywhere hardly ever hits.
        let page = random.random_range(0..content.len() / PAGE) * PAGE;
        let at = page + random.random_range(0..if round % 2 == 0 { 64 } else { PAGE });
        let bit = random.random_range(0..8);
        let directory = Arc::new(tempfile::tempdir().unwrap());
        let mut damaged = content.clone();
        damaged[at] ^= 1 << bit;
        std::fs::write(database(directory.path()), damaged).unwrap();
        if SqliteStore::open(directory.path(), &store_config()).is_err() {
            refused += 1;
            continue;
        }
        let app = open(&directory);
        let what = format!("round {round}: bit {bit} of byte {at}");
        let known = app.get("/maps").await.ok()["maps"]
            .as_array()
            .is_some_and(|maps| !maps.is_empty());
        let mut served = 0;
        for (seed, id) in (0..).zip(&ids).filter(|_| known) {
            app.post_png("/query?map=m&top_k=1", seed).await;
            served += usize::from(is_served(&app, id, seed, &what).await);
        }
        if served == ids.len() {
            whole += 1;
            continue;
        }
        hurt += 1;
        assert!(
            metric(&app, "placeformer_corrupt_records_total").await > 0,
            "{what}: {served} served, unreported"
        );
    }
    println!("{refused} refused at opening, {hurt} lost references, {whole} lost none");
    assert!(hurt > 5 && whole > 5, "{hurt} hurt, {whole} whole");
}

#[tokio::test]
async fn a_lost_global_vector_is_noticed_at_start_and_healed_by_the_photo() {
    let directory = Arc::new(tempfile::tempdir().unwrap());
    let ids = stored(&directory, 4).await;
    change(
        directory.path(),
        "DELETE FROM global_vector WHERE number = 3",
    );
    let app = open(&directory);
    assert_eq!(metric(&app, "placeformer_corrupt_records_total").await, 1);
    assert_eq!(metric(&app, "placeformer_quarantined_references").await, 1);
    app.get(&format!("/references/{}", ids[2]))
        .await
        .problem("corrupt_record");
    app.post_png("/references?map=m&external_id=2", 2)
        .await
        .created();
    assert_eq!(
        app.post_png("/query?map=m&top_k=1", 2).await.ok()["results"][0]["external_id"],
        "2"
    );
    assert_eq!(metric(&app, "placeformer_quarantined_references").await, 0);
    assert_eq!(
        metric(&app, "placeformer_corrupt_records_total").await,
        1,
        "met once, counted once"
    );
}

#[tokio::test]
async fn a_damaged_reference_can_be_deleted() {
    let directory = Arc::new(tempfile::tempdir().unwrap());
    let ids = stored(&directory, 3).await;
    let app = open(&directory);
    // One is met by the deletion itself, the other was met before.
    change(
        directory.path(),
        "UPDATE reference SET heading = 12.5 WHERE number < 3",
    );
    app.get(&format!("/references/{}", ids[1]))
        .await
        .problem("corrupt_record");
    for id in &ids[..2] {
        assert_eq!(app.delete(&format!("/references/{id}")).await.status, 204);
        app.get(&format!("/references/{id}"))
            .await
            .problem("reference_not_found");
        app.delete(&format!("/references/{id}"))
            .await
            .problem("reference_not_found");
    }
    assert_eq!(
        app.post_png("/query?map=m&top_k=5", 0).await.ok()["results"]
            .as_array()
            .map(Vec::len),
        Some(1)
    );
    assert_eq!(metric(&app, "placeformer_references{map=\"m\"}").await, 1);
    assert_eq!(metric(&app, "placeformer_quarantined_references").await, 0);
    drop(app);
    let report = SqliteStore::open(directory.path(), &store_config())
        .unwrap()
        .verify()
        .unwrap();
    assert!(
        report.references == 1 && report.damaged.is_empty() && report.engine_errors.is_empty(),
        "{report:?}"
    );
}

#[tokio::test]
async fn damage_met_by_any_request_is_counted_and_leaves_the_index() {
    let requests: [fn(&str) -> String; 3] = [
        |id| format!("/references/{id}"),
        |_| "/references?map=m".to_owned(),
        |_| "/references".to_owned(),
    ];
    for path in requests {
        let directory = Arc::new(tempfile::tempdir().unwrap());
        let ids = stored(&directory, 5).await;
        let app = open(&directory);
        let found = async || {
            let answer = app.post_png("/query?map=m&rerank=false&top_k=5", 0).await;
            answer.ok()["results"].as_array().unwrap().len()
        };
        // While the service runs, as a failing disk would.
        change(
            directory.path(),
            "UPDATE reference SET heading = 12.5 WHERE number = 2",
        );
        assert_eq!(metric(&app, "placeformer_references{map=\"m\"}").await, 5);
        app.get(&path(&ids[1])).await;
        assert_eq!(metric(&app, "placeformer_corrupt_records_total").await, 1);
        assert_eq!(
            metric(&app, "placeformer_references{map=\"m\"}").await,
            4,
            "it is still searched"
        );
        assert_eq!(found().await, 4);
        // Sent again it is back under a new identity.
        app.post_png("/references?map=m&external_id=1", 1)
            .await
            .created();
        assert_eq!(
            (
                found().await,
                metric(&app, "placeformer_quarantined_references").await
            ),
            (5, 0)
        );
    }
}

#[tokio::test]
async fn a_damaged_map_record_is_named_as_such_and_costs_no_other_map() {
    let directory = Arc::new(tempfile::tempdir().unwrap());
    let app = open(&directory);
    for map in ["m", "other"] {
        app.post_png(&format!("/references?map={map}"), 1)
            .await
            .created();
    }
    drop(app);
    change(
        directory.path(),
        "UPDATE map SET model = model || '?' WHERE name = 'm'",
    );
    let app = open(&directory);
    assert!(metric(&app, "placeformer_corrupt_records_total").await >= 1);
    assert!(
        app.post_png("/query?map=m", 1)
            .await
            .problem("corrupt_record")
            .contains('m')
    );
    app.post_png("/query?map=never", 1)
        .await
        .problem("map_not_found");
    assert_eq!(
        app.post_png("/query?map=other", 1).await.ok()["results"]
            .as_array()
            .map(Vec::len),
        Some(1)
    );
    // Deleting it makes room for a new one.
    app.delete("/maps/m").await.ok();
    app.post_png("/references?map=m", 2).await.created();
    assert_eq!(
        app.post_png("/query?map=m", 2).await.ok()["results"]
            .as_array()
            .map(Vec::len),
        Some(1)
    );
}

#[tokio::test]
async fn a_count_that_no_checksum_covers_reserves_no_memory() {
    let directory = Arc::new(tempfile::tempdir().unwrap());
    let ids = stored(&directory, 2).await;
    change(
        directory.path(),
        "UPDATE map SET reference_count = 9223372036854775807",
    );
    let app = open(&directory);
    let answer = app.post_png("/query?map=m&top_k=1", 1).await;
    assert_eq!(
        answer.ok()["results"][0]["reference_id"],
        Value::from(ids[1].clone())
    );
}
