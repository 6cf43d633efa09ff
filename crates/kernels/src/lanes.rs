//! One vector register of f32 at each level, so that an elementwise kernel is written once and
//! compiled three times.
//!
//! A kernel is an `#[inline(always)]` function generic over [`Lanes`]; [`at_level!`] instantiates
//! it inside one `#[target_feature]` function per level and picks among them by the
//! [`Simd`](super::Simd) token. The portable instance is the scalar twin: plain Rust on arrays, no
//! intrinsics.
//!
//! `min` and `max` follow x86: where either operand is NaN they give the second, so a kernel
//! decides by the order of its operands whether NaN survives.

#[cfg(target_arch = "x86_64")]
use std::arch::x86_64::*;

/// Added to and taken from a float below 2^22 in magnitude, it rounds to the nearest integer.
pub(super) const ROUNDING: f32 = 12_582_912.0;

/// A vector of f32.
///
/// # Safety
/// Every method may be called only where the level's instructions are available; pointers must be
/// valid for `COUNT` elements.
pub(super) trait Lanes: Copy {
    /// Elements per vector.
    const COUNT: usize;

    unsafe fn splat(value: f32) -> Self;
    unsafe fn load(from: *const f32) -> Self;
    /// One element in every place.
    unsafe fn broadcast(from: *const f32) -> Self;
    unsafe fn store(self, to: *mut f32);
    unsafe fn add(self, other: Self) -> Self;
    unsafe fn sub(self, other: Self) -> Self;
    unsafe fn mul(self, other: Self) -> Self;
    /// `self * factor + term`, fused where the level can.
    unsafe fn mul_add(self, factor: Self, term: Self) -> Self;
    unsafe fn min(self, other: Self) -> Self;
    unsafe fn max(self, other: Self) -> Self;
    /// `self * 2^n` for a whole n, -126 <= n <= 127.
    unsafe fn scale(self, n: Self) -> Self;
    /// The bits of `self` less those of `other`, both taken as i32, as floats.
    unsafe fn integer_difference(self, other: Self) -> Self;
    unsafe fn sum(self) -> f32;
    unsafe fn maximum(self) -> f32;

    /// Stores bf16, rounded to the nearest, two to a word: `COUNT / 2` words. At the highest level
    /// only where the CPU has AVX-512 BF16.
    #[inline(always)]
    unsafe fn store_bf16(self, to: *mut u32) {
        let mut values = [0.0f32; 16];
        // SAFETY: the caller vouches for the words at `to`; 16 is the longest vector.
        unsafe {
            self.store(values.as_mut_ptr());
            for (pair, values) in values[..Self::COUNT].chunks_exact(2).enumerate() {
                let bits = |value: f32| u32::from(half::bf16::from_f32(value).to_bits());
                to.add(pair)
                    .write_unaligned(bits(values[0]) | bits(values[1]) << 16);
            }
        }
    }

    /// Stores the values, rounded to the nearest, as `COUNT` bytes; they must lie in 0..=255.
    #[inline(always)]
    unsafe fn store_u8(self, to: *mut u8) {
        let mut values = [0.0f32; 16];
        // SAFETY: the caller vouches for the bytes at `to`.
        unsafe {
            self.store(values.as_mut_ptr());
            for (at, value) in values[..Self::COUNT].iter().enumerate() {
                to.add(at).write(value.round_ties_even() as u8);
            }
        }
    }

    /// The first `count` elements, the others `fill`.
    #[inline(always)]
    unsafe fn load_partial(from: *const f32, count: usize, fill: f32) -> Self {
        let mut padded = [fill; 16];
        // SAFETY: the caller vouches for `count` <= COUNT <= 16 elements at `from`.
        unsafe {
            std::ptr::copy_nonoverlapping(from, padded.as_mut_ptr(), count);
            Self::load(padded.as_ptr())
        }
    }

    /// Stores the first `count` elements.
    #[inline(always)]
    unsafe fn store_partial(self, to: *mut f32, count: usize) {
        let mut padded = [0.0f32; 16];
        // SAFETY: as above, for `to`.
        unsafe {
            self.store(padded.as_mut_ptr());
            std::ptr::copy_nonoverlapping(padded.as_ptr(), to, count);
        }
    }

