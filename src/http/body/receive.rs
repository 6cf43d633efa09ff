//! Receives a body: bounded in length, in time and in memory.

use crate::http::config::HttpConfig;
use crate::http::memory_budget::Reservation;
use crate::http::problem::ApiError;
use crate::http::state::AppState;
use axum::body::{Body, HttpBody};
use axum::extract::Request;
use bytes::Bytes;
use http_body_util::BodyExt;
use hyper::body::Frame;
use placeformer_core::error::ErrorCode;
use std::time::Duration;
use tokio::time::{Instant, timeout_at};

/// First size of the buffer of a body whose length is not known.
const FIRST_BUFFER_BYTES: usize = 16 << 10;

/// A body that has arrived.
pub(super) struct ReceivedBody {
    pub bytes: Vec<u8>,
    /// Covers the capacity of `bytes`.
    pub reservation: Reservation,
}

/// Until when a body may arrive.
struct ReceiveTimeouts {
    start: Instant,
    /// When the whole body has to be there.
    end: Instant,
    /// Longest pause between two frames.
    pause: Duration,
    /// Slowest average rate in bytes a second, after the first pause.
    rate: u64,
}

impl ReceiveTimeouts {
    fn new(config: &HttpConfig) -> Self {
        let start = Instant::now();
        Self {
            start,
            end: start + Duration::from_millis(config.body_timeout_ms),
            pause: Duration::from_millis(config.body_idle_timeout_ms),
            rate: config.min_body_bytes_per_second,
        }
    }

    /// When the next frame has to be there, after so many bytes.
    fn next(&self, received: usize) -> Instant {
        let earned = match self.rate {
            0 => Duration::MAX,
            rate => Duration::from_secs_f64(received as f64 / rate as f64),
        };
        let by_rate = self.start.checked_add(self.pause.saturating_add(earned));
        let by_rate = by_rate.unwrap_or(self.end);
        self.end.min(by_rate).min(Instant::now() + self.pause)
    }
}

/// Buffers a body of at most `limit` bytes within the body timeouts and the budget.
///
/// # Errors
/// `body_too_large`, `request_timeout`, `malformed_request` if the body breaks off, `overloaded` if
/// the budget is used up.
pub(super) async fn receive(
    state: &AppState,
    request: Request,
    limit: usize,
) -> Result<ReceivedBody, ApiError> {
    let too_large = || {
        let detail = format!("the body has more than {limit} bytes");
        ApiError::new(ErrorCode::BodyTooLarge, detail)
    };
    let mut body = request.into_body();
    let announced = HttpBody::size_hint(&body);
    if announced.lower() > limit as u64 {
        return Err(too_large());
    }
    let longest = match announced.upper().map(usize::try_from) {
        Some(Ok(upper)) => upper.min(limit),
        _ => limit,
    };
    let timeouts = ReceiveTimeouts::new(&state.http);
    let mut received = ReceivedBody {
        bytes: Vec::new(),
        reservation: state.body_budget.reserve()?,
    };
    while let Some(frame) = next_frame(&mut body, timeouts.next(received.bytes.len())).await? {
        let Ok(data) = frame.into_data() else {
            continue;
        };
        if received.bytes.len() + data.len() > limit {
            return Err(too_large());
        }
        received.append(&data, longest)?;
    }
    Ok(received)
}

/// The next frame of the body; `None` at its end.
async fn next_frame(body: &mut Body, end: Instant) -> Result<Option<Frame<Bytes>>, ApiError> {
    let Ok(frame) = timeout_at(end, body.frame()).await else {
        return Err(ApiError::new(
            ErrorCode::RequestTimeout,
            "the body stopped arriving, came too slowly or took too long",
        ));
    };
    frame
        .transpose()
        .map_err(|error| ApiError::malformed(format!("the body broke off: {error}")))
}

impl ReceivedBody {
    /// Appends to the buffer. It doubles as bytes come, but never beyond the `longest` that the
    /// body can be, so a length that a client only announces costs nothing.
    fn append(&mut self, data: &[u8], longest: usize) -> Result<(), ApiError> {
        let needed = self.bytes.len() + data.len();
        let capacity = self.bytes.capacity();
        if needed > capacity {
            let doubled = (2 * capacity).max(FIRST_BUFFER_BYTES).min(longest);
            let larger = needed.max(doubled);
            // While the bytes move, there are two buffers.
            self.reservation.resize(capacity + larger)?;
            self.bytes.reserve_exact(larger - self.bytes.len());
            self.reservation.resize(self.bytes.capacity())?;
        }
        self.bytes.extend_from_slice(data);
        Ok(())
    }
}
