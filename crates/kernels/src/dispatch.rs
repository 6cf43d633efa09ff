//! The one way in which a kernel is chosen by instruction set.
//!
//! See the crate's documentation for the convention that this macro relies on.

/// Calls the function of this name in the module `scalar`, `avx2` or `avx512` that the caller sees,
/// whichever the [`Simd`](crate::Simd) token stands for; its value is the function's.
///
/// `dispatch!(simd, kernel(first, second))` is the usual form. CPUs with AMX use the `avx512`
/// module; `dispatch!(simd, kernel(first, second), amx)` sends them to a module `amx` instead.
/// Arguments are plain names, so that no caller's expression is evaluated inside the `unsafe`
/// block.
macro_rules! dispatch {
    ($simd:expr, $kernel:ident($($argument:ident),* $(,)?)) => {
        $crate::dispatch::dispatch!($simd, $kernel($($argument),*), avx512)
    };
    ($simd:expr, $kernel:ident($($argument:ident),* $(,)?), $highest:ident) => {
        match $simd.level() {
            $crate::SimdLevel::Scalar => scalar::$kernel($($argument),*),
            #[cfg(target_arch = "x86_64")]
            $crate::SimdLevel::Avx2 => {
                // SAFETY: a token of this level exists only where the CPU has AVX2, FMA and
                // POPCNT, which are all that functions in `avx2` modules are compiled for.
                unsafe { avx2::$kernel($($argument),*) }
            }
            #[cfg(target_arch = "x86_64")]
            $crate::SimdLevel::Avx512 => {
                // SAFETY: a token of this level exists only where the CPU has AVX-512 F, BW, DQ,
                // VL and VNNI on top of what AVX2 modules need, which are all that
                // functions in `avx512` modules are compiled for.
                unsafe { avx512::$kernel($($argument),*) }
            }
            #[cfg(target_arch = "x86_64")]
            $crate::SimdLevel::Amx => {
                // SAFETY: a token of this level exists only where the CPU has AMX tiles, AVX-512
                // BF16 and everything that the level below it stands for.
                unsafe { $highest::$kernel($($argument),*) }
            }
            #[cfg(not(target_arch = "x86_64"))]
            level => unreachable!("a token for {level} cannot exist on this architecture"),
        }
    };
}
pub(crate) use dispatch;
