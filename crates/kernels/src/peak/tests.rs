//! Every level measures what its CPU has instructions for.

use super::*;

#[test]
fn every_level_reaches_something_and_lower_precision_is_offered_where_the_cpu_has_it() {
    let time = Duration::from_millis(1);
    for simd in Simd::all() {
        assert!(f32_operations(simd, time) > 0.0);
        assert_eq!(bf16_operations(simd, time).is_some(), simd.has_bf16_dot());
        assert_eq!(
            int8_operations(simd, time).is_some(),
            simd.level() >= SimdLevel::Avx512
        );
    }
}
