//! The layer that refuses what foreign web pages make a browser send.
//!
//! A browser on the machine or in the network of the service sends requests for any page that is
//! open in it. It says so in the header `Origin`, or `Sec-Fetch-Site`: then the request is refused
//! unless the page's origin is the service's own or one that the settings allow. A page can also
//! have its own name lead to the service's address (DNS rebinding), so that its origin seems to be
//! the service's: the name is then in the header `Host`. A service that everyone on its machine may
//! use, because it has no keys, therefore answers only to names of that machine.

use super::config::HttpConfig;
use super::connection_info::ConnectionInfo;
use super::problem::ApiError;
use super::routes;
use super::state::AppState;
use axum::extract::{MatchedPath, Request, State};
use axum::http::uri::{Authority, Scheme};
use axum::http::{HeaderMap, HeaderName, Method, Uri, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use placeformer_core::error::ErrorCode;
use placeformer_core::types::InvalidValue;
use std::net::IpAddr;
use tower_http::cors::{AllowHeaders, AllowMethods, AllowOrigin, CorsLayer, ExposeHeaders};

const SEC_FETCH_SITE: HeaderName = HeaderName::from_static("sec-fetch-site");
const SEC_FETCH_MODE: HeaderName = HeaderName::from_static("sec-fetch-mode");
const SEC_FETCH_DEST: HeaderName = HeaderName::from_static("sec-fetch-dest");

/// Headers of answers that pages of allowed origins may read beyond the few that every page may.
const SHOWN_HEADERS: [HeaderName; 4] = [
    header::LOCATION,
    header::RETRY_AFTER,
    HeaderName::from_static("server-timing"),
    HeaderName::from_static(super::observe::REQUEST_ID),
];

/// Most characters of a header that an error repeats.
const MAX_SHOWN: usize = 80;

/// Which names and origins the settings allow.
#[derive(Debug)]
pub struct CrossOriginRules {
    hosts: Vec<String>,
    origins: Vec<Origin>,
}

/// Where a web page comes from.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Origin {
    is_https: bool,
    host: Host,
}

/// Whom a request is addressed to.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Host {
    /// In lower case, without a dot at the end.
    name: String,
    port: Option<u16>,
}

impl CrossOriginRules {
    /// The rules of the settings.
    ///
    /// # Errors
    /// A host has a port or cannot be one, or an origin is not `http://` or `https://` with a host.
    pub fn new(config: &HttpConfig) -> Result<Self, InvalidValue> {
        let mut hosts = Vec::with_capacity(config.allowed_hosts.len());
        for text in &config.allowed_hosts {
            match Host::parse(text) {
                Some(Host { name, port: None }) => hosts.push(name),
                _ => {
                    let reason = format!("{text:?} is not a name or an address without a port");
                    return Err(InvalidValue::new("http.allowed_hosts", reason));
                }
            }
        }
        let mut origins = Vec::with_capacity(config.allowed_origins.len());
        for text in &config.allowed_origins {
            origins.push(Origin::parse(text).ok_or_else(|| {
                let reason = format!("{text:?} is not an origin, such as https://example.com");
                InvalidValue::new("http.allowed_origins", reason)
            })?);
        }
        Ok(Self { hosts, origins })
    }

    /// The layer that lets pages of the allowed origins see the answers; `None` without any.
    pub fn cors(&self) -> Option<CorsLayer> {
        if self.origins.is_empty() {
            return None;
        }
        let origins = self.origins.clone();
        let is_allowed = AllowOrigin::predicate(move |origin, _| {
            let origin = origin.to_str().ok().and_then(Origin::parse);
            origin.is_some_and(|origin| origins.contains(&origin))
        });
        let layer = CorsLayer::new()
            .allow_origin(is_allowed)
            .allow_methods(AllowMethods::mirror_request())
            .allow_headers(AllowHeaders::mirror_request())
            .expose_headers(ExposeHeaders::list(SHOWN_HEADERS));
        Some(layer)
    }

    /// Checks that the request is addressed to a name that the service has.
    fn check_host(&self, request: &Request, must_be_local: bool) -> Result<(), ApiError> {
        if self.hosts.is_empty() && !must_be_local {
            return Ok(());
        }
        let named = hosts_of(request);
        let is_allowed = |host: &Option<Host>| {
            let host = host.as_ref();
            host.is_some_and(|host| host.is_this_machine() || self.hosts.contains(&host.name))
        };
        if !named.is_empty() && named.iter().all(is_allowed) {
            return Ok(());
        }
        let shown = shown(request.headers().get(header::HOST));
        let detail = format!(
            "the header Host is {shown}; use localhost or 127.0.0.1, or a name of the setting \
             http.allowed_hosts"
        );
        Err(ApiError::new(ErrorCode::HostNotAllowed, detail))
    }

    /// Checks that the request was not sent for a foreign web page.
    fn check_origin(&self, request: &Request, is_tls: bool) -> Result<(), ApiError> {
        let headers = request.headers();
        let mut origins = headers.get_all(header::ORIGIN).iter();
        let Some(first) = origins.next() else {
            return refuse_cross_site(request);
        };
        let origin = first.to_str().ok().and_then(Origin::parse);
        let is_allowed = origins.next().is_none()
            && origin.is_some_and(|origin| {
                self.origins.contains(&origin) || is_own(&origin, request, is_tls)
            });
        if is_allowed {
            return Ok(());
        }
        let detail = format!(
            "the page's origin {} is neither the service's own nor in the setting \
             http.allowed_origins",
            shown(Some(first))
        );
        Err(ApiError::new(ErrorCode::CrossOrigin, detail))
    }
}

