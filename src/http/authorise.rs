//! The layer that lets a request through only if its key allows the route and its caller has not
//! used up its rate.

use super::access::Access;
use super::api_keys::{Holder, missing_key, presented_key, unknown_key};
use super::auth::Auth;
use super::map_scope::MapScope;
use super::problem::ApiError;
use super::route::Scope;
use super::routes;
use super::state::AppState;
use crate::pipeline::{Caller, network_of};
use axum::extract::{MatchedPath, Request, State};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::sync::Arc;

/// The client's end of the connection that a request came over.
#[derive(Debug, Clone, Copy)]
pub struct Peer(pub SocketAddr);

/// The layer itself.
pub async fn authorise(
    State(state): State<AppState>,
    mut request: Request,
    next: Next,
) -> Response {
    match check(&state, &request) {
        Ok(access) => {
            request.extensions_mut().insert(access);
            next.run(request).await
        }
        Err(error) => error.into_response(),
    }
}

fn check(state: &AppState, request: &Request) -> Result<Access, ApiError> {
    let network = network_of(address_of(request));
    let anonymous = |maps| Access {
        caller: Caller::Network(network),
        maps,
    };
    let Some(scope) = scope_of(request) else {
        return Ok(anonymous(MapScope::none()));
    };
    let auth = state.auth();
    if auth.keys.is_empty() {
        let access = anonymous(MapScope::All);
        if let Scope::Key(_) = scope {
            auth.rates.check(&access.caller)?;
        }
        return Ok(access);
    }
    let Some(role) = scope.role() else {
        return Ok(anonymous(MapScope::none()));
    };
    let Some(key) = presented_key(request.headers()) else {
        // Without a key there are numbers, but no names.
        if scope == Scope::Metrics && !auth.keys.protect_metrics() {
            return Ok(anonymous(MapScope::none()));
        }
        return Err(missing_key());
    };
    let holder = holder_of(state, &auth, network, key)?;
    tracing::Span::current().record("key", &*holder.name);
    holder.check_role(role)?;
    let access = Access {
        caller: Caller::Key(holder.name.clone()),
        maps: holder.maps.clone(),
    };
    auth.rates.check(&access.caller)?;
    Ok(access)
}

/// Whose key this is. An address that has presented too many unknown ones is not answered that.
fn holder_of(
    state: &AppState,
    auth: &Auth,
    network: IpAddr,
    key: &[u8],
) -> Result<Arc<Holder>, ApiError> {
    state
        .failed_keys
        .check(network, auth.failed_keys_per_minute)?;
    match auth.keys.holder_of(key) {
        Some(holder) => Ok(holder.clone()),
        None => {
            state.failed_keys.count(network);
            Err(unknown_key())
        }
    }
}

/// Who may send the request; `None` for a path that does not exist.
fn scope_of(request: &Request) -> Option<Scope> {
    let path = request.extensions().get::<MatchedPath>()?.as_str();
    Some(routes::scope_of(request.method(), path))
}

/// Where the request came from. Only tests call the router without a connection.
fn address_of(request: &Request) -> IpAddr {
    match request.extensions().get::<Peer>() {
        Some(peer) => peer.0.ip(),
        None => IpAddr::V4(Ipv4Addr::LOCALHOST),
    }
}
