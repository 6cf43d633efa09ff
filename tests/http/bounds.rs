//! The bounds hold whatever clients do: leave and come again, ask for more than there is, or be in
//! a hurry.

use crate::support::{App, FakeSource, Gate, PATIENCE, multipart, picture, until};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use placeformer_core::types::{
    Calibration, ExternalId, MapName, NewReference, PackedPatches, Reference, ReferenceId,
};
use placeformer_store::{
    CombinedStore, Cursor, GlobalRow, HeadExchange, Inserted, MapInfo, NewHead, Page, ReadPlaces,
    ReferencePatch, SqliteStore, StoreError, WritePlaces,
};
use serde_json::json;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;
use tokio::task::JoinHandle;
use tokio::time::{sleep, timeout};

fn cores() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}

/// Sends a query on a task of its own.
fn query(app: &Arc<App>, seed: u64, options: &str) -> JoinHandle<crate::support::Answer> {
    let (app, path) = (app.clone(), format!("/query?map=m{options}"));
    tokio::spawn(async move { app.post_png(&path, seed).await })
}

// ---------------------------------------------------------------- clients that leave

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn clients_that_leave_during_extraction_get_no_second_one() {
    let app = Arc::new(App::new());
    app.post_png("/references?map=m", 0).await.created();
    app.source.describing.gate.close();
    for seed in 1..=20 {
        let leaving = query(&app, seed, "");
        until("an extraction", || app.source.describing.inside() > 0).await;
        // Long enough to get in beside the one that is abandoned, if that could be.
        sleep(Duration::from_millis(20)).await;
        leaving.abort();
    }
    assert_eq!(app.source.describing.peak(), 1);
    app.source.describing.gate.open();
    app.post_png("/query?map=m", 21).await.ok();
    assert_eq!(app.source.describing.peak(), 1);
    app.drained().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn clients_that_leave_during_decoding_get_no_more_decoders() {
    let app = Arc::new(App::new());
    app.post_png("/references?map=m", 0).await.created();
    app.source.decoding.gate.close();
    for seed in 1..=20 {
        let leaving = query(&app, seed, "");
        until("decoding", || app.source.decoding.inside() > 0).await;
        sleep(Duration::from_millis(20)).await;
        leaving.abort();
    }
    let peak = app.source.decoding.peak();
    assert!(peak <= cores(), "{peak} decoders on {} cores", cores());
    app.source.decoding.gate.open();
    app.post_png("/query?map=m", 21).await.ok();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn abandoned_work_keeps_its_place_in_the_queue_until_it_ends() {
    let app = Arc::new(App::with(|config| config.pipeline.queue_capacity = 1));
    app.post_png("/references?map=m", 0).await.created();
    for step in [&app.source.decoding, &app.source.describing] {
        step.gate.close();
        let leaving = query(&app, 1, "");
        until("work", || step.inside() == 1).await;
        leaving.abort();
        until("a client that left", || leaving.is_finished()).await;
        app.post_png("/query?map=m", 2).await.problem("overloaded");
        step.gate.open();
        until("the end of the work", || step.inside() == 0).await;
        app.drained().await;
        app.post_png("/query?map=m", 2).await.ok();
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn abandoned_references_are_bounded_too() {
    let app = Arc::new(App::with(|config| config.pipeline.queue_capacity = 3));
    app.source.describing.gate.close();
    for seed in 1..=10 {
        let (sender, path) = (app.clone(), format!("/references?map=m&external_id={seed}"));
        let leaving = tokio::spawn(async move { sender.post_png(&path, seed).await });
        until("an extraction", || app.source.describing.inside() > 0).await;
        sleep(Duration::from_millis(20)).await;
        leaving.abort();
    }
    assert_eq!(app.source.describing.peak(), 1);
    app.source.describing.gate.open();
    app.post_png("/references?map=m", 11).await.created();
    assert_eq!(
        app.count().await,
        1,
        "what was abandoned before its commit is not stored"
    );
}

// ---------------------------------------------------------------- bytes under way

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_body_counts_until_it_is_decoded_even_if_its_client_has_left() {
    let app = Arc::new(App::with(|config| {
        config.http.max_buffered_bytes = 192 << 10
    }));
    app.post_png("/references?map=m", 0).await.created();
    app.source.decoding.gate.close();
    let leaving = {
        let app = app.clone();
        tokio::spawn(async move { app.post_bytes("/query?map=m", &[7; 130 << 10]).await })
    };
    until("decoding", || app.source.decoding.inside() == 1).await;
    leaving.abort();
    until("a client that left", || leaving.is_finished()).await;
    app.post_bytes("/query?map=m", &[7; 100 << 10])
        .await
        .problem("overloaded");
    app.source.decoding.gate.open();
    until("the end of decoding", || app.source.decoding.inside() == 0).await;
    let began = std::time::Instant::now();
    while app.post_bytes("/query?map=m", &[7; 100 << 10]).await.json["code"] == "overloaded" {
        assert!(
            began.elapsed() < PATIENCE,
            "the bytes were never given back"
        );
    }
    // Given back before the queue for the model, not only with the answer.
    app.source.describing.gate.close();
    let waiting = query(&app, 1, "");
    until("an extraction", || app.source.describing.inside() == 1).await;
    app.post_bytes("/query?map=m", &[7; 180 << 10])
        .await
        .problem("unsupported_media_type");
    app.source.describing.gate.open();
    waiting.await.unwrap().ok();
}

#[tokio::test]
async fn every_copy_of_an_image_is_charged() {
    // Room for the image, but not for it and what it is taken out of.
    let app = App::with(|config| config.http.max_buffered_bytes = 256 << 10);
    app.post_png("/references?map=m", 0).await.created();
    let image = vec![7; 150 << 10];
    app.post_bytes("/query?map=m", &image)
        .await
        .problem("unsupported_media_type");
    let encoded = json!({"map": "m", "image": STANDARD.encode(&image)}).to_string();
    app.post("/query", "application/json", encoded)
        .await
        .problem("overloaded");
    let (kind, form) = multipart(&[("image", &image), ("json", br#"{"map": "m"}"#)]);
    app.post("/query", &kind, form).await.problem("overloaded");
    assert_eq!(
        app.metric("placeformer_rejected_total{reason=\"body_memory\"}")
            .await,
        2.0
    );
    // A smaller one fits with its copies, again and again: all of it is given back.
    let image = picture(0);
    let escaped = json!({"map": "m", "image": STANDARD.encode(&image)})
        .to_string()
        .replace('/', "\\/");
    let (kind, form) = multipart(&[("image", &image), ("json", br#"{"map": "m"}"#)]);
    for _ in 0..20 {
        app.post("/query", "application/json", escaped.clone())
            .await
            .ok();
        app.post("/query", &kind, form.clone()).await.ok();
    }
}

#[tokio::test]
async fn json_beside_the_image_is_short() {
    let app = App::new();
    let many = format!(
        "{{\"map\": \"m\", \"image\": \"AAAA\", \"metadata\": {{\"a\": [0{}]}}}}",
        ",0".repeat(200_000)
    );
    app.post("/references", "application/json", many.clone())
        .await
        .problem("body_too_large");
    let (kind, form) = multipart(&[("image", &picture(1)), ("json", many.as_bytes())]);
    app.post("/references", &kind, form)
        .await
        .problem("body_too_large");
    let members: String = (0..60_000).map(|n| format!("\"{n}\":0,")).collect();
    let wide = format!("{{{members}\"map\": \"m\", \"image\": \"AAAA\"}}");
    app.post("/references", "application/json", wide)
        .await
        .problem("body_too_large");
    assert_eq!(app.count().await, 0);
}

// ---------------------------------------------------------------- the store

/// The gate at which listings and deletions wait.
#[derive(Clone)]
struct AtGate {
    gate: Arc<Gate>,
    /// Calls that came to the gate.
    arrived: Arc<AtomicUsize>,
}

impl AtGate {
    fn wait(&self) {
        self.arrived.fetch_add(1, Ordering::SeqCst);
        self.gate.pass();
    }
}

/// The reading part of a store whose listings wait at the gate, each with a connection in use.
struct GatedReading {
    inner: Arc<SqliteStore>,
    gate: AtGate,
}

impl ReadPlaces for GatedReading {
    fn list(
        &self,
        map: Option<&MapName>,
        after: Option<Cursor>,
        limit: usize,
    ) -> Result<Page, StoreError> {
        self.inner
            .scan_globals(&"m".parse().unwrap(), &mut |_| self.gate.wait())?;
        self.inner.list(map, after, limit)
    }

    fn get(&self, id: ReferenceId) -> Result<Reference, StoreError> {
        self.inner.get(id)
    }

    fn map_of(&self, id: ReferenceId) -> Result<MapName, StoreError> {
        self.inner.map_of(id)
    }

    fn get_many(&self, ids: &[ReferenceId]) -> Result<Vec<Reference>, StoreError> {
        self.inner.get_many(ids)
    }

    fn find_external(
        &self,
        map: &MapName,
        external_id: &ExternalId,
    ) -> Result<Option<Reference>, StoreError> {
        self.inner.find_external(map, external_id)
    }

    fn patches(&self, id: ReferenceId) -> Result<PackedPatches, StoreError> {
        self.inner.patches(id)
    }

    fn maps(&self) -> Result<Vec<MapInfo>, StoreError> {
        self.inner.maps()
    }

    fn map(&self, name: &MapName) -> Result<MapInfo, StoreError> {
        self.inner.map(name)
    }

    fn head(&self, map: &MapName) -> Result<Option<Vec<u8>>, StoreError> {
        self.inner.head(map)
    }

    fn scan_globals(
        &self,
        map: &MapName,
        visit: &mut dyn FnMut(GlobalRow),
    ) -> Result<(), StoreError> {
        self.inner.scan_globals(map, visit)
    }
}

/// The writing part of a store whose deletions wait at the gate.
struct GatedWriting {
    inner: Arc<SqliteStore>,
    gate: AtGate,
}

impl WritePlaces for GatedWriting {
    fn delete(&self, id: ReferenceId) -> Result<Reference, StoreError> {
        self.gate.wait();
        self.inner.delete(id)
    }

    fn insert(&self, new: NewReference) -> Result<Inserted, StoreError> {
        self.inner.insert(new)
    }

    fn update(&self, id: ReferenceId, patch: ReferencePatch) -> Result<Reference, StoreError> {
        self.inner.update(id, patch)
    }

    fn delete_map(&self, name: &MapName) -> Result<u64, StoreError> {
        self.inner.delete_map(name)
    }

    fn replace_globals(
        &self,
        map: &MapName,
        head: NewHead,
        exchange: &mut dyn HeadExchange,
    ) -> Result<(), StoreError> {
        self.inner.replace_globals(map, head, exchange)
    }

    fn set_calibration(
        &self,
        map: &MapName,
        calibration: Option<Calibration>,
    ) -> Result<(), StoreError> {
        self.inner.set_calibration(map, calibration)
    }
}

/// `store` with its listings and deletions waiting at `gate`.
fn gated_store(store: SqliteStore, gate: AtGate) -> CombinedStore {
    let inner = Arc::new(store);
    CombinedStore {
        reading: Arc::new(GatedReading {
            inner: inner.clone(),
            gate: gate.clone(),
        }),
        writing: Arc::new(GatedWriting {
            inner: inner.clone(),
            gate,
        }),
        maintenance: inner,
    }
}

struct Flooded {
    app: Arc<App>,
    gate: Arc<Gate>,
    arrived: Arc<AtomicUsize>,
    /// The one reference there is.
    id: String,
}

async fn gated() -> Flooded {
    let gate = Arc::new(Gate::default());
    let arrived = Arc::new(AtomicUsize::new(0));
    let at_gate = AtGate {
        gate: gate.clone(),
        arrived: arrived.clone(),
    };
    let app = App::around(
        move |store| Arc::new(gated_store(store, at_gate)),
        Arc::new(tempfile::tempdir().unwrap()),
        FakeSource::new("fake-1"),
        |config| config.pipeline.max_wait_ms = 300,
    );
    let id = app.post_png("/references?map=m", 0).await.created()["id"]
        .as_str()
        .unwrap()
        .to_owned();
    gate.close();
    Flooded {
        app: Arc::new(app),
        gate,
        arrived,
        id,
    }
}

/// More than the runtime has threads for blocking work.
const FLOOD: usize = 600;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn slow_listings_keep_no_query_waiting() {
    let Flooded {
        app, gate, arrived, ..
    } = gated().await;
    let listings: Vec<_> = (0..FLOOD)
        .map(|_| {
            let app = app.clone();
            tokio::spawn(async move { app.get("/references").await })
        })
        .collect();
    until("a turn for some, and a refusal for the rest", || {
        listings
            .iter()
            .filter(|listing| listing.is_finished())
            .count()
            == FLOOD - 4
    })
    .await;
    assert_eq!(arrived.load(Ordering::SeqCst), 4, "listings at the store");
    let found = timeout(PATIENCE, app.post_png("/query?map=m", 0))
        .await
        .expect("the query waits for the listings");
    assert_eq!(found.ok()["results"].as_array().unwrap().len(), 1);
    let refused = timeout(
        PATIENCE,
        app.metric("placeformer_rejected_total{reason=\"store_busy\"}"),
    )
    .await;
    assert_eq!(
        refused.expect("the metrics wait for the listings"),
        (FLOOD - 4) as f64
    );
    gate.open();
    let mut answered = 0;
    for listing in listings {
        match listing.await.unwrap() {
            answer if answer.status == 200 => answered += 1,
            answer => {
                answer.problem("overloaded");
            }
        }
    }
    assert_eq!(answered, 4);
    app.get("/references").await.ok();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn slow_deletions_keep_neither_queries_nor_listings_waiting() {
    let Flooded {
        app,
        gate,
        arrived,
        id,
    } = gated().await;
    let deletions: Vec<_> = (0..FLOOD)
        .map(|_| {
            let (app, path) = (app.clone(), format!("/references/{id}"));
            tokio::spawn(async move { app.delete(&path).await })
        })
        .collect();
    // All deletions of one map wait for each other, the first of them at the gate.
    until("a refusal for all without a turn", || {
        deletions
            .iter()
            .filter(|deletion| deletion.is_finished())
            .count()
            == FLOOD - 16
    })
    .await;
    assert_eq!(arrived.load(Ordering::SeqCst), 1, "deletions at the store");
    timeout(PATIENCE, app.post_png("/query?map=m", 0))
        .await
        .expect("the query waits for the deletions")
        .ok();
    timeout(PATIENCE, app.get("/maps"))
        .await
        .expect("the listing waits for the deletions")
        .ok();
    gate.open();
    let mut deleted = 0;
    for deletion in deletions {
        deleted += usize::from(deletion.await.unwrap().status == 204);
    }
    assert_eq!(deleted, 1, "of one reference");
}

// ---------------------------------------------------------------- deadlines

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_deadline_is_kept_in_the_queue_and_during_the_work() {
    for stage in ["decoding", "describing"] {
        let app = Arc::new(App::with(|config| config.pipeline.deadline_ms = 400));
        app.post_png("/references?map=m", 0).await.created();
        let step = if stage == "decoding" {
            &app.source.decoding
        } else {
            &app.source.describing
        };
        step.gate.close();
        // These take the places at work, as far as the door lets so many in at once; the others
        // wait for a turn.
        let busy = cores().min(5);
        let working: Vec<_> = (0..busy as u64).map(|seed| query(&app, seed, "")).collect();
        until(stage, || step.inside() > 0).await;
        let (kind, pair) = multipart(&[("query", &picture(1)), ("reference", &picture(2))]);
        let matching = timeout(PATIENCE, app.post("/match", &kind, pair));
        let waiting = timeout(PATIENCE, app.post_png("/query?map=m&deadline_ms=100", 9));
        let (matching, waiting) = tokio::join!(matching, waiting);
        matching
            .expect("the match waited for its turn")
            .problem("deadline_exceeded");
        waiting
            .expect("the query waited for its turn")
            .problem("deadline_exceeded");
        for query in working {
            let query = timeout(PATIENCE, query)
                .await
                .expect("the query waited for its own work");
            query.unwrap().problem("deadline_exceeded");
        }
        assert!(step.inside() > 0, "nothing was let through the gate");
        step.gate.open();
        let late = app
            .metric("placeformer_rejected_total{reason=\"deadline\"}")
            .await;
        assert_eq!(late, (busy + 2) as f64, "{stage}");
        app.drained().await;
        app.post_png("/query?map=m", 0).await.ok();
    }
}
