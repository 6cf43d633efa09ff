//! From an image to its descriptor, and from descriptors to ranked places: pure computation.
//!
//! ```text
//! bytes --image--> RGB tensor --extract--> Descriptor { global [256], key patches at 3 scales }
//! global [256] --search--> candidates --rerank--> ranked places
//! ```
//!
//! The four modules never import each other; the service's pipeline composes them.
//!
//! All of it is portable Rust. SIMD is in `placeformer-kernels`, which has a scalar twin for every
//! kernel.

pub mod extract;
pub mod image;
pub mod rerank;
pub mod search;

#[cfg(test)]
mod golden;
#[cfg(test)]
mod tests;
