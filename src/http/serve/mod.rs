//! Runs the surface on a listener: which connections there are at once ([`connections`]), how long
//! a client may take to send a head or to take an answer ([`watched`]), encryption ([`tls`]), and
//! how everything ends.

mod activity;
mod connection;
mod connections;
pub mod tls;
mod watched;

use super::router::app;
use super::state::AppState;
use axum::Router;
use connection::serve_connection;
use connections::{Connections, Place};
use std::future::Future;
use std::io;
use std::net::SocketAddr;
use std::pin::pin;
use std::sync::Arc;
use std::time::Duration;
use tls::Certificate;
use tokio::net::{TcpListener, TcpStream};
use tokio::time::{sleep, timeout};
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

/// Pause after a failed accept (out of file descriptors, mostly), so that the loop does not spin.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);
/// Time for the last answers to leave once draining is over.
const LAST_ANSWERS: Duration = Duration::from_secs(2);

/// What all connections of a listener share.
struct Surface {
    router: Router,
    state: AppState,
    certificate: Option<Certificate>,
    /// Whether only this machine reaches the listener.
    is_loopback: bool,
    /// Cancelled when connections end after the answer under way.
    closing: CancellationToken,
}

/// An accepted connection.
struct Accepted {
    stream: TcpStream,
    peer: SocketAddr,
    place: Place,
}

/// Serves plain HTTP until `shutdown` resolves, then drains as [`serve_encrypted`] does.
pub async fn serve(listener: TcpListener, state: AppState, shutdown: impl Future<Output = ()>) {
    serve_encrypted(listener, state, None, shutdown).await;
}

/// Serves until `shutdown` resolves, then drains. With a `certificate` it speaks HTTPS, else HTTP.
///
/// Draining means: readiness fails at once, connections are refused after the drain delay, and
/// requests that still run at the end of the drain time are answered with `shutting_down`.
pub async fn serve_encrypted(
    listener: TcpListener,
    state: AppState,
    certificate: Option<Certificate>,
    shutdown: impl Future<Output = ()>,
) {
    let connections = Connections::new(&state.http, state.metrics.clone());
    let surface = Arc::new(Surface {
        router: app(state.clone()),
        certificate,
        is_loopback: is_loopback(&listener),
        closing: CancellationToken::new(),
        state,
    });
    let tasks = TaskTracker::new();
    let end_of_accepting = async {
        shutdown.await;
        surface.state.health.draining();
        sleep(Duration::from_millis(surface.state.http.drain_delay_ms)).await;
    };
    let mut end_of_accepting = pin!(end_of_accepting);
    loop {
        let accepted = tokio::select! {
            accepted = accept(&listener, &connections) => accepted,
            () = &mut end_of_accepting => break,
        };
        match accepted {
            Ok(Some(accepted)) => {
                tasks.spawn(serve_connection(accepted, surface.clone()));
            }
            Ok(None) => {}
            Err(error) => {
                tracing::error!(%error, "cannot accept connections");
                connections.end_idlest();
                sleep(ACCEPT_PAUSE).await;
            }
        }
    }
    drop(listener);
    drain(tasks, &surface).await;
}

/// Whether only this machine reaches `listener`; if that is not known, it counts as if others did.
fn is_loopback(listener: &TcpListener) -> bool {
    let address = listener.local_addr();
    address.is_ok_and(|address| address.ip().to_canonical().is_loopback())
}

/// Waits for a client; `None` if there is no place for it.
///
/// Cancel safety: no connection is lost, because accepting is cancel safe itself and nothing is
/// awaited after it.
async fn accept(
    listener: &TcpListener,
    connections: &Arc<Connections>,
) -> io::Result<Option<Accepted>> {
    let (stream, peer) = listener.accept().await?;
    let Some(place) = connections.admit(peer.ip()) else {
        tracing::debug!(%peer, "no place for another connection");
        return Ok(None);
    };
    Ok(Some(Accepted {
        stream,
        peer,
        place,
    }))
}

/// Lets requests under way end, by themselves first and then with an error.
async fn drain(tasks: TaskTracker, surface: &Surface) {
    tracing::info!(connections = tasks.len(), "draining");
    surface.closing.cancel();
    tasks.close();
    let allowed = Duration::from_millis(surface.state.http.drain_timeout_ms);
    if timeout(allowed, tasks.wait()).await.is_ok() {
        return;
    }
    tracing::warn!("the time for draining is over; requests under way get shutting_down");
    surface.state.stopping.cancel();
    if timeout(LAST_ANSWERS, tasks.wait()).await.is_err() {
        tracing::warn!("some connections would not end");
    }
}
