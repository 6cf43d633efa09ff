//! Portable products of bf16 and int8, eight words at a time.

use super::DotIsa;
use crate::registers::{first, first_mut};

/// Pairs of bf16 with f32 sums.
#[derive(Clone, Copy)]
pub(in crate::gemm) struct ScalarBf16Dot;

/// Unsigned bytes on the left, signed bytes on the right, i32 sums.
#[derive(Clone, Copy)]
pub(in crate::gemm) struct ScalarInt8Dot;

/// All that the two have in common: registers are arrays of words.
macro_rules! dot_of_arrays {
    ($name:ident, $dot:ident) => {
        impl DotIsa for $name {
            const COUNT: usize = 8;
            type Register = [u32; 8];

            #[inline(always)]
            fn zero(self) -> [u32; 8] {
                [0; 8]
            }

            #[inline(always)]
            fn load(self, from: &[u32]) -> [u32; 8] {
                *first(from)
            }

            #[inline(always)]
            fn broadcast(self, word: u32) -> [u32; 8] {
                [word; 8]
            }

            #[inline(always)]
            fn store(self, register: [u32; 8], to: &mut [u32]) {
                *first_mut(to) = register;
            }

            #[inline(always)]
            fn add_products(self, sums: [u32; 8], left: [u32; 8], right: [u32; 8]) -> [u32; 8] {
                std::array::from_fn(|lane| $dot(sums[lane], left[lane], right[lane]))
            }
        }
    };
}

dot_of_arrays!(ScalarBf16Dot, add_bf16_products);
dot_of_arrays!(ScalarInt8Dot, add_int8_products);

/// The bits of an f32 sum after adding two products, the later number's first.
#[inline(always)]
fn add_bf16_products(sum: u32, left: u32, right: u32) -> u32 {
    let low = |word: u32| f32::from_bits(word << 16);
    let high = |word: u32| f32::from_bits(word & 0xffff_0000);
    let sum = f32::from_bits(sum) + high(left) * high(right) + low(left) * low(right);
    sum.to_bits()
}

/// The bits of an i32 sum after adding four products; it wraps as the instructions do.
#[inline(always)]
fn add_int8_products(sum: u32, left: u32, right: u32) -> u32 {
    let pairs = left.to_le_bytes().into_iter().zip(right.to_le_bytes());
    pairs.fold(sum, |sum, (left, right)| {
        let product = i32::from(left) * i32::from(right.cast_signed());
        sum.wrapping_add(product.cast_unsigned())
    })
}
