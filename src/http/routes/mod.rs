//! The route table, and one file per group of handlers.
//!
//! A handler parses, calls the pipeline, and shapes the answer. Everything else about its route is
//! in its row of [`ROUTES`], from which the router, the check of keys and rates, the OpenAPI
//! document, the metrics and the log are made. So a new route is a handler and one row.
//!
//! The attributes of a handler repeat its method and path, because their macro insists; a test
//! compares them with the row.

pub mod console;
pub mod docs;
pub mod info;
pub mod maps;
pub mod match_images;
pub mod probes;
pub mod query;
pub mod references;
pub mod shapes;

use super::config::Role;
use super::examples;
use super::route::{AccessLog, Handler, RequestBody, Route, Scope};
use axum::http::Method;
use axum::routing::get;
use placeformer_core::error::ErrorCode;
use utoipa_axum::routes;

/// Every route there is.
pub static ROUTES: &[Route] = &[
    Route {
        method: Method::POST,
        path: "/references",
        scope: Scope::Key(Role::Write),
        access_log: AccessLog::Logged,
        body: RequestBody::Images(&references::UPLOAD),
        own_errors: &[
            ErrorCode::ImageUninformative,
            ErrorCode::ExternalIdConflict,
            ErrorCode::ModelMismatch,
            ErrorCode::CorruptRecord,
            ErrorCode::MemoryPressure,
            ErrorCode::DiskFull,
        ],
        answer_example: Some(examples::created_reference),
        handler: Handler::Operation(|| routes!(references::create)),
    },
    Route {
        method: Method::GET,
        path: "/references",
        scope: Scope::Key(Role::Read),
        access_log: AccessLog::Logged,
        body: RequestBody::None,
        own_errors: &[
            ErrorCode::InvalidParameter,
            ErrorCode::MapNotFound,
            ErrorCode::CorruptRecord,
        ],
        answer_example: Some(examples::reference_page),
        handler: Handler::Operation(|| routes!(references::list)),
    },
    Route {
        method: Method::GET,
        path: "/references/{id}",
        scope: Scope::Key(Role::Read),
        access_log: AccessLog::Logged,
        body: RequestBody::None,
        own_errors: &[ErrorCode::ReferenceNotFound, ErrorCode::CorruptRecord],
        answer_example: Some(examples::reference),
        handler: Handler::Operation(|| routes!(references::get)),
    },
    Route {
        method: Method::PATCH,
        path: "/references/{id}",
        scope: Scope::Key(Role::Write),
        access_log: AccessLog::Logged,
        body: RequestBody::Json {
            example: examples::reference_change,
        },
        own_errors: &[
            ErrorCode::ReferenceNotFound,
            ErrorCode::ExternalIdConflict,
            ErrorCode::CorruptRecord,
            ErrorCode::DiskFull,
        ],
        answer_example: Some(examples::reference),
        handler: Handler::Operation(|| routes!(references::update)),
    },
    Route {
        method: Method::DELETE,
        path: "/references/{id}",
        scope: Scope::Key(Role::Write),
        access_log: AccessLog::Logged,
        body: RequestBody::None,
        own_errors: &[
            ErrorCode::ReferenceNotFound,
            ErrorCode::CorruptRecord,
            ErrorCode::DiskFull,
        ],
        answer_example: None,
        handler: Handler::Operation(|| routes!(references::delete)),
    },
    Route {
        method: Method::POST,
        path: "/query",
        scope: Scope::Key(Role::Read),
        access_log: AccessLog::Logged,
        body: RequestBody::Images(&query::UPLOAD),
        own_errors: &[
            ErrorCode::MapNotFound,
            ErrorCode::ModelMismatch,
            ErrorCode::TrackMalformed,
            ErrorCode::TrackForged,
            ErrorCode::TrackExpired,
            ErrorCode::TrackOtherMap,
            ErrorCode::TrackOtherModel,
            ErrorCode::TrackUnavailable,
            ErrorCode::CorruptRecord,
            ErrorCode::DeadlineExceeded,
        ],
        answer_example: Some(examples::query_answer),
        handler: Handler::Operation(|| routes!(query::query)),
    },
    Route {
        method: Method::POST,
        path: "/match",
        scope: Scope::Key(Role::Read),
        access_log: AccessLog::Logged,
        body: RequestBody::Images(&match_images::UPLOAD),
        own_errors: &[
            ErrorCode::ReferenceNotFound,
            ErrorCode::ModelMismatch,
            ErrorCode::CorruptRecord,
            ErrorCode::DeadlineExceeded,
        ],
        answer_example: Some(examples::match_answer),
        handler: Handler::Operation(|| routes!(match_images::match_images)),
    },
    Route {
        method: Method::GET,
        path: "/maps",
        scope: Scope::Key(Role::Read),
        access_log: AccessLog::Logged,
        body: RequestBody::None,
        own_errors: &[],
        answer_example: Some(examples::map_list),
        handler: Handler::Operation(|| routes!(maps::list)),
    },
    Route {
        method: Method::GET,
        path: "/maps/{map}",
        scope: Scope::Key(Role::Read),
        access_log: AccessLog::Logged,
        body: RequestBody::None,
        own_errors: &[ErrorCode::MapNotFound, ErrorCode::CorruptRecord],
        answer_example: Some(examples::map),
        handler: Handler::Operation(|| routes!(maps::get)),
    },
    Route {
        method: Method::DELETE,
        path: "/maps/{map}",
        scope: Scope::Key(Role::Write),
        access_log: AccessLog::Logged,
        body: RequestBody::None,
        own_errors: &[
            ErrorCode::MapNotFound,
            ErrorCode::CorruptRecord,
            ErrorCode::DiskFull,
        ],
        answer_example: Some(examples::map_deleted),
        handler: Handler::Operation(|| routes!(maps::delete)),
    },
    Route {
        method: Method::PUT,
        path: "/maps/{map}/calibration",
        scope: Scope::Key(Role::Write),
        access_log: AccessLog::Logged,
        body: RequestBody::Json {
            example: examples::calibration,
        },
        own_errors: &[
            ErrorCode::MapNotFound,
            ErrorCode::CalibrationMismatch,
            ErrorCode::CorruptRecord,
            ErrorCode::DiskFull,
        ],
        answer_example: Some(examples::calibration),
        handler: Handler::Operation(|| routes!(maps::set_calibration)),
    },
    Route {
        method: Method::DELETE,
        path: "/maps/{map}/calibration",
        scope: Scope::Key(Role::Write),
        access_log: AccessLog::Logged,
        body: RequestBody::None,
        own_errors: &[
            ErrorCode::MapNotFound,
            ErrorCode::CorruptRecord,
            ErrorCode::DiskFull,
        ],
        answer_example: None,
        handler: Handler::Operation(|| routes!(maps::remove_calibration)),
    },
    Route {
        method: Method::PUT,
        path: "/maps/{map}/head",
        scope: Scope::Key(Role::Write),
        access_log: AccessLog::Logged,
        body: RequestBody::File {
            max_bytes: maps::MAX_HEAD_BYTES,
            description: "The head's safetensors file",
        },
        own_errors: &[
            ErrorCode::MapNotFound,
            ErrorCode::HeadUnreadable,
            ErrorCode::HeadMismatch,
            ErrorCode::ModelMismatch,
            ErrorCode::CorruptRecord,
            ErrorCode::MemoryPressure,
            ErrorCode::DiskFull,
        ],
        answer_example: Some(examples::map),
        handler: Handler::Operation(|| routes!(maps::set_head)),
    },
    Route {
        method: Method::DELETE,
        path: "/maps/{map}/head",
        scope: Scope::Key(Role::Write),
        access_log: AccessLog::Logged,
        body: RequestBody::None,
        own_errors: &[
            ErrorCode::MapNotFound,
            ErrorCode::HeadMismatch,
            ErrorCode::ModelMismatch,
            ErrorCode::CorruptRecord,
            ErrorCode::MemoryPressure,
            ErrorCode::DiskFull,
        ],
        answer_example: Some(examples::map),
        handler: Handler::Operation(|| routes!(maps::remove_head)),
    },
    Route {
        method: Method::GET,
        path: "/info",
        scope: Scope::Key(Role::Read),
        access_log: AccessLog::Logged,
        body: RequestBody::None,
        own_errors: &[],
        answer_example: Some(examples::info),
        handler: Handler::Operation(|| routes!(info::info)),
    },
    Route {
        method: Method::GET,
        path: "/livez",
        scope: Scope::Public,
        access_log: AccessLog::Quiet,
        body: RequestBody::None,
        own_errors: &[],
        answer_example: Some(examples::live),
        handler: Handler::Operation(|| routes!(probes::livez)),
    },
    Route {
        method: Method::GET,
        path: "/readyz",
        scope: Scope::Public,
        access_log: AccessLog::Quiet,
        body: RequestBody::None,
        own_errors: &[ErrorCode::InvalidParameter],
        answer_example: Some(examples::ready),
        handler: Handler::Operation(|| routes!(probes::readyz)),
    },
    Route {
        method: Method::GET,
        path: "/metrics",
        scope: Scope::Metrics,
        access_log: AccessLog::Quiet,
        body: RequestBody::None,
        own_errors: &[],
        answer_example: Some(examples::metrics),
        handler: Handler::Operation(|| routes!(probes::metrics)),
    },
    Route {
        method: Method::GET,
        path: "/openapi.json",
        scope: Scope::Public,
        access_log: AccessLog::Logged,
        body: RequestBody::None,
        own_errors: &[],
        answer_example: Some(examples::openapi_json),
        handler: Handler::Operation(|| routes!(docs::openapi_json)),
    },
    Route {
        method: Method::GET,
        path: "/",
        scope: Scope::Public,
        access_log: AccessLog::Logged,
        body: RequestBody::None,
        own_errors: &[],
        answer_example: None,
        handler: Handler::Page(|| get(console::index)),
    },
    Route {
        method: Method::GET,
        path: "/console/{*rest}",
        scope: Scope::Public,
        access_log: AccessLog::Logged,
        body: RequestBody::None,
        own_errors: &[ErrorCode::RouteNotFound],
        answer_example: None,
        handler: Handler::Page(|| get(console::file)),
    },
    Route {
        method: Method::GET,
        path: "/docs",
        scope: Scope::Public,
        access_log: AccessLog::Logged,
        body: RequestBody::None,
        own_errors: &[],
        answer_example: None,
        handler: Handler::Page(|| get(docs::redirect_to_ui)),
    },
    Route {
        method: Method::GET,
        path: "/docs/",
        scope: Scope::Public,
        access_log: AccessLog::Logged,
        body: RequestBody::None,
        own_errors: &[],
        answer_example: None,
        handler: Handler::Page(|| get(docs::ui_index)),
    },
    Route {
        method: Method::GET,
        path: "/docs/{*rest}",
        scope: Scope::Public,
        access_log: AccessLog::Logged,
        body: RequestBody::None,
        own_errors: &[ErrorCode::RouteNotFound],
        answer_example: None,
        handler: Handler::Page(|| get(docs::ui_file)),
    },
];

