//! Realistic answers and bodies for the OpenAPI document.
//!
//! They follow one story: a camera drives through a harbour, and a frame of it is looked for again.

use serde_json::{Value, json};

const ID: &str = "0197f3c2-7c1e-7d3a-9b1f-2f6f0c1d2e3f";
const MODEL: &str = "dinov2-vits14:747267a07f39:b8:448x336:t1:k400-200-50:h0a81be38658c";
/// A grey PNG of one pixel, in base64.
const PIXEL: &str = "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAAAAAA6fptVAAAACklEQVR4nGNgAAAAAgABSK\
    +kcQAAAABJRU5ErkJggg==";

/// The answer of `/livez`.
pub(super) fn live() -> Value {
    json!({"status": "live"})
}

/// The answer of `/readyz` while requests are taken.
pub(super) fn ready() -> Value {
    json!({"status": "ready", "progress": null, "detail": null})
}

/// The answer of `/readyz` while they are not.
pub(super) fn not_ready() -> Value {
    let progress = json!({"done": 61_440, "total": 250_000});
    json!({"status": "building_index", "progress": progress, "detail": null})
}

/// The beginning of the metrics.
pub(super) fn metrics() -> Value {
    json!(
        "# HELP placeformer_queue_depth Requests waiting for or in compute.\n\
         # TYPE placeformer_queue_depth gauge\nplaceformer_queue_depth 3\n"
    )
}

/// The beginning of the document itself.
pub(super) fn openapi_json() -> Value {
    json!({"openapi": "3.1.0", "info": {"title": "PlaceFormer"}, "paths": {}})
}

/// The answer of `/info`.
pub(super) fn info() -> Value {
    json!({
        "version": env!("CARGO_PKG_VERSION"),
        "model": MODEL,
        "input_size": {"width": 448, "height": 336},
        "scales": ["1", "1+2", "2+3"],
        "score": "learned",
        "calibration": calibration(),
        "limits": {
            "max_image_bytes": 20_971_520,
            "top_k": 10,
            "candidates": 100,
            "max_candidates": 1000,
            "deadline_ms": 30_000,
            "max_metadata_bytes": 16_384,
            "max_page": 1000,
        },
    })
}

/// A map.
pub(super) fn map() -> Value {
    json!({
        "name": "harbour",
        "model": MODEL,
        "references": 1204,
        "created_at": "2026-05-17T17:58:40.120934Z",
        "calibration": null,
    })
}

/// The list of all maps.
pub(super) fn map_list() -> Value {
    json!({"maps": [map()]})
}

/// The answer to the deletion of a map.
pub(super) fn map_deleted() -> Value {
    json!({"references_deleted": 1204})
}

/// A calibration, as it is sent and as it is stored.
pub(super) fn calibration() -> Value {
    let curve = |bias: f64, score: f64, distance: f64, threshold: f64| {
        json!({
            "weights": {"bias": bias, "score": score, "distance": distance},
            "threshold": threshold,
            "right": 268,
            "wrong": 234,
            "without_match": 219,
            "precision": 0.991,
            "recall": 0.76,
            "expected_calibration_error": 0.031,
        })
    };
    json!({
        "format": 2,
        "model": MODEL,
        "rerank": "1,1+2,2+3:t1.5:i2000:c0.995:learned",
        "data": "harbour, two drives",
        "target_precision": 0.99,
        "reranked": curve(-1.82, 3.86, -14.45, 0.892),
        "global": curve(17.93, 0.0, -17.45, 0.924),
        "learned_score": {
            "bias": -3.1,
            "terms": [
                {"feature": "s11.inliers", "mean": 2.2, "deviation": 0.7, "weight": 0.9},
            ],
        },
    })
}

fn location() -> Value {
    json!({"lat": 51.5072, "lon": -0.1276, "alt": 83.5, "heading": 270.0})
}

/// A body of `POST /references`.
pub(super) fn new_reference() -> Value {
    json!({
        "image": PIXEL,
        "map": "harbour",
        "external_id": "drive7/000123.jpg",
        "lat": 51.5072,
        "lon": -0.1276,
        "alt": 83.5,
        "heading": 270,
        "captured_at": "2026-05-17T09:30:00Z",
        "metadata": {"camera": "left"},
        // The example's image is one grey pixel.
        "allow_uninformative": true,
    })
}

/// A body of `PATCH /references/{id}`.
pub(super) fn reference_change() -> Value {
    json!({"heading": 90, "metadata": null})
}

/// A stored reference.
pub(super) fn reference() -> Value {
    json!({
        "id": ID,
        "map": "harbour",
        "external_id": "drive7/000123.jpg",
        "location": location(),
        "captured_at": "2026-05-17T09:30:00Z",
        "metadata": {"camera": "left"},
        "content_sha256": "9f86d081884c7d659a2feaa0c55ad015a3bf4f1b2b0b822cd15d6c15b0f00a08",
        "model": MODEL,
        "created_at": "2026-05-17T18:02:11.482193Z",
    })
}

/// A reference that was just stored: it was sent with a position, and its photo knew the time.
pub(super) fn created_reference() -> Value {
    let mut created = reference();
    created["sources"] = json!({
        "location": "request",
        "heading": "request",
        "captured_at": "exif",
    });
    created
}

