//! Memory that a computation needs besides its input and output.

#[cfg(target_arch = "x86_64")]
use super::Best;

/// Elements of the longest vectors of f32.
#[cfg(target_arch = "x86_64")]
pub(super) const MAX_LANES: usize = 16;

/// Memory that is kept from one call to the next, to save allocations.
#[derive(Debug, Default)]
#[cfg_attr(
    not(target_arch = "x86_64"),
    expect(dead_code, reason = "the scalar code needs no scratch memory")
)]
pub struct Scratch {
    /// AVX2: `[rows][dim / 2]`, rows widened to i16 and filled up with zero to whole pairs.
    pub(super) pairs: Vec<[i16; 2]>,
    /// AVX-512: `[rows][dim / 4]`, rows filled up with zeros to whole fours; empty if the rows are
    /// whole fours as given.
    pub(super) quads: Vec<[i8; 4]>,
    /// AVX-512: `[rows]`, what the sums of each row start from.
    pub(super) starts: Vec<i32>,
    /// `[rows][lanes]`: each row's largest similarity in every lane of a vector.
    pub(super) lane_values: Vec<f32>,
    /// `[rows][lanes]`: the columns of those, -1 if there is none.
    pub(super) lane_indices: Vec<i32>,
}

#[cfg(target_arch = "x86_64")]
impl Scratch {
    /// Forgets the maxima of all lanes.
    pub(super) fn reset_lanes(&mut self, rows: usize, lanes: usize) {
        self.lane_values.clear();
        self.lane_values.resize(rows * lanes, f32::NEG_INFINITY);
        self.lane_indices.clear();
        self.lane_indices.resize(rows * lanes, -1);
    }

    /// The best over the lanes of `row`; of equal ones that with the lowest column.
    #[inline(always)]
    pub(super) fn reduce_lanes(&self, row: usize, lanes: usize) -> Best {
        let range = row * lanes..(row + 1) * lanes;
        // Filled up to the longest vectors with what loses every comparison.
        let mut values = [f32::NEG_INFINITY; MAX_LANES];
        let mut columns = [u32::MAX; MAX_LANES];
        values[..lanes].copy_from_slice(&self.lane_values[range.clone()]);
        for (column, &index) in columns.iter_mut().zip(&self.lane_indices[range]) {
            *column = index as u32;
        }

        // The upper half is compared with the lower half until one lane is left. There are no
        // branches, so that the compiler can use vectors: which lane is best is unpredictable.
        let mut half = MAX_LANES / 2;
        while half > 0 {
            for lane in 0..half {
                let value = values[lane + half];
                let column = columns[lane + half];
                let tie_to_lower = (value == values[lane]) & (column < columns[lane]);
                let better = (value > values[lane]) | tie_to_lower;
                values[lane] = if better { value } else { values[lane] };
                columns[lane] = if better { column } else { columns[lane] };
            }
            half /= 2;
        }
        Best {
            value: values[0],
            index: columns[0],
        }
    }
}
