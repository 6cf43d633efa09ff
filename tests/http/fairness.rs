//! One caller that asks without end, and others who ask now and then.

use crate::keys::{key, send_as};
use crate::support::{App, PATIENCE, until};
use axum::body::Body;
use axum::http::Request;
use placeformer::http::Role;
use placeformer::http::authorise::Peer;
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::Duration;
use tokio::task::JoinHandle;

/// Time of one description; a flood of requests is answered ten times slower than it comes.
const DESCRIPTION: Duration = Duration::from_millis(20);

/// Requests of the caller that asks now and then.
const SELDOM: usize = 15;

/// Keeps so many requests under way until told to stop; counts those that were answered.
fn flood(
    app: &Arc<App>,
    at_once: usize,
    stop: &Arc<AtomicBool>,
    answered: &Arc<AtomicUsize>,
    request: impl Fn(u64) -> Request<Body> + Send + Sync + 'static,
) -> Vec<JoinHandle<()>> {
    let request = Arc::new(request);
    let sender = |first: u64| {
        let (app, stop) = (app.clone(), stop.clone());
        let (request, answered) = (request.clone(), answered.clone());
        tokio::spawn(async move {
            let mut seed = first;
            while !stop.load(Ordering::SeqCst) {
                let answer = app.send(request(seed)).await;
                if answer.status.is_success() {
                    answered.fetch_add(1, Ordering::SeqCst);
                } else {
                    answer.problem("overloaded");
                    tokio::time::sleep(Duration::from_millis(5)).await;
                }
                seed += 1000;
            }
        })
    };
    (0..at_once as u64)
        .map(|at| sender(1000 * 1000 * at + 7))
        .collect()
}

fn service(capacity: usize) -> Arc<App> {
    Arc::new(App::with(|config| {
        config.auth.keys = vec![
            key("flood", Role::Write),
            key("seldom", Role::Write),
            key("builder", Role::Write),
        ];
        config.pipeline.queue_capacity = capacity;
    }))
}

/// What the other caller asks while one floods the same route is answered, all of it.
async fn seldom_is_answered(
    method: &'static str,
    path: impl Fn(u64) -> String + Clone + Send + Sync + 'static,
    has_image: bool,
) {
    let app = service(16);
    send_as(
        &app,
        "builder",
        "POST",
        "/references?map=m&external_id=first",
        Some(1),
    )
    .await
    .created();
    app.source.slow_down(DESCRIPTION);
    let stop = Arc::new(AtomicBool::new(false));
    let answered = Arc::new(AtomicUsize::new(0));
    let flooding_path = path.clone();
    let senders = flood(&app, 48, &stop, &answered, move |seed| {
        let image = has_image.then_some(seed);
        crate::keys::request_as("flood", method, &flooding_path(seed), image)
    });
    let began = answered.clone();
    until("an answer to the flood", || {
        began.load(Ordering::SeqCst) > 0
    })
    .await;
    for number in 0..SELDOM as u64 {
        let image = has_image.then_some(number);
        let answer = send_as(&app, "seldom", method, &path(number), image).await;
        assert!(
            answer.status.is_success(),
            "{method} {number}: {}",
            answer.text
        );
    }
    stop.store(true, Ordering::SeqCst);
    for sender in senders {
        sender.await.unwrap();
    }
    assert!(
        answered.load(Ordering::SeqCst) > 0,
        "the flood is served, too"
    );
    app_is_drained(&app).await;
}

