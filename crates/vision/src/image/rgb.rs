//! An image in memory.

use placeformer_core::types::ImageSize;

/// An upright 8-bit RGB image.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RgbImage {
    /// Width and height in pixels, after orientation.
    pub size: ImageSize,
    /// `[height, width, 3]` row-major.
    pub pixels: Vec<u8>,
}

impl RgbImage {
    /// An image of one colour.
    pub fn filled(size: ImageSize, colour: [u8; 3]) -> Self {
        Self {
            size,
            pixels: colour.repeat(size.width as usize * size.height as usize),
        }
    }

    /// The colour (R, G, B) at column `x`, row `y`.
    ///
    /// # Panics
    /// If the row is outside the image.
    pub fn pixel(&self, x: u32, y: u32) -> [u8; 3] {
        let start = (y as usize * self.size.width as usize + x as usize) * 3;
        std::array::from_fn(|channel| self.pixels[start + channel])
    }
}
