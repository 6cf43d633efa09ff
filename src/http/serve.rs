//! Connections: how many, how long they may dawdle, and how they end.

use super::auth::Peer;
use super::{AppState, app};
use axum::body::Body;
use axum::extract::Request;
use hyper::body::Incoming;
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::server::graceful::GracefulShutdown;
use hyper_util::service::TowerToHyperService;
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

/// Pause after a failed accept (out of file descriptors, mostly), so that the loop does not spin.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);
/// Time for the last answers to leave once draining is over.
const LAST_WORDS: Duration = Duration::from_secs(2);

/// Serves until `shutdown` resolves, then drains: readiness fails at once, connections are refused
/// after the drain delay, and what is still running at the end of the drain time is answered with
/// `shutting_down`.
pub async fn serve(listener: TcpListener, state: AppState, shutdown: impl Future<Output = ()>) {
    let router = app(state.clone());
    let graceful = GracefulShutdown::new();
    let places = Arc::new(Semaphore::new(state.http.max_connections));
    let leaving = async {
        shutdown.await;
        state.health.draining();
        sleep(Duration::from_millis(state.http.drain_delay_ms)).await;
    };
    let mut leaving = pin!(leaving);
    loop {
        let accepted = tokio::select! {
            accepted = accept(&listener, &places) => accepted,
            () = &mut leaving => break,
        };
        match accepted {
            Ok((stream, peer, place)) => {
                let connection = connect(stream, peer, &router, &state);
                let connection = graceful.watch(connection);
                tokio::spawn(async move {
                    // Timeouts and resets of single clients are no event for operators.
                    if let Err(error) = connection.await {
                        tracing::debug!(%peer, %error, "connection ended");
                    }
                    drop(place);
                });
            }
            Err(error) => {
                tracing::error!(%error, "cannot accept connections");
                sleep(ACCEPT_PAUSE).await;
            }
        }
    }
    drop(listener);
    drain(graceful, &state).await;
}

/// Waits for a place, then for a client.
///
/// Cancel safety: no connection is lost, as `accept` itself is cancel safe.
async fn accept(
    listener: &TcpListener,
    places: &Arc<Semaphore>,
) -> io::Result<(TcpStream, SocketAddr, OwnedSemaphorePermit)> {
    let place = places
        .clone()
        .acquire_owned()
        .await
        .map_err(io::Error::other)?;
    let (stream, peer) = listener.accept().await?;
    stream.set_nodelay(true)?;
    Ok((stream, peer, place))
}

type Connection = http1::Connection<
    TokioIo<TcpStream>,
    TowerToHyperService<
        tower::util::BoxCloneService<
            Request<Incoming>,
            axum::response::Response,
            std::convert::Infallible,
        >,
    >,
>;

fn connect(
    stream: TcpStream,
    peer: SocketAddr,
    router: &axum::Router,
    state: &AppState,
) -> Connection {
    let service = router
        .clone()
        .map_request(move |request: Request<Incoming>| {
            let mut request = request.map(Body::new);
            request.extensions_mut().insert(Peer(peer));
            request
        });
    http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(Duration::from_millis(state.http.header_timeout_ms))
        .max_header_size(state.http.max_header_bytes)
        .serve_connection(
            TokioIo::new(stream),
            TowerToHyperService::new(tower::util::BoxCloneService::new(service)),
        )
}

async fn drain(graceful: GracefulShutdown, state: &AppState) {
    tracing::info!(connections = graceful.count(), "draining");
    let mut finished = pin!(graceful.shutdown());
    let allowed = Duration::from_millis(state.http.drain_timeout_ms);
    if timeout(allowed, &mut finished).await.is_ok() {
        return;
    }
    tracing::warn!(
        "the time for draining is over; what is still running is answered with shutting_down"
    );
    state.stopping.cancel();
    if timeout(LAST_WORDS, &mut finished).await.is_err() {
        tracing::warn!("some connections would not end");
    }
}
