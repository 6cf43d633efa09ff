//! A JPEG encoder that writes every layout: sequential or progressive, interleaved or not, with any
//! sampling factors, with or without restart markers. It is slow and simple.

use crate::jpeg::bits::{Bits, size};
use crate::jpeg::picture::{Colours, value};
use crate::jpeg::refinement::Refinement;
use placeformer_core::types::ImageSize;
use std::f32::consts::PI;
use std::sync::LazyLock;

/// How a picture is laid out in the file.
#[derive(Debug, Clone)]
pub struct Layout {
    pub size: ImageSize,
    pub colours: Colours,
    /// Sampling factors of each component, horizontal and vertical.
    pub sampling: Vec<(u32, u32)>,
    pub progressive: bool,
    pub scans: Vec<Scan>,
    /// Units between restart markers; 0 for none.
    pub restart_interval: u16,
}

/// What a scan holds.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Scan {
    pub components: Vec<usize>,
    /// The first and the last coefficient of the band.
    pub band: (usize, usize),
    /// The lowest bit that was known before, 0 for none, and the lowest after it.
    pub bits: (u32, u32),
}

impl Scan {
    pub fn new(components: &[usize], band: (usize, usize), bits: (u32, u32)) -> Self {
        Self {
            components: components.to_vec(),
            band,
            bits,
        }
    }
}

/// One scan of all components.
pub fn interleaved(components: usize) -> Vec<Scan> {
    let all: Vec<usize> = (0..components).collect();
    vec![Scan::new(&all, (0, 63), (0, 0))]
}

/// One scan for each component.
pub fn separate(components: usize) -> Vec<Scan> {
    (0..components)
        .map(|component| Scan::new(&[component], (0, 63), (0, 0)))
        .collect()
}

/// The scans of libjpeg's progressive mode: means first, then bands, then the last bit.
pub fn progressive(components: usize) -> Vec<Scan> {
    let all: Vec<usize> = (0..components).collect();
    let mut scans = vec![Scan::new(&all, (0, 0), (0, 1))];
    for &component in &all {
        scans.push(Scan::new(&[component], (1, 5), (0, 2)));
        scans.push(Scan::new(&[component], (6, 63), (0, 2)));
        scans.push(Scan::new(&[component], (1, 63), (2, 1)));
    }
    scans.push(Scan::new(&all, (0, 0), (1, 0)));
    scans.extend(
        all.iter()
            .map(|&component| Scan::new(&[component], (1, 63), (1, 0))),
    );
    scans
}

impl Layout {
    /// A sequential picture of one scan, all components at full size.
    pub fn new(width: u32, height: u32, colours: Colours) -> Self {
        Self {
            size: ImageSize { width, height },
            colours,
            sampling: vec![(1, 1); colours.components()],
            progressive: false,
            scans: interleaved(colours.components()),
            restart_interval: 0,
        }
    }

    pub fn sampled(self, sampling: &[(u32, u32)]) -> Self {
        Self {
            sampling: sampling.to_vec(),
            ..self
        }
    }

    pub fn separate(self) -> Self {
        Self {
            scans: separate(self.colours.components()),
            ..self
        }
    }

    pub fn progressive(self) -> Self {
        Self {
            scans: progressive(self.colours.components()),
            progressive: true,
            ..self
        }
    }

    pub fn restarting(self, restart_interval: u16) -> Self {
        Self {
            restart_interval,
            ..self
        }
    }

    pub fn largest(&self) -> (u32, u32) {
        let horizontal = self
            .sampling
            .iter()
            .map(|sampling| sampling.0)
            .max()
            .unwrap();
        let vertical = self
            .sampling
            .iter()
            .map(|sampling| sampling.1)
            .max()
            .unwrap();
        (horizontal, vertical)
    }

    /// Units of a scan of several components, across and down.
    fn units(&self) -> (u32, u32) {
        let (horizontal, vertical) = self.largest();
        let ImageSize { width, height } = self.size;
        (
            width.div_ceil(8 * horizontal),
            height.div_ceil(8 * vertical),
        )
    }

    /// Blocks with samples of the picture, across and down.
    fn blocks(&self, component: usize) -> (u32, u32) {
        let (horizontal, vertical) = self.largest();
        let ImageSize { width, height } = self.size;
        let (own_horizontal, own_vertical) = self.sampling[component];
        let blocks = |side: u32, own: u32, all: u32| (side * own).div_ceil(all).div_ceil(8);
        (
            blocks(width, own_horizontal, horizontal),
            blocks(height, own_vertical, vertical),
        )
    }

