//! The OpenAPI document: operations and answers from the handlers, errors from the one table.

use super::problem::{PROBLEM_JSON, ProblemBody};
use super::{examples, routes};
use crate::ops::Metrics;
use placeformer_core::error::ErrorCode;
use serde_json::{Map, Value, json};
use std::collections::BTreeMap;
use std::sync::LazyLock;
use utoipa::PartialSchema;

static DOCUMENT: LazyLock<String> = LazyLock::new(|| {
    // Values parsed from strings serialise back.
    serde_json::to_string_pretty(&document()).unwrap_or_default() + "\n"
});

/// The document as it is served and committed.
pub fn document_text() -> &'static str {
    &DOCUMENT
}

/// Builds the document from the code.
pub fn document() -> Value {
    let (_, api) = routes::all().split_for_parts();
    let mut document = serde_json::to_value(api).unwrap_or_default();
    document["info"] = json!({
        "title": "PlaceFormer",
        "version": env!("CARGO_PKG_VERSION"),
        "summary": "Which mapped place does this photo show?",
        "description": "Visual place recognition: photos of known places make a map; a query photo is answered with \
            the places it may show, found by a global descriptor and re-ranked by matching key patches. Every error \
            is `application/problem+json` with a stable `code`. Every answer carries `x-request-id`.",
        "license": {"name": "Apache-2.0 OR MIT", "identifier": "Apache-2.0 OR MIT"},
    });
    document["servers"] = json!([{"url": "/"}]);
    document["components"]["schemas"]["ProblemBody"] = schema_value::<ProblemBody>();
    document["components"]["securitySchemes"] = json!({
        "bearer": {"type": "http", "scheme": "bearer", "description": "An API key; servers without keys are open."},
        "header": {"type": "apiKey", "in": "header", "name": "X-API-Key"},
    });
    document["tags"] = json!([
        {"name": "query", "description": "Find and compare places."},
        {"name": "references", "description": "The photos that make up the maps."},
        {"name": "maps", "description": "Sets of references that are searched together."},
        {"name": "service", "description": "What runs here, and how it is."},
    ]);
    describe_uploads(&mut document);
    document["paths"]["/maps/{map}/head"]["put"]["requestBody"] = json!({
        "required": true,
        "description": "The head's safetensors file, at most 32 MiB.",
        "content": {"application/octet-stream": binary()},
    });
    for (path, method, operation) in operations(&mut document) {
        add_examples(operation);
        add_errors(operation, &errors_of(&path, &method));
        if !is_public(&path) {
            operation["security"] = json!([{}, {"bearer": []}, {"header": []}]);
        }
    }
    document
}

fn schema_value<T: PartialSchema>() -> Value {
    serde_json::to_value(T::schema()).unwrap_or_default()
}

/// Every operation with its path and method.
fn operations(document: &mut Value) -> Vec<(String, String, &mut Value)> {
    let Some(paths) = document["paths"].as_object_mut() else {
        return Vec::new();
    };
    let items = paths
        .iter_mut()
        .filter_map(|(path, item)| Some((path, item.as_object_mut()?)));
    items
        .flat_map(|(path, item)| {
            item.iter_mut()
                .map(|(method, value)| (path.clone(), method.clone(), value))
        })
        .filter(|(_, method, _)| method != "parameters")
        .collect()
}

fn is_public(path: &str) -> bool {
    matches!(path, "/livez" | "/readyz" | "/openapi.json" | "/metrics")
}

/// Makes every documented series of requests appear with zeros.
pub fn expect_routes(metrics: &Metrics) {
    let mut document = document();
    for (path, method, operation) in operations(&mut document) {
        let statuses = operation["responses"]
            .as_object()
            .into_iter()
            .flat_map(Map::keys);
        let statuses: Vec<u16> = statuses.filter_map(|status| status.parse().ok()).collect();
        metrics.expect_route(&path, &method.to_uppercase(), statuses);
    }
}

/// What each operation can fail with.
fn errors_of(path: &str, method: &str) -> Vec<ErrorCode> {
    use ErrorCode::*;
    let guarded = [
        Unauthorized,
        Forbidden,
        RateLimited,
        NotReady,
        Overloaded,
        ShuttingDown,
        Internal,
    ];
    let sent = [
        MalformedRequest,
        InvalidParameter,
        RequestTimeout,
        BodyTooLarge,
        UnsupportedMediaType,
    ];
    let image = [EmptyImage, ImageTooLarge, ImageUndecodable];
    let own: &[&[ErrorCode]] = match (path, method) {
        ("/livez", _) | ("/openapi.json", _) => return vec![Internal],
        ("/readyz", _) => return vec![InvalidParameter],
        ("/metrics", _) => return vec![Unauthorized, Forbidden, RateLimited, Internal],
        ("/references", "post") => &[
            &sent,
            &image,
            &[
                ExternalIdConflict,
                ModelMismatch,
                CorruptRecord,
                MemoryPressure,
                DiskFull,
            ],
        ],
        ("/query", _) => &[
            &sent,
            &image,
            &[MapNotFound, ModelMismatch, CorruptRecord, DeadlineExceeded],
        ],
        ("/match", _) => &[
            &sent,
            &image,
            &[
                ReferenceNotFound,
                ModelMismatch,
                CorruptRecord,
                DeadlineExceeded,
            ],
        ],
        ("/references", _) => &[&[InvalidParameter, MapNotFound, CorruptRecord]],
        ("/references/{id}", "patch") => &[
            &sent,
            &[
                ReferenceNotFound,
                ExternalIdConflict,
                CorruptRecord,
                DiskFull,
            ],
        ],
        ("/references/{id}", "delete") => &[&[ReferenceNotFound, CorruptRecord, DiskFull]],
        ("/references/{id}", _) => &[&[ReferenceNotFound, CorruptRecord]],
        ("/maps/{map}/calibration", "put") => &[
            &sent,
            &[MapNotFound, CalibrationMismatch, CorruptRecord, DiskFull],
        ],
        ("/maps/{map}/calibration", _) | ("/maps/{map}", "delete") => {
            &[&[MapNotFound, CorruptRecord, DiskFull]]
        }
        ("/maps/{map}/head", "put") => &[
            &sent,
            &[
                MapNotFound,
                HeadUnreadable,
                HeadMismatch,
                ModelMismatch,
                CorruptRecord,
                MemoryPressure,
                DiskFull,
            ],
        ],
        ("/maps/{map}/head", _) => &[&[
            MapNotFound,
            HeadMismatch,
            ModelMismatch,
            CorruptRecord,
            MemoryPressure,
            DiskFull,
        ]],
        ("/maps/{map}", _) => &[&[MapNotFound, CorruptRecord]],
        _ => &[],
    };
    let mut codes: Vec<ErrorCode> = own
        .iter()
        .flat_map(|codes| codes.iter())
        .chain(&guarded)
        .copied()
        .collect();
    codes.sort_by_key(|code| code.status());
    codes
}

