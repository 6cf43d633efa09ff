//! What a connection is doing, as far as it matters to who may be cut off.

use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// What a connection is doing. Its own task writes it; whoever looks for a connection to cut off
/// reads it.
#[derive(Debug)]
pub(super) struct Activity(Mutex<State>);

#[derive(Debug)]
struct State {
    /// Requests that have arrived with their head and whose answer is not yet made and handed over
    /// for writing.
    requests: usize,
    /// Since when an answer has waited for the client to take it.
    stalled_since: Option<Instant>,
    /// Since when there has been no request.
    idle_since: Instant,
    /// Whether the client has sent anything.
    has_received: bool,
    /// Whether the client took an answer too slowly.
    was_too_slow: bool,
}

impl Activity {
    /// Of a connection that was just accepted.
    pub(super) fn new() -> Self {
        Self(Mutex::new(State {
            requests: 0,
            stalled_since: None,
            idle_since: Instant::now(),
            has_received: false,
            was_too_slow: false,
        }))
    }

    /// The state. It is only ever replaced field by field, so that it is whole after a panic, too.
    fn state(&self) -> MutexGuard<'_, State> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Bytes have come from the client.
    pub(super) fn received(&self) {
        self.state().has_received = true;
    }

    /// The head of a request is complete.
    pub(super) fn request_began(&self) {
        self.state().requests += 1;
    }

    /// The answer was handed over for writing, or its client has left.
    pub(super) fn request_ended(&self) {
        let mut state = self.state();
        state.requests = state.requests.saturating_sub(1);
        state.idle_since = Instant::now();
    }

    /// An answer waits for the client to take it.
    pub(super) fn stalled(&self) {
        let mut state = self.state();
        state.stalled_since.get_or_insert_with(Instant::now);
    }

    /// Everything that was to be written is written.
    pub(super) fn flushed(&self) {
        let mut state = self.state();
        if state.stalled_since.take().is_some() {
            state.idle_since = Instant::now();
        }
    }

    /// The client took an answer too slowly, which ends the connection.
    pub(super) fn too_slow(&self) {
        self.state().was_too_slow = true;
    }

    /// Whether the connection ended because the client took an answer too slowly.
    pub(super) fn was_too_slow(&self) -> bool {
        self.state().was_too_slow
    }

    /// How long there has been neither a request nor an answer; `None` if there is one.
    pub(super) fn idle_time(&self) -> Option<Duration> {
        let state = self.state();
        let is_idle = state.requests == 0 && state.stalled_since.is_none();
        is_idle.then(|| state.idle_since.elapsed())
    }

    /// How long the client alone has kept the server waiting, be it for a request or by not taking
    /// an answer; `None` while the server works on a request.
    pub(super) fn waiting_time(&self) -> Option<Duration> {
        let state = self.state();
        match (state.requests, state.stalled_since) {
            (_, Some(since)) => Some(since.elapsed()),
            (0, None) => Some(state.idle_since.elapsed()),
            _ => None,
        }
    }

    /// How long the client has sent nothing since it connected; `None` once it has.
    pub(super) fn silent_time(&self) -> Option<Duration> {
        let state = self.state();
        (!state.has_received).then(|| state.idle_since.elapsed())
    }
}
