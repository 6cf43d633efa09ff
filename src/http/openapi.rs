//! The OpenAPI document.
//!
//! What an operation takes and answers comes from the attributes of its handler. Bodies with
//! images, errors, and who may call come from the route table ([`ROUTES`]) and the error table, so
//! that the document says what the server does.

use super::body::ImageUpload;
use super::examples;
use super::problem::{ApiError, ErrorHeader, PROBLEM_JSON, ProblemBody};
use super::route::{Handler, RequestBody, Route, Scope};
use super::routes::ROUTES;
use super::state::AppState;
use crate::ops::Metrics;
use placeformer_core::error::ErrorCode;
use serde::Serialize;
use serde_json::{Map, Value, json};
use std::collections::BTreeMap;
use std::sync::LazyLock;
use utoipa::PartialSchema;
use utoipa_axum::router::OpenApiRouter;

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
    let mut document = described_by_attributes();
    describe_service(&mut document);
    for route in ROUTES {
        if let Some(operation) = operation_of(&mut document, route) {
            describe_body(operation, &route.body);
            describe_answers(operation, route);
            describe_errors(operation, &route.error_codes());
            describe_security(operation, route.scope);
        }
    }
    document
}

/// Makes every documented series of requests appear with zeros.
pub fn expect_documented_answers(metrics: &Metrics) {
    let mut document = document();
    for route in ROUTES {
        let Some(operation) = operation_of(&mut document, route) else {
            continue;
        };
        let responses = operation["responses"].as_object();
        let statuses = responses.into_iter().flat_map(Map::keys);
        let statuses = statuses.filter_map(|status| status.parse().ok());
        metrics.expect_route(route.path, route.method.as_str(), statuses);
    }
}

/// What the attributes of the handlers say.
fn described_by_attributes() -> Value {
    let mut router = OpenApiRouter::<AppState>::new();
    for route in ROUTES {
        if let Handler::Operation(operation) = route.handler {
            router = router.routes(operation());
        }
    }
    to_value(router.into_openapi())
}

/// The part of the document about `route`; `None` if it is a page, which the document leaves out.
fn operation_of<'a>(document: &'a mut Value, route: &Route) -> Option<&'a mut Value> {
    let item = document["paths"].get_mut(route.path)?;
    item.get_mut(route.method.as_str().to_lowercase())
}

/// What concerns the service as a whole.
fn describe_service(document: &mut Value) {
    document["info"] = json!({
        "title": "PlaceFormer",
        "version": env!("CARGO_PKG_VERSION"),
        "summary": "Which mapped place does this photo show?",
        "description": "Visual place recognition: photos of known places make a map; a query \
            photo is answered with the places it may show, found by a global descriptor and \
            re-ranked by matching key patches. Every error is `application/problem+json` with a \
            stable `code`. Every answer carries `x-request-id`.",
        "license": {"name": "Apache-2.0 OR MIT", "identifier": "Apache-2.0 OR MIT"},
    });
    document["servers"] = json!([{"url": "/"}]);
    document["components"]["schemas"]["ProblemBody"] = to_value(ProblemBody::schema());
    document["components"]["securitySchemes"] = json!({
        "bearer": {
            "type": "http",
            "scheme": "bearer",
            "description": "An API key; servers without keys are open.",
        },
        "header": {"type": "apiKey", "in": "header", "name": "X-API-Key"},
    });
    document["tags"] = json!([
        {"name": "query", "description": "Find and compare places."},
        {"name": "references", "description": "The photos that make up the maps."},
        {"name": "maps", "description": "Sets of references that are searched together."},
        {"name": "service", "description": "What runs here, and how it is."},
    ]);
}

/// A part of the document as JSON. Schemas, operations and errors always serialise.
fn to_value(part: impl Serialize) -> Value {
    serde_json::to_value(part).unwrap_or_default()
}

fn describe_body(operation: &mut Value, body: &RequestBody) {
    match body {
        RequestBody::None => {}
        RequestBody::Json { example } => {
            let content = operation.pointer_mut("/requestBody/content/application~1json");
            if let Some(content) = content {
                content["example"] = example();
            }
        }
        RequestBody::File {
            max_bytes,
            description,
        } => {
            let max_mib = max_bytes >> 20;
            operation["requestBody"] = json!({
                "required": true,
                "description": format!("{description}, at most {max_mib} MiB."),
                "content": {"application/octet-stream": bytes_content()},
            });
        }
        RequestBody::Images(upload) => operation["requestBody"] = images_body(upload),
    }
}

