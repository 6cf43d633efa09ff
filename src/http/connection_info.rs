//! What layers need to know about the connection of a request.

/// The connection that a request came over, as an extension of the request. Requests that tests
/// give to the router directly have none.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ConnectionInfo {
    /// Whether it is one of those kept for probes.
    pub is_reserved: bool,
    /// Whether the listener is reached from this machine alone.
    pub is_loopback: bool,
    /// Whether it is encrypted.
    pub is_tls: bool,
}
