//! Comparing every kernel with its scalar reference on the machine at hand.
//!
//! Tests run on some CPUs only; others may have instruction sets that no test has seen, or defects.
//! So before the program computes anything, every kernel is run on small inputs at the chosen
//! level, which takes a few milliseconds, and a level that computes something else is refused.

use crate::similarity;
use crate::{Simd, SimdError, attention, elementwise, gemm, homography, quantise, scan, simd};
use std::sync::OnceLock;

/// Compares one kernel at one level with its scalar reference or its definition on small odd inputs
/// and describes the first difference.
type Check = fn(Simd) -> Result<(), String>;

/// The check of every kernel, by the kernel's name.
const CHECKS: &[(&str, Check)] = &[
    ("homography", homography::check),
    ("scan", scan::check),
    ("quantise", quantise::check),
    ("similarity", similarity::check),
    ("gemm", gemm::check),
    ("elementwise", elementwise::check),
    ("attention", attention::check),
];

/// Chooses the level ([`simd::try_selected`]) and runs the check of every kernel at it: a few
/// milliseconds, once in a process however often it is called.
///
/// # Errors
/// The environment variable `PLACEFORMER_SIMD` names no level, or one that this CPU lacks; or a
/// kernel disagrees with its scalar reference.
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
    fn every_level_of_this_cpu_agrees_with_the_scalar_reference() {
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
