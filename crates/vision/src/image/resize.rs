//! Antialiased resizing without keeping the aspect ratio, and ImageNet normalisation, both as
//! torchvision does them on a Pillow image.

use super::error::ImageError;
use super::rgb::RgbImage;
use fast_image_resize::images::{TypedImage, TypedImageRef};
use fast_image_resize::pixels::U8x3;
use fast_image_resize::{FilterType, ResizeAlg, ResizeOptions, Resizer};
use placeformer_core::types::{ImageSize, ImageTensor};

/// ImageNet mean of R, G, B.
pub const MEAN: [f32; 3] = [0.485, 0.456, 0.406];
/// ImageNet standard deviation of R, G, B.
pub const DEVIATION: [f32; 3] = [0.229, 0.224, 0.225];

impl RgbImage {
    /// The same image at another size, with an antialiased bilinear filter.
    ///
    /// # Errors
    /// [`ImageError::EmptyTarget`] if a side of `size` is zero.
    pub fn resized(&self, size: ImageSize) -> Result<Self, ImageError> {
        resize(self, size)
    }
}

/// Resizes `image` to `size` with Pillow's BILINEAR filter: its support grows with the reduction,
/// so that every pixel of the source counts.
///
/// # Errors
/// [`ImageError::EmptyTarget`] if a side of `size` is zero.
pub(super) fn resize(image: &RgbImage, size: ImageSize) -> Result<RgbImage, ImageError> {
    if size.width == 0 || size.height == 0 {
        return Err(ImageError::EmptyTarget(size));
    }
    if image.size == size {
        return Ok(image.clone());
    }
    let ImageSize { width, height } = image.size;
    let empty = |_| ImageError::EmptyTarget(size);
    // The resizer's untyped images would have the compiler make every loop for each of its twelve
    // types of pixels, which took longer than the rest of this crate.
    let source = TypedImageRef::<U8x3>::from_buffer(width, height, &image.pixels).map_err(empty)?;
    let mut pixels = vec![0; size.width as usize * size.height as usize * 3];
    let mut small = TypedImage::<U8x3>::from_buffer(size.width, size.height, &mut pixels)
        .map_err(|_| ImageError::EmptyTarget(size))?;
    let options = ResizeOptions::new().resize_alg(ResizeAlg::Convolution(FilterType::Bilinear));
    Resizer::new()
        .resize_typed(&source, &mut small, &options)
        .map_err(|_| ImageError::EmptyTarget(size))?;
    Ok(RgbImage { size, pixels })
}

/// Bytes `[height, width, 3]` to floats `[3, height, width]`: `(value / 255 - mean) / deviation`.
pub(super) fn normalise(image: &RgbImage) -> ImageTensor {
    let area = image.pixels.len() / 3;
    let mut data = vec![0f32; area * 3];
    for (channel, plane) in data.chunks_exact_mut(area.max(1)).enumerate() {
        // A byte has only 256 values, so the formula is evaluated once for each.
        let table: [f32; 256] = std::array::from_fn(|value| {
            (value as f32 / 255.0 - MEAN[channel]) / DEVIATION[channel]
        });
        for (out, rgb) in plane.iter_mut().zip(image.pixels.chunks_exact(3)) {
            *out = table[usize::from(rgb[channel])];
        }
    }
    ImageTensor {
        size: image.size,
        data,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn normalising_follows_the_formula_plane_by_plane() {
        let image = RgbImage {
            size: ImageSize {
                width: 2,
                height: 1,
            },
            pixels: vec![0, 128, 255, 10, 20, 30],
        };
        let tensor = normalise(&image);
        let expected = [
            (0.0 - 0.485) / 0.229,
            (10.0 / 255.0 - 0.485) / 0.229,
            (128.0 / 255.0 - 0.456) / 0.224,
            (20.0 / 255.0 - 0.456) / 0.224,
            (255.0 / 255.0 - 0.406) / 0.225,
            (30.0 / 255.0 - 0.406) / 0.225f32,
        ];
        for (value, expected) in tensor.data.iter().zip(expected) {
            assert!((value - expected).abs() < 1e-6, "{value} {expected}");
        }
    }

    #[test]
    fn shrinking_antialiases_fine_stripes_to_grey() {
        let size = ImageSize {
            width: 64,
            height: 8,
        };
        let grey = |i: usize| if i.is_multiple_of(2) { 0u8 } else { 255 };
        let stripes = RgbImage {
            size,
            pixels: (0..64 * 8).flat_map(|i| [grey(i); 3]).collect(),
        };
        let target = ImageSize {
            width: 8,
            height: 8,
        };
        let small = resize(&stripes, target).unwrap();
        let is_grey = |value: &u8| (110..=145).contains(value);
        assert!(
            small.pixels.iter().all(is_grey),
            "{:?}",
            &small.pixels[..24]
        );
    }

    #[test]
    fn an_empty_target_is_refused() {
        let image = RgbImage::filled(
            ImageSize {
                width: 4,
                height: 4,
            },
            [1, 2, 3],
        );
        assert!(matches!(
            image.resized(ImageSize {
                width: 0,
                height: 4
            }),
            Err(ImageError::EmptyTarget(_))
        ));
    }
}
