//! The layer that lets a request through only if its key allows the route and its caller has not
//! used up its rate.

use super::config::Role;
use super::problem::ApiError;
use super::rate_limits::Caller;
use super::routes;
use super::state::AppState;
use axum::extract::{MatchedPath, Request, State};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use std::net::{IpAddr, Ipv4Addr, SocketAddr};

/// The client's end of the connection that a request came over.
#[derive(Debug, Clone, Copy)]
pub struct Peer(pub SocketAddr);

/// The layer itself.
pub async fn authorise(State(state): State<AppState>, request: Request, next: Next) -> Response {
    match check(&state, &request) {
        Ok(()) => next.run(request).await,
        Err(error) => error.into_response(),
    }
}

fn check(state: &AppState, request: &Request) -> Result<(), ApiError> {
    let Some(role) = required_role(state, request) else {
        return Ok(());
    };
    let caller = if state.api_keys.is_empty() {
        Caller::Address(address_of(request))
    } else {
        let name = state.api_keys.holder(request.headers(), role)?;
        tracing::Span::current().record("key", name.as_str());
        Caller::Key(name)
    };
    state.rate_limits.check(&caller)
}

/// The role that the request needs; `None` if anyone may send it, which also holds for paths that
/// do not exist.
fn required_role(state: &AppState, request: &Request) -> Option<Role> {
    let path = request.extensions().get::<MatchedPath>()?.as_str();
    routes::scope_of(request.method(), path).required_role(state.api_keys.protect_metrics())
}

/// Where the request came from. Only tests call the router without a connection.
fn address_of(request: &Request) -> IpAddr {
    match request.extensions().get::<Peer>() {
        Some(peer) => peer.0.ip(),
        None => IpAddr::V4(Ipv4Addr::LOCALHOST),
    }
}