    /// As [`store_bf16`](Self::store_bf16), the first `count` elements, a lone last one beside a
    /// zero.
    #[inline(always)]
    unsafe fn store_bf16_partial(self, to: *mut u32, count: usize) {
        let (mut values, mut words) = ([0.0f32; 16], [0u32; 8]);
        // SAFETY: as above, for half as many words.
        unsafe {
            self.store_partial(values.as_mut_ptr(), count);
            Self::load(values.as_ptr()).store_bf16(words.as_mut_ptr());
            std::ptr::copy_nonoverlapping(words.as_ptr(), to, count.div_ceil(2));
        }
    }

    /// The first `count` elements, the others zero.
    #[inline(always)]
    unsafe fn first(self, count: usize) -> Self {
        let mut values = [0.0f32; 16];
        // SAFETY: both are as long as the longest vector.
        unsafe {
            self.store_partial(values.as_mut_ptr(), count);
            Self::load(values.as_ptr())
        }
    }
}

/// A value at any address.
#[derive(Clone, Copy)]
#[repr(C, packed)]
struct Unaligned<T>(T);

/// The value at `place`. Where assertions are on, `read_unaligned` and the `loadu` intrinsics check
/// for overlap, and a dereferenced pointer for null, at every call: the inner loops cannot afford
/// either, and a reference is not checked.
///
/// # Safety
/// `place` must be valid for reads of `T`; it need not be aligned.
#[allow(
    clippy::transmute_ptr_to_ref,
    reason = "a dereferenced pointer is checked for null where assertions are on"
)]
#[inline(always)]
unsafe fn read<T: Copy>(place: *const f32) -> T {
    // SAFETY: the caller's; the packed type needs no alignment.
    let value: &Unaligned<T> = unsafe { std::mem::transmute(place) };
    value.0
}

/// As [`read`], for writing.
///
/// # Safety
/// `place` must be valid for writes of `T`; it need not be aligned.
#[allow(
    clippy::transmute_ptr_to_ref,
    reason = "a dereferenced pointer is checked for null where assertions are on"
)]
#[inline(always)]
unsafe fn write<T: Copy>(place: *mut f32, value: T) {
    // SAFETY: the caller's; the packed type needs no alignment.
    let target: &mut Unaligned<T> = unsafe { std::mem::transmute(place) };
    *target = Unaligned(value);
}

/// Eight floats in an array: what the compiler makes of plain Rust.
#[derive(Clone, Copy)]
pub(super) struct Portable([f32; 8]);

impl Portable {
    #[inline(always)]
    fn zip(self, other: Self, apply: impl Fn(f32, f32) -> f32) -> Self {
        Self(std::array::from_fn(|lane| {
            apply(self.0[lane], other.0[lane])
        }))
    }
}

impl Lanes for Portable {
    const COUNT: usize = 8;

    #[inline(always)]
    unsafe fn splat(value: f32) -> Self {
        Self([value; 8])
    }
    #[inline(always)]
    unsafe fn load(from: *const f32) -> Self {
        // SAFETY: the caller vouches for 8 elements; the read need not be aligned.
        Self(unsafe { read::<[f32; 8]>(from) })
    }
    #[inline(always)]
    unsafe fn broadcast(from: *const f32) -> Self {
        // SAFETY: as above, for one element.
        Self([unsafe { read::<f32>(from) }; 8])
    }
    #[inline(always)]
    unsafe fn store(self, to: *mut f32) {
        // SAFETY: as above.
        unsafe { write::<[f32; 8]>(to, self.0) }
    }
    #[inline(always)]
    unsafe fn add(self, other: Self) -> Self {
        self.zip(other, |a, b| a + b)
    }
    #[inline(always)]
    unsafe fn sub(self, other: Self) -> Self {
        self.zip(other, |a, b| a - b)
    }
    #[inline(always)]
    unsafe fn mul(self, other: Self) -> Self {
        self.zip(other, |a, b| a * b)
    }
    #[inline(always)]
    unsafe fn mul_add(self, factor: Self, term: Self) -> Self {
        Self(std::array::from_fn(|lane| {
            self.0[lane] * factor.0[lane] + term.0[lane]
        }))
    }
    #[inline(always)]
    unsafe fn min(self, other: Self) -> Self {
        self.zip(other, |a, b| if a < b { a } else { b })
    }
    #[inline(always)]
    unsafe fn max(self, other: Self) -> Self {
        self.zip(other, |a, b| if a > b { a } else { b })
    }
    #[inline(always)]
    unsafe fn scale(self, n: Self) -> Self {
        self.zip(n, |value, n| {
            value * f32::from_bits((n + ROUNDING).to_bits().wrapping_add(127) << 23)
        })
    }
    #[inline(always)]
    unsafe fn integer_difference(self, other: Self) -> Self {
        self.zip(other, |a, b| {
            a.to_bits().wrapping_sub(b.to_bits()).cast_signed() as f32
        })
    }
    #[inline(always)]
    unsafe fn sum(self) -> f32 {
        self.0.iter().sum()
    }
    #[inline(always)]
    unsafe fn maximum(self) -> f32 {
        self.0
            .iter()
            .fold(f32::NEG_INFINITY, |a, &b| if a > b { a } else { b })
    }
}

