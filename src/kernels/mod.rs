//! SIMD inner loops with scalar twins. The only `unsafe` code of the crate.
