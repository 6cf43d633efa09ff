//! Tracks over HTTP: a drawn drive is followed, lost and found again, and nothing but this
//! service's own tokens continues one.

use crate::support::{App, FakeSource, multipart, picture};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use placeformer_core::types::Timestamp;
use placeformer_track::{KEY_BYTES, Track, TrackKey};
use placeformer_vision::rerank::RerankConfig;
use serde_json::{Value, json};
use std::collections::HashSet;
use std::sync::Arc;

/// Places of the street, ten metres apart.
const PLACES: u64 = 30;
/// Degrees of latitude of ten metres.
const STEP: f64 = 10.0 / 111_195.0;

/// Trusts answers of about 50 inliers and more, or nearer than 0.5.
fn calibration() -> Value {
    let curve = |bias: f64, score: f64, distance: f64| {
        json!({
            "weights": {"bias": bias, "score": score, "distance": distance}, "threshold": 0.75,
            "right": 80, "wrong": 60, "without_match": 50, "precision": 0.99, "recall": 0.9,
            "expected_calibration_error": 0.02
        })
    };
    json!({
        "format": 1, "model": "fake-1", "rerank": RerankConfig::default().id(), "data": "made up",
        "target_precision": 0.99, "reranked": curve(-12.0, 3.5, -0.25),
        "global": curve(5.0, 0.0, -8.0)
    })
}

fn lat(place: u64) -> f64 {
    51.0 + place as f64 * STEP
}

async fn add(app: &App, map: &str, seed: u64, place: &str) -> String {
    let path = format!("/references?map={map}{place}");
    let added = app.post_png(&path, seed).await;
    added.created()["id"].as_str().unwrap().to_owned()
}

/// A map of a street: place `i` shows picture `i`, looks north and lies at 100 m and `i`.
async fn street(app: &App, map: &str) -> Vec<String> {
    let mut ids = Vec::new();
    for i in 0..PLACES {
        let place = format!("&lat={}&lon=7&heading=0&alt={}", lat(i), 100 + i);
        ids.push(add(app, map, i, &place).await);
    }
    let path = format!("/maps/{map}/calibration");
    app.put(&path, "application/json", calibration().to_string())
        .await
        .ok();
    ids
}

/// One frame: the picture `seed`, with the token of the frame before.
async fn frame(app: &App, seed: u64, token: &str, options: &str) -> Value {
    let path = format!("/query?map=m&track={token}{options}");
    app.post_png(&path, seed).await.ok().clone()
}

fn token(answer: &Value) -> &str {
    answer["track"]["token"].as_str().unwrap()
}

fn best(answer: &Value) -> &str {
    answer["results"][0]["reference_id"].as_str().unwrap()
}

#[tokio::test]
async fn a_drive_is_followed_and_a_twin_of_its_street_is_not_taken_for_it() {
    let app = App::new();
    // The same photo as of place 5, five kilometres away, and found before it.
    let twin = add(&app, "m", 5, "&lat=51.05&lon=7").await;
    let ids = street(&app, "m").await;
    let alone = app.post_png("/query?map=m", 5).await;
    assert_eq!(best(alone.ok()), twin);
    assert_eq!(alone.json["track"], Value::Null);

    let mut last = json!({"track": {"token": ""}});
    for place in 3..9 {
        let answer = frame(&app, place, token(&last), "&moved_m=10&moved_sigma_m=1").await;
        let track = &answer["track"];
        assert_eq!(track["frames"], place - 2, "{answer}");
        assert_eq!(track["lost"], false, "{answer}");
        assert_eq!(best(&answer), ids[place as usize], "{answer}");
        assert_eq!(answer["confidence"], track["probability"]);
        if place > 3 {
            assert_eq!(answer["matched"], true, "{answer}");
        }
        assert!(token(&answer).len() <= 8192);
        last = answer;
    }
    assert!(
        last["track"]["probability"].as_f64().unwrap() > 0.95,
        "{last}"
    );
}

#[tokio::test]
async fn a_kidnapped_vehicle_is_lost_and_found_again() {
    let app = App::new();
    let ids = street(&app, "m").await;
    let mut last = frame(&app, 2, "", "").await;
    for place in 3..6 {
        last = frame(&app, place, token(&last), "&moved_m=10").await;
    }
    assert_eq!(app.metric("placeformer_tracks_lost_total").await, 0.0);
    // Out of the map: pictures that it has not.
    let mut lost_after = None;
    for unknown in 0..6 {
        last = frame(&app, 1000 + unknown, token(&last), "&moved_m=10").await;
        // The first such photo may be a bad one.
        if unknown > 1 {
            assert_eq!(last["matched"], false, "{last}");
        }
        if last["track"]["lost"] == true {
            lost_after = lost_after.or(Some(unknown + 1));
        }
    }
    assert!(
        lost_after.is_some_and(|frames| frames <= 4),
        "{lost_after:?}"
    );
    assert_eq!(last["estimate"], Value::Null);
    assert_eq!(app.metric("placeformer_tracks_lost_total").await, 1.0);
    // Back in it elsewhere, of which the odometry knows nothing.
    let mut found_after = None;
    for place in 20..25 {
        last = frame(&app, place, token(&last), "&moved_m=10").await;
        if found_after.is_none() && last["matched"] == true {
            found_after = Some(place - 19);
        }
    }
    assert!(
        found_after.is_some_and(|frames| frames <= 2),
        "{found_after:?}"
    );
    assert_eq!(
        (best(&last), &last["track"]["lost"]),
        (ids[24].as_str(), &json!(false))
    );
}

