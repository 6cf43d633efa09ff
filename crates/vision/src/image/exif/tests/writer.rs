//! Writes EXIF blocks and files around them.

use crate::image::exif::{
    DATE_TIME_ORIGINAL, EXIF_DIRECTORY, GPS_DIRECTORY, OFFSET_TIME_ORIGINAL, ORIENTATION,
};

#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Order {
    Little,
    Big,
}

impl Order {
    pub(super) fn u16(self, value: u16) -> [u8; 2] {
        match self {
            Self::Little => value.to_le_bytes(),
            Self::Big => value.to_be_bytes(),
        }
    }

    pub(super) fn u32(self, value: u32) -> [u8; 4] {
        match self {
            Self::Little => value.to_le_bytes(),
            Self::Big => value.to_be_bytes(),
        }
    }

    pub(super) fn header(self) -> Vec<u8> {
        let mark: &[u8] = if self == Self::Little { b"II" } else { b"MM" };
        [mark, &self.u16(42), &self.u32(8)].concat()
    }
}

#[derive(Debug, Clone)]
pub(super) enum Value {
    Byte(Vec<u8>),
    Text(&'static str),
    Short(Vec<u16>),
    Long(Vec<u32>),
    Rational(Vec<(u32, u32)>),
    SignedRational(Vec<(i32, i32)>),
    Float(Vec<f32>),
    Double(Vec<f64>),
}

impl Value {
    /// Type, number of values, and bytes.
    fn encode(&self, order: Order) -> (u16, usize, Vec<u8>) {
        let u32s = |values: &[u32]| -> Vec<u8> {
            values.iter().flat_map(|value| order.u32(*value)).collect()
        };
        let doubles = |values: &[f64]| -> Vec<u8> {
            let bytes = |value: &f64| match order {
                Order::Little => value.to_le_bytes(),
                Order::Big => value.to_be_bytes(),
            };
            values.iter().flat_map(bytes).collect()
        };
        match self {
            Self::Byte(values) => (1, values.len(), values.clone()),
            Self::Text(text) => (2, text.len() + 1, [text.as_bytes(), b"\0"].concat()),
            Self::Short(values) => {
                let bytes = values.iter().flat_map(|value| order.u16(*value));
                (3, values.len(), bytes.collect())
            }
            Self::Long(values) => (4, values.len(), u32s(values)),
            Self::Rational(values) => {
                let flat: Vec<u32> = values.iter().flat_map(|&(a, b)| [a, b]).collect();
                (5, values.len(), u32s(&flat))
            }
            Self::SignedRational(values) => {
                let flat = values.iter().flat_map(|&(a, b)| [a, b]);
                let flat: Vec<u32> = flat.map(i32::cast_unsigned).collect();
                (10, values.len(), u32s(&flat))
            }
            Self::Float(values) => {
                let bits: Vec<u32> = values.iter().map(|value| value.to_bits()).collect();
                (11, values.len(), u32s(&bits))
            }
            Self::Double(values) => (12, values.len(), doubles(values)),
        }
    }
}

pub(super) type Entries = Vec<(u16, Value)>;

/// The content of an EXIF block.
#[derive(Debug, Clone, Default)]
pub(super) struct Exif {
    pub(super) first: Entries,
    pub(super) exif: Entries,
    pub(super) gps: Entries,
}

impl Exif {
    /// A position in Paris.
    pub(super) fn paris() -> Self {
        let degrees = |units: u32| Value::Rational(vec![(units, 10_000), (0, 1), (0, 1)]);
        Self::default()
            .gps(1, Value::Text("N"))
            .gps(2, degrees(488_584))
            .gps(3, Value::Text("E"))
            .gps(4, degrees(22_945))
    }

    pub(super) fn gps(mut self, tag: u16, value: Value) -> Self {
        self.gps.retain(|(known, _)| *known != tag);
        self.gps.push((tag, value));
        self
    }

    pub(super) fn exif(mut self, tag: u16, value: Value) -> Self {
        self.exif.push((tag, value));
        self
    }

    pub(super) fn heading(self, degrees: f64) -> Self {
        let tenths = (degrees * 10.0) as u32;
        self.gps(17, Value::Rational(vec![(tenths, 10)]))
    }

    pub(super) fn time(self, text: &'static str) -> Self {
        self.exif(DATE_TIME_ORIGINAL, Value::Text(text))
    }

    pub(super) fn offset(self, text: &'static str) -> Self {
        self.exif(OFFSET_TIME_ORIGINAL, Value::Text(text))
    }

    pub(super) fn gps_time(self, date: &'static str, clock: [u32; 3]) -> Self {
        let clock = clock.map(|part| (part, 1)).to_vec();
        self.gps(29, Value::Text(date))
            .gps(7, Value::Rational(clock))
    }

    pub(super) fn orientation(mut self, value: u16) -> Self {
        self.first.push((ORIENTATION, Value::Short(vec![value])));
        self
    }

