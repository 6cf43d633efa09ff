//! Whether an image shows anything by which a place could be known.
//!
//! A black frame, a covered lens or a blank wall has no patches of its own, but a descriptor all
//! the same: one that resembles that of every other such frame. Stored, it attracts all of them;
//! asked for, it gets a confident answer that means nothing. So images are measured before they
//! are described.
//!
//! The measure looks for detail: places where brightness does not change evenly. The image is
//! averaged in a fixed grid of boxes, which removes the noise of a sensor. Where the mean of a box
//! differs from what its two neighbours in a row or column would lead to, there is detail; an even
//! gradient, such as a vignette's, has none. Detail counts only where nearly all boxes around have
//! it too, so that lines and grains count for nothing. This takes one pass over the pixels that
//! the model sees, whatever the size of the photo.

use super::resize::{DEVIATION, MEAN};
use placeformer_core::types::ImageTensor;

/// Boxes in a row and in a column of the grid.
const BOXES: [usize; 2] = [64, 48];

/// How far a box's mean must lie from that of its neighbours, in levels of 0 to 255 and twice the
/// distance from their middle. Noise with a deviation of 10 levels stays below it at usual sizes.
const LEVELS: f32 = 4.0;

/// Boxes with detail among the nine of a window, for the window to have detail.
const OF_NINE: usize = 8;

/// Weights of red, green and blue in brightness (ITU-R BT.601).
const BRIGHTNESS: [f32; 3] = [0.299, 0.587, 0.114];

/// How much of an image has detail.
///
/// Over 5,361 photographs of streets by day, at dusk, by night and in snow (MSLS London, CMU
/// Seasons, CamVid, and 28 of a campus), the least shares were 0.22 of the whole and 0.033 of the
/// centre. Black, grey and white frames with noise, gradients and vignettes have less than 0.01.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Detail {
    /// Share of all windows, 0 to 1.
    pub whole: f32,
    /// Share of the windows in the middle half of both directions, 0 to 1.
    pub centre: f32,
}

/// What an image lacks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum Uninformative {
    /// Almost everywhere brightness is even: a dark or blank frame, a covered lens, fog.
    #[error("brightness is even almost everywhere, as in a dark or blank frame")]
    Blank,
    /// What detail there is lies at the border: the rim of a lens around nothing.
    #[error("brightness is even in the whole centre, as behind a covered lens")]
    EmptyCentre,
}

impl Detail {
    /// Least share of the whole: a tenth of the least that an honest photograph had.
    const LEAST_WHOLE: f32 = 0.02;
    /// Least share of the centre. The rim of a lens has none there at all.
    const LEAST_CENTRE: f32 = 0.005;

    /// Measures the input of a model.
    pub fn of(image: &ImageTensor) -> Self {
        let means = BoxMeans::of(image);
        let windows = means.windows_with_detail();
        let share = |margin: usize| windows.share(margin);
        Self {
            whole: share(0),
            centre: share(4),
        }
    }

    /// What the image lacks; `None` if it may show a place.
    pub fn lacks(self) -> Option<Uninformative> {
        if self.whole < Self::LEAST_WHOLE {
            Some(Uninformative::Blank)
        } else if self.centre < Self::LEAST_CENTRE {
            Some(Uninformative::EmptyCentre)
        } else {
            None
        }
    }
}

/// Mean brightness of boxes, in levels of 0 to 255.
struct BoxMeans {
    columns: usize,
    rows: usize,
    /// `[rows, columns]`.
    means: Vec<f32>,
}

/// Which windows of three by three boxes have detail.
struct Windows {
    columns: usize,
    rows: usize,
    /// `[rows, columns]`.
    has_detail: Vec<bool>,
}