    /// The segments before the first scan.
    pub fn head(&self) -> Vec<Vec<u8>> {
        let mut segments = Vec::new();
        match self.colours {
            Colours::Rgb | Colours::Cmyk => segments.push(adobe(0)),
            Colours::Ycck => segments.push(adobe(2)),
            Colours::Grey | Colours::YCbCr => segments.push(jfif()),
        }
        segments.push(segment(0xdb, &[&[0][..], &[QUANTISER; 64]].concat()));
        segments.push(self.frame_header());
        segments.extend(huffman_tables());
        if self.restart_interval > 0 {
            segments.push(segment(0xdd, &self.restart_interval.to_be_bytes()));
        }
        segments
    }

    fn frame_header(&self) -> Vec<u8> {
        let mut body = vec![8];
        body.extend((self.size.height as u16).to_be_bytes());
        body.extend((self.size.width as u16).to_be_bytes());
        body.push(self.sampling.len() as u8);
        for (place, (horizontal, vertical)) in self.sampling.iter().enumerate() {
            body.extend([place as u8 + 1, (horizontal << 4 | vertical) as u8, 0]);
        }
        segment(if self.progressive { 0xc2 } else { 0xc0 }, &body)
    }

    /// The whole file.
    pub fn encode(&self) -> Vec<u8> {
        let mut file = b"\xff\xd8".to_vec();
        file.extend(self.head().concat());
        file.extend(self.scans().concat());
        file.extend(b"\xff\xd9");
        file
    }

    /// The scans, each with its header.
    pub fn scans(&self) -> Vec<Vec<u8>> {
        let components = 0..self.sampling.len();
        let planes: Vec<Plane> = components.map(|component| self.plane(component)).collect();
        self.scans
            .iter()
            .map(|scan| self.scan(scan, &planes))
            .collect()
    }

    fn scan(&self, scan: &Scan, planes: &[Plane]) -> Vec<u8> {
        let mut body = vec![scan.components.len() as u8];
        for &component in &scan.components {
            body.extend([component as u8 + 1, 0]);
        }
        let (high, low) = scan.bits;
        body.extend([
            scan.band.0 as u8,
            scan.band.1 as u8,
            (high << 4 | low) as u8,
        ]);
        let mut bytes = segment(0xda, &body);
        let units = self.unit_blocks(scan);
        let interval = match self.restart_interval {
            0 => units.len(),
            interval => usize::from(interval),
        };
        for (number, units) in units.chunks(interval).enumerate() {
            if number > 0 {
                bytes.extend([0xff, 0xd0 + (number as u8 - 1) % 8]);
            }
            bytes.extend(encode_interval(scan, self.progressive, units, planes));
        }
        bytes
    }

    /// For each unit the blocks in it: component and place.
    fn unit_blocks(&self, scan: &Scan) -> Vec<Vec<(usize, usize)>> {
        let columns = |component: usize| self.units().0 * self.sampling[component].0;
        let place = |component, x: u32, y: u32| (component, (y * columns(component) + x) as usize);
        let mut units = Vec::new();
        if let [component] = scan.components[..] {
            let (across, down) = self.blocks(component);
            for y in 0..down {
                units.extend((0..across).map(|x| vec![place(component, x, y)]));
            }
            return units;
        }
        let (across, down) = self.units();
        for (y, x) in (0..down).flat_map(|y| (0..across).map(move |x| (y, x))) {
            let mut unit = Vec::new();
            for &component in &scan.components {
                let (horizontal, vertical) = self.sampling[component];
                for (v, h) in (0..vertical).flat_map(|v| (0..horizontal).map(move |h| (v, h))) {
                    unit.push(place(component, x * horizontal + h, y * vertical + v));
                }
            }
            units.push(unit);
        }
        units
    }

    /// The quantised coefficients of a component, in zigzag order, block by block.
    fn plane(&self, component: usize) -> Plane {
        let (largest_horizontal, largest_vertical) = self.largest();
        let (horizontal, vertical) = self.sampling[component];
        let (across, down) = self.units();
        let ImageSize { width, height } = self.size;
        let sample = |x: u32, y: u32| {
            let u = (x as f32 + 0.5) * largest_horizontal as f32 / horizontal as f32;
            let v = (y as f32 + 0.5) * largest_vertical as f32 / vertical as f32;
            value(component, u / width as f32, v / height as f32).clamp(0.0, 255.0) - 128.0
        };
        let mut blocks = Vec::new();
        for y in 0..down * vertical {
            for x in 0..across * horizontal {
                let samples = std::array::from_fn(|i| {
                    let (i, j) = (i as u32 % 8, i as u32 / 8);
                    sample(8 * x + i, 8 * y + j)
                });
                blocks.push(coefficients(&samples));
            }
        }
        blocks
    }
}

/// Coefficients of the blocks of a component.
pub type Plane = Vec<[i32; 64]>;

const QUANTISER: u8 = 3;

/// For each place and frequency the cosine of the transform.
static WAVES: LazyLock<[[f32; 8]; 8]> = LazyLock::new(|| {
    let angle = |at: usize, frequency: usize| ((2 * at + 1) * frequency) as f32 * PI / 16.0;
    std::array::from_fn(|at| std::array::from_fn(|frequency| angle(at, frequency).cos()))
});

