//! Where the fields of a new reference come from: the request, or what the photo says about itself.

use crate::common::photo::{Says, exif_block, png_with_exif, png_with_xmp, with_chunk};
use crate::support::{App, multipart, picture};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use serde_json::{Value, json};

const EVERYTHING: Says = Says {
    position: Some((48.8584, -2.2945)),
    alt: Some(115),
    heading: Some(270),
    time: Some("2026:03:01 14:30:05+02:00"),
};

fn sources(location: Value, alt: Value, heading: Value, captured_at: Value) -> Value {
    json!({"location": location, "alt": alt, "heading": heading, "captured_at": captured_at})
}

#[tokio::test]
async fn what_the_request_leaves_out_is_read_from_the_photo() {
    let app = App::new();
    let photo = png_with_exif(1, EVERYTHING);
    let path = "/references?map=m&external_id=a";
    let created = app.post(path, "image/png", photo.clone()).await;
    let body = created.created();
    let location = json!({"lat": 48.8584, "lon": -2.2945, "alt": 115.0, "heading": 270.0});
    assert_eq!(body["location"], location);
    assert_eq!(body["captured_at"], "2026-03-01T12:30:05Z");
    let exif = || json!("exif");
    assert_eq!(body["sources"], sources(exif(), exif(), exif(), exif()));
    // It is stored, and found there when the photo is sent again.
    let stored = app.get(created.header("location")).await;
    assert_eq!(stored.ok()["location"], location);
    assert_eq!(stored.json["sources"], Value::Null);
    let again = app
        .post(&format!("{path}&lat=1&lon=2"), "image/png", photo)
        .await;
    assert_eq!(again.ok()["location"], location);
    let stored = || json!("stored");
    assert_eq!(
        again.json["sources"],
        sources(stored(), stored(), stored(), stored())
    );
}

#[tokio::test]
async fn the_request_comes_first_field_by_field() {
    let app = App::new();
    let photo = png_with_exif(1, EVERYTHING);
    let created = app
        .post("/references?map=m&lat=1&lon=2", "image/png", photo.clone())
        .await;
    let body = created.created();
    let location = json!({"lat": 1.0, "lon": 2.0, "alt": 115.0, "heading": 270.0});
    assert_eq!(body["location"], location);
    assert_eq!(
        body["sources"],
        sources(
            json!("request"),
            json!("exif"),
            json!("exif"),
            json!("exif")
        )
    );
    let path = "/references?map=m&heading=5&captured_at=2020-01-01T00:00:00Z";
    let body = app.post(path, "image/png", photo).await;
    let body = body.created();
    assert_eq!(body["location"]["heading"], 5.0);
    assert_eq!(body["captured_at"], "2020-01-01T00:00:00Z");
    assert_eq!(
        body["sources"],
        sources(
            json!("exif"),
            json!("exif"),
            json!("request"),
            json!("request")
        )
    );
}

#[tokio::test]
async fn the_photo_is_left_alone_where_the_request_says_so() {
    let app = App::new();
    let photo = png_with_exif(1, EVERYTHING);
    let nothing = sources(Value::Null, Value::Null, Value::Null, Value::Null);
    let raw = app
        .post("/references?map=m&exif=false", "image/png", photo.clone())
        .await;
    let options = json!({"map": "m", "exif": false});
    let text = options.to_string();
    let (kind, body) = multipart(&[("image", &photo), ("json", text.as_bytes())]);
    let parts = app.post("/references", &kind, body).await;
    let mut options = options;
    options["image"] = STANDARD.encode(&photo).into();
    let base64 = app
        .post("/references", "application/json", options.to_string())
        .await;
    for answer in [raw, parts, base64] {
        let body = answer.created();
        assert_eq!(
            (&body["location"], &body["captured_at"]),
            (&Value::Null, &Value::Null)
        );
        assert_eq!(body["sources"], nothing);
    }
    let wrong = app
        .post("/references?map=m&exif=perhaps", "image/png", photo)
        .await;
    wrong.problem("invalid_parameter");
}

#[tokio::test]
async fn xmp_is_read_too_and_a_photo_may_say_nothing() {
    let app = App::new();
    let properties = "drone-dji:GpsLatitude=\"+48.8584\" drone-dji:GpsLongitude=\"+2.2945\" \
                      drone-dji:GimbalYawDegree=\"-90.0\"";
    let photo = png_with_xmp(1, properties);
    let created = app.post("/references?map=m", "image/png", photo).await;
    let body = created.created();
    let location = json!({"lat": 48.8584, "lon": 2.2945, "alt": null, "heading": 270.0});
    assert_eq!(body["location"], location);
    assert_eq!(
        body["sources"],
        sources(json!("xmp"), Value::Null, json!("xmp"), Value::Null)
    );
    let body = app.post_png("/references?map=m", 2).await;
    let body = body.created();
    assert_eq!(body["location"], Value::Null);
    assert_eq!(
        body["sources"],
        sources(Value::Null, Value::Null, Value::Null, Value::Null)
    );
}

#[tokio::test]
async fn a_block_made_to_keep_a_reader_busy_does_not() {
    // Overlapping directories: a reader that follows each of them needs hundreds of gigabytes.
    let count = u32::from(u16::MAX);
    let start = 8 + 2 + 12 * count + 4;
    let mut bomb = b"II*\0\x08\0\0\0".to_vec();
    bomb.extend((count as u16).to_le_bytes());
    for index in 0..count {
        bomb.extend(0x8769u16.to_le_bytes());
        bomb.extend(4u16.to_le_bytes());
        bomb.extend(1u32.to_le_bytes());
        bomb.extend((start + index).to_le_bytes());
    }
    bomb.resize(bomb.len() + 4, 0);
    bomb.resize(bomb.len() + 865_535, 0xff);
    let app = App::new();
    for kind in ["image/jpeg", "image/png", "image/webp"] {
        let bare = app.post("/references?map=m", kind, bomb.clone()).await;
        bare.problem("unsupported_media_type");
        let query = app.post("/query?map=m", kind, bomb.clone()).await;
        assert!(query.status.is_client_error(), "{}", query.text);
    }
    let hidden = with_chunk(&picture(1), b"eXIf", &bomb);
    let created = app.post("/references?map=m", "image/png", hidden).await;
    assert_eq!(created.created()["location"], Value::Null);
    let sound = with_chunk(&picture(2), b"eXIf", &exif_block(EVERYTHING));
    let created = app.post("/references?map=m", "image/png", sound).await;
    assert_eq!(created.created()["sources"]["location"], "exif");
}
