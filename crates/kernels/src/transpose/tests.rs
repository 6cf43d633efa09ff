//! Every instruction set against the definition, at odd sizes.

use super::*;
use proptest::prelude::*;

proptest! {
    #[test]
    fn every_level_puts_every_word_where_it_belongs_and_touches_no_other(
        rows in 0usize..40,
        columns in 0usize..40,
        spare in 0usize..5,
    ) {
        let stride = columns + spare;
        let out_stride = rows + spare;
        let source: Vec<u32> = (0..rows * stride).map(|at| at as u32).collect();
        for simd in Simd::all() {
            let mut out = vec![u32::MAX; columns * out_stride];
            let source = SourceBlock {
                words: &source,
                stride,
                rows,
                columns,
            };
            transpose(simd, source, &mut out, out_stride);
            for (at, &word) in out.iter().enumerate() {
                let column = at / out_stride;
                let row = at % out_stride;
                let expected = if row < rows {
                    (row * stride + column) as u32
                } else {
                    u32::MAX
                };
                prop_assert_eq!(
                    word,
                    expected,
                    "level {}, row {}, column {}",
                    simd.level(),
                    row,
                    column
                );
            }
        }
    }
}
