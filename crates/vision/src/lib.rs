//! From an image to its descriptor, and from descriptors to ranked places: pure computation.
//!
//! ```text
//! bytes --image--> RGB tensor --extract--> Descriptor { global [256], key patches at 3 scales }
//! global [256] --search--> candidates --rerank--> ranked places
//! ```
//!
//! The four modules never import each other; the service's pipeline composes them.

pub mod extract;
pub mod image;
pub mod rerank;
pub mod search;
