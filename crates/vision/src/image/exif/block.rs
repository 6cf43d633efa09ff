//! Finds the EXIF and XMP blocks of a JPEG, PNG or WebP by walking its segments or chunks.
//!
//! A bare EXIF block, which is a TIFF file, is none of these formats and is not read.

use super::tiff::Tiff;

/// Most bytes of a block that are looked at. A JPEG cannot hold longer ones in one piece; what is
/// used stands at the beginning of the others.
const MAX_BLOCK_BYTES: usize = 64 << 10;
/// Most blocks of a kind. Editors that add a second one instead of changing the first are known,
/// more are not.
const MAX_BLOCKS: usize = 4;

const EXIF_IDENTIFIER: &[u8] = b"Exif\0\0";
const XMP_IDENTIFIER: &[u8] = b"http://ns.adobe.com/xap/1.0/\0";
const XMP_KEYWORD: &[u8] = b"XML:com.adobe.xmp\0";

/// The blocks of one image.
#[derive(Debug, Default)]
pub(super) struct Blocks<'a> {
    /// EXIF blocks, each beginning with the header of a TIFF file.
    pub(super) exif: Vec<&'a [u8]>,
    /// XMP packets.
    pub(super) xmp: Vec<&'a [u8]>,
}

impl<'a> Blocks<'a> {
    pub(super) fn find(bytes: &'a [u8]) -> Self {
        let mut blocks = Self::default();
        // A walk ends early where the file is cut off; what came before counts.
        let _ = if let Some(rest) = bytes.strip_prefix(b"\xff\xd8") {
            blocks.walk_jpeg(rest)
        } else if let Some(rest) = bytes.strip_prefix(b"\x89PNG\r\n\x1a\n") {
            blocks.walk_png(rest)
        } else if bytes.starts_with(b"RIFF") && bytes.get(8..12) == Some(b"WEBP") {
            blocks.walk_webp(&bytes[12..])
        } else {
            None
        };
        blocks
    }

    /// Reads the segments between the start of the image and its first scan, as decoders do.
    fn walk_jpeg(&mut self, mut rest: &'a [u8]) -> Option<()> {
        const END_OF_IMAGE: u8 = 0xd9;
        const START_OF_SCAN: u8 = 0xda;
        const APP1: u8 = 0xe1;
        loop {
            let marker_at = rest.iter().position(|&byte| byte == 0xff)?;
            rest = &rest[marker_at..];
            match *rest.get(1)? {
                // Padding before a marker.
                0xff => rest = &rest[1..],
                // Markers without a length.
                0x00 | 0x01 | 0xd0..=0xd8 => rest = &rest[2..],
                END_OF_IMAGE | START_OF_SCAN => return None,
                marker => {
                    let length = u16::from_be_bytes(*rest.get(2..)?.first_chunk()?);
                    let length = usize::from(length).checked_sub(2)?;
                    let (segment, after) = rest.get(4..)?.split_at_checked(length)?;
                    if marker == APP1 {
                        self.add_app1(segment);
                    }
                    rest = after;
                }
            }
        }
    }

    fn add_app1(&mut self, segment: &'a [u8]) {
        if segment.starts_with(EXIF_IDENTIFIER) {
            self.add_exif(segment);
        } else if let Some(packet) = segment.strip_prefix(XMP_IDENTIFIER) {
            self.add_xmp(packet);
        }
    }

    fn walk_png(&mut self, mut rest: &'a [u8]) -> Option<()> {
        loop {
            let length = u32::from_be_bytes(*rest.first_chunk()?);
            let (chunk, after) = rest.get(8..)?.split_at_checked(length as usize)?;
            match &rest[4..8] {
                b"eXIf" => self.add_exif(chunk),
                b"iTXt" => xmp_in_text(chunk)
                    .into_iter()
                    .for_each(|xmp| self.add_xmp(xmp)),
                b"IEND" => return None,
                _ => {}
            }
            // The checksum follows. Decoders ignore that of such chunks, too.
            rest = after.get(4..)?;
        }
    }

    fn walk_webp(&mut self, mut rest: &'a [u8]) -> Option<()> {
        loop {
            let length = u32::from_le_bytes(*rest.get(4..)?.first_chunk()?);
            let (chunk, after) = rest.get(8..)?.split_at_checked(length as usize)?;
            match &rest[..4] {
                b"EXIF" => self.add_exif(chunk),
                b"XMP " => self.add_xmp(chunk),
                _ => {}
            }
            // Chunks begin at even offsets.
            rest = after.get(chunk.len() % 2..)?;
        }
    }

    /// Adds an EXIF block. Before the header, writers of PNG and WebP leave the identifier that it
    /// has in a JPEG.
    fn add_exif(&mut self, block: &'a [u8]) {
        let block = block.strip_prefix(EXIF_IDENTIFIER).unwrap_or(block);
        if self.exif.len() < MAX_BLOCKS && Tiff::new(block).is_some() {
            self.exif.push(beginning(block));
        }
    }

    fn add_xmp(&mut self, packet: &'a [u8]) {
        if self.xmp.len() < MAX_BLOCKS {
            self.xmp.push(beginning(packet));
        }
    }
}

fn beginning(block: &[u8]) -> &[u8] {
    &block[..block.len().min(MAX_BLOCK_BYTES)]
}

/// The XMP packet in the international text of a PNG, unless it is compressed or another text.
fn xmp_in_text(chunk: &[u8]) -> Option<&[u8]> {
    let rest = chunk.strip_prefix(XMP_KEYWORD)?;
    // A flag of compression, and its method.
    let rest = rest.strip_prefix(b"\0")?.get(1..)?;
    // The language and the translated keyword, both mostly empty.
    rest.splitn(3, |&byte| byte == 0).nth(2)
}