/// The discrete cosine transform by its formula, quantised, in zigzag order.
fn coefficients(samples: &[f32; 64]) -> [i32; 64] {
    let scale = |frequency: usize| if frequency == 0 { 0.5f32.sqrt() } else { 1.0 };
    let waves = &*WAVES;
    ZIGZAG.map(|(u, v)| {
        let mut sum = 0.0;
        for (row, down) in samples.chunks_exact(8).zip(waves) {
            let across: f32 = row
                .iter()
                .zip(waves)
                .map(|(value, wave)| value * wave[u])
                .sum();
            sum += across * down[v];
        }
        (sum * scale(u) * scale(v) / 4.0 / f32::from(QUANTISER)).round() as i32
    })
}

/// The frequencies, across and down, in the order in which they are stored.
static ZIGZAG: LazyLock<[(usize, usize); 64]> = LazyLock::new(|| {
    let mut order: Vec<(usize, usize)> = (0..64).map(|i| (i % 8, i / 8)).collect();
    // Along the diagonals, upwards and downwards in turn.
    order.sort_by_key(|&(u, v)| (u + v, if (u + v).is_multiple_of(2) { u } else { v }));
    order.try_into().unwrap()
});

fn encode_interval(
    scan: &Scan,
    is_progressive: bool,
    units: &[Vec<(usize, usize)>],
    planes: &[Plane],
) -> Vec<u8> {
    let blocks = units
        .iter()
        .flatten()
        .map(|&(component, at)| (component, &planes[component][at]));
    if scan.band.0 > 0 && scan.bits.0 > 0 {
        return Refinement::encode(scan, blocks.map(|(_, block)| block));
    }
    let mut bits = Bits::default();
    let mut last_dc = [0; 4];
    let mut run = 0;
    let (high, low) = scan.bits;
    for (component, block) in blocks {
        if scan.band.0 == 0 && high > 0 {
            bits.put((block[0] >> low) as u32, 1);
        } else if scan.band.0 == 0 {
            let dc = block[0] >> low;
            let difference = dc - std::mem::replace(&mut last_dc[component], dc);
            bits.dc(size(difference));
            bits.value(difference, size(difference));
        }
        let first = scan.band.0.max(1);
        if high == 0 && first <= scan.band.1 {
            // A point transform cuts off bits towards zero.
            let band = block[first..=scan.band.1]
                .iter()
                .map(|value| value / (1 << low));
            first_ac(
                &mut bits,
                &band.collect::<Vec<_>>(),
                &mut run,
                is_progressive,
            );
        }
    }
    end_run(&mut bits, &mut run);
    bits.finish()
}

/// The band of a block; in a progressive picture `run` counts the blocks that are not yet ended.
fn first_ac(bits: &mut Bits, band: &[i32], run: &mut u32, is_progressive: bool) {
    let mut zeros = 0;
    for &value in band {
        if value == 0 {
            zeros += 1;
            continue;
        }
        end_run(bits, run);
        while zeros > 15 {
            bits.ac(0xf0);
            zeros -= 16;
        }
        bits.ac(zeros << 4 | size(value));
        bits.value(value, size(value));
        zeros = 0;
    }
    if zeros > 0 && is_progressive {
        *run += 1;
        if *run == 0x7fff {
            end_run(bits, run);
        }
    } else if zeros > 0 {
        bits.ac(0);
    }
}

/// Says that `run` blocks end here.
pub fn end_run(bits: &mut Bits, run: &mut u32) {
    if *run > 0 {
        let extra = size(*run as i32) - 1;
        bits.ac(extra << 4);
        bits.put(*run, extra);
        *run = 0;
    }
}

/// A segment with its marker and length.
pub fn segment(marker: u8, body: &[u8]) -> Vec<u8> {
    let length = (body.len() as u16 + 2).to_be_bytes();
    [&[0xff, marker][..], &length, body].concat()
}

pub fn jfif() -> Vec<u8> {
    segment(0xe0, b"JFIF\0\x01\x01\0\0\x01\0\x01\0\0")
}

fn adobe(transform: u8) -> Vec<u8> {
    segment(
        0xee,
        &[b"Adobe\0\x64\0\0\0\0".as_slice(), &[transform][..]].concat(),
    )
}

/// A DC table whose codes are the symbols 0 to 11 in four bits, and an AC table whose codes are the
/// symbols 0 to 254 in eight.
pub fn huffman_tables() -> [Vec<u8>; 2] {
    let table = |class: u8, bits: usize, symbols: u8| {
        let mut counts = [0; 16];
        counts[bits - 1] = symbols;
        let symbols: Vec<u8> = (0..symbols).collect();
        segment(0xc4, &[&[class][..], &counts, &symbols].concat())
    };
    [table(0x00, 4, 12), table(0x10, 8, 255)]
}