fn add_errors(operation: &mut Value, codes: &[ErrorCode]) {
    let mut by_status: BTreeMap<u16, Vec<ErrorCode>> = BTreeMap::new();
    for &code in codes {
        by_status.entry(code.status()).or_default().push(code);
    }
    for (status, codes) in by_status {
        let examples: Map<String, Value> = codes
            .iter()
            .map(|code| (code.as_str().to_owned(), json!({"value": example(*code)})))
            .collect();
        let lines: Vec<String> = codes
            .iter()
            .map(|code| format!("`{}`: {}.", code.as_str(), code.title()))
            .collect();
        let response = &mut operation["responses"][status.to_string()];
        if response.is_null() {
            *response = json!({});
        }
        response["description"] = Value::from(lines.join(" "));
        response["content"][PROBLEM_JSON] =
            json!({"schema": {"$ref": "#/components/schemas/ProblemBody"}, "examples": examples});
        if codes
            .iter()
            .any(|code| matches!(code.status(), 429 | 503 | 507))
        {
            response["headers"]["retry-after"] = json!({"description": "Seconds after which to try again.", "schema": {"type": "integer", "minimum": 1}});
        }
    }
}

fn example(code: ErrorCode) -> Value {
    json!({
        "type": format!("urn:placeformer:error:{}", code.as_str()),
        "title": code.title(),
        "status": code.status(),
        "code": code.as_str(),
        "detail": "what exactly is wrong with this request",
        "request_id": "0197f3c2-7c1e-7d3a-9b1f-2f6f0c1d2e3f",
        "retryable": code.retryable(),
    })
}

/// A realistic answer, and a JSON body to send.
fn add_examples(operation: &mut Value) {
    let id = operation["operationId"]
        .as_str()
        .unwrap_or_default()
        .to_owned();
    for (status, response) in operation["responses"].as_object_mut().into_iter().flatten() {
        let example = if status == "503" {
            Some(examples::not_ready())
        } else {
            examples::answer(&id)
        };
        // Indexing would add the key to answers without a body.
        let contents = response.get_mut("content").and_then(Value::as_object_mut);
        for (_, content) in contents.into_iter().flatten() {
            content["example"] = example.clone().unwrap_or_default();
        }
    }
    if let (Some(content), Some(body)) = (
        operation.pointer_mut("/requestBody/content/application~1json"),
        examples::body(&id),
    ) {
        content["example"] = body;
    }
}

/// The three ways to send images.
fn describe_uploads(document: &mut Value) {
    let uploads = [
        (
            "/references",
            schema_value::<routes::references::ReferenceParams>(),
            &["image"][..],
            &["image", "map"][..],
        ),
        (
            "/query",
            schema_value::<routes::query::QueryParams>(),
            &["image"],
            &["image", "map"],
        ),
        (
            "/match",
            schema_value::<routes::match_images::MatchParams>(),
            &["query", "reference"],
            &["query"],
        ),
    ];
    for (path, params, images, required) in uploads {
        let raw = binary();
        let mut form = json!({"type": "object", "additionalProperties": false, "required": [images[0]], "properties": {
            "json": params,
        }});
        let mut plain = params.clone();
        plain["required"] = json!(required);
        for image in images {
            form["properties"][image] = json!({"type": "string", "format": "binary", "description": "A JPEG, PNG or WebP image."});
            plain["properties"][image] = json!({"type": "string", "contentEncoding": "base64",
                "description": "A JPEG, PNG or WebP image in base64."});
        }
        document["paths"][path]["post"]["requestBody"] = json!({
            "required": true,
            "description": "The image as it is, in a form, or in JSON.",
            "content": {
                "image/jpeg": raw, "image/png": raw, "image/webp": raw, "application/octet-stream": raw,
                "multipart/form-data": {"schema": form, "encoding": {"json": {"contentType": "application/json"}}},
                "application/json": {"schema": plain},
            },
        });
    }
}

/// A body that is bytes.
fn binary() -> Value {
    json!({"schema": {"type": "string", "format": "binary", "minLength": 1}})
}
