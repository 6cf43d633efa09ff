//! The segments of a JPEG, read as libjpeg reads them, because that is what viewers use.
//!
//! So stray bytes between segments, fill bytes, segments in an odd order and bytes behind the end
//! are no faults. Nothing is decoded here, and the cost is linear in the bytes: tables are kept as
//! they are stored.

use super::fault::Fault;
use super::frame::{Colours, Component, Frame, Scan, ScanPart, StoredTable, TableInUse};
use super::standard;
use super::{COEFFICIENTS, MAX_SCANS};
use placeformer_core::types::ImageSize;

/// The frame and the scans of a JPEG.
#[derive(Debug)]
pub(super) struct Layout<'a> {
    pub frame: Frame,
    /// As many as the picture needs: further scans of a complete sequential picture are left out.
    pub scans: Vec<Scan<'a>>,
    /// Whether there is an end-of-image marker.
    pub ended: bool,
}

mod marker {
    pub const TEM: u8 = 0x01;
    pub const FIRST_RST: u8 = 0xd0;
    pub const LAST_RST: u8 = 0xd7;
    pub const SOI: u8 = 0xd8;
    pub const EOI: u8 = 0xd9;
    pub const DHT: u8 = 0xc4;
    pub const DAC: u8 = 0xcc;
    pub const SOS: u8 = 0xda;
    pub const DQT: u8 = 0xdb;
    pub const DNL: u8 = 0xdc;
    pub const DRI: u8 = 0xdd;
    pub const APP0: u8 = 0xe0;
    pub const APP14: u8 = 0xee;
    pub const APP15: u8 = 0xef;
    pub const COM: u8 = 0xfe;
}

/// Reads the segments. `check_size` is asked as soon as the size is known.
///
/// # Errors
/// What `check_size` refuses; see [`Fault`].
pub(super) fn read<'a, E: From<Fault>>(
    bytes: &'a [u8],
    check_size: impl Fn(ImageSize) -> Result<(), E>,
) -> Result<Layout<'a>, E> {
    let mut reader = Reader::new(bytes);
    while let Some(marker) = reader.next_marker() {
        if marker == marker::EOI {
            reader.ended = true;
            break;
        }
        let had_frame = reader.frame.is_some();
        match reader.segment(marker) {
            // What follows a complete picture takes nothing away from it.
            Err(fault) if !reader.is_complete || matches!(fault, Fault::Scans(_)) => {
                return Err(fault.into());
            }
            Err(_) => break,
            Ok(()) => {}
        }
        if let Some(frame) = reader.frame.as_ref().filter(|_| !had_frame) {
            check_size(frame.size)?;
        }
    }
    Ok(reader.finish()?)
}

