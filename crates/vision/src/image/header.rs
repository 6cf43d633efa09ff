//! The format from the magic bytes, and checks of the header before anything is decoded.
//!
//! The PNG decoder allocates buffers according to the size that a file states, so that size is read
//! here, from the first 24 bytes.

use super::config::ImageConfig;
use super::error::ImageError;
use placeformer_core::types::ImageSize;

/// An image format that can be decoded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ImageFormat {
    Jpeg,
    Png,
    WebP,
}

impl ImageFormat {
    /// Its name in messages.
    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Jpeg => "JPEG",
            Self::Png => "PNG",
            Self::WebP => "WebP",
        }
    }

    /// The error that an image of this format cannot be decoded.
    pub(super) fn undecodable(self, reason: impl Into<String>) -> ImageError {
        ImageError::Undecodable {
            format: self.name(),
            reason: reason.into(),
        }
    }
}

const JPEG_MAGIC: &[u8] = b"\xff\xd8\xff";

const PNG_MAGIC: &[u8] = b"\x89PNG\r\n\x1a\n";

/// Checks the limit on bytes, and recognises the format.
pub(super) fn recognise(bytes: &[u8], config: &ImageConfig) -> Result<ImageFormat, ImageError> {
    if bytes.is_empty() {
        return Err(ImageError::Empty);
    }
    if bytes.len() > config.max_bytes {
        return Err(ImageError::TooManyBytes {
            bytes: bytes.len(),
            limit: config.max_bytes,
        });
    }
    format_of(bytes).ok_or_else(|| ImageError::UnknownFormat {
        found: describe(bytes),
    })
}

/// Whether bytes begin as an image does that can be decoded, whatever a sender calls them.
pub fn is_image(bytes: &[u8]) -> bool {
    format_of(bytes).is_some()
}

/// The format that the first bytes name.
fn format_of(bytes: &[u8]) -> Option<ImageFormat> {
    // A file that ends within its magic bytes is a truncated image of that format, not one of an
    // unknown format. A single byte is too little to tell.
    let begins_with =
        |magic: &[u8]| bytes.len() >= 2 && (bytes.starts_with(magic) || magic.starts_with(bytes));
    if begins_with(JPEG_MAGIC) {
        Some(ImageFormat::Jpeg)
    } else if begins_with(PNG_MAGIC) {
        Some(ImageFormat::Png)
    } else if bytes.starts_with(b"RIFF") && bytes.get(8..12) == Some(b"WEBP") {
        Some(ImageFormat::WebP)
    } else {
        None
    }
}

/// For the error message: what bytes of an unknown format look like.
fn describe(bytes: &[u8]) -> String {
    let known: [(&[u8], &str); 7] = [
        (b"GIF8", "they look like a GIF"),
        (b"BM", "they look like a BMP"),
        (b"II*\0", "they look like a TIFF"),
        (b"MM\0*", "they look like a TIFF"),
        (b"%PDF", "they look like a PDF"),
        (b"<svg", "they look like an SVG"),
        (b"\0\0\0\x0cJXL ", "they look like a JPEG XL"),
    ];
    if let Some((_, text)) = known.iter().find(|(magic, _)| bytes.starts_with(magic)) {
        return (*text).to_owned();
    }
    match bytes.get(4..12) {
        Some(b"ftypheic" | b"ftypheix" | b"ftypmif1") => {
            return "they look like an HEIC".to_owned();
        }
        Some(b"ftypavif") => return "they look like an AVIF".to_owned(),
        _ => {}
    }
    let start = &bytes[..bytes.len().min(64)];
    let is_text = |byte: &u8| byte.is_ascii_graphic() || byte.is_ascii_whitespace();
    if start.iter().all(is_text) {
        return "they look like text".to_owned();
    }
    let first = start.iter().take(8);
    let hex: Vec<String> = first.map(|byte| format!("{byte:02x}")).collect();
    format!("they begin with {}", hex.join(" "))
}

/// The size in a PNG's IHDR chunk.
pub(super) fn png_size(bytes: &[u8]) -> Result<ImageSize, ImageError> {
    let truncated = || ImageFormat::Png.undecodable("truncated inside the header");
    let chunk = four_bytes(bytes, 12).ok_or_else(truncated)?;
    if &chunk != b"IHDR" {
        return Err(ImageFormat::Png.undecodable("the first chunk is not IHDR"));
    }
    let width = four_bytes(bytes, 16).ok_or_else(truncated)?;
    let height = four_bytes(bytes, 20).ok_or_else(truncated)?;
    Ok(ImageSize {
        width: u32::from_be_bytes(width),
        height: u32::from_be_bytes(height),
    })
}

fn four_bytes(bytes: &[u8], at: usize) -> Option<[u8; 4]> {
    bytes.get(at..)?.first_chunk().copied()
}

/// Checks the size that a header states against the limits.
pub(super) fn check_size(
    format: ImageFormat,
    size: ImageSize,
    config: &ImageConfig,
) -> Result<(), ImageError> {
    if size.width == 0 || size.height == 0 {
        return Err(format.undecodable(format!("its header says {size} pixels")));
    }
    if size.width.max(size.height) > config.max_side {
        return Err(ImageError::SideTooLong {
            size,
            limit: config.max_side,
        });
    }
    if u64::from(size.width) * u64::from(size.height) > config.max_pixels {
        return Err(ImageError::TooManyPixels {
            size,
            limit: config.max_pixels,
        });
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn other_formats_are_named() {
        let config = ImageConfig::default();
        let found = |bytes: &[u8]| match recognise(bytes, &config) {
            Err(ImageError::UnknownFormat { found }) => found,
            other => panic!("{other:?}"),
        };
        assert_eq!(found(b"GIF89a......"), "they look like a GIF");
        assert_eq!(
            found(b"Dear sir, this is no picture"),
            "they look like text"
        );
        assert_eq!(found(b"\0\0\0\x1cftypheic...."), "they look like an HEIC");
        assert_eq!(found(b"\x01\x02\x03"), "they begin with 01 02 03");
        assert_eq!(found(b"\xff"), "they begin with ff");
    }
}
