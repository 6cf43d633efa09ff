//! Photos that say about themselves where, in which direction and when they were taken.

use super::noise;

/// What a photo says; `None` is left out.
#[derive(Debug, Clone, Copy, Default)]
pub struct Says {
    pub position: Option<(f64, f64)>,
    pub alt: Option<u16>,
    pub heading: Option<u16>,
    /// `YYYY:MM:DD HH:MM:SS`.
    pub time: Option<&'static str>,
}

/// A PNG drawn from `seed` with what it says in EXIF.
pub fn png_with_exif(seed: u64, says: Says) -> Vec<u8> {
    with_chunk(&noise::png(seed, 64, 48), b"eXIf", &exif_block(says))
}

/// A PNG drawn from `seed` with the properties of an XMP packet.
pub fn png_with_xmp(seed: u64, properties: &str) -> Vec<u8> {
    let text = format!(
        "XML:com.adobe.xmp\0\0\0\0\0<x:xmpmeta xmlns:x=\"adobe:ns:meta/\"><rdf:RDF>\
         <rdf:Description {properties}/></rdf:RDF></x:xmpmeta>"
    );
    with_chunk(&noise::png(seed, 64, 48), b"iTXt", text.as_bytes())
}

/// A PNG with one more chunk behind its header.
pub fn with_chunk(png: &[u8], kind: &[u8; 4], body: &[u8]) -> Vec<u8> {
    let named = [kind.as_slice(), body].concat();
    let length = (body.len() as u32).to_be_bytes();
    let checksum = crc32fast::hash(&named).to_be_bytes();
    // Signature and IHDR fill the first 33 bytes.
    let (header, rest) = png.split_at(33);
    [header, &length, &named, &checksum, rest].concat()
}

/// Tag, type, number of values, and their bytes.
type Entry = (u16, u16, usize, Vec<u8>);

/// An EXIF block, big-endian.
pub fn exif_block(says: Says) -> Vec<u8> {
    let text = |tag: u16, text: &str| -> Entry {
        let bytes = [text.as_bytes(), b"\0"].concat();
        (tag, 2, bytes.len(), bytes)
    };
    let millionths = |tag: u16, value: f64| -> Entry {
        let units = (value.abs() * 1e6).round() as u32;
        let bytes = [units.to_be_bytes(), 1_000_000u32.to_be_bytes()].concat();
        (tag, 5, 1, bytes)
    };
    let mut gps = Vec::new();
    if let Some((lat, lon)) = says.position {
        gps.push(text(1, if lat < 0.0 { "S" } else { "N" }));
        gps.push(millionths(2, lat));
        gps.push(text(3, if lon < 0.0 { "W" } else { "E" }));
        gps.push(millionths(4, lon));
    }
    gps.extend(says.alt.map(|metres| millionths(6, f64::from(metres))));
    gps.extend(
        says.heading
            .map(|degrees| millionths(17, f64::from(degrees))),
    );
    let exif: Vec<Entry> = says
        .time
        .map(|time| text(0x9003, time))
        .into_iter()
        .collect();
    let pointer = |tag: u16, at: usize| (tag, 4, 1, (at as u32).to_be_bytes().to_vec());
    // Header, and a directory of two pointers.
    let exif_at = 8 + 2 + 2 * 12 + 4;
    let exif = directory(exif_at, &exif);
    let gps_at = exif_at + exif.len();
    let first = directory(8, &[pointer(0x8769, exif_at), pointer(0x8825, gps_at)]);
    let header = b"MM\0*\0\0\0\x08";
    [header.as_slice(), &first, &exif, &directory(gps_at, &gps)].concat()
}

/// A directory that begins at `at`, its long values behind it.
fn directory(at: usize, entries: &[Entry]) -> Vec<u8> {
    let mut bytes = (entries.len() as u16).to_be_bytes().to_vec();
    let mut values: Vec<u8> = Vec::new();
    let values_at = at + 2 + 12 * entries.len() + 4;
    for (tag, kind, count, data) in entries {
        bytes.extend(tag.to_be_bytes());
        bytes.extend(kind.to_be_bytes());
        bytes.extend((*count as u32).to_be_bytes());
        let mut inline = data.clone();
        if data.len() > 4 {
            inline = ((values_at + values.len()) as u32).to_be_bytes().to_vec();
            values.extend(data);
        }
        inline.resize(4, 0);
        bytes.extend(inline);
    }
    bytes.extend([0; 4]);
    bytes.extend(values);
    bytes
}
