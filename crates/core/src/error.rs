//! The one table of error codes: what a caller can rely on when something goes wrong.
//!
//! Every stage's error maps to one [`ErrorCode`]; the table gives its HTTP status, title and
//! whether trying again may help. `problem+json`, OpenAPI, metrics and the documentation all read
//! this table and nothing else.

use serde::Serialize;

macro_rules! error_codes {
    ($($(#[$doc:meta])* $variant:ident = $code:literal, $status:literal, $retryable:literal, $title:literal;)*) => {
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

            /// A short, fixed sentence for people.
            pub fn title(self) -> &'static str {
                match self { $(Self::$variant => $title,)* }
            }
        }
    };
}

error_codes! {
    /// The request cannot be parsed.
    MalformedRequest = "malformed_request", 400, false, "The request cannot be understood";
    /// A parameter is missing, unknown, of the wrong type or out of range.
    InvalidParameter = "invalid_parameter", 400, false, "A parameter is not valid";
    /// No image bytes were sent.
    EmptyImage = "empty_image", 400, false, "The image is empty";
    /// No or wrong credentials.
    Unauthorized = "unauthorized", 401, false, "Credentials are missing or wrong";
    /// The credentials do not allow this.
    Forbidden = "forbidden", 403, false, "These credentials do not allow this";
    /// No such route.
    RouteNotFound = "route_not_found", 404, false, "There is nothing at this path";
    /// No such map.
    MapNotFound = "map_not_found", 404, false, "The map does not exist";
    /// No such reference.
    ReferenceNotFound = "reference_not_found", 404, false, "The reference does not exist";
    /// The path exists, the method does not.
    MethodNotAllowed = "method_not_allowed", 405, false, "The path does not support this method";
    /// The body did not arrive in time.
    RequestTimeout = "request_timeout", 408, true, "The request took too long to arrive";
    /// The external id belongs to other content.
    ExternalIdConflict = "external_id_conflict", 409, false, "The external id is taken by another image";
    /// The map was built with another model.
    ModelMismatch = "model_mismatch", 409, false, "The map was built with another model";
    /// The calibration belongs to another model or another re-ranking.
    CalibrationMismatch = "calibration_mismatch", 409, false, "The calibration was fitted for something else";
    /// The head is made for other tokens than the map keeps, or pools them otherwise.
    HeadMismatch = "head_mismatch", 409, false, "The head does not fit the map";
    /// The body is larger than allowed.
    BodyTooLarge = "body_too_large", 413, false, "The body is too large";
    /// The image has more pixels, or a longer side, than allowed.
    ImageTooLarge = "image_too_large", 413, false, "The image has too many pixels";
    /// The body's or image's type is not supported.
    UnsupportedMediaType = "unsupported_media_type", 415, false, "The media type is not supported";
    /// The bytes are not a readable image.
    ImageUndecodable = "image_undecodable", 422, false, "The image cannot be decoded";
    /// The bytes are not a head.
    HeadUnreadable = "head_unreadable", 422, false, "The head cannot be read";
    /// The key has used up its rate.
    RateLimited = "rate_limited", 429, true, "Too many requests with this key";
    /// The request asked for nothing the server could finish before its client left.
    ClientGone = "client_gone", 499, true, "The client left before the answer was ready";
    /// A stored record fails its checksum.
    CorruptRecord = "corrupt_record", 500, false, "A stored record is damaged";
    /// A fault of the server.
    Internal = "internal", 500, true, "The server failed";
    /// The queue is full, or too long to wait in.
    Overloaded = "overloaded", 503, true, "The server is at capacity";
    /// Still starting.
    NotReady = "not_ready", 503, true, "The server is still starting";
    /// Stopping.
    ShuttingDown = "shutting_down", 503, true, "The server is stopping";
    /// Memory is short, so nothing new is taken in.
    MemoryPressure = "memory_pressure", 503, true, "The server is short of memory";
    /// The deadline passed before any answer was ready.
    DeadlineExceeded = "deadline_exceeded", 504, true, "The deadline passed";
    /// No space is left to store it.
    DiskFull = "disk_full", 507, true, "The disk is full";
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::HashSet;

    #[test]
    fn codes_are_distinct_and_statuses_are_errors() {
        let names: HashSet<_> = ErrorCode::ALL.iter().map(|code| code.as_str()).collect();
        assert_eq!(names.len(), ErrorCode::ALL.len());
        assert!(
            ErrorCode::ALL
                .iter()
                .all(|code| (400..600).contains(&code.status()))
        );
    }
}