/// The layer itself.
pub async fn refuse_foreign_pages(
    State(state): State<AppState>,
    request: Request,
    next: Next,
) -> Response {
    match check(&state, &request) {
        Ok(()) => next.run(request).await,
        Err(error) => error.into_response(),
    }
}

fn check(state: &AppState, request: &Request) -> Result<(), ApiError> {
    let path = request.extensions().get::<MatchedPath>();
    if path.is_some_and(|path| routes::is_health(path.as_str())) {
        return Ok(());
    }
    let info = request.extensions().get::<ConnectionInfo>();
    let is_loopback = info.is_some_and(|info| info.is_loopback);
    let is_tls = info.is_some_and(|info| info.is_tls);
    let must_be_local = is_loopback && state.auth().keys.is_empty();
    let rules = &state.cross_origin;
    rules.check_host(request, must_be_local)?;
    rules.check_origin(request, is_tls)
}

/// A browser leaves `Origin` out of some requests, such as those for pictures, but says what kind
/// of page they are for.
fn refuse_cross_site(request: &Request) -> Result<(), ApiError> {
    let headers = request.headers();
    if !has(headers, &SEC_FETCH_SITE, "cross-site") || is_link_to_page(request) {
        return Ok(());
    }
    let detail = "a browser sent this for a page of another site, whose origin it does not name";
    Err(ApiError::new(ErrorCode::CrossOrigin, detail))
}

/// Whether somebody followed a link to the documentation, which gives nothing to the page that has
/// the link.
fn is_link_to_page(request: &Request) -> bool {
    let headers = request.headers();
    let path = request.extensions().get::<MatchedPath>();
    matches!(*request.method(), Method::GET | Method::HEAD)
        && path.is_some_and(|path| routes::is_page(path.as_str()))
        && has(headers, &SEC_FETCH_MODE, "navigate")
        && has(headers, &SEC_FETCH_DEST, "document")
}

fn has(headers: &HeaderMap, name: &HeaderName, wanted: &str) -> bool {
    let mut values = headers.get_all(name).iter();
    values.any(|value| value.as_bytes().eq_ignore_ascii_case(wanted.as_bytes()))
}

/// Everyone to whom a request says that it is addressed: in its target, and in each header `Host`.
/// `None` for what cannot be a host.
fn hosts_of(request: &Request) -> Vec<Option<Host>> {
    let target = request.uri().authority();
    let target = target.map(|authority| Host::parse(authority.as_str()));
    let headers = request.headers().get_all(header::HOST).iter();
    let headers = headers.map(|value| value.to_str().ok().and_then(Host::parse));
    target.into_iter().chain(headers).collect()
}

/// Whether `origin` is where the request is addressed to. A proxy may have taken the encryption
/// off, so that an unencrypted connection says nothing about the page's.
fn is_own(origin: &Origin, request: &Request, is_tls: bool) -> bool {
    let addressed = hosts_of(request);
    let is_same = |host: &Option<Host>| {
        let host = host.as_ref();
        host.is_some_and(|host| {
            let port = host.port.unwrap_or(origin.default_port());
            host.name == origin.host.name && port == origin.port()
        })
    };
    (origin.is_https || !is_tls) && !addressed.is_empty() && addressed.iter().all(is_same)
}

/// A header's value as an error may repeat it.
fn shown(value: Option<&header::HeaderValue>) -> String {
    let Some(value) = value else {
        return "missing".to_owned();
    };
    let text = String::from_utf8_lossy(value.as_bytes());
    let text: String = text.chars().take(MAX_SHOWN).collect();
    format!("{text:?}")
}

impl Origin {
    fn parse(text: &str) -> Option<Self> {
        let uri: Uri = text.parse().ok()?;
        // An origin has no path; the parser makes one of nothing.
        let is_bare = uri.path_and_query().is_none_or(|path| path == "/") && !text.ends_with('/');
        let scheme = uri.scheme()?;
        let is_https = *scheme == Scheme::HTTPS;
        if !is_bare || !(is_https || *scheme == Scheme::HTTP) {
            return None;
        }
        let host = Host::parse(uri.authority()?.as_str())?;
        let port = Some(host.port.unwrap_or(default_port(is_https)));
        let name = host.name;
        Some(Self {
            is_https,
            host: Host { name, port },
        })
    }

    fn default_port(&self) -> u16 {
        default_port(self.is_https)
    }

    fn port(&self) -> u16 {
        self.host.port.unwrap_or(self.default_port())
    }
}

fn default_port(is_https: bool) -> u16 {
    if is_https { 443 } else { 80 }
}

impl Host {
    fn parse(text: &str) -> Option<Self> {
        let authority: Authority = text.parse().ok()?;
        let host = authority.host();
        // Whatever is left out of host and port is something that does not belong there.
        let rest = text.strip_prefix(host)?;
        let port = match rest.strip_prefix(':') {
            Some(digits) => Some(digits.parse().ok()?),
            None if rest.is_empty() => None,
            None => return None,
        };
        let name = host.strip_suffix('.').unwrap_or(host);
        let name = name.to_ascii_lowercase();
        (!name.is_empty()).then_some(Self { name, port })
    }

    /// Whether no name server, and no page, can make this lead to another machine or from one.
    fn is_this_machine(&self) -> bool {
        let bare = self
            .name
            .strip_prefix('[')
            .and_then(|name| name.strip_suffix(']'));
        let address = bare.unwrap_or(&self.name).parse::<IpAddr>();
        self.name == "localhost" || address.is_ok_and(|ip| ip.to_canonical().is_loopback())
    }
}