/// The routes at a path as the router matched it.
pub fn routes_at(path: &str) -> impl Iterator<Item = &'static Route> {
    ROUTES.iter().filter(move |route| route.path == path)
}

/// Who may send `method` to `path`, a path of the table.
///
/// A method that no route of the path answers leads to the status 405, which names the methods that
/// there are. That answer is for callers who might use the path. So the method is treated like the
/// path's routes of the same kind, where there are two kinds: methods that only read, and others.
pub fn scope_of(method: &Method, path: &str) -> Scope {
    if let Some(route) = routes_at(path).find(|route| route.answers(method)) {
        return route.scope;
    }
    let without_key = routes_at(path).find(|route| !matches!(route.scope, Scope::Key(_)));
    if let Some(route) = without_key {
        return route.scope;
    }
    if only_reads(method) {
        return Scope::Key(Role::Read);
    }
    let changing = routes_at(path).find(|route| !only_reads(&route.method));
    match changing {
        Some(route) => route.scope,
        None => Scope::Key(Role::Write),
    }
}

fn only_reads(method: &Method) -> bool {
    matches!(*method, Method::GET | Method::HEAD | Method::OPTIONS)
}

/// How loud the log is about requests to `path`, whatever their method. Requests to paths that do
/// not exist are logged.
pub fn access_log_of(path: &str) -> AccessLog {
    let is_quiet = routes_at(path).any(|route| route.access_log == AccessLog::Quiet);
    if is_quiet {
        AccessLog::Quiet
    } else {
        AccessLog::Logged
    }
}

