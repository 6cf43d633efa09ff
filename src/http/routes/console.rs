//! The console at `/`: a page on which people ask this service, and see what its answers rest on.
//!
//! Its files are compiled in, so that the page works wherever the service does, without a network. They
//! hold no data, and anyone may load them. Whatever the page shows comes from the other routes, with
//! the key that its user entered.
//!
//! That key would be within reach of any script in the page. So the page may run and load nothing
//! but these files, send nothing to anyone but the service, and be framed by no other page.

use crate::http::problem::ApiError;
use axum::extract::Path;
use axum::http::{HeaderName, HeaderValue, header};
use axum::response::{IntoResponse, Response};
use placeformer_core::error::ErrorCode;

/// What the page may do. Photos and drawings are shown from memory, which is what `blob:` names.
const CONTENT_SECURITY_POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; \
     img-src 'self' blob:; connect-src 'self'; base-uri 'none'; form-action 'none'; \
     frame-ancestors 'none'";

/// The headers of every file, beside its type.
const HEADERS: [(HeaderName, HeaderValue); 5] = [
    (
        header::CONTENT_SECURITY_POLICY,
        HeaderValue::from_static(CONTENT_SECURITY_POLICY),
    ),
    (
        header::X_CONTENT_TYPE_OPTIONS,
        HeaderValue::from_static("nosniff"),
    ),
    (
        header::REFERRER_POLICY,
        HeaderValue::from_static("no-referrer"),
    ),
    (
        HeaderName::from_static("cross-origin-opener-policy"),
        HeaderValue::from_static("same-origin"),
    ),
    // A newer version of the server has newer files under the same names.
    (header::CACHE_CONTROL, HeaderValue::from_static("no-cache")),
];

/// A file of the console.
struct ConsoleFile {
    /// Its path below `/console/`.
    path: &'static str,
    content_type: &'static str,
    bytes: &'static [u8],
}

const HTML: &str = "text/html; charset=utf-8";
const CSS: &str = "text/css; charset=utf-8";
const SCRIPT: &str = "text/javascript; charset=utf-8";
const SVG: &str = "image/svg+xml";

/// Declares [`FILES`] from rows of `path: content type`.
macro_rules! console_files {
    ($($path:literal: $content_type:expr,)*) => {
        /// Every file of the folder `console`.
        const FILES: &[ConsoleFile] = &[$(
            ConsoleFile {
                path: $path,
                content_type: $content_type,
                bytes: include_bytes!(concat!(env!("CARGO_MANIFEST_DIR"), "/console/", $path)),
            },
        )*];
    };
}

console_files! {
    "index.html": HTML,
    "style.css": CSS,
    "icon.svg": SVG,
    "js/add.js": SCRIPT,
    "js/answer.js": SCRIPT,
    "js/api.js": SCRIPT,
    "js/coverage.js": SCRIPT,
    "js/dom.js": SCRIPT,
    "js/evidence.js": SCRIPT,
    "js/format.js": SCRIPT,
    "js/geometry.js": SCRIPT,
    "js/locate.js": SCRIPT,
    "js/main.js": SCRIPT,
    "js/map.js": SCRIPT,
    "js/map_canvas.js": SCRIPT,
    "js/pictures.js": SCRIPT,
    "js/positions.js": SCRIPT,
    "js/prometheus.js": SCRIPT,
    "js/server.js": SCRIPT,
    "js/session.js": SCRIPT,
}

/// The page itself.
pub async fn index() -> Response {
    answer("index.html")
}

/// A script, style or picture of the page.
pub async fn file(Path(path): Path<String>) -> Response {
    answer(&path)
}

fn answer(path: &str) -> Response {
    match FILES.iter().find(|file| file.path == path) {
        Some(file) => {
            let content_type = [(header::CONTENT_TYPE, file.content_type)];
            (HEADERS, content_type, file.bytes).into_response()
        }
        None => {
            let detail = "the console has no file of this name";
            ApiError::new(ErrorCode::RouteNotFound, detail).into_response()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    /// The files below `console/`, relative to it.
    fn files_on_disk() -> BTreeSet<String> {
        let root = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("console");
        let mut folders = vec![root.clone()];
        let mut files = BTreeSet::new();
        while let Some(folder) = folders.pop() {
            for entry in std::fs::read_dir(folder).unwrap() {
                let path = entry.unwrap().path();
                if path.is_dir() {
                    folders.push(path);
                } else {
                    let relative = path.strip_prefix(&root).unwrap();
                    files.insert(relative.to_str().unwrap().to_owned());
                }
            }
        }
        files
    }

    #[test]
    fn every_file_of_the_folder_is_served() {
        let served: BTreeSet<String> = FILES.iter().map(|file| file.path.to_owned()).collect();
        assert_eq!(served, files_on_disk());
    }

    /// What the policy forbids would fail silently in a browser.
    #[test]
    fn the_page_has_no_inline_script_or_style_and_names_no_other_host() {
        for file in FILES {
            let text = std::str::from_utf8(file.bytes).unwrap();
            for forbidden in ["https://", "style=\"", "onclick=", "<style", "javascript:"] {
                assert!(!text.contains(forbidden), "{}: {forbidden}", file.path);
            }
            // The name space of SVG is a name, and nothing is loaded from it.
            let hosts = text.replace("http://www.w3.org/2000/svg", "");
            assert!(!hosts.contains("http://"), "{}", file.path);
            for script in text.split("<script").skip(1) {
                assert!(
                    script.starts_with(" type=\"module\" src=\""),
                    "{}",
                    file.path
                );
            }
        }
    }
}
