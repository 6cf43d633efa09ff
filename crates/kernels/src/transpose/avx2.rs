//! The portable loop compiled for AVX2: the level has no formats whose keys have to be fast to
//! transpose.

use super::{SourceBlock, scalar};

/// See [`super::transpose`].
#[target_feature(enable = "avx2")]
pub(super) fn transpose(source: SourceBlock<'_>, out: &mut [u32], out_stride: usize) {
    scalar::transpose(source, out, out_stride);
}