/// Eight floats in an AVX register.
#[cfg(target_arch = "x86_64")]
#[derive(Clone, Copy)]
pub(super) struct Avx2(pub(super) __m256);

// SAFETY (every block): the trait's contract is that AVX2 and FMA are available and pointers are
// valid.
#[cfg(target_arch = "x86_64")]
impl Lanes for Avx2 {
    const COUNT: usize = 8;

    #[inline(always)]
    unsafe fn splat(value: f32) -> Self {
        Self(unsafe { _mm256_set1_ps(value) })
    }
    #[inline(always)]
    unsafe fn load(from: *const f32) -> Self {
        Self(unsafe { read::<__m256>(from) })
    }
    #[inline(always)]
    unsafe fn broadcast(from: *const f32) -> Self {
        Self(unsafe { _mm256_set1_ps(read::<f32>(from)) })
    }
    #[inline(always)]
    unsafe fn store(self, to: *mut f32) {
        unsafe { write::<__m256>(to, self.0) }
    }
    #[inline(always)]
    unsafe fn add(self, other: Self) -> Self {
        Self(unsafe { _mm256_add_ps(self.0, other.0) })
    }
    #[inline(always)]
    unsafe fn sub(self, other: Self) -> Self {
        Self(unsafe { _mm256_sub_ps(self.0, other.0) })
    }
    #[inline(always)]
    unsafe fn mul(self, other: Self) -> Self {
        Self(unsafe { _mm256_mul_ps(self.0, other.0) })
    }
    #[inline(always)]
    unsafe fn mul_add(self, factor: Self, term: Self) -> Self {
        Self(unsafe { _mm256_fmadd_ps(self.0, factor.0, term.0) })
    }
    #[inline(always)]
    unsafe fn min(self, other: Self) -> Self {
        Self(unsafe { _mm256_min_ps(self.0, other.0) })
    }
    #[inline(always)]
    unsafe fn max(self, other: Self) -> Self {
        Self(unsafe { _mm256_max_ps(self.0, other.0) })
    }
    #[inline(always)]
    unsafe fn scale(self, n: Self) -> Self {
        unsafe {
            let shifted = _mm256_castps_si256(_mm256_add_ps(n.0, _mm256_set1_ps(ROUNDING)));
            let biased = _mm256_add_epi32(shifted, _mm256_set1_epi32(127));
            Self(_mm256_mul_ps(
                self.0,
                _mm256_castsi256_ps(_mm256_slli_epi32::<23>(biased)),
            ))
        }
    }
    #[inline(always)]
    unsafe fn integer_difference(self, other: Self) -> Self {
        unsafe {
            let (a, b) = (_mm256_castps_si256(self.0), _mm256_castps_si256(other.0));
            Self(_mm256_cvtepi32_ps(_mm256_sub_epi32(a, b)))
        }
    }
    #[inline(always)]
    unsafe fn sum(self) -> f32 {
        unsafe {
            let half = _mm_add_ps(
                _mm256_castps256_ps128(self.0),
                _mm256_extractf128_ps::<1>(self.0),
            );
            let quarter = _mm_add_ps(half, _mm_movehl_ps(half, half));
            _mm_cvtss_f32(_mm_add_ss(quarter, _mm_movehdup_ps(quarter)))
        }
    }
    #[inline(always)]
    unsafe fn maximum(self) -> f32 {
        unsafe {
            let half = _mm_max_ps(
                _mm256_castps256_ps128(self.0),
                _mm256_extractf128_ps::<1>(self.0),
            );
            let quarter = _mm_max_ps(half, _mm_movehl_ps(half, half));
            _mm_cvtss_f32(_mm_max_ss(quarter, _mm_movehdup_ps(quarter)))
        }
    }
}

