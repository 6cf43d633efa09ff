//! Coordinates in which the homography search computes.
//!
//! Pixel coordinates differ in size from the other entries of a homography, which costs precision.
//! So the origin is moved to the centre of the correspondences and the tolerance becomes the unit
//! of length, in both images.

/// The normalised coordinates of one pair of images.
pub(super) struct Frame {
    /// Mean of `x, y, u, v`, in pixels.
    centre: [f64; 4],
    /// The tolerance in pixels.
    unit: f64,
}

impl Frame {
    /// The frame of `correspondences` (`x, y, u, v` in pixels), of which there is at least one.
    pub(super) fn of(correspondences: &[[f32; 4]], unit: f64) -> Self {
        let mut sums = [0.0; 4];
        for pair in correspondences {
            for (sum, &value) in sums.iter_mut().zip(pair) {
                *sum += f64::from(value);
            }
        }
        let count = correspondences.len() as f64;
        Self {
            centre: sums.map(|sum| sum / count),
            unit,
        }
    }

    /// A correspondence in this frame.
    pub(super) fn normalise(&self, pair: [f32; 4]) -> [f32; 4] {
        std::array::from_fn(|axis| {
            let pixels = f64::from(pair[axis]) - self.centre[axis];
            (pixels / self.unit) as f32
        })
    }

    /// A homography of this frame, in pixels: `T(u, v)^-1 H T(x, y)`, where T maps pixels to the
    /// frame.
    pub(super) fn denormalise(&self, homography: &[f64; 9]) -> [f64; 9] {
        let [cx, cy, cu, cv] = self.centre;
        let mut out = [0.0; 9];
        for row in 0..3 {
            let [p, q, r] = [0, 1, 2].map(|column| homography[row * 3 + column]);
            out[row * 3] = p / self.unit;
            out[row * 3 + 1] = q / self.unit;
            out[row * 3 + 2] = r - (p * cx + q * cy) / self.unit;
        }
        for column in 0..3 {
            out[column] = out[column] * self.unit + cu * out[6 + column];
            out[3 + column] = out[3 + column] * self.unit + cv * out[6 + column];
        }
        out
    }
}