#[tokio::test]
async fn what_the_motion_leads_to_is_compared_even_if_the_search_does_not_find_it() {
    let app = App::new();
    let ids = street(&app, "m").await;
    let first = frame(&app, 10, "", "&candidates=1&top_k=1").await;
    assert_eq!(first["results"].as_array().unwrap().len(), 1);
    // One candidate, what is around it, and what else is near by its looks.
    let options = "&candidates=1&top_k=20&moved_m=10";
    let next = frame(&app, 11, token(&first), options).await;
    let results = next["results"].as_array().unwrap();
    assert_eq!(best(&next), ids[11]);
    let scored = results.iter().filter(|result| !result["scores"].is_null());
    assert!((4..12).contains(&scored.count()), "{next}");
    let distinct: HashSet<&str> = results
        .iter()
        .map(|result| result["reference_id"].as_str().unwrap())
        .collect();
    assert_eq!((results.len(), distinct.len()), (20, 20), "{next}");
    // A filter holds for these, too.
    let near = format!("&near={},7&radius_m=1", lat(11));
    let only = frame(&app, 11, token(&first), &format!("&moved_m=10{near}")).await;
    assert_eq!(only["results"].as_array().unwrap().len(), 1, "{only}");
    let without_rerank = frame(&app, 11, token(&first), "&rerank=false&moved_m=10").await;
    assert_eq!(best(&without_rerank), ids[11]);
    assert_eq!(without_rerank["reranked"], false);
}

#[tokio::test]
async fn references_that_vanished_do_not_end_a_track() {
    let app = App::new();
    let ids = street(&app, "m").await;
    let mut last = frame(&app, 4, "", "").await;
    last = frame(&app, 5, token(&last), "&moved_m=10").await;
    for id in &ids[4..6] {
        app.delete(&format!("/references/{id}")).await;
    }
    let next = frame(&app, 6, token(&last), "&moved_m=10").await;
    assert_eq!(
        (best(&next), &next["track"]["frames"]),
        (ids[6].as_str(), &json!(3))
    );
    // All of them.
    for id in ids.iter().filter(|id| **id != ids[4] && **id != ids[5]) {
        app.delete(&format!("/references/{id}")).await;
    }
    let nowhere = frame(&app, 6, token(&last), "&moved_m=10").await;
    assert_eq!(nowhere["results"], json!([]));
    assert_eq!(
        (&nowhere["track"]["lost"], &nowhere["matched"]),
        (&json!(true), &json!(false))
    );
    // A track may begin in an empty map.
    frame(&app, 6, token(&nowhere), "").await;
}

#[tokio::test]
async fn a_token_cut_anywhere_or_changed_is_refused_before_the_photo_is_looked_at() {
    let app = App::new();
    street(&app, "m").await;
    let answer = frame(&app, 4, "", "").await;
    let token = token(&answer);
    let described = app.source.described();
    let refused = |token: String| {
        let path = format!("/query?map=m&track={token}");
        let app = &app;
        async move { app.post_png(&path, 4).await }
    };
    for end in 1..token.len() {
        refused(token[..end].to_owned())
            .await
            .problem("track_malformed");
    }
    refused(format!("{token}AAAA"))
        .await
        .problem("track_malformed");
    refused("A".repeat(9000)).await.problem("track_malformed");
    for text in ["%20", "not+a/token", "%F0%9F%9A%97"] {
        refused(text.to_owned()).await.problem("track_malformed");
    }
    let middle = token.len() / 2;
    let other = if &token[middle..=middle] == "A" {
        "B"
    } else {
        "A"
    };
    let forged = format!("{}{other}{}", &token[..middle], &token[middle + 1..]);
    refused(forged).await.problem("track_forged");
    assert_eq!(app.source.described(), described);
}

/// The token of the answer, with `change` made and sealed with `key`.
fn resealed(answer: &Value, key: u8, change: impl FnOnce(&mut Track)) -> String {
    let own = TrackKey::new(&[7; KEY_BYTES]);
    let mut track = Track::open(token(answer), &own).unwrap();
    change(&mut track);
    track.seal(&TrackKey::new(&[key; KEY_BYTES]))
}