/// The mask of the first `count` of sixteen lanes.
#[cfg(target_arch = "x86_64")]
#[inline(always)]
fn first_lanes(count: usize) -> __mmask16 {
    ((1u32 << count.min(16)) - 1) as __mmask16
}

/// Sixteen floats in an AVX-512 register.
#[cfg(target_arch = "x86_64")]
#[derive(Clone, Copy)]
pub(super) struct Avx512(pub(super) __m512);

// SAFETY (every block): the trait's contract is that AVX-512F is available and pointers are valid.
#[cfg(target_arch = "x86_64")]
impl Lanes for Avx512 {
    const COUNT: usize = 16;

    #[inline(always)]
    unsafe fn splat(value: f32) -> Self {
        Self(unsafe { _mm512_set1_ps(value) })
    }
    #[inline(always)]
    unsafe fn load(from: *const f32) -> Self {
        Self(unsafe { read::<__m512>(from) })
    }
    #[inline(always)]
    unsafe fn broadcast(from: *const f32) -> Self {
        Self(unsafe { _mm512_set1_ps(read::<f32>(from)) })
    }
    #[inline(always)]
    unsafe fn store(self, to: *mut f32) {
        unsafe { write::<__m512>(to, self.0) }
    }
    #[inline(always)]
    unsafe fn add(self, other: Self) -> Self {
        Self(unsafe { _mm512_add_ps(self.0, other.0) })
    }
    #[inline(always)]
    unsafe fn sub(self, other: Self) -> Self {
        Self(unsafe { _mm512_sub_ps(self.0, other.0) })
    }
    #[inline(always)]
    unsafe fn mul(self, other: Self) -> Self {
        Self(unsafe { _mm512_mul_ps(self.0, other.0) })
    }
    #[inline(always)]
    unsafe fn mul_add(self, factor: Self, term: Self) -> Self {
        Self(unsafe { _mm512_fmadd_ps(self.0, factor.0, term.0) })
    }
    #[inline(always)]
    unsafe fn min(self, other: Self) -> Self {
        Self(unsafe { _mm512_min_ps(self.0, other.0) })
    }
    #[inline(always)]
    unsafe fn max(self, other: Self) -> Self {
        Self(unsafe { _mm512_max_ps(self.0, other.0) })
    }
    #[inline(always)]
    unsafe fn scale(self, n: Self) -> Self {
        Self(unsafe { _mm512_scalef_ps(self.0, n.0) })
    }
    #[inline(always)]
    unsafe fn integer_difference(self, other: Self) -> Self {
        unsafe {
            let (a, b) = (_mm512_castps_si512(self.0), _mm512_castps_si512(other.0));
            Self(_mm512_cvtepi32_ps(_mm512_sub_epi32(a, b)))
        }
    }
    #[inline(always)]
    unsafe fn store_bf16(self, to: *mut u32) {
        // A bit pattern of 256 bits is a valid vector of integers.
        unsafe {
            write::<__m256i>(
                to.cast(),
                std::mem::transmute::<__m256bh, __m256i>(_mm512_cvtneps_pbh(self.0)),
            )
        }
    }
    #[inline(always)]
    unsafe fn store_u8(self, to: *mut u8) {
        unsafe {
            write::<__m128i>(
                to.cast(),
                _mm512_cvtusepi32_epi8(_mm512_cvtps_epi32(self.0)),
            )
        }
    }
    #[inline(always)]
    unsafe fn load_partial(from: *const f32, count: usize, fill: f32) -> Self {
        Self(unsafe { _mm512_mask_loadu_ps(_mm512_set1_ps(fill), first_lanes(count), from) })
    }
    #[inline(always)]
    unsafe fn store_partial(self, to: *mut f32, count: usize) {
        unsafe { _mm512_mask_storeu_ps(to, first_lanes(count), self.0) }
    }
    #[inline(always)]
    unsafe fn first(self, count: usize) -> Self {
        Self(unsafe { _mm512_maskz_mov_ps(first_lanes(count), self.0) })
    }
    #[inline(always)]
    unsafe fn sum(self) -> f32 {
        unsafe { _mm512_reduce_add_ps(self.0) }
    }
    #[inline(always)]
    unsafe fn maximum(self) -> f32 {
        unsafe { _mm512_reduce_max_ps(self.0) }
    }
}

