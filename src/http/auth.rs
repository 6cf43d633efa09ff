//! Who asks, and whether they may: API keys with a role, kept as hashes, compared in constant time.

use super::AppState;
use super::config::{AuthConfig, Role};
use super::limits::Caller;
use super::problem::ApiError;
use axum::extract::{MatchedPath, Request, State};
use axum::http::{HeaderMap, Method, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use placeformer_core::error::ErrorCode;
use placeformer_core::types::InvalidValue;
use sha2::{Digest, Sha256};
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use subtle::ConstantTimeEq;

/// The keys, ready to compare.
pub struct Keys {
    keys: Vec<(String, [u8; 32], Role)>,
    protect_metrics: bool,
}

/// The peer of the connection that a request came over.
#[derive(Debug, Clone, Copy)]
pub struct Peer(pub SocketAddr);

impl Keys {
    /// Checks and takes over the configured keys.
    pub fn new(config: &AuthConfig) -> Result<Self, InvalidValue> {
        config.check()?;
        let keys = config
            .keys
            .iter()
            .map(|key| Ok((key.name.clone(), key.hash()?, key.role)));
        Ok(Self {
            keys: keys.collect::<Result<_, InvalidValue>>()?,
            protect_metrics: config.protect_metrics,
        })
    }

    /// The holder of the key that `headers` carry, if its role allows `needed`.
    fn holder(&self, headers: &HeaderMap, needed: Role) -> Result<String, ApiError> {
        let key = presented(headers)?;
        let hash: [u8; 32] = Sha256::digest(key).into();
        // All keys are compared, so that the time taken says nothing.
        let mut found = None;
        for (name, known, role) in &self.keys {
            if bool::from(known.ct_eq(&hash)) {
                found = Some((name, *role));
            }
        }
        let (name, role) = found
            .ok_or_else(|| ApiError::new(ErrorCode::Unauthorized, "the API key is not known"))?;
        if role < needed {
            let detail = format!("key {name:?} may read; this needs a key that may write");
            return Err(ApiError::new(ErrorCode::Forbidden, detail));
        }
        Ok(name.clone())
    }
}

fn presented(headers: &HeaderMap) -> Result<&[u8], ApiError> {
    if let Some(key) = headers.get("x-api-key") {
        return Ok(key.as_bytes());
    }
    let missing = || {
        ApiError::new(
            ErrorCode::Unauthorized,
            "send an API key as \"Authorization: Bearer KEY\" or \"X-API-Key: KEY\"",
        )
    };
    let value = headers
        .get(header::AUTHORIZATION)
        .ok_or_else(missing)?
        .as_bytes();
    let (scheme, key) = value.split_at_checked(7).ok_or_else(missing)?;
    if scheme.eq_ignore_ascii_case(b"bearer ") {
        Ok(key.trim_ascii())
    } else {
        Err(missing())
    }
}

/// What a request needs; `None` if anyone may send it.
fn needed_role(request: &Request, protect_metrics: bool) -> Option<Role> {
    let path = request.extensions().get::<MatchedPath>()?.as_str();
    match path {
        "/livez" | "/readyz" | "/openapi.json" => None,
        "/metrics" => protect_metrics.then_some(Role::Read),
        _ if path.starts_with("/docs") => None,
        "/query" | "/match" => Some(Role::Read),
        _ if matches!(
            *request.method(),
            Method::GET | Method::HEAD | Method::OPTIONS
        ) =>
        {
            Some(Role::Read)
        }
        _ => Some(Role::Write),
    }
}

/// Lets a request through if its key allows it and its rate is not used up.
pub async fn admit(State(state): State<AppState>, request: Request, next: Next) -> Response {
    match identify(&state, &request) {
        Ok(()) => next.run(request).await,
        Err(error) => error.into_response(),
    }
}

fn identify(state: &AppState, request: &Request) -> Result<(), ApiError> {
    let Some(needed) = needed_role(request, state.keys.protect_metrics) else {
        return Ok(());
    };
    let caller = if state.keys.keys.is_empty() {
        let peer = request
            .extensions()
            .get::<Peer>()
            .map_or(IpAddr::V4(Ipv4Addr::LOCALHOST), |peer| peer.0.ip());
        Caller::Address(peer)
    } else {
        let name = state.keys.holder(request.headers(), needed)?;
        tracing::Span::current().record("key", name.as_str());
        Caller::Key(name)
    };
    state.rates.check(&caller)
}

#[cfg(test)]
mod tests {
    use super::super::config::ApiKey;
    use super::*;

    fn keys() -> Keys {
        // SHA-256 of "secret".
        let sha256 = "2bb80d537b1da3e38bd30361aa855686bde0eacd7162fef6a25fe97bf527a25b".to_owned();
        let key = ApiKey {
            name: "fleet".into(),
            sha256,
            role: Role::Read,
            requests_per_second: None,
        };
        Keys::new(&AuthConfig {
            keys: vec![key],
            ..Default::default()
        })
        .unwrap()
    }

    #[test]
    fn keys_are_found_in_either_header_and_roles_hold() {
        let headers = |name: &'static str, value: &'static str| {
            HeaderMap::from_iter([(
                header::HeaderName::from_static(name),
                header::HeaderValue::from_static(value),
            )])
        };
        let keys = keys();
        let code =
            |headers: HeaderMap, role| keys.holder(&headers, role).map_err(|error| error.code);
        assert_eq!(
            code(headers("x-api-key", "secret"), Role::Read).unwrap(),
            "fleet"
        );
        assert_eq!(
            code(headers("authorization", "bearer secret"), Role::Read).unwrap(),
            "fleet"
        );
        assert_eq!(
            code(headers("authorization", "Bearer secret"), Role::Write),
            Err(ErrorCode::Forbidden)
        );
        assert_eq!(
            code(headers("authorization", "Basic secret"), Role::Read),
            Err(ErrorCode::Unauthorized)
        );
        assert_eq!(
            code(headers("x-api-key", "Secret"), Role::Read),
            Err(ErrorCode::Unauthorized)
        );
        assert_eq!(
            code(HeaderMap::new(), Role::Read),
            Err(ErrorCode::Unauthorized)
        );
    }
}