/// A page of a listing.
pub(super) fn reference_page() -> Value {
    json!({"references": [reference()], "next": "at-1204"})
}

/// A body of `/query`.
pub(super) fn query_body() -> Value {
    json!({"image": PIXEL, "map": "harbour", "top_k": 5, "deadline_ms": 2000})
}

/// The answer of `/query`.
pub(super) fn query_answer() -> Value {
    json!({
        "results": [{
            "rank": 1,
            "reference_id": ID,
            "external_id": "drive7/000123.jpg",
            "location": location(),
            "global_distance": 0.41,
            "score": 4.2,
            "spatial_score": 412,
            "scores": {
                "s11": {"matches": 171, "inliers": 122},
                "s12": {"matches": 236, "inliers": 178},
                "s23": {"matches": 140, "inliers": 112},
            },
            "captured_at": "2026-05-17T09:30:00Z",
            "metadata": {"camera": "left"},
        }],
        "reranked": true,
        "ranked_by": "learned",
        "matched": true,
        "confidence": 0.996,
        "unmatched_reason": null,
        "estimate": {
            "lat": 51.50721,
            "lon": -0.12758,
            "alt": 83.4,
            "heading": 268.9,
            "accuracy_m": 7.8,
            "accuracy_deg": 8.2,
            "horizontal_covariance": [27.1, 0.4, 0.4, 26.3],
        },
        "track": {
            "token": "AWMAQB1bHSlCBgABQB1bHSlCBgARAAAAB2hhcmJvdXI",
            "probability": 0.996,
            "lost": false,
            "frames": 17,
        },
        "timings_ms": {
            "decode": 6.1,
            "queue": 0.4,
            "extract": 190.0,
            "search": 0.2,
            "load": 2.8,
            "rerank": 31.0,
        },
        "model": MODEL,
    })
}

/// A body of `/match`.
pub(super) fn match_body() -> Value {
    json!({"query": PIXEL, "reference": PIXEL})
}

/// The answer of `/match`.
pub(super) fn match_answer() -> Value {
    json!({
        "spatial_score": 122,
        "combinations": {"s11": {
            "matches": 171,
            "inliers": 122,
            "homography": [1.04, 0.01, -11.8, -0.02, 1.03, 4.6, 0.00002, -0.00001, 1.0],
            "correspondences": [{
                "query": [105.0, 91.0],
                "query_scale": 1,
                "reference": [91.0, 91.0],
                "reference_scale": 1,
                "inlier": true,
            }],
        }},
        "key_patches": {
            "patch_size": 14,
            "query": [{"centre": [105.0, 91.0], "scale": 1, "attention": 3.2}],
            "reference": [{"centre": [91.0, 91.0], "scale": 1, "attention": 2.9}],
        },
        "input_size": {"width": 448, "height": 336},
        "timings_ms": {"decode": 11.9, "queue": 0.4, "extract": 381.0, "rerank": 1.1},
        "model": MODEL,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::http::openapi::document;
    use std::collections::BTreeSet;

    /// The schema a reference leads to.
    fn resolve<'a>(document: &'a Value, schema: &'a Value) -> &'a Value {
        match schema["$ref"].as_str() {
            Some(reference) => document.pointer(&reference[1..]).unwrap(),
            None => schema,
        }
    }

    /// Names every field of an object that its schema lacks or that misses.
    fn check(document: &Value, schema: &Value, value: &Value, place: &str, compared: &mut usize) {
        let schema = resolve(document, schema);
        if let Some(choices) = schema["oneOf"].as_array() {
            let choice = choices
                .iter()
                .find(|choice| (choice["type"] == "null") == value.is_null())
                .unwrap();
            return check(document, choice, value, place, compared);
        }
        if let (Some(items), Some(values)) = (schema.get("items"), value.as_array()) {
            values
                .iter()
                .for_each(|value| check(document, items, value, place, compared));
        }
        let (Some(properties), Some(fields)) =
            (schema["properties"].as_object(), value.as_object())
        else {
            return;
        };
        *compared += 1;
        let known: BTreeSet<&String> = properties.keys().collect();
        let given: BTreeSet<&String> = fields.keys().collect();
        assert_eq!(given, known, "{place}");
        for (name, field) in fields {
            check(
                document,
                &properties[name],
                field,
                &format!("{place}.{name}"),
                compared,
            );
        }
    }

    #[test]
    fn every_answer_has_exactly_the_fields_of_its_schema() {
        let document = document();
        let mut compared = 0;
        for (path, item) in document["paths"].as_object().unwrap() {
            for (method, operation) in item.as_object().unwrap() {
                for (status, response) in operation["responses"].as_object().unwrap() {
                    let content = &response["content"]["application/json"];
                    if content["example"].is_object() {
                        let place = format!("{method} {path} {status}");
                        check(
                            &document,
                            &content["schema"],
                            &content["example"],
                            &place,
                            &mut compared,
                        );
                    }
                }
            }
        }
        assert!(compared >= 20, "only {compared} objects were compared");
    }

    #[test]
    fn the_calibration_is_one() {
        let parsed: placeformer_core::types::Calibration =
            serde_json::from_value(calibration()).unwrap();
        assert_eq!(serde_json::to_value(parsed).unwrap(), calibration());
    }
}