struct Reader<'a> {
    bytes: &'a [u8],
    at: usize,
    frame: Option<Frame>,
    scans: Vec<Scan<'a>>,
    scan_count: usize,
    /// Whether this is a sequential picture of which all components have had their scan.
    is_complete: bool,
    ended: bool,
    quantisers: [Option<[u16; COEFFICIENTS]>; 4],
    dc_tables: [Option<StoredTable<'a>>; 4],
    ac_tables: [Option<StoredTable<'a>>; 4],
    restart_interval: u32,
    is_jfif: bool,
    adobe_transform: Option<u8>,
}

impl<'a> Reader<'a> {
    fn new(bytes: &'a [u8]) -> Self {
        Self {
            bytes,
            // The caller has seen the start-of-image marker.
            at: 2,
            frame: None,
            scans: Vec::new(),
            scan_count: 0,
            is_complete: false,
            ended: false,
            quantisers: [None; 4],
            dc_tables: [None; 4],
            ac_tables: [None; 4],
            restart_interval: 0,
            is_jfif: false,
            adobe_transform: None,
        }
    }

    fn finish(self) -> Result<Layout<'a>, Fault> {
        let frame = self.frame.ok_or(Fault::NoImageData)?;
        if self.scans.is_empty() {
            return Err(Fault::NoImageData);
        }
        Ok(Layout {
            frame,
            scans: self.scans,
            ended: self.ended,
        })
    }

    /// Goes behind the next marker, over whatever stands before it.
    fn next_marker(&mut self) -> Option<u8> {
        loop {
            let rest = self.bytes.get(self.at..)?;
            self.at += rest.iter().position(|&byte| byte == 0xff)? + 1;
            let rest = &self.bytes[self.at..];
            self.at += rest.iter().position(|&byte| byte != 0xff)? + 1;
            let marker = self.bytes[self.at - 1];
            if marker != 0 {
                return Some(marker);
            }
        }
    }

    /// The content of the segment whose marker was just read; `name` is for the error.
    fn body(&mut self, name: &'static str) -> Result<&'a [u8], Fault> {
        let rest = self.bytes.get(self.at..).unwrap_or_default();
        let length = rest.first_chunk().ok_or(Fault::SegmentEnd)?;
        let length = usize::from(u16::from_be_bytes(*length));
        if length < 2 {
            return Err(Fault::Length(name));
        }
        let body = rest.get(2..length).ok_or(Fault::SegmentEnd)?;
        self.at += length;
        Ok(body)
    }

    /// The same for segments that are skipped: libjpeg takes a length that is too short for zero.
    fn metadata(&mut self) -> Result<&'a [u8], Fault> {
        if let Some([0, 0 | 1]) = self.bytes.get(self.at..self.at + 2) {
            self.at += 2;
            return Ok(&[]);
        }
        self.body("metadata")
    }

    fn segment(&mut self, marker: u8) -> Result<(), Fault> {
        match marker {
            marker::TEM | marker::FIRST_RST..=marker::LAST_RST => Ok(()),
            marker::SOI => Err(Fault::Second("start of image")),
            marker::DHT => self.huffman_tables(),
            marker::DQT => self.quantiser_tables(),
            marker::DRI => self.restart_interval(),
            marker::SOS => self.scan(),
            marker::APP0..=marker::APP15 => self.application_data(marker),
            marker::COM | marker::DNL | marker::DAC => self.metadata().map(drop),
            0xc0..=0xcf => self.frame_header(marker),
            _ => Err(Fault::UnknownMarker(marker)),
        }
    }

    fn application_data(&mut self, marker: u8) -> Result<(), Fault> {
        let body = self.metadata()?;
        // What comes behind the first scan header no longer says what the colours mean.
        if self.scan_count > 0 {
            return Ok(());
        }
        if marker == marker::APP0 && body.starts_with(b"JFIF\0") && body.len() >= 14 {
            self.is_jfif = true;
        }
        if marker == marker::APP14 && body.starts_with(b"Adobe") && body.len() >= 12 {
            self.adobe_transform = Some(body[11]);
        }
        Ok(())
    }

    fn quantiser_tables(&mut self) -> Result<(), Fault> {
        let mut body = self.body("DQT")?;
        while let Some((&head, rest)) = body.split_first() {
            let wide = head >> 4 > 0;
            let slot = self.quantisers.get_mut(usize::from(head & 15));
            let slot = slot.ok_or(Fault::Slot)?;
            let length = if wide { 2 } else { 1 } * COEFFICIENTS;
            let (values, rest) = rest.split_at_checked(length).ok_or(Fault::Length("DQT"))?;
            *slot = Some(std::array::from_fn(|i| match wide {
                true => u16::from_be_bytes([values[2 * i], values[2 * i + 1]]),
                false => u16::from(values[i]),
            }));
            body = rest;
        }
        Ok(())
    }

    fn huffman_tables(&mut self) -> Result<(), Fault> {
        let mut body = self.body("DHT")?;
        while let Some((&head, rest)) = body.split_first() {
            let wrong = Fault::Length("DHT");
            let (counts, rest) = rest.split_first_chunk().ok_or(wrong.clone())?;
            let length: usize = counts.iter().map(|&count| usize::from(count)).sum();
            let (symbols, rest) = rest.split_at_checked(length).ok_or(wrong)?;
            let tables = match head >> 4 {
                0 => &mut self.dc_tables,
                1 => &mut self.ac_tables,
                _ => return Err(Fault::Slot),
            };
            let slot = tables.get_mut(usize::from(head & 15)).ok_or(Fault::Slot)?;
            if length > 256 {
                return Err(Fault::BadTable);
            }
            *slot = Some(StoredTable { counts, symbols });
            body = rest;
        }
        Ok(())
    }

    fn restart_interval(&mut self) -> Result<(), Fault> {
        let body = self.body("DRI")?;
        let interval = body.try_into().map_err(|_| Fault::Length("DRI"))?;
        self.restart_interval = u32::from(u16::from_be_bytes(interval));
        Ok(())
    }

    fn frame_header(&mut self, marker: u8) -> Result<(), Fault> {
        if self.frame.is_some() {
            return Err(Fault::Second("frame header"));
        }
        let progressive = match marker {
            0xc0 | 0xc1 => false,
            0xc2 => true,
            0xc3 => return Err(Fault::Coding("lossless")),
            0xc9 | 0xca => return Err(Fault::Coding("arithmetic")),
            0xcb => return Err(Fault::Coding("lossless arithmetic")),
            _ => return Err(Fault::Coding("hierarchical")),
        };
        let body = self.body("frame header")?;
        let wrong = Fault::Length("frame header");
        let (&[depth, y0, y1, x0, x1, count], rest) =
            body.split_first_chunk().ok_or(wrong.clone())?;
        if depth != 8 {
            return Err(Fault::Depth(depth));
        }
        let size = ImageSize {
            width: u32::from(u16::from_be_bytes([x0, x1])),
            height: u32::from(u16::from_be_bytes([y0, y1])),
        };
        if size.height == 0 {
            return Err(Fault::NoHeight);
        }
        let count = usize::from(count);
        if ![1, 3, 4].contains(&count) {
            return Err(Fault::Components(count));
        }
        if rest.len() != 3 * count {
            return Err(wrong);
        }
        let components: Vec<_> = rest
            .chunks_exact(3)
            .map(component)
            .collect::<Result<_, _>>()?;
        self.frame = Some(Frame {
            size,
            progressive,
            components,
            colours: Colours::Grey,
        });
        Ok(())
    }

    fn scan(&mut self) -> Result<(), Fault> {
        let body = self.body("SOS")?;
        self.scan_count += 1;
        if self.scan_count > MAX_SCANS {
            return Err(Fault::Scans(MAX_SCANS));
        }
        let data = self.scan_data();
        if self.is_complete {
            return Ok(());
        }
        let colours = self.colours();
        let frame = self.frame.as_mut().ok_or(Fault::BeforeFrame("SOS"))?;
        if self.scans.is_empty() {
            frame.colours = colours;
        }
        if self.scans.is_empty() && !frame.progressive {
            // Frames of motion JPEG leave the tables out: they all use the standard ones.
            standard::fill(&mut self.dc_tables, &mut self.ac_tables);
        }
        let wrong = Fault::ScanHeader(self.scan_count);
        let (&count, rest) = body.split_first().ok_or(wrong.clone())?;
        let count = usize::from(count);
        if !(1..=4).contains(&count) || rest.len() != 2 * count + 3 {
            return Err(wrong);
        }
        let (pairs, parameters) = rest.split_at(2 * count);
        let tables = (&self.dc_tables, &self.ac_tables);
        let parts = parts(pairs, frame, tables).ok_or(wrong)?;
        for part in &parts {
            let component = &mut frame.components[part.component];
            let quantisers = self.quantisers[component.quantiser_slot];
            component.quantisers = component.quantisers.or(quantisers);
        }
        // A sequential picture has one scan for each coefficient. What it says about bands is
        // ignored.
        let (band, approximation) = match frame.progressive {
            true => ((parameters[0].into(), parameters[1].into()), parameters[2]),
            false => ((0, COEFFICIENTS - 1), 0),
        };
        self.scans.push(Scan {
            parts,
            band,
            high: approximation >> 4,
            low: approximation & 15,
            restart_interval: self.restart_interval,
            data,
        });
        let had_scans: usize = self.scans.iter().map(|scan| scan.parts.len()).sum();
        self.is_complete = !frame.progressive && had_scans >= frame.components.len();
        Ok(())
    }

    /// What follows a scan header: up to a marker that cannot stand in compressed data.
    fn scan_data(&mut self) -> &'a [u8] {
        let start = self.at;
        loop {
            let rest = &self.bytes[self.at..];
            let Some(next) = rest.iter().position(|&byte| byte == 0xff) else {
                self.at = self.bytes.len();
                break;
            };
            self.at += next;
            match self.bytes.get(self.at + 1).copied() {
                Some(0x00 | marker::TEM | marker::FIRST_RST..=marker::LAST_RST) => self.at += 2,
                Some(0xff) => self.at += 1,
                Some(_) => break,
                None => self.at += 1,
            }
        }
        &self.bytes[start..self.at]
    }

    /// What the components mean, decided as libjpeg decides.
    fn colours(&self) -> Colours {
        let components = self
            .frame
            .as_ref()
            .map_or(&[][..], |frame| &frame.components);
        let ids: Vec<u8> = components.iter().map(|component| component.id).collect();
        match (ids.as_slice(), self.is_jfif, self.adobe_transform) {
            ([_], ..) => Colours::Grey,
            ([_, _, _], false, Some(0)) | ([82, 71, 66], false, None) => Colours::Rgb,
            ([_, _, _, _], _, None | Some(0)) => Colours::Cmyk,
            ([_, _, _, _], ..) => Colours::Ycck,
            _ => Colours::YCbCr,
        }
    }
}

