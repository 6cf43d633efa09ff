//! Answers in JSON, whose memory is reserved while they are written and until their clients have
//! taken them.
//!
//! A listing has megabytes, and its client may take its time. So its bytes count against a budget
//! for as long as any of them waits in this process; an answer that would exceed the budget is
//! `overloaded` instead. Short answers are free: the number of connections bounds them.

use super::codec::Workload;
use super::memory_budget::{MemoryBudget, Reservation};
use super::problem::ApiError;
use super::state::AppState;
use axum::body::Body;
use axum::http::header;
use axum::response::{IntoResponse, Response};
use bytes::Bytes;
use placeformer_core::error::ErrorCode;
use serde::Serialize;
use std::io;

/// Longest answer that takes nothing of the budget.
const FREE_BYTES: usize = 16 << 10;

/// Makes the value that `make` returns into an answer, on a thread where that holds nobody up.
///
/// # Errors
/// `overloaded` if too many bytes of answers wait to be taken.
pub async fn json<T: Serialize>(
    state: &AppState,
    workload: Workload,
    make: impl FnOnce() -> T + Send + 'static,
) -> Result<Response, ApiError> {
    let shared = state.clone();
    let write = move || {
        let mut writer = BudgetedWriter::new(&shared.answer_budget);
        match serde_json::to_writer(&mut writer, &make()) {
            Ok(()) => Ok(writer.finish()),
            Err(error) => Err(writer.failure(&error)),
        }
    };
    let bytes = state.codec.run(workload, write).await?;
    Ok(respond(bytes, "application/json"))
}

/// An answer of bytes whose memory is reserved already.
pub fn respond(bytes: Bytes, content_type: &'static str) -> Response {
    ([(header::CONTENT_TYPE, content_type)], Body::from(bytes)).into_response()
}

/// A buffer that reserves its memory as it grows.
pub struct BudgetedWriter<'a> {
    bytes: Vec<u8>,
    budget: &'a MemoryBudget,
    /// Covers the capacity of `bytes`; `None` as long as they are free.
    reservation: Option<Reservation>,
    /// Why no more was written.
    refusal: Option<ApiError>,
}

impl<'a> BudgetedWriter<'a> {
    /// An empty buffer.
    pub fn new(budget: &'a MemoryBudget) -> Self {
        Self {
            bytes: Vec::new(),
            budget,
            reservation: None,
            refusal: None,
        }
    }

    /// The bytes, which keep their reservation until the last clone of them is dropped.
    pub fn finish(mut self) -> Bytes {
        self.bytes.shrink_to_fit();
        match self.reservation {
            None => Bytes::from(self.bytes),
            Some(mut reservation) => {
                // Giving back cannot fail.
                let _ = reservation.resize(self.bytes.capacity());
                reservation.attach_one(self.bytes)
            }
        }
    }

    /// Why writing failed: the budget is used up, or the value cannot be written.
    pub fn failure(self, error: &dyn std::error::Error) -> ApiError {
        self.refusal.unwrap_or_else(|| {
            tracing::error!(%error, "an answer cannot be written");
            ApiError::new(ErrorCode::Internal, "the answer cannot be written")
        })
    }

    /// Makes room for so many bytes in all.
    fn grow(&mut self, needed: usize) -> Result<(), ApiError> {
        let capacity = self.bytes.capacity();
        let larger = needed.max(2 * capacity).max(FREE_BYTES);
        if larger > FREE_BYTES {
            let mut reservation = match self.reservation.take() {
                Some(reservation) => reservation,
                None => self.budget.reserve()?,
            };
            // While the bytes move, there are two buffers.
            reservation.resize(capacity + larger)?;
            self.bytes.reserve_exact(larger - self.bytes.len());
            reservation.resize(self.bytes.capacity())?;
            self.reservation = Some(reservation);
        } else {
            self.bytes.reserve_exact(larger - self.bytes.len());
        }
        Ok(())
    }
}

impl io::Write for BudgetedWriter<'_> {
    fn write(&mut self, data: &[u8]) -> io::Result<usize> {
        let needed = self.bytes.len() + data.len();
        if needed > self.bytes.capacity()
            && let Err(refusal) = self.grow(needed)
        {
            self.refusal = Some(refusal);
            return Err(io::ErrorKind::OutOfMemory.into());
        }
        self.bytes.extend_from_slice(data);
        Ok(data.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::http::config::{AuthConfig, HttpConfig};
    use crate::http::memory_budget::BufferKind;
    use crate::ops::Metrics;
    use http_body_util::BodyExt;
    use std::io::Write;
    use std::sync::Arc;

    fn budget(bytes: usize) -> MemoryBudget {
        let metrics = Arc::new(Metrics::new().unwrap());
        MemoryBudget::new(BufferKind::Answers, bytes, metrics)
    }

    #[test]
    fn a_long_answer_counts_until_its_last_byte_is_gone_and_a_short_one_never() {
        let budget = budget(192 << 10);
        let mut long = BudgetedWriter::new(&budget);
        let mut short = BudgetedWriter::new(&budget);
        long.write_all(&vec![1; 100 << 10]).unwrap();
        short.write_all(&[2; FREE_BYTES]).unwrap();
        let long = long.finish();
        assert_eq!(long.len(), 100 << 10);
        assert_eq!(short.finish().len(), FREE_BYTES);
        let last = long.slice(long.len() - 1..);
        drop(long);

        let mut second = BudgetedWriter::new(&budget);
        let refused = second.write_all(&vec![3; 100 << 10]).unwrap_err();
        assert_eq!(second.failure(&refused).code, ErrorCode::Overloaded);
        drop(last);
        let mut third = BudgetedWriter::new(&budget);
        third.write_all(&vec![3; 100 << 10]).unwrap();
    }

    /// Is written as whether the thread that writes it is another than this.
    struct Writer(std::thread::ThreadId);

    impl Serialize for Writer {
        fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
            serializer.serialize_bool(std::thread::current().id() != self.0)
        }
    }

    #[tokio::test]
    async fn answers_are_made_and_written_off_the_thread_of_the_connections() {
        let state = AppState::new(
            HttpConfig::default(),
            &AuthConfig::default(),
            1 << 20,
            Arc::new(Metrics::new().unwrap()),
            Arc::default(),
        )
        .unwrap();
        let here = std::thread::current().id();
        let make = move || (std::thread::current().id() != here, Writer(here));
        let answer = json(&state, Workload::Large, make).await.unwrap();
        let body = answer.into_body().collect().await.unwrap().to_bytes();
        assert_eq!(body, "[true,true]");
    }
}
