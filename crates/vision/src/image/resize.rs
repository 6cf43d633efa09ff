//! Antialiased squash resize and ImageNet normalisation, as torchvision does them on a Pillow
//! image.

use super::{ImageError, RgbImage};
use fast_image_resize::images::{Image, ImageRef};
use fast_image_resize::{FilterType, PixelType, ResizeAlg, ResizeOptions, Resizer};
use placeformer_core::types::{ImageSize, ImageTensor};

/// ImageNet mean of R, G, B.
pub const MEAN: [f32; 3] = [0.485, 0.456, 0.406];
/// ImageNet standard deviation of R, G, B.
pub const DEVIATION: [f32; 3] = [0.229, 0.224, 0.225];

/// Squashes `image` to `size`: bilinear, its support widened by the reduction (Pillow's BILINEAR).
pub(super) fn resize(image: &RgbImage, size: ImageSize) -> Result<RgbImage, ImageError> {
    if size.width == 0 || size.height == 0 {
        return Err(ImageError::EmptyTarget(size));
    }
    if image.size == size {
        return Ok(image.clone());
    }
    let failed = |_| ImageError::EmptyTarget(size);
    let source = ImageRef::new(
        image.size.width,
        image.size.height,
        &image.pixels,
        PixelType::U8x3,
    )
    .map_err(failed)?;
    let mut small = Image::new(size.width, size.height, PixelType::U8x3);
    let options = ResizeOptions::new().resize_alg(ResizeAlg::Convolution(FilterType::Bilinear));
    Resizer::new()
        .resize(&source, &mut small, &options)
        .map_err(|_| ImageError::EmptyTarget(size))?;
    Ok(RgbImage {
        size,
        pixels: small.into_vec(),
    })
}

/// `[height, width, 3]` bytes to `[3, height, width]` f32: `(value / 255 - mean) / deviation`.
pub(super) fn normalise(image: &RgbImage) -> ImageTensor {
    let area = image.pixels.len() / 3;
    let mut data = vec![0f32; area * 3];
    for (channel, plane) in data.chunks_exact_mut(area.max(1)).enumerate() {
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
        let stripes = (0..64 * 8)
            .flat_map(|i| [if i % 2 == 0 { 0u8 } else { 255 }; 3])
            .collect();
        let small = resize(
            &RgbImage {
                size,
                pixels: stripes,
            },
            ImageSize {
                width: 8,
                height: 8,
            },
        )
        .unwrap();
        assert!(
            small.pixels.iter().all(|value| (110..=145).contains(value)),
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
