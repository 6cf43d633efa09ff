//! The inner loops of PlaceFormer, written for the vector instructions of the CPU at hand. This is
//! the only crate of the project with `unsafe` code.
//!
//! Extraction, search and re-ranking spend nearly all their time in a few loops. With vector
//! instructions these are five to fifty times as fast as without, but a program for every CPU must
//! find out at start which instructions there are. Every kernel here therefore exists for several
//! instruction sets, takes a token ([`Simd`]) that tells which one to use, and has a portable
//! version (`scalar`) as the reference for the others.
//!
//! Vector instructions are supported on x86-64 only: AVX2, AVX-512 and AMX. On other architectures,
//! such as aarch64, everything builds and computes the same with the portable version, slowly.
//!
//! | module | computes |
//! |---|---|
//! | [`gemm`] | matrix products with a packed right-hand side, in f32, bf16 and int8 |
//! | [`operand`] | the number formats of products; packing of left-hand sides |
//! | [`elementwise`] | LayerNorm, softmax, and the epilogues of products (bias, GELU, residual) |
//! | [`attention`] | softmax attention of a block of query tokens |
//! | [`scan`] | bounds on the distances between one global descriptor and many |
//! | [`similarity`] | the best partner of every local descriptor of two images |
//! | [`homography`] | RANSAC's homographies of four correspondences, and inlier counts |
//! | [`quantise`] | int8 codes of f32 vectors |
//! | [`peak`] | the most that the machine can compute, for benchmarks |
//! | [`simd`] | which instruction set is used: the best, or that of `PLACEFORMER_SIMD` |
//! | [`aligned`] | buffers that start on a cache line |
//! | `registers` | vector registers as types that only code for their instruction set can make |
//! | `transpose` | transposition of blocks of words |
//!
//! # How a kernel is organised
//!
//! A kernel is a folder. `mod.rs` has the public functions, which check their arguments and then
//! call `dispatch!(simd, kernel(arguments))`. That macro is the one way from a token to code: it
//! calls the function `kernel` in the module `scalar`, `avx2`, `avx512` or, if asked for, `amx` of
//! the folder. In the last three, functions are compiled for their instructions by
//! `#[target_feature]`. Calling them is unsafe on a CPU that lacks those; the token proves that
//! this one has them, since [`Simd`] cannot be made for a level that the CPU lacks.
//!
//! Where the algorithm is the same for every instruction set, it is written once as a generic
//! function over the traits in `registers`, and the four modules call it with their registers.
//! Where the algorithm depends on particular instructions, the modules differ.
//!
//! Modules with x86 intrinsics or assembly are behind `cfg(target_arch = "x86_64")`, so no other
//! target sees them; a test keeps them out of every other module.
//!
//! # How results are kept right
//!
//! `check.rs` in each folder compares a level with the portable version, and [`self_check()`] runs
//! all of them on the machine at hand before the program computes anything. Property tests do the
//! same over many sizes. Integers agree exactly everywhere; for floats each kernel tells whether
//! its bits are the same at every level.

pub mod aligned;
pub mod attention;
mod dispatch;
pub mod elementwise;
pub mod gemm;
pub mod homography;
pub mod operand;
pub mod peak;
pub mod quantise;
mod registers;
pub mod scan;
mod self_check;
pub mod simd;
pub mod similarity;
mod testing;
mod transpose;

pub use self_check::self_check;
pub use simd::{Simd, SimdError, SimdLevel};

fn greatest_common_divisor(mut a: usize, mut b: usize) -> usize {
    while b > 0 {
        (a, b) = (b, a % b);
    }
    a
}