/// The three ways to send images: raw, as multipart, and as JSON.
fn images_body(upload: &ImageUpload) -> Value {
    let parameters = to_value((upload.parameters)());
    let first_image = upload.images.first();
    let mut form = json!({
        "type": "object",
        "additionalProperties": false,
        "required": first_image.as_slice(),
        "properties": {"json": parameters},
    });
    let required: Vec<&str> = first_image
        .into_iter()
        .chain(upload.required_parameters)
        .copied()
        .collect();
    let mut object = parameters;
    object["required"] = json!(required);
    for image in upload.images {
        form["properties"][image] = json!({
            "type": "string",
            "format": "binary",
            "description": "A JPEG, PNG or WebP image.",
        });
        object["properties"][image] = json!({
            "type": "string",
            "contentEncoding": "base64",
            "description": "A JPEG, PNG or WebP image in base64.",
        });
    }
    json!({
        "required": true,
        "description": "The image as it is, in a form, or in JSON. A body without a content type, \
            or with the type `application/x-www-form-urlencoded` that curl gives to everything, is \
            taken for an image if its bytes are one.",
        "content": {
            "image/jpeg": bytes_content(),
            "image/png": bytes_content(),
            "image/webp": bytes_content(),
            "application/octet-stream": bytes_content(),
            "multipart/form-data": {
                "schema": form,
                "encoding": {"json": {"contentType": "application/json"}},
            },
            "application/json": {"schema": object, "example": (upload.example)()},
        },
    })
}

/// A body that is bytes.
fn bytes_content() -> Value {
    json!({"schema": {"type": "string", "format": "binary", "minLength": 1}})
}

/// Gives the answers that the attributes describe a realistic example each.
fn describe_answers(operation: &mut Value, route: &Route) {
    let responses = operation["responses"].as_object_mut();
    for (status, response) in responses.into_iter().flatten() {
        let example = if status == "503" {
            Some(examples::not_ready())
        } else {
            route.answer_example.map(|example| example())
        };
        // Indexing would add the key to answers without a body.
        let contents = response.get_mut("content").and_then(Value::as_object_mut);
        for (_, content) in contents.into_iter().flatten() {
            content["example"] = example.clone().unwrap_or_default();
        }
    }
}

fn describe_errors(operation: &mut Value, codes: &[ErrorCode]) {
    let mut by_status: BTreeMap<u16, Vec<ErrorCode>> = BTreeMap::new();
    for &code in codes {
        by_status.entry(code.status()).or_default().push(code);
    }
    for (status, codes) in by_status {
        let response = &mut operation["responses"][status.to_string()];
        describe_error_response(response, &codes);
    }
}

/// Describes the response of one status, which may have a body of its own already.
fn describe_error_response(response: &mut Value, codes: &[ErrorCode]) {
    if response.is_null() {
        *response = json!({});
    }
    let mut sentences: Vec<String> = Vec::new();
    if let Some(own) = response["description"].as_str() {
        sentences.push(own.to_owned());
    }
    let mut problems = Map::new();
    for code in codes {
        sentences.push(format!("`{}`: {}.", code.as_str(), code.title()));
        problems.insert(code.as_str().to_owned(), json!({"value": problem(*code)}));
        for header in ErrorHeader::of(*code) {
            response["headers"][header.name().as_str()] = describe_header(header);
        }
    }
    response["description"] = Value::from(sentences.join(" "));
    response["content"][PROBLEM_JSON] = json!({
        "schema": {"$ref": "#/components/schemas/ProblemBody"},
        "examples": problems,
    });
}

fn describe_header(header: ErrorHeader) -> Value {
    match header {
        ErrorHeader::RetryAfter(_) => json!({
            "description": "Seconds after which to try again.",
            "schema": {"type": "integer", "minimum": 1},
        }),
        ErrorHeader::WwwAuthenticate => json!({
            "description": "How to present a key.",
            "schema": {"type": "string"},
        }),
    }
}

/// An error as it is sent.
fn problem(code: ErrorCode) -> Value {
    let error = ApiError::new(code, "what exactly is wrong with this request");
    to_value(error.body("0197f3c2-7c1e-7d3a-9b1f-2f6f0c1d2e3f"))
}

/// Nothing, or a key in either header: a server without keys needs none.
fn describe_security(operation: &mut Value, scope: Scope) {
    match scope {
        Scope::Public => {}
        Scope::Metrics | Scope::Key(_) => {
            operation["security"] = json!([{}, {"bearer": []}, {"header": []}])
        }
    }
}
