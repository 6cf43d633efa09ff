//! Attention against its definition, and the sizes of chunks.

use super::*;
use crate::SimdLevel;
use proptest::prelude::*;

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]
    #[test]
    fn equals_the_definition(tokens in 36usize..180, heads in 1usize..3) {
        for simd in Simd::all() {
            for formats in check::formats(simd) {
                prop_assert_eq!(
                    check::compare_with_definition(simd, formats, tokens, heads, 32),
                    Ok(())
                );
            }
        }
    }

    #[test]
    fn chunks_are_whole_panels_and_keep_every_thread_busy(
        tokens in 1usize..3000,
        images in 1usize..10,
        threads in 1usize..33,
    ) {
        for simd in Simd::all() {
            let tile = Tiling::of(simd);
            let rows = chunk_rows(simd, tokens, images, threads);
            prop_assert_eq!((rows % tile.rows, rows % tile.columns), (0, 0));
            let fewest = chunks::fewest_rows(simd);
            prop_assert!(
                (fewest..=chunks::MOST_ROWS).contains(&rows),
                "{} rows",
                rows
            );
            if simd.level() == SimdLevel::Amx {
                let after = |rows| chunks::finish_time(rows, tokens, images, threads);
                prop_assert!(after(rows) <= after(fewest));
            }
        }
    }
}

#[test]
fn the_slowest_thread_decides_how_long_a_layer_takes() {
    let time = |rows| rows + chunks::WEIGHT_ROWS;
    // Four whole chunks and one of a single token; five nearly equal ones; more threads than
    // chunks.
    assert_eq!(chunks::finish_time(192, 769, 1, 2), 2 * time(192) + time(1));
    assert_eq!(
        chunks::finish_time(160, 769, 1, 2),
        2 * time(160) + time(129)
    );
    assert_eq!(chunks::finish_time(64, 769, 1, 16), time(64));
    // The last chunks of three images fit into the time that the odd whole chunk takes; one that is
    // nearly whole does not.
    assert_eq!(
        chunks::finish_time(64, 64 + 1, 3, 2),
        2 * time(64) + time(1)
    );
    assert_eq!(chunks::finish_time(128, 128 + 1, 1, 2), time(128));
}
