//! The one table of error codes: what a caller can rely on when something goes wrong.
//!
//! Every stage's error maps to one [`ErrorCode`]. The table gives the code's HTTP status, whether
//! trying again may help, when to try again, and a title. `problem+json`, OpenAPI, metrics and the
//! documentation all read this table and nothing else.

use serde::Serialize;

/// Declares [`ErrorCode`] and its accessors from rows of
/// `Variant = code, status, retryable, retry_after, title;`.
macro_rules! error_codes {
    ($(
        $(#[$doc:meta])*
        $variant:ident =
            $code:literal, $status:literal, $retryable:literal, $retry_after:expr, $title:literal;
    )*) => {
        /// A stable name for a kind of failure.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize)]
        #[non_exhaustive]
        pub enum ErrorCode {
            $($(#[$doc])* #[serde(rename = $code)] $variant,)*
        }

        impl ErrorCode {
            /// Every code, in the order of the table.
            pub const ALL: &'static [Self] = &[$(Self::$variant,)*];

            /// The name callers match on; never changes once released.
            pub fn as_str(self) -> &'static str {
                match self { $(Self::$variant => $code,)* }
            }

            /// The HTTP status it is answered with.
            pub fn status(self) -> u16 {
                match self { $(Self::$variant => $status,)* }
            }

            /// Whether the same request may succeed later.
            pub fn retryable(self) -> bool {
                match self { $(Self::$variant => $retryable,)* }
            }

            /// The `Retry-After` header of an answer with this code, in seconds.
            ///
            /// `Some` means that every such answer carries the header. The number is the one to
            /// send when the server knows none better for the request at hand: an empty rate
            /// limit and a full queue compute theirs. `None` means that the code itself brings no
            /// such header.
            pub fn retry_after(self) -> Option<u32> {
                match self { $(Self::$variant => $retry_after,)* }
            }

            /// A short, fixed sentence for people.
            pub fn title(self) -> &'static str {
                match self { $(Self::$variant => $title,)* }
            }
        }
    };
}

error_codes! {
    /// The request cannot be parsed.
    MalformedRequest = "malformed_request", 400, false, None,
        "The request cannot be understood";
    /// A parameter is missing, unknown, of the wrong type or out of range.
    InvalidParameter = "invalid_parameter", 400, false, None,
        "A parameter is not valid";
    /// No image bytes were sent.
    EmptyImage = "empty_image", 400, false, None,
        "The image is empty";
    /// The token of a track is not whole, or not one of this release.
    TrackMalformed = "track_malformed", 400, false, None,
        "The token of the track is damaged";
    /// The token of a track was not made by this service.
    TrackForged = "track_forged", 400, false, None,
        "The token of the track is not this service's";
    /// The token of a track is too old.
    TrackExpired = "track_expired", 400, false, None,
        "The token of the track is too old";
    /// The token of a track is of another map.
    TrackOtherMap = "track_other_map", 400, false, None,
        "The token of the track is of another map";
    /// The map has another model than when the track's token was made.
    TrackOtherModel = "track_other_model", 400, false, None,
        "The token of the track is of another model";
    /// No or wrong credentials.
    Unauthorized = "unauthorized", 401, false, None,
        "Credentials are missing or wrong";
    /// The credentials do not allow this.
    Forbidden = "forbidden", 403, false, None,
        "These credentials do not allow this";
    /// The request is addressed to a name that is not the server's.
    HostNotAllowed = "host_not_allowed", 403, false, None,
        "The server is not to be used under this name";
    /// A browser sent the request for a web page of another origin.
    CrossOrigin = "cross_origin", 403, false, None,
        "Web pages of this origin may not use the server";
    /// No such route.
    RouteNotFound = "route_not_found", 404, false, None,
        "There is nothing at this path";
    /// No such map.
    MapNotFound = "map_not_found", 404, false, None,
        "The map does not exist";
    /// No such reference.
    ReferenceNotFound = "reference_not_found", 404, false, None,
        "The reference does not exist";
    /// The path exists, the method does not.
    MethodNotAllowed = "method_not_allowed", 405, false, None,
        "The path does not support this method";
    /// The body did not arrive in time.
    RequestTimeout = "request_timeout", 408, true, None,
        "The request took too long to arrive";
    /// The external id belongs to other content.
    ExternalIdConflict = "external_id_conflict", 409, false, None,
        "The external id is taken by another image";
    /// The map was built with another model.
    ModelMismatch = "model_mismatch", 409, false, None,
        "The map was built with another model";
    /// The map has no positions, or no calibration, from which a track could be kept.
    TrackUnavailable = "track_unavailable", 409, false, None,
        "The map cannot be tracked in";
    /// The calibration belongs to another model or another re-ranking.
    CalibrationMismatch = "calibration_mismatch", 409, false, None,
        "The calibration was fitted for something else";
    /// The head is made for other tokens than the map keeps, or pools them otherwise.
    HeadMismatch = "head_mismatch", 409, false, None,
        "The head does not fit the map";
    /// The body is larger than allowed.
    BodyTooLarge = "body_too_large", 413, false, None,
        "The body is too large";
    /// The image has more pixels, or a longer side, than allowed.
    ImageTooLarge = "image_too_large", 413, false, None,
        "The image has too many pixels";
    /// The body's or image's type is not supported.
    UnsupportedMediaType = "unsupported_media_type", 415, false, None,
        "The media type is not supported";
    /// The bytes are not a readable image.
    ImageUndecodable = "image_undecodable", 422, false, None,
        "The image cannot be decoded";
    /// The image shows nothing by which a place could be known.
    ImageUninformative = "image_uninformative", 422, false, None,
        "The image shows nothing to know a place by";
    /// The bytes are not a head.
    HeadUnreadable = "head_unreadable", 422, false, None,
        "The head cannot be read";
    /// The key has used up its rate.
    RateLimited = "rate_limited", 429, true, Some(1),
        "Too many requests with this key";
    /// The request asked for nothing the server could finish before its client left.
    ClientGone = "client_gone", 499, true, None,
        "The client left before the answer was ready";
    /// A stored record fails its checksum.
    CorruptRecord = "corrupt_record", 500, false, None,
        "A stored record is damaged";
    /// A fault of the server.
    Internal = "internal", 500, true, None,
        "The server failed";
    /// The queue is full, or too long to wait in.
    Overloaded = "overloaded", 503, true, Some(1),
        "The server is at capacity";
    /// Still starting.
    NotReady = "not_ready", 503, true, Some(1),
        "The server is still starting";
    /// Stopping.
    ShuttingDown = "shutting_down", 503, true, Some(1),
        "The server is stopping";
    /// Memory is short, so nothing new is taken in.
    MemoryPressure = "memory_pressure", 503, true, Some(1),
        "The server is short of memory";
    /// The deadline passed before any answer was ready.
    DeadlineExceeded = "deadline_exceeded", 504, true, Some(1),
        "The deadline passed";
    /// No space is left to store it.
    DiskFull = "disk_full", 507, true, Some(30),
        "The disk is full";
    /// The files of the store are gone, exchanged, or cannot be written.
    StorageLost = "storage_lost", 507, true, Some(30),
        "The storage cannot be written";
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::HashSet;

    #[test]
    fn codes_are_distinct_and_statuses_are_errors() {
        let names: HashSet<_> = ErrorCode::ALL.iter().map(|code| code.as_str()).collect();
        assert_eq!(names.len(), ErrorCode::ALL.len());
        for code in ErrorCode::ALL {
            assert!((400..600).contains(&code.status()), "{code:?}");
        }
    }

    #[test]
    fn every_refusal_for_want_of_capacity_or_time_says_when_to_come_back() {
        for code in ErrorCode::ALL {
            let asks_to_come_back = matches!(code.status(), 429 | 503 | 504 | 507);
            assert_eq!(code.retry_after().is_some(), asks_to_come_back, "{code:?}");
        }
    }

    #[test]
    fn only_retryable_codes_say_when_to_come_back_and_never_at_once() {
        for code in ErrorCode::ALL {
            if let Some(seconds) = code.retry_after() {
                assert!(code.retryable(), "{code:?}");
                assert!(seconds >= 1, "{code:?}");
            }
        }
    }
}