/// Calls one of three instances of a kernel, each compiled for its level, by a `Simd` token.
///
/// `at_level!(simd, (name: Type = value, ...) -> Return, portable expression, avx2 expression,
/// avx512 expression)`: the expressions see the named arguments.
macro_rules! at_level {
    ($simd:expr, ($($name:ident: $type:ty = $value:expr),* $(,)?) $(-> $return:ty)?,
     $portable:expr, $avx2:expr, $avx512:expr $(,)?) => {
        $crate::lanes::instances!(
            "avx512f,avx512bw,avx512dq,avx512vl,avx512vnni,avx2,fma",
            $simd, ($($name: $type = $value),*) $(-> $return)?, $portable, $avx2, $avx512
        )
    };
}
pub(super) use at_level;

/// As [`at_level!`], for kernels whose highest instance uses AVX-512 BF16 too.
///
/// # Panics
/// At the highest level of a CPU without it: callers ask
/// [`Format::is_available`](super::operand::Format) first.
macro_rules! at_bf16_level {
    ($simd:expr, ($($name:ident: $type:ty = $value:expr),* $(,)?) $(-> $return:ty)?,
     $portable:expr, $avx2:expr, $avx512:expr $(,)?) => {{
        let simd: $crate::Simd = $simd;
        assert!(
            simd.level() < $crate::SimdLevel::Avx512 || simd.has_bf16_dot(),
            "this CPU has no AVX-512 BF16"
        );
        $crate::lanes::instances!(
            "avx512f,avx512bw,avx512dq,avx512vl,avx512vnni,avx512bf16,avx2,fma",
            simd, ($($name: $type = $value),*) $(-> $return)?, $portable, $avx2, $avx512
        )
    }};
}
pub(super) use at_bf16_level;

/// What the two macros above share; the first argument is what the highest instance is compiled
/// for.
macro_rules! instances {
    ($features:tt, $simd:expr, ($($name:ident: $type:ty = $value:expr),*) $(-> $return:ty)?,
     $portable:expr, $avx2:expr, $avx512:expr) => {{
        #[inline(never)]
        unsafe fn portable($($name: $type),*) $(-> $return)? {
            // SAFETY: no instructions beyond the baseline; the caller vouches for the arguments.
            unsafe { $portable }
        }
        #[cfg(target_arch = "x86_64")]
        #[target_feature(enable = "avx2,fma")]
        unsafe fn avx2($($name: $type),*) $(-> $return)? {
            // SAFETY: called only below; the caller vouches for the arguments.
            unsafe { $avx2 }
        }
        #[cfg(target_arch = "x86_64")]
        #[target_feature(enable = $features)]
        unsafe fn avx512($($name: $type),*) $(-> $return)? {
            // SAFETY: called only below; the caller vouches for the arguments.
            unsafe { $avx512 }
        }
        match $simd.level() {
            #[cfg(target_arch = "x86_64")]
            // SAFETY: the token proves the level; the surrounding function has checked the
            // arguments.
            $crate::SimdLevel::Avx512 | $crate::SimdLevel::Amx => unsafe { avx512($($value),*) },
            #[cfg(target_arch = "x86_64")]
            // SAFETY: the same.
            $crate::SimdLevel::Avx2 => unsafe { avx2($($value),*) },
            // SAFETY: the same.
            _ => unsafe { portable($($value),*) },
        }
    }};
}
pub(super) use instances;