    pub(super) fn write(&self, order: Order) -> Vec<u8> {
        let mut block = order.header();
        let mut first = self.first.clone();
        first.push((EXIF_DIRECTORY, Value::Long(vec![0])));
        first.push((GPS_DIRECTORY, Value::Long(vec![0])));
        // Offsets depend only on lengths, so the second time they are right.
        let first_end = block.len() + directory(&first, 0, order).len();
        let exif_end = first_end + directory(&self.exif, 0, order).len();
        let count = first.len();
        first[count - 2].1 = Value::Long(vec![first_end as u32]);
        first[count - 1].1 = Value::Long(vec![exif_end as u32]);
        block.extend(directory(&first, block.len(), order));
        block.extend(directory(&self.exif, block.len(), order));
        block.extend(directory(&self.gps, block.len(), order));
        block
    }

    /// The same in a JPEG, read.
    pub(super) fn read(&self) -> crate::image::ExifInfo {
        crate::image::read_exif(&Container::Jpeg.with_exif(&self.write(Order::Little)))
    }
}

/// A directory that begins at `at`, with its values behind it.
fn directory(entries: &Entries, at: usize, order: Order) -> Vec<u8> {
    let mut bytes = order.u16(entries.len() as u16).to_vec();
    let mut values = Vec::new();
    let values_at = at + 2 + 12 * entries.len() + 4;
    for (tag, value) in entries {
        let (kind, count, mut data) = value.encode(order);
        bytes.extend(order.u16(*tag));
        bytes.extend(order.u16(kind));
        bytes.extend(order.u32(count as u32));
        if data.len() <= 4 {
            data.resize(4, 0);
            bytes.extend(data);
        } else {
            bytes.extend(order.u32((values_at + values.len()) as u32));
            values.extend(data);
        }
    }
    bytes.extend([0; 4]);
    bytes.extend(values);
    bytes
}

/// An image format, of which only the outline matters here.
#[derive(Debug, Clone, Copy)]
pub(super) enum Container {
    Jpeg,
    Png,
    WebP,
}

impl Container {
    pub(super) const ALL: [Self; 3] = [Self::Jpeg, Self::Png, Self::WebP];

    /// A file around an EXIF block. That in a JPEG is cut to the length of a segment.
    pub(super) fn with_exif(self, block: &[u8]) -> Vec<u8> {
        match self {
            Self::Jpeg => {
                let bare = block.strip_prefix(b"Exif\0\0").unwrap_or(block);
                jpeg_of(&[(b"Exif\0\0", &bare[..bare.len().min(65_000)])])
            }
            Self::Png => png_of(&[(b"eXIf", block)]),
            Self::WebP => webp_of(&[(b"EXIF", block)]),
        }
    }

    pub(super) fn with_xmp(self, packet: &str) -> Vec<u8> {
        let packet = packet.as_bytes();
        match self {
            Self::Jpeg => jpeg_of(&[(b"http://ns.adobe.com/xap/1.0/\0", packet)]),
            Self::Png => {
                let text = [b"XML:com.adobe.xmp\0\0\0en\0title\0".as_slice(), packet].concat();
                png_of(&[(b"iTXt", &text)])
            }
            Self::WebP => webp_of(&[(b"XMP ", packet)]),
        }
    }
}

/// A JPEG with one APP1 segment for each identifier and content.
pub(super) fn jpeg_of(segments: &[(&[u8], &[u8])]) -> Vec<u8> {
    let mut bytes = b"\xff\xd8\xff\xe0\x00\x04ab".to_vec();
    for (identifier, content) in segments {
        let length = (identifier.len() + content.len() + 2) as u16;
        bytes.extend([b"\xff\xe1", &length.to_be_bytes()[..], identifier, content].concat());
    }
    bytes.extend(b"\xff\xda\x00\x02scan\xff\xd9");
    bytes
}

/// A PNG with these chunks behind its pixels.
pub(super) fn png_of(chunks: &[(&[u8; 4], &[u8])]) -> Vec<u8> {
    let mut bytes = b"\x89PNG\r\n\x1a\n".to_vec();
    let pixels: [(&[u8; 4], &[u8]); 2] = [(b"IHDR", &[0; 13]), (b"IDAT", b"pixels")];
    for (kind, body) in pixels.iter().chain(chunks).chain([&(b"IEND", &b""[..])]) {
        let length = (body.len() as u32).to_be_bytes();
        bytes.extend([&length, kind.as_slice(), body, b"crc!"].concat());
    }
    bytes
}

/// A WebP with these chunks behind its pixels.
pub(super) fn webp_of(chunks: &[(&[u8; 4], &[u8])]) -> Vec<u8> {
    let mut bytes = b"WEBP".to_vec();
    let pixels: [(&[u8; 4], &[u8]); 1] = [(b"VP8 ", b"pixel")];
    for (kind, body) in pixels.iter().chain(chunks) {
        let length = (body.len() as u32).to_le_bytes();
        bytes.extend([kind.as_slice(), &length, body].concat());
        bytes.resize(bytes.len().next_multiple_of(2), 0);
    }
    let length = (bytes.len() as u32).to_le_bytes();
    [b"RIFF", length.as_slice(), &bytes].concat()
}
