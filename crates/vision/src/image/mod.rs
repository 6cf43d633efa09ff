//! From bytes to a normalised tensor: limits, decoding, orientation, resizing, normalisation (paper
//! IV-A).
//!
//! The bytes may come from a camera, a phone or an attacker. So the format is recognised by the
//! magic bytes and never by a name; the size is read from the header and checked before anything is
//! decoded or allocated; the errors of the decoders become one error type that names the cause; and
//! if a decoder panics, only that one request fails.
//!
//! The pixels follow torchvision on a Pillow image, because the models were trained on those:
//! 16-bit samples keep their high byte, alpha is dropped (not blended), and the resize filter is
//! Pillow's antialiased bilinear one. The one difference is that EXIF orientation is applied, to
//! the small image after resizing.
//!
//! | module | holds |
//! |---|---|
//! | `load` | the whole way, from bytes to image or tensor |
//! | `header`, `decode` | format and limits; a way for each format |
//! | `jpeg` | what of a JPEG is accepted, and which library decodes it |
//! | `png`, `webp` | decoding these |
//! | `orientation` | turning an image upright |
//! | `resize` | resizing and normalisation |
//! | `information` | whether an image shows anything by which a place could be known |
//! | `encode` | back to JPEG and PNG |
//! | `exif` | position, heading and time of a photo, from its EXIF and XMP |

mod config;
mod decode;
mod encode;
mod error;
mod exif;
mod header;
mod information;
mod jpeg;
mod load;
mod orientation;
mod png;
mod resize;
mod rgb;
mod webp;

pub use config::ImageConfig;
pub use encode::{encode_jpeg, encode_png};
pub use error::ImageError;
pub use exif::{ExifInfo, ExifSources, MetadataBlock, read_exif};
pub use header::is_image;
pub use information::{Detail, Uninformative};
pub use load::{decode, load_tensor};
pub use resize::{DEVIATION, MEAN};
pub use rgb::RgbImage;