/// One component of a frame header.
fn component(fields: &[u8]) -> Result<Component, Fault> {
    let (horizontal, vertical) = (fields[1] >> 4, fields[1] & 15);
    if !(1..=4).contains(&horizontal) || !(1..=4).contains(&vertical) {
        return Err(Fault::Sampling(format!("{horizontal}x{vertical}")));
    }
    if fields[2] > 3 {
        return Err(Fault::Slot);
    }
    Ok(Component {
        id: fields[0],
        sampling: (horizontal.into(), vertical.into()),
        quantiser_slot: fields[2].into(),
        quantisers: None,
    })
}

type Tables<'a> = [Option<StoredTable<'a>>; 4];

/// The components of a scan, which must come in the order of the frame.
fn parts<'a>(
    pairs: &[u8],
    frame: &Frame,
    (dc, ac): (&Tables<'a>, &Tables<'a>),
) -> Option<Vec<ScanPart<'a>>> {
    let mut parts = Vec::with_capacity(4);
    let mut from = 0;
    for pair in pairs.chunks_exact(2) {
        let rest = frame.components.get(from..)?;
        let component = from + rest.iter().position(|component| component.id == pair[0])?;
        from = component + 1;
        let in_use = |tables: &Tables<'a>, slot: u8| {
            let table = *tables.get(usize::from(slot))?;
            Some(TableInUse { slot, table })
        };
        parts.push(ScanPart {
            component,
            dc: in_use(dc, pair[1] >> 4)?,
            ac: in_use(ac, pair[1] & 15)?,
        });
    }
    Some(parts)
}
