//! SIMD inner loops with scalar twins. The only `unsafe` code of the crate.
//!
//! | module | holds |
//! |---|---|
//! | [`scan`] | one int8 vector against many: bounds on their distances, for the search |
//! | [`simd`] | which instructions may be used: chosen once at start, or forced by `PLACEFORMER_SIMD` |
//! | [`homography`] | four-point homographies and inlier counts, in vectors |
//! | [`similarity`] | best partners among int8 descriptors: running row and column maxima |
//! | [`gemm`], [`elementwise`], [`attention`] | the transformer: packed products, what lies between them, blocked softmax attention |
//! | [`quantise`] | f32 vectors to int8 codes |
//! | [`peak`] | what the machine can do at most, for benchmarks |
//! | [`operand`], `dot` | the formats of a product: f32, bf16, int8 |
//! | `lanes`, `tiles`, [`aligned`] | vector registers by level; matrix registers (AMX); buffers on cache lines |
//! | `transpose` | words of rows to words of columns |
//!
//! Every kernel takes a [`Simd`] and has a portable twin, which tests compare it with over odd
//! sizes. Where tests ran on a CPU without AVX-512 or AMX, that level is still guarded:
//! [`self_check`] compares every kernel with its twin on the machine at hand before the program
//! computes anything, and a level that disagrees is refused with an error.

pub mod aligned;
pub mod attention;
mod dispatch;
pub mod elementwise;
pub mod gemm;
#[allow(
    clippy::needless_range_loop,
    reason = "lanes, corners and halves index several arrays at once"
)]
pub mod homography;
mod lanes;
pub mod operand;
pub mod peak;
#[allow(
    clippy::needless_range_loop,
    reason = "lanes index several arrays at once"
)]
pub mod quantise;
#[allow(dead_code)]
mod registers;
pub mod scan;
pub mod simd;
#[allow(
    clippy::needless_range_loop,
    reason = "sections and halves index several arrays at once"
)]
pub mod similarity;
mod testing;
mod transpose;

use std::sync::OnceLock;

pub use simd::{Simd, SimdError, SimdLevel};

fn greatest_common_divisor(mut a: usize, mut b: usize) -> usize {
    while b > 0 {
        (a, b) = (b, a % b);
    }
    a
}

/// Compares one kernel at one level with its scalar twin on small odd inputs; tells the first
/// difference.
type Check = fn(Simd) -> Result<(), String>;

/// Every kernel's check, by the kernel's name.
const CHECKS: &[(&str, Check)] = &[
    ("homography", homography::check),
    ("scan", scan::check),
    ("quantise", quantise::check),
    ("similarity", similarity::check),
    ("gemm", gemm::check),
    ("elementwise", elementwise::check),
    ("attention", attention::check),
];

/// Chooses the level and compares every kernel at it with its scalar twin: a few milliseconds, once
/// in a process however often it is asked.
///
/// # Errors
/// `PLACEFORMER_SIMD` names no level or one this CPU lacks; or a kernel disagrees with its twin.
pub fn self_check() -> Result<Simd, SimdError> {
    static OUTCOME: OnceLock<Result<Simd, SimdError>> = OnceLock::new();
    let check = || {
        let simd = simd::try_selected()?;
        check_level(simd, CHECKS)?;
        Ok(simd)
    };
    OUTCOME.get_or_init(check).clone()
}

fn check_level(simd: Simd, checks: &[(&'static str, Check)]) -> Result<(), SimdError> {
    for &(kernel, check) in checks {
        check(simd).map_err(|difference| SimdError::Disagrees {
            kernel,
            level: simd.level(),
            difference,
        })?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_level_of_this_cpu_agrees_with_the_scalar_twins() {
        for simd in Simd::all() {
            check_level(simd, CHECKS).unwrap();
        }
    }

    #[test]
    fn a_kernel_that_disagrees_is_refused_by_name() {
        let wrong: &[(&str, Check)] = &[
            ("fine", |_| Ok(())),
            ("broken", |_| Err("3 is not 4".into())),
        ];
        let error = check_level(Simd::SCALAR, wrong).unwrap_err().to_string();
        assert!(
            error.contains("broken") && error.contains("3 is not 4"),
            "{error}"
        );
    }
}
