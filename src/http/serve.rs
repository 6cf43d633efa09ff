//! Runs the surface on a listener: how many connections there are at once, how long a client may
//! take to send a head, and how everything ends.

use super::authorise::Peer;
use super::router::app;
use super::state::AppState;
use axum::Router;
use axum::body::Body;
use axum::extract::Request;
use axum::response::Response;
use hyper::body::Incoming;
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::server::graceful::GracefulShutdown;
use hyper_util::service::TowerToHyperService;
use std::convert::Infallible;
use std::future::Future;
use std::io;
use std::net::SocketAddr;
use std::pin::pin;
use std::sync::Arc;
use std::time::Duration;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::{sleep, timeout};
use tower::ServiceExt;
use tower::util::BoxCloneService;

/// Pause after a failed accept (out of file descriptors, mostly), so that the loop does not spin.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);
/// Time for the last answers to leave once draining is over.
const LAST_ANSWERS: Duration = Duration::from_secs(2);

/// One connection of a client, served by the router.
type Connection = http1::Connection<
    TokioIo<TcpStream>,
    TowerToHyperService<BoxCloneService<Request<Incoming>, Response, Infallible>>,
>;

/// An accepted connection.
struct Accepted {
    stream: TcpStream,
    peer: SocketAddr,
    /// One of the connections that may be open at once.
    permit: OwnedSemaphorePermit,
}

/// Serves until `shutdown` resolves, then drains.
///
/// Draining means: readiness fails at once, connections are refused after the drain delay, and
/// requests that still run at the end of the drain time are answered with `shutting_down`.
pub async fn serve(listener: TcpListener, state: AppState, shutdown: impl Future<Output = ()>) {
    let router = app(state.clone());
    let graceful = GracefulShutdown::new();
    let permits = Arc::new(Semaphore::new(state.http.max_connections));
    let end_of_accepting = async {
        shutdown.await;
        state.health.draining();
        sleep(Duration::from_millis(state.http.drain_delay_ms)).await;
    };
    let mut end_of_accepting = pin!(end_of_accepting);
    loop {
        let accepted = tokio::select! {
            accepted = accept(&listener, &permits) => accepted,
            () = &mut end_of_accepting => break,
        };
        match accepted {
            Ok(accepted) => spawn_connection(accepted, &router, &state, &graceful),
            Err(error) => {
                tracing::error!(%error, "cannot accept connections");
                sleep(ACCEPT_PAUSE).await;
            }
        }
    }
    drop(listener);
    drain(graceful, &state).await;
}

/// Waits until another connection may be open, then for a client.
///
/// Cancel safety: no connection is lost, because accepting is cancel safe itself and nothing is
/// awaited after it.
async fn accept(listener: &TcpListener, permits: &Arc<Semaphore>) -> io::Result<Accepted> {
    let permit = permits
        .clone()
        .acquire_owned()
        .await
        .map_err(io::Error::other)?;
    let (stream, peer) = listener.accept().await?;
    stream.set_nodelay(true)?;
    Ok(Accepted {
        stream,
        peer,
        permit,
    })
}

/// Serves one connection on a task of its own.
fn spawn_connection(
    accepted: Accepted,
    router: &Router,
    state: &AppState,
    graceful: &GracefulShutdown,
) {
    let Accepted {
        stream,
        peer,
        permit,
    } = accepted;
    let connection = graceful.watch(connect(stream, peer, router, state));
    tokio::spawn(async move {
        // Timeouts and resets of single clients are nothing that operators need to know.
        if let Err(error) = connection.await {
            tracing::debug!(%peer, %error, "connection ended");
        }
        drop(permit);
    });
}

fn connect(stream: TcpStream, peer: SocketAddr, router: &Router, state: &AppState) -> Connection {
    let service = router
        .clone()
        .map_request(move |request: Request<Incoming>| {
            let mut request = request.map(Body::new);
            request.extensions_mut().insert(Peer(peer));
            request
        });
    let service = TowerToHyperService::new(BoxCloneService::new(service));
    http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(Duration::from_millis(state.http.header_timeout_ms))
        .max_header_size(state.http.max_header_bytes)
        .serve_connection(TokioIo::new(stream), service)
}

/// Lets requests under way end, by themselves first and then with an error.
async fn drain(graceful: GracefulShutdown, state: &AppState) {
    tracing::info!(connections = graceful.count(), "draining");
    let mut finished = pin!(graceful.shutdown());
    let allowed = Duration::from_millis(state.http.drain_timeout_ms);
    if timeout(allowed, &mut finished).await.is_ok() {
        return;
    }
    tracing::warn!("the time for draining is over; requests under way get shutting_down");
    state.stopping.cancel();
    if timeout(LAST_ANSWERS, &mut finished).await.is_err() {
        tracing::warn!("some connections would not end");
    }
}