#[tokio::test]
async fn tokens_of_others_and_of_the_past_are_refused_with_codes_of_their_own() {
    let app = App::new();
    street(&app, "m").await;
    street(&app, "other").await;
    let answer = frame(&app, 4, "", "").await;
    let refused = |map: &str, token: String| {
        let path = format!("/query?map={map}&track={token}");
        let app = &app;
        async move { app.post_png(&path, 4).await }
    };
    refused("m", resealed(&answer, 8, |_| {}))
        .await
        .problem("track_forged");
    let moved = refused("other", token(&answer).to_owned()).await;
    let detail = moved.problem("track_other_map");
    assert!(
        detail.contains("map m") && detail.contains("map other"),
        "{detail}"
    );
    let old = resealed(&answer, 7, |track| {
        let micros = track.issued_at.unix_micros() - 601_000_000;
        track.issued_at = Timestamp::from_unix_micros(micros).unwrap();
    });
    let expired = refused("m", old).await;
    assert!(
        expired.problem("track_expired").contains("601"),
        "{}",
        expired.text
    );

    // The same map with another model.
    let kept = token(&answer).to_owned();
    let directory = Arc::new(tempfile::tempdir().unwrap());
    let app = App::open(directory, FakeSource::new("fake-2"), |_| {});
    add(&app, "m", 4, "&lat=51&lon=7").await;
    let mut other = calibration();
    other["model"] = json!("fake-2");
    app.put("/maps/m/calibration", "application/json", other.to_string())
        .await
        .ok();
    let path = format!("/query?map=m&track={kept}");
    let refused = app.post_png(&path, 4).await;
    let detail = refused.problem("track_other_model");
    assert!(
        detail.contains("fake-1") && detail.contains("fake-2"),
        "{detail}"
    );
}

#[tokio::test]
async fn what_cannot_be_a_motion_is_refused_with_its_name() {
    let app = App::new();
    street(&app, "m").await;
    for (options, named) in [
        ("&track=&moved_m=NaN", "moved_m"),
        ("&track=&moved_m=inf", "moved_m"),
        ("&track=&moved_m=-1", "moved_m"),
        ("&track=&moved_m=1e12", "moved_m"),
        ("&track=&moved_m=far", "moved_m"),
        ("&track=&moved_m=1&moved_sigma_m=NaN", "moved_sigma_m"),
        ("&track=&moved_m=1&moved_sigma_m=-2", "moved_sigma_m"),
        ("&track=&moved_sigma_m=2", "moved_sigma_m"),
        ("&track=&turned_deg=NaN", "turned_deg"),
        ("&track=&turned_deg=1e9", "turned_deg"),
        (
            "&track=&turned_deg=1&turned_sigma_deg=0",
            "turned_sigma_deg",
        ),
        ("&track=&turned_sigma_deg=1", "turned_sigma_deg"),
        ("&track=&max_speed_mps=0", "max_speed_mps"),
        ("&track=&max_speed_mps=NaN", "max_speed_mps"),
        ("&track=&max_speed_mps=1e9", "max_speed_mps"),
        ("&track=&captured_at=yesterday", "captured_at"),
        ("&moved_m=1", "moved_m"),
        ("&captured_at=2026-05-17T09:30:00Z", "captured_at"),
        ("&track=&moved=1", "moved"),
    ] {
        let refused = app.post_png(&format!("/query?map=m{options}"), 1).await;
        let detail = refused.problem("invalid_parameter");
        assert!(detail.contains(named), "{options}: {detail}");
    }
    let body = |track: Value| {
        json!({"image": STANDARD.encode(picture(1)), "map": "m", "track": track}).to_string()
    };
    for track in [json!(7), json!({}), json!([]), json!(true)] {
        let refused = app.post("/query", "application/json", body(track)).await;
        assert!(
            refused.problem("invalid_parameter").contains("track"),
            "{}",
            refused.text
        );
    }
}

#[tokio::test]
async fn time_runs_forwards_by_one_clock() {
    let app = App::new();
    let ids = street(&app, "m").await;
    let at = |second: u32| format!("&captured_at=2026-05-17T09:30:{second:02}Z&max_speed_mps=10");
    let first = frame(&app, 4, "", &at(10)).await;
    let next = frame(&app, 5, token(&first), &at(11)).await;
    assert_eq!(best(&next), ids[5]);
    let ask = |options: String| {
        let path = format!("/query?map=m&track={}{options}", token(&next));
        let app = &app;
        async move { app.post_png(&path, 5).await }
    };
    let backwards = ask(at(10)).await;
    assert!(
        backwards
            .problem("invalid_parameter")
            .contains("captured_at")
    );
    let mixed = ask(String::new()).await;
    assert!(mixed.problem("invalid_parameter").contains("two clocks"));
    ask(at(11)).await.ok();
}