impl BoxMeans {
    fn of(image: &ImageTensor) -> Self {
        let width = image.size.width as usize;
        let height = image.size.height as usize;
        let columns = BOXES[0].min(width);
        let rows = BOXES[1].min(height);
        let mut means = Vec::with_capacity(columns * rows);
        let mut line = vec![0.0f32; width];
        for row in 0..rows {
            let lines = row * height / rows..(row + 1) * height / rows;
            line.fill(0.0);
            for y in lines.clone() {
                add_brightness(image, y, &mut line);
            }
            for column in 0..columns {
                let span = column * width / columns..(column + 1) * width / columns;
                let pixels = (span.len() * lines.len()) as f32;
                means.push(line[span].iter().sum::<f32>() / pixels);
            }
        }
        Self {
            columns,
            rows,
            means,
        }
    }

    /// Whether the mean of a box is not what its neighbours on both sides lead to.
    ///
    /// A mean that is no number counts as detail: it is not for this measure to judge.
    fn has_detail(&self, row: usize, column: usize) -> bool {
        let at = row * self.columns + column;
        let bend = |step: usize| {
            let [before, here, after] = [at - step, at, at + step].map(|i| self.means[i]);
            (before - 2.0 * here + after).abs()
        };
        let is_even = bend(1) <= LEVELS && bend(self.columns) <= LEVELS;
        !is_even
    }

    fn windows_with_detail(&self) -> Windows {
        // Neither the boxes at the border nor windows around them have all their neighbours.
        let [inner_columns, inner_rows] = [self.columns, self.rows].map(|n| n.saturating_sub(2));
        let mut detail = Vec::with_capacity(inner_columns * inner_rows);
        for row in 0..inner_rows {
            for column in 0..inner_columns {
                detail.push(self.has_detail(row + 1, column + 1));
            }
        }
        let [columns, rows] = [inner_columns, inner_rows].map(|n| n.saturating_sub(2));
        let mut has_detail = Vec::with_capacity(columns * rows);
        for row in 0..rows {
            for column in 0..columns {
                let of_line = |line: usize| {
                    let start = line * inner_columns + column;
                    detail[start..start + 3].iter().filter(|&&it| it).count()
                };
                let count: usize = (row..row + 3).map(of_line).sum();
                has_detail.push(count >= OF_NINE);
            }
        }
        Windows {
            columns,
            rows,
            has_detail,
        }
    }
}

impl Windows {
    /// The share of windows with detail, without one part in `margin` at each border; with 0, of
    /// all. 1 where there are none, which says nothing against the image.
    fn share(&self, margin: usize) -> f32 {
        let cut = |length: usize| length.checked_div(margin).unwrap_or(0);
        let columns = cut(self.columns)..self.columns - cut(self.columns);
        let rows = cut(self.rows)..self.rows - cut(self.rows);
        let total = columns.len() * rows.len();
        if total == 0 {
            return 1.0;
        }
        let of_row = |row: usize| {
            let start = row * self.columns;
            let windows = &self.has_detail[start + columns.start..start + columns.end];
            windows.iter().filter(|&&it| it).count()
        };
        let with_detail: usize = rows.map(of_row).sum();
        with_detail as f32 / total as f32
    }
}

