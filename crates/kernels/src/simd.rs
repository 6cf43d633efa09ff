//! Which instructions the kernels may use, decided once at start.
//!
//! A kernel takes a [`Simd`] token and runs the code for the token's [`level`](Simd::level). The
//! token cannot be made for a level that the CPU lacks, so it proves that calling functions that
//! were compiled for the level's instructions is sound. [`selected`] is what the process uses: the
//! highest level of the CPU, or the one that `PLACEFORMER_SIMD` names. Asking for a level that the
//! CPU lacks is an error; a lower one is never chosen silently.

#[cfg(target_arch = "x86_64")]
use crate::registers::{amx, avx2, avx512};
use std::fmt;
use std::str::FromStr;
use std::sync::OnceLock;

/// The environment variable that forces a level: `scalar`, `avx2`, `avx512` or `amx`.
pub const SIMD_VARIABLE: &str = "PLACEFORMER_SIMD";

/// A set of instructions. Each level includes those before it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum SimdLevel {
    /// Portable Rust, the reference that every other level is compared with.
    Scalar,
    /// AVX2, FMA, F16C and POPCNT.
    Avx2,
    /// AVX-512 F, BW, DQ, VL and VNNI on top of [`SimdLevel::Avx2`].
    Avx512,
    /// Matrix products of bf16 and int8 (AMX), and AVX-512 BF16, on top of [`SimdLevel::Avx512`].
    Amx,
}

impl SimdLevel {
    /// Every level, ascending.
    pub const ALL: [Self; 4] = [Self::Scalar, Self::Avx2, Self::Avx512, Self::Amx];

    /// The name [`SIMD_VARIABLE`] takes.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Scalar => "scalar",
            Self::Avx2 => "avx2",
            Self::Avx512 => "avx512",
            Self::Amx => "amx",
        }
    }

    #[cfg(target_arch = "x86_64")]
    fn is_available(self) -> bool {
        match self {
            Self::Scalar => true,
            Self::Avx2 => avx2::is_available(),
            Self::Avx512 => avx2::is_available() && avx512::is_available(),
            Self::Amx => Self::Avx512.is_available() && avx512::has_bf16() && amx::is_available(),
        }
    }

    #[cfg(not(target_arch = "x86_64"))]
    fn is_available(self) -> bool {
        self == Self::Scalar
    }
}

impl fmt::Display for SimdLevel {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

impl FromStr for SimdLevel {
    type Err = SimdError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        Self::ALL
            .into_iter()
            .find(|level| level.as_str() == text)
            .ok_or_else(|| SimdError::UnknownLevel {
                value: text.to_owned(),
            })
    }
}

/// Why no level could be chosen, or why the chosen one may not be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum SimdError {
    /// The environment variable is not the name of a level.
    #[error(
        "{SIMD_VARIABLE}={value:?} is not a SIMD level; use scalar, avx2, avx512 or amx, \
         or leave it unset"
    )]
    UnknownLevel {
        /// Its value.
        value: String,
    },
    /// The CPU lacks instructions of the level asked for.
    #[error("SIMD level {asked} was asked for, but this CPU goes no further than {best}")]
    Unavailable {
        /// The level asked for.
        asked: SimdLevel,
        /// The highest the CPU has.
        best: SimdLevel,
    },
    /// A kernel gave another result than its scalar reference.
    #[error(
        "the {level} kernel {kernel} disagrees with its scalar twin ({difference}); \
         refusing to compute with it: set {SIMD_VARIABLE} to a lower level and report this CPU"
    )]
    Disagrees {
        /// The kernel.
        kernel: &'static str,
        /// The level it ran at.
        level: SimdLevel,
        /// What differed, and on which input.
        difference: String,
    },
}

/// Proof that the CPU has the instructions of a level.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Simd {
    // Private, because unsafe blocks rely on it: a value exists only if its level is available.
    level: SimdLevel,
}

