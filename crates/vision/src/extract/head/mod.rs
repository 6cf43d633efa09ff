//! The linear projection from the pooled tokens to the global descriptor (paper III-A).
//!
//! A head is fitted to the tokens of one backbone and to one way of pooling them; with any other
//! tokens it would give vectors that look right and find nothing. So it carries the identity of its
//! backbone and its pooling, and is refused elsewhere.
//!
//! The pooled vector is L2-normalised, multiplied by W `[256, d]`, shifted by b `[256]`, and
//! L2-normalised again. `projection` does that; `check` refuses heads that cannot; `file` reads and
//! writes heads, and knows those that are built into the binary.

mod check;
mod file;
mod projection;
#[cfg(test)]
mod tests;

pub use projection::Head;