/// Adds the brightness of the pixels of line `y`, in levels of 0 to 255.
fn add_brightness(image: &ImageTensor, y: usize, sums: &mut [f32]) {
    let width = image.size.width as usize;
    let area = width * image.size.height as usize;
    for channel in 0..3 {
        let scale = 255.0 * BRIGHTNESS[channel] * DEVIATION[channel];
        let offset = 255.0 * BRIGHTNESS[channel] * MEAN[channel];
        let start = channel * area + y * width;
        let values = &image.data[start..start + width];
        for (sum, value) in sums.iter_mut().zip(values) {
            *sum += value * scale + offset;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::resize::{normalise, resize};
    use super::super::rgb::RgbImage;
    use super::*;
    use placeformer_core::types::ImageSize;

    const PHOTO: ImageSize = ImageSize {
        width: 640,
        height: 480,
    };
    const INPUTS: [[u32; 2]; 4] = [[448, 336], [322, 238], [224, 224], [644, 476]];

    /// A photo whose pixels are `brightness` of their position from the centre, -1 to 1, with noise
    /// of a triangular distribution of this deviation.
    fn draw(noise: f32, brightness: impl Fn(f32, f32) -> f32) -> RgbImage {
        let mut state = 1u32;
        let mut random = move || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 8) as f32 / (1 << 24) as f32
        };
        let mut pixels = Vec::new();
        for y in 0..PHOTO.height {
            for x in 0..PHOTO.width {
                let from_centre = |at: u32, length: u32| 2.0 * at as f32 / length as f32 - 1.0;
                let level = brightness(from_centre(x, PHOTO.width), from_centre(y, PHOTO.height));
                for _ in 0..3 {
                    // The sum of two equal distributions over 1 has a deviation of 1 / sqrt(6).
                    let grain = (random() + random() - 1.0) * 6f32.sqrt() * noise;
                    pixels.push((level + grain).round().clamp(0.0, 255.0) as u8);
                }
            }
        }
        RgbImage {
            size: PHOTO,
            pixels,
        }
    }

    fn lacks(photo: &RgbImage, [width, height]: [u32; 2]) -> Option<Uninformative> {
        let small = resize(photo, ImageSize { width, height }).unwrap();
        Detail::of(&normalise(&small)).lacks()
    }

    fn from_centre(x: f32, y: f32) -> f32 {
        (x * x + (y * 0.75) * (y * 0.75)).sqrt()
    }

    #[test]
    fn nothing_but_noise_gradients_and_vignettes_is_blank() {
        type Brightness = fn(f32, f32) -> f32;
        let frames: [(&str, Brightness); 7] = [
            ("black", |_, _| 2.0),
            ("grey", |_, _| 128.0),
            ("white", |_, _| 253.0),
            ("gradient", |x, _| 128.0 + 120.0 * x),
            ("vignette", |x, y| 200.0 - 120.0 * from_centre(x, y).powi(2)),
            ("heavy vignette", |x, y| {
                255.0 * (-(1.4 * from_centre(x, y)).powi(4)).exp()
            }),
            ("finger", |x, y| 60.0 + 50.0 * x - 40.0 * y * x),
        ];
        for (name, brightness) in frames {
            for noise in [0.0, 3.0, 8.0] {
                let photo = draw(noise, brightness);
                for input in INPUTS {
                    let lacks = lacks(&photo, input);
                    assert!(lacks.is_some(), "{name}, noise {noise}, {input:?}");
                }
            }
        }
    }

    #[test]
    fn a_rim_around_nothing_has_an_empty_centre() {
        let rim = |x: f32, y: f32| if from_centre(x, y) < 0.72 { 150.0 } else { 0.0 };
        for noise in [0.0, 5.0] {
            let lacks = lacks(&draw(noise, rim), INPUTS[0]);
            assert_eq!(lacks, Some(Uninformative::EmptyCentre));
        }
    }

    #[test]
    fn a_dim_drawing_and_one_behind_a_rim_are_informative() {
        let town = |x: f32, y: f32| {
            let stripes = (x * 31.0).sin() + (y * 23.0 + x * 9.0).sin();
            if y < -0.3 { 0.9 } else { 0.5 + 0.2 * stripes }
        };
        for input in INPUTS {
            assert_eq!(lacks(&draw(3.0, |x, y| 200.0 * town(x, y)), input), None);
            assert_eq!(lacks(&draw(3.0, |x, y| 60.0 * town(x, y)), input), None);
            let behind = |x: f32, y: f32| {
                let is_open = from_centre(x, y) < 0.72;
                if is_open { 200.0 * town(x, y) } else { 0.0 }
            };
            assert_eq!(lacks(&draw(3.0, behind), input), None, "{input:?}");
        }
    }

    #[test]
    fn what_is_too_small_or_no_number_is_not_judged() {
        let tiny = ImageTensor {
            size: ImageSize {
                width: 4,
                height: 3,
            },
            data: vec![0.0; 36],
        };
        assert_eq!(Detail::of(&tiny).lacks(), None);
        let size = ImageSize {
            width: 112,
            height: 84,
        };
        let data = vec![f32::NAN; 3 * 112 * 84];
        assert_eq!(Detail::of(&ImageTensor { size, data }).lacks(), None);
    }
}