impl Simd {
    /// The portable level, which every CPU has.
    pub const SCALAR: Self = Self {
        level: SimdLevel::Scalar,
    };

    /// The token of `level`.
    ///
    /// # Errors
    /// [`SimdError::Unavailable`] if the CPU lacks the level.
    pub fn new(level: SimdLevel) -> Result<Self, SimdError> {
        if level.is_available() {
            Ok(Self { level })
        } else {
            Err(SimdError::Unavailable {
                asked: level,
                best: Self::best().level,
            })
        }
    }

    /// The highest level of this CPU.
    pub fn best() -> Self {
        Self::all().last().unwrap_or(Self::SCALAR)
    }

    /// Every level of this CPU, ascending. Tests run kernels at all of them.
    pub fn all() -> impl Iterator<Item = Self> {
        SimdLevel::ALL
            .into_iter()
            .filter(|level| level.is_available())
            .map(|level| Self { level })
    }

    /// The lower of this level and `limit`.
    pub fn at_most(self, limit: SimdLevel) -> Self {
        // Each level includes those before it.
        Self {
            level: self.level.min(limit),
        }
    }

    /// The level proven.
    pub fn level(self) -> SimdLevel {
        self.level
    }

    /// Whether products of bf16 (`vdpbf16ps`) may be used too: not every CPU of
    /// [`SimdLevel::Avx512`] has them.
    pub fn has_bf16_dot(self) -> bool {
        #[cfg(target_arch = "x86_64")]
        return self.level >= SimdLevel::Avx512 && avx512::has_bf16();
        #[cfg(not(target_arch = "x86_64"))]
        return false;
    }
}

/// The level for a value of [`SIMD_VARIABLE`]: the best of the CPU if it is unset or empty.
fn choose(forced: Option<&str>) -> Result<Simd, SimdError> {
    match forced.map(str::trim).filter(|text| !text.is_empty()) {
        Some(text) => Simd::new(text.parse()?),
        None => Ok(Simd::best()),
    }
}

static SELECTED: OnceLock<Result<Simd, SimdError>> = OnceLock::new();

/// The level that this process computes with. The environment variable is read by the first call
/// only.
///
/// # Errors
/// The variable names no level, or one that the CPU lacks. Programs call this at start, through
/// [`self_check`](super::self_check()), and stop on an error.
pub fn try_selected() -> Result<Simd, SimdError> {
    let read = || {
        let value = std::env::var_os(SIMD_VARIABLE);
        choose(
            value
                .map(|value| value.to_string_lossy().into_owned())
                .as_deref(),
        )
    };
    SELECTED.get_or_init(read).clone()
}

/// As [`try_selected`], for code that runs after a program has checked at start.
///
/// # Panics
/// If `try_selected` fails: computing with other instructions than those asked for would hide the
/// error.
pub fn selected() -> Simd {
    match try_selected() {
        Ok(simd) => simd,
        Err(error) => panic!("{error}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_available_level_can_be_forced_and_no_other() {
        let available: Vec<_> = Simd::all().map(Simd::level).collect();
        assert_eq!(available[0], SimdLevel::Scalar);
        for level in SimdLevel::ALL {
            let chosen = choose(Some(level.as_str())).map(Simd::level);
            if available.contains(&level) {
                assert_eq!(chosen, Ok(level));
            } else {
                assert_eq!(
                    chosen,
                    Err(SimdError::Unavailable {
                        asked: level,
                        best: Simd::best().level()
                    })
                );
            }
        }
    }

    #[test]
    fn unset_or_empty_means_the_best_and_nonsense_is_refused_by_name() {
        assert_eq!(choose(None), Ok(Simd::best()));
        assert_eq!(choose(Some("  ")), Ok(Simd::best()));
        let message = choose(Some("sse9")).unwrap_err().to_string();
        assert!(
            message.contains("sse9") && message.contains("avx2"),
            "{message}"
        );
    }
}
