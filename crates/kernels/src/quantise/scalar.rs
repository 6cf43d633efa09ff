//! The loops, written once over arrays of [`LANES`] elements; the other modules compile them for
//! their instruction sets. No multiplication is fused with an addition and sums have a fixed
//! order, so every instruction set gives the same bits.

/// Sums that run side by side.
const LANES: usize = 16;

/// See [`super::largest`].
#[inline(always)]
pub(super) fn largest(values: &[f32]) -> f32 {
    // Not `f32::max`, since the comparison has to ignore NaN in the same way everywhere.
    let larger = |largest: f32, value: f32| {
        if value.abs() > largest {
            value.abs()
        } else {
            largest
        }
    };

    let mut lanes = [0f32; LANES];
    let (groups, rest) = values.as_chunks::<LANES>();
    for group in groups {
        for (lane, &value) in lanes.iter_mut().zip(group) {
            *lane = larger(*lane, value);
        }
    }
    let remaining = rest.iter().chain(&lanes);
    remaining.fold(0.0, |largest, &value| larger(largest, value))
}

/// See [`super::quantise`].
#[inline(always)]
pub(super) fn quantise(values: &[f32], divisor: f32, factor: f32, codes: &mut [i8]) {
    for (code, value) in codes.iter_mut().zip(values) {
        let scaled = value / divisor * factor;
        let scaled = if scaled.is_nan() {
            0.0
        } else {
            scaled.clamp(-127.0, 127.0)
        };
        // A plain cast would saturate, which the compiler does one element at a time.
        // SAFETY: `scaled` is a number within -127..=127, which i32 can hold.
        let whole: i32 = unsafe { scaled.to_int_unchecked() };
        // The difference is exact, so that exactly one half is distinguished from its neighbouring
        // floats.
        let fraction = scaled - whole as f32;
        let rounded = whole + i32::from(fraction >= 0.5) - i32::from(fraction <= -0.5);
        *code = rounded as i8;
    }
}

/// See [`super::squared_lengths`].
#[inline(always)]
pub(super) fn squared_lengths(values: &[f32], codes: &[i8], scale: f32) -> (f64, f64) {
    let scale = f64::from(scale);
    let mut missed = [0f64; LANES];
    let mut whole = [0f64; LANES];
    let mut add = |lane: usize, value: f32, code: i8| {
        let value = f64::from(value);
        let error = value - scale * f64::from(code);
        missed[lane] += error * error;
        whole[lane] += value * value;
    };

    let (value_groups, values_left) = values.as_chunks::<LANES>();
    let (code_groups, codes_left) = codes.as_chunks::<LANES>();
    for (values, codes) in value_groups.iter().zip(code_groups) {
        for lane in 0..LANES {
            add(lane, values[lane], codes[lane]);
        }
    }
    for (lane, (&value, &code)) in values_left.iter().zip(codes_left).enumerate() {
        add(lane, value, code);
    }
    (missed.iter().sum(), whole.iter().sum())
}