/// Whether `path` is for those who watch over the service: supervisors, balancers, Prometheus.
pub fn is_probe(path: &str) -> bool {
    access_log_of(path) == AccessLog::Quiet
}

/// Whether `path` says no more than how the service is, so that anyone may ask, from anywhere.
pub fn is_health(path: &str) -> bool {
    routes_at(path).any(Route::is_health)
}

/// Whether `path` is a page for people, which holds no data.
pub fn is_page(path: &str) -> bool {
    routes_at(path).any(|route| matches!(route.handler, Handler::Page(_)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::HashSet;

    #[test]
    fn every_row_has_the_path_and_method_of_its_handler() {
        for route in ROUTES {
            let Handler::Operation(operation) = route.handler else {
                continue;
            };
            let (_, described, _) = operation();
            let described = serde_json::to_value(described).unwrap();
            let paths = described.as_object().unwrap();
            assert_eq!(paths.keys().collect::<Vec<_>>(), [route.path]);
            let methods = described[route.path].as_object().unwrap();
            let method = route.method.as_str().to_lowercase();
            assert_eq!(methods.keys().collect::<Vec<_>>(), [&method]);
        }
    }

    #[test]
    fn no_two_rows_are_for_the_same_method_and_path() {
        let mut seen = HashSet::new();
        for route in ROUTES {
            let is_new = seen.insert((&route.method, route.path));
            assert!(is_new, "{} {}", route.method, route.path);
        }
    }

    #[test]
    fn the_log_is_as_loud_about_all_methods_of_a_path() {
        for route in ROUTES {
            assert_eq!(route.access_log, access_log_of(route.path));
        }
    }

    #[test]
    fn no_code_is_named_twice_for_a_route() {
        for route in ROUTES {
            let codes = route.error_codes();
            let distinct: HashSet<_> = codes.iter().collect();
            assert_eq!(distinct.len(), codes.len(), "{} {codes:?}", route.path);
        }
    }

    #[test]
    fn an_unsupported_method_has_the_scope_of_those_of_its_kind() {
        let key = Scope::Key;
        for (method, path, scope) in [
            (Method::HEAD, "/maps", key(Role::Read)),
            (Method::GET, "/maps/{map}/head", key(Role::Read)),
            (Method::OPTIONS, "/query", key(Role::Read)),
            (Method::PUT, "/query", key(Role::Read)),
            (Method::PUT, "/references", key(Role::Write)),
            (Method::POST, "/info", key(Role::Write)),
            (Method::POST, "/livez", Scope::Public),
            (Method::POST, "/docs/", Scope::Public),
            (Method::DELETE, "/metrics", Scope::Metrics),
        ] {
            assert_eq!(scope_of(&method, path), scope, "{method} {path}");
        }
    }
}
