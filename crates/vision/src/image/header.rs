//! The format from the magic bytes, and the limits from the header.
//!
//! PNG states its size in its first 24 bytes, before any decoder has sized a buffer after it, so it
//! is read here; the JPEG and WebP decoders parse their headers without allocating by them and are
//! asked instead.

use super::{ImageConfig, ImageError};
use placeformer_core::types::ImageSize;

/// A container this service decodes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Format {
    Jpeg,
    Png,
    WebP,
}

impl Format {
    /// Its name for messages.
    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Jpeg => "JPEG",
            Self::Png => "PNG",
            Self::WebP => "WebP",
        }
    }

    /// An error of this format.
    pub(super) fn undecodable(self, reason: impl Into<String>) -> ImageError {
        ImageError::Undecodable {
            format: self.name(),
            reason: reason.into(),
        }
    }
}

const PNG_MAGIC: &[u8] = b"\x89PNG\r\n\x1a\n";

/// Checks the byte limit and names the format.
pub(super) fn sniff(bytes: &[u8], config: &ImageConfig) -> Result<Format, ImageError> {
    if bytes.is_empty() {
        return Err(ImageError::Empty);
    }
    if bytes.len() > config.max_bytes {
        return Err(ImageError::TooManyBytes {
            bytes: bytes.len(),
            limit: config.max_bytes,
        });
    }
    // A file cut inside its magic bytes is a truncated image of that format, not an unknown one;
    // two bytes are the least that tell anything apart.
    let begins =
        |magic: &[u8]| bytes.len() >= 2 && (bytes.starts_with(magic) || magic.starts_with(bytes));
    if begins(b"\xff\xd8\xff") {
        Ok(Format::Jpeg)
    } else if begins(PNG_MAGIC) {
        Ok(Format::Png)
    } else if bytes.len() >= 12 && bytes.starts_with(b"RIFF") && &bytes[8..12] == b"WEBP" {
        Ok(Format::WebP)
    } else {
        Err(ImageError::UnknownFormat {
            found: describe(bytes),
        })
    }
}

/// What bytes that are none of ours look like, for the message.
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
    let head = &bytes[..bytes.len().min(64)];
    if head
        .iter()
        .all(|byte| byte.is_ascii_graphic() || byte.is_ascii_whitespace())
    {
        return "they look like text".to_owned();
    }
    let hex: Vec<String> = head
        .iter()
        .take(8)
        .map(|byte| format!("{byte:02x}"))
        .collect();
    format!("they begin with {}", hex.join(" "))
}

/// The size in a PNG's IHDR chunk.
pub(super) fn png_size(bytes: &[u8]) -> Result<ImageSize, ImageError> {
    let truncated = || Format::Png.undecodable("truncated inside the header");
    if bytes.get(12..16).ok_or_else(truncated)? != b"IHDR" {
        return Err(Format::Png.undecodable("the first chunk is not IHDR"));
    }
    let side = |at: usize| {
        let field = bytes
            .get(at..at + 4)
            .and_then(|field| <[u8; 4]>::try_from(field).ok());
        field.map(u32::from_be_bytes).ok_or_else(truncated)
    };
    Ok(ImageSize {
        width: side(16)?,
        height: side(20)?,
    })
}

/// Whether a WebP holds all the bytes that its RIFF header states; a lossless one cut short decodes
/// as corrupt at best.
pub(super) fn webp_is_complete(bytes: &[u8]) -> bool {
    let stated = bytes
        .get(4..8)
        .and_then(|field| <[u8; 4]>::try_from(field).ok())
        .map(u32::from_le_bytes);
    stated.is_some_and(|stated| bytes.len() as u64 >= u64::from(stated) + 8)
}

/// Checks a header's size against the limits.
pub(super) fn check_size(
    format: Format,
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

/// Most scans of a JPEG. Cameras and encoders write one to about ten; each costs a pass over the
/// whole picture, however few bytes it has, so a file of a few megabytes could otherwise keep a
/// decoder busy for hours.
pub(super) const MAX_JPEG_SCANS: usize = 100;

/// Checks that a JPEG's last scan is followed by an end-of-image marker, and that it has no absurd
/// number of scans.
///
/// Decoders paint what is missing grey; half a picture would match half a place, so a file without
/// its end is refused. Entropy-coded data never holds `FF` before anything but `00` or a restart
/// marker, so the end is found by walking the segments, as the decoders do. Bytes after it (a
/// second picture, a maker's appendix) do not matter.
pub(super) fn check_jpeg(bytes: &[u8]) -> Result<(), ImageError> {
    let truncated = || Format::Jpeg.undecodable("truncated: the end-of-image marker is missing");
    let (mut at, mut scans) = (2, 0);
    while at + 1 < bytes.len() {
        if bytes[at] != 0xff {
            at += bytes[at..]
                .iter()
                .position(|&byte| byte == 0xff)
                .ok_or_else(truncated)?;
            continue;
        }
        match bytes[at + 1] {
            0xd9 => return Ok(()),
            // Stuffing, restarts and stand-alone markers carry no length; a second FF is padding.
            0x00 | 0x01 | 0xd0..=0xd8 => at += 2,
            0xff => at += 1,
            marker => {
                let length = bytes.get(at + 2..at + 4).ok_or_else(truncated)?;
                let length = usize::from(u16::from_be_bytes([length[0], length[1]]));
                scans += usize::from(marker == 0xda);
                if scans > MAX_JPEG_SCANS {
                    return Err(Format::Jpeg
                        .undecodable(format!("it has more than {MAX_JPEG_SCANS} scans")));
                }
                if length < 2 && scans == 0 {
                    return Err(truncated());
                }
                at += 2 + length;
            }
        }
    }
    Err(truncated())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn other_formats_are_named() {
        let config = ImageConfig::default();
        let found = |bytes: &[u8]| match sniff(bytes, &config) {
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

    #[test]
    fn completeness_needs_the_end_marker_outside_segments() {
        let comment_with_end = b"\xff\xd8\xff\xfe\x00\x04\xff\xd9";
        assert!(check_jpeg(comment_with_end).is_err());
        let stuffed = b"\xff\xd8\xff\xda\x00\x02abc\xff\x00\xd9\xff\xd0z";
        assert!(check_jpeg(stuffed).is_err());
        assert!(check_jpeg(&[stuffed.as_slice(), b"\xff\xd9tail"].concat()).is_ok());
    }

    #[test]
    fn scans_are_counted_outside_segments_only() {
        let scan = b"\xff\xda\x00\x02xy";
        let with =
            |scans: usize| [b"\xff\xd8".as_slice(), &scan.repeat(scans), b"\xff\xd9"].concat();
        assert!(check_jpeg(&with(MAX_JPEG_SCANS)).is_ok());
        let refused = check_jpeg(&with(MAX_JPEG_SCANS + 1))
            .unwrap_err()
            .to_string();
        assert!(refused.contains("more than 100 scans"), "{refused}");
        let hidden = scan.repeat(200);
        let comment = [
            b"\xff\xd8\xff\xfe".as_slice(),
            &(hidden.len() as u16 + 2).to_be_bytes(),
            &hidden,
        ];
        assert!(check_jpeg(&[&comment.concat(), scan.as_slice(), b"\xff\xd9"].concat()).is_ok());
    }
}
