//! What a JPEG states about itself: its frame, its scans and the tables that each of them uses.

use super::COEFFICIENTS;
use placeformer_core::types::ImageSize;

/// The frame header, with what else is needed to turn samples into colours.
#[derive(Debug, Clone)]
pub(super) struct Frame {
    pub size: ImageSize,
    pub progressive: bool,
    pub components: Vec<Component>,
    pub colours: Colours,
}

/// One of the planes that a frame consists of.
#[derive(Debug, Clone)]
pub(super) struct Component {
    pub id: u8,
    /// Sampling factors, horizontal and vertical, 1 to 4.
    pub sampling: (u32, u32),
    pub quantiser_slot: usize,
    /// The quantisers in zigzag order, as they were when the first scan of the component began.
    pub quantisers: Option<[u16; COEFFICIENTS]>,
}

/// What the components of a frame mean.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Colours {
    Grey,
    YCbCr,
    Rgb,
    Cmyk,
    Ycck,
}

/// Columns and rows of blocks of 8 x 8 samples.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Grid {
    pub columns: u32,
    pub rows: u32,
}

impl Grid {
    pub fn area(self) -> u64 {
        u64::from(self.columns) * u64::from(self.rows)
    }
}

impl Frame {
    /// The largest sampling factors of all components.
    pub fn largest_sampling(&self) -> (u32, u32) {
        let sampling = || self.components.iter().map(|component| component.sampling);
        let horizontal = sampling().map(|(horizontal, _)| horizontal).max();
        let vertical = sampling().map(|(_, vertical)| vertical).max();
        (horizontal.unwrap_or(1), vertical.unwrap_or(1))
    }

    /// The minimum coded units of a scan of several components.
    pub fn units(&self) -> Grid {
        let (horizontal, vertical) = self.largest_sampling();
        Grid {
            columns: self.size.width.div_ceil(8 * horizontal),
            rows: self.size.height.div_ceil(8 * vertical),
        }
    }

    /// The blocks that a scan of this component alone holds: those with samples of the picture.
    pub fn blocks_alone(&self, component: &Component) -> Grid {
        let (largest_horizontal, largest_vertical) = self.largest_sampling();
        let (horizontal, vertical) = component.sampling;
        let samples = |side: u32, factor: u32, largest: u32| (side * factor).div_ceil(largest);
        Grid {
            columns: samples(self.size.width, horizontal, largest_horizontal).div_ceil(8),
            rows: samples(self.size.height, vertical, largest_vertical).div_ceil(8),
        }
    }

    /// The blocks of this component in a scan of several: whole units, beyond the picture too.
    pub fn blocks_in_units(&self, component: &Component) -> Grid {
        let units = self.units();
        let (horizontal, vertical) = component.sampling;
        Grid {
            columns: units.columns * horizontal,
            rows: units.rows * vertical,
        }
    }

    /// Samples that decoding `scan` visits.
    pub fn samples_of(&self, scan: &Scan<'_>) -> u64 {
        let blocks = |part: &ScanPart<'_>| {
            let component = &self.components[part.component];
            if scan.parts.len() == 1 {
                self.blocks_alone(component).area()
            } else {
                self.blocks_in_units(component).area()
            }
        };
        scan.parts.iter().map(blocks).sum::<u64>() * COEFFICIENTS as u64
    }
}

/// One pass over the blocks of some components.
#[derive(Debug, Clone)]
pub(super) struct Scan<'a> {
    pub parts: Vec<ScanPart<'a>>,
    /// The first and the last coefficient of the band, in zigzag order.
    pub band: (usize, usize),
    /// The bit that was the lowest known one before this scan; 0 in the first scan of a band.
    pub high: u8,
    /// The bit that is the lowest known one after it.
    pub low: u8,
    /// Units between restart markers; 0 for none.
    pub restart_interval: u32,
    /// What follows the scan's header, up to the next segment.
    pub data: &'a [u8],
}

/// What a scan says about one component.
#[derive(Debug, Clone, Copy)]
pub(super) struct ScanPart<'a> {
    /// Place of the component in the frame.
    pub component: usize,
    pub dc: TableInUse<'a>,
    pub ac: TableInUse<'a>,
}

/// A slot for Huffman tables, and what it held when the scan began.
#[derive(Debug, Clone, Copy)]
pub(super) struct TableInUse<'a> {
    pub slot: u8,
    pub table: Option<StoredTable<'a>>,
}

/// A Huffman table as a file stores it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct StoredTable<'a> {
    /// How many codes have 1, 2, ... 16 bits.
    pub counts: &'a [u8; 16],
    /// What the codes mean, from the shortest to the longest.
    pub symbols: &'a [u8],
}

impl Scan<'_> {
    /// Whether it holds the first coefficient of each block, which is its mean.
    pub fn is_dc(&self) -> bool {
        self.band.0 == 0
    }

    /// Whether it adds one bit to coefficients that earlier scans began.
    pub fn is_refinement(&self) -> bool {
        self.high > 0
    }
}