#[tokio::test]
async fn options_of_a_track_are_the_same_in_every_kind_of_body() {
    let app = App::new();
    street(&app, "m").await;
    let first = frame(&app, 4, "", "").await;
    let token = token(&first);
    let options = json!({"map": "m", "track": token, "moved_m": 10.0, "turned_deg": 0.0});
    let mut body = options.clone();
    body["image"] = json!(STANDARD.encode(picture(5)));
    let in_json = app
        .post("/query", "application/json", body.to_string())
        .await;
    let text = options.to_string();
    let (kind, form) = multipart(&[("image", &picture(5)), ("json", text.as_bytes())]);
    let in_form = app.post("/query", &kind, form).await;
    let raw = frame(&app, 5, token, "&moved_m=10.0&turned_deg=0").await;
    for answer in [in_json.ok(), in_form.ok()] {
        assert_eq!(answer["results"], raw["results"]);
        assert_eq!(answer["track"]["probability"], raw["track"]["probability"]);
    }
}

#[tokio::test]
async fn a_map_that_cannot_be_tracked_in_says_why() {
    let app = App::new();
    add(&app, "m", 1, "&lat=51&lon=7").await;
    let refused = app.post_png("/query?map=m&track=", 1).await;
    let detail = refused.problem("track_unavailable");
    assert!(detail.contains("calibration"), "{detail}");
    add(&app, "indoor", 1, "").await;
    let path = "/maps/indoor/calibration";
    app.put(path, "application/json", calibration().to_string())
        .await
        .ok();
    let refused = app.post_png("/query?map=indoor&track=", 1).await;
    let detail = refused.problem("track_unavailable");
    assert!(detail.contains("position"), "{detail}");
    app.post_png("/query?map=nowhere&track=", 1)
        .await
        .problem("map_not_found");
    // Without a track both are answered as ever.
    assert_eq!(
        app.post_png("/query?map=indoor", 1).await.ok()["matched"],
        true
    );
}

#[tokio::test]
async fn a_trusted_photo_has_a_position_with_its_accuracy() {
    let app = App::new();
    street(&app, "m").await;
    let answer = app.post_png("/query?map=m", 7).await;
    let estimate = &answer.ok()["estimate"];
    let near = |field: &str, value: f64, by: f64| {
        let found = estimate[field].as_f64().unwrap();
        assert!((found - value).abs() < by, "{field}: {estimate}");
    };
    near("lat", lat(7), STEP / 10.0);
    near("lon", 7.0, 1e-6);
    near("alt", 107.0, 0.1);
    near("accuracy_m", 8.0, 8.0);
    let covariance = estimate["horizontal_covariance"].as_array().unwrap();
    assert_eq!(covariance.len(), 4);
    assert!(estimate["heading"].as_f64().unwrap() < 1e-3, "{estimate}");
    assert!(
        estimate["accuracy_deg"].as_f64().unwrap() > 0.0,
        "{estimate}"
    );

    let strange = app.post_png("/query?map=m", 777).await;
    assert_eq!(
        (&strange.ok()["matched"], &strange.json["estimate"]),
        (&json!(false), &Value::Null)
    );
    // Without heights and headings there are none.
    add(&app, "plain", 1, "&lat=51&lon=7").await;
    let path = "/maps/plain/calibration";
    app.put(path, "application/json", calibration().to_string())
        .await
        .ok();
    let plain = app.post_png("/query?map=plain", 1).await;
    let estimate = &plain.ok()["estimate"];
    assert!(estimate["lat"].is_number(), "{estimate}");
    for field in ["alt", "heading", "accuracy_deg"] {
        assert_eq!(estimate[field], Value::Null, "{estimate}");
    }
}

#[tokio::test]
async fn heights_are_stored_changed_and_checked() {
    let app = App::new();
    let id = add(&app, "m", 1, "&alt=-3.25").await;
    let path = format!("/references/{id}");
    assert_eq!(app.get(&path).await.ok()["location"]["alt"], -3.25);
    assert_eq!(
        app.patch(&path, &json!({"alt": 12})).await.ok()["location"]["alt"],
        12.0
    );
    let cleared = app.patch(&path, &json!({"alt": null})).await;
    assert_eq!(cleared.ok()["location"], Value::Null);
    for value in ["NaN", "1e9", "-20000", "high"] {
        let refused = app
            .post_png(&format!("/references?map=m&alt={value}"), 2)
            .await;
        assert!(
            refused.problem("invalid_parameter").contains("alt"),
            "{}",
            refused.text
        );
    }
    app.patch(&path, &json!({"alt": 1e9}))
        .await
        .problem("invalid_parameter");
}