async fn app_is_drained(app: &App) {
    let began = std::time::Instant::now();
    while app.metric("placeformer_queue_depth").await > 0.0 {
        assert!(began.elapsed() < PATIENCE, "the queue never emptied");
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_flood_of_queries_does_not_keep_another_key_from_being_answered() {
    seldom_is_answered("POST", |_| "/query?map=m".to_owned(), true).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_flood_of_references_does_not_keep_another_key_from_storing() {
    let path = |seed| {
        format!(
            "/references?map=m&external_id={seed}-{}",
            uuid::Uuid::now_v7()
        )
    };
    seldom_is_answered("POST", path, true).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_flood_of_listings_does_not_keep_another_key_from_listing() {
    seldom_is_answered("GET", |_| "/references?limit=1000".to_owned(), false).await;
}

/// A query that goes around with the address that it came from.
fn query_from(address: &str, seed: u64) -> Request<Body> {
    let address: SocketAddr = address.parse().unwrap();
    let mut request = Request::post("/query?map=m")
        .header("content-type", "image/png")
        .body(Body::from(crate::support::picture(seed)))
        .unwrap();
    request.extensions_mut().insert(Peer(address));
    request
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn without_keys_addresses_take_turns_and_a_network_of_ipv6_is_one() {
    let app = Arc::new(App::with(|config| config.pipeline.queue_capacity = 8));
    app.post_png("/references?map=m", 1).await.created();
    app.source.slow_down(DESCRIPTION);
    let stop = Arc::new(AtomicBool::new(false));
    let answered = Arc::new(AtomicUsize::new(0));
    // Every request comes from another address of one network, more than there are places.
    let senders = flood(&app, 32, &stop, &answered, |seed| {
        query_from(&format!("[2001:db8:0:1:{:x}::1]:5000", seed % 0xffff), seed)
    });
    let began = answered.clone();
    until("an answer to the flood", || {
        began.load(Ordering::SeqCst) > 0
    })
    .await;
    for (number, address) in ["[2001:db8:0:2::1]:5000", "10.0.0.1:5000", "10.0.0.2:5000"]
        .iter()
        .cycle()
        .take(SELDOM)
        .enumerate()
    {
        app.send(query_from(address, number as u64)).await.ok();
    }
    stop.store(true, Ordering::SeqCst);
    for sender in senders {
        sender.await.unwrap();
    }
    app.drained().await;
}

/// The order in which the compute worker takes requests, with everything held until all wait.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_worker_serves_the_second_caller_next_whatever_the_first_has_queued() {
    let app = service(32);
    send_as(&app, "builder", "POST", "/references?map=m", Some(1))
        .await
        .created();
    app.source.describing.gate.close();
    let ask = |name: &'static str, seed: u64| {
        let app = app.clone();
        tokio::spawn(async move { send_as(&app, name, "POST", "/query?map=m", Some(seed)).await })
    };
    let flood: Vec<_> = (10..18).map(|seed| ask("flood", seed)).collect();
    let depth = |app: &Arc<App>| {
        let app = app.clone();
        async move { app.metric("placeformer_queue_depth").await }
    };
    while depth(&app).await < 8.0 || app.source.decoding.inside() > 0 {
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    let other = ask("seldom", 30);
    while depth(&app).await < 9.0 || app.source.decoding.inside() > 0 {
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    // Decoded images still have to get in line.
    tokio::time::sleep(Duration::from_millis(50)).await;
    app.source.slow_down(Duration::from_millis(50));
    let before = app.source.described();
    app.source.describing.gate.open();
    other.await.unwrap().ok();
    let described = app.source.described() - before;
    assert!(
        described <= 5,
        "{described} images were described before the answer to the only query of its caller"
    );
    for query in flood {
        query.await.unwrap().ok();
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn who_asks_seldom_is_answered_while_the_work_of_another_goes_on() {
    let app = service(32);
    send_as(&app, "builder", "POST", "/references?map=m", Some(1))
        .await
        .created();
    // So many that the other caller has asked for less than half of its share.
    for seed in 2..6 {
        send_as(&app, "flood", "POST", "/query?map=m", Some(seed))
            .await
            .ok();
    }
    app.source.long.store(true, Ordering::SeqCst);
    let flooding = app.clone();
    let long =
        tokio::spawn(
            async move { send_as(&flooding, "flood", "POST", "/query?map=m", Some(10)).await },
        );
    until("an extraction", || app.source.describing.inside() == 1).await;
    send_as(&app, "seldom", "POST", "/query?map=m", Some(20))
        .await
        .ok();
    assert!(!long.is_finished());
    app.source.long.store(false, Ordering::SeqCst);
    long.await.unwrap().ok();
}
