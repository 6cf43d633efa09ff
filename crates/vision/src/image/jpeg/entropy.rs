//! The compressed data of a scan, read code by code without computing any coefficient.
//!
//! A decoder that runs out of data fills the picture with grey, and half a picture would match half
//! of a place. Only the codes tell whether the data of each block are there. They also tell where
//! the data end, so that what stands between them and the next marker can be left out.

use super::COEFFICIENTS;
use super::fault::Fault;
use super::frame::{Frame, Scan, ScanPart, TableInUse};
use super::huffman::{Bits, BlockSteps, HuffmanTable};

/// The standard's limit on blocks in a unit of several components. Decoders have buffers for it.
const MAX_UNIT_BLOCKS: u32 = 10;
/// Most bits of a DC difference of 8-bit samples.
const MAX_DC_BITS: u8 = 11;
/// Most bits of another coefficient, with those that later scans add. Honest ones have 10; with
/// more than 15 the sums of some decoders overflow.
const MAX_AC_BITS: u32 = 15;

/// For each block of a component a bit for each coefficient that is not zero; empty if no scan
/// refines the component, because only then it is needed.
pub(super) type NonZero = Vec<u64>;

/// Checks that the data of a scan, the `number`-th, are complete, and appends them to `clean`.
///
/// Between restart intervals stand just the restart markers, numbered in order.
pub(super) fn copy_data(
    frame: &Frame,
    scan: &Scan<'_>,
    number: usize,
    non_zero: &mut [NonZero],
    clean: &mut Vec<u8>,
) -> Result<(), Fault> {
    let mut decoder = ScanDecoder::new(frame, scan, number, non_zero)?;
    let units = match scan.parts.as_slice() {
        [part] => frame.blocks_alone(&frame.components[part.component]),
        _ => frame.units(),
    };
    let units = units.area();
    let interval = match scan.restart_interval {
        0 => units,
        interval => u64::from(interval),
    };
    let mut start = 0;
    let mut restarts = 0u8;
    loop {
        let until = units.min(decoder.done + interval);
        let taken = decoder
            .interval(&scan.data[start..], until)
            .map_err(|fault| match fault {
                Fault::DataEnd => Fault::UnitsMissing {
                    scan: number,
                    done: decoder.done,
                    all: units,
                },
                other => other,
            })?;
        clean.extend_from_slice(&scan.data[start..start + taken]);
        if until == units {
            return Ok(());
        }
        let next = behind_restart(scan.data, start + taken, restarts);
        start = next.ok_or(Fault::UnitsMissing {
            scan: number,
            done: until,
            all: units,
        })?;
        clean.extend_from_slice(&[0xff, 0xd0 + restarts]);
        restarts = (restarts + 1) % 8;
    }
}

/// Where the data behind restart marker `expected` begin.
///
/// As in libjpeg, a marker that is one or two too early means that data are missing, one that is
/// one or two too late is passed over, and any other is taken for the expected one.
fn behind_restart(data: &[u8], mut at: usize, expected: u8) -> Option<usize> {
    loop {
        at += data.get(at..)?.iter().position(|&byte| byte == 0xff)? + 1;
        at += data[at..].iter().position(|&byte| byte != 0xff)? + 1;
        let marker = data[at - 1];
        if !(0xd0..=0xd7).contains(&marker) {
            continue;
        }
        match (marker - 0xd0 + 8 - expected) % 8 {
            1 | 2 => return None,
            6 | 7 => {}
            _ => return Some(at),
        }
    }
}

/// The tables that the codes of a block are in.
struct BlockTables<'a> {
    dc: Option<HuffmanTable<'a>>,
    ac: Option<HuffmanTable<'a>>,
    /// In a sequential picture, those of `ac`.
    steps: Option<Box<BlockSteps>>,
}

struct ScanDecoder<'a> {
    progressive: bool,
    is_dc: bool,
    is_refinement: bool,
    band: (usize, usize),
    low: u32,
    /// For each component of the scan.
    tables: Vec<BlockTables<'a>>,
    /// For each block of a unit the component, as place in `tables`.
    unit: Vec<usize>,
    non_zero: &'a mut [u64],
    /// Units that are read.
    done: u64,
}

impl<'a> ScanDecoder<'a> {
    fn new(
        frame: &Frame,
        scan: &Scan<'a>,
        number: usize,
        non_zero: &'a mut [NonZero],
    ) -> Result<Self, Fault> {
        let mut unit = Vec::new();
        for (place, part) in scan.parts.iter().enumerate() {
            let (horizontal, vertical) = frame.components[part.component].sampling;
            let blocks = if scan.parts.len() == 1 {
                1
            } else {
                horizontal * vertical
            };
            unit.extend(std::iter::repeat_n(place, blocks as usize));
        }
        if unit.len() > MAX_UNIT_BLOCKS as usize {
            let reason = format!("{} blocks in a unit, more than 10", unit.len());
            return Err(Fault::Sampling(reason));
        }
        let needed = tables_needed(scan);
        let tables = scan
            .parts
            .iter()
            .map(|part| block_tables(part, needed, number));
        Ok(Self {
            progressive: frame.progressive,
            is_dc: scan.is_dc(),
            is_refinement: scan.is_refinement(),
            band: scan.band,
            low: u32::from(scan.low),
            tables: tables.collect::<Result<_, _>>()?,
            unit,
            non_zero: &mut non_zero[scan.parts[0].component],
            done: 0,
        })
    }

    /// Reads the units of one restart interval, up to unit `until`; returns how many bytes they
    /// take.
    fn interval(&mut self, data: &[u8], until: u64) -> Result<usize, Fault> {
        // The bits are handed over, not lent, so that they stay in registers.
        let bits = Bits::new(data);
        let bits = match (self.progressive, self.is_dc, self.is_refinement) {
            (false, ..) => self.sequential(bits, until)?,
            (true, true, false) => self.dc_first(bits, until)?,
            (true, true, true) => self.dc_refinement(bits, until)?,
            (true, false, false) => self.ac_first(bits, until)?,
            (true, false, true) => self.ac_refinement(bits, until)?,
        };
        Ok(bits.bytes_taken())
    }

    fn sequential<'b>(&mut self, mut bits: Bits<'b>, until: u64) -> Result<Bits<'b>, Fault> {
        let mut unit = Vec::with_capacity(self.unit.len());
        for &place in &self.unit {
            let tables = &self.tables[place];
            let steps = tables.steps.as_deref().ok_or(Fault::BadTable)?;
            unit.push((tables.dc()?, tables.ac()?, steps));
        }
        while self.done < until {
            for (dc, ac, steps) in &unit {
                dc_difference(&mut bits, dc)?;
                bits.skip_block(ac, steps)?;
            }
            self.done += 1;
        }
        Ok(bits)
    }

    fn dc_first<'b>(&mut self, mut bits: Bits<'b>, until: u64) -> Result<Bits<'b>, Fault> {
        while self.done < until {
            for &place in &self.unit {
                dc_difference(&mut bits, self.tables[place].dc()?)?;
            }
            self.done += 1;
        }
        Ok(bits)
    }

    fn dc_refinement<'b>(&mut self, mut bits: Bits<'b>, until: u64) -> Result<Bits<'b>, Fault> {
        bits.skip_many((until - self.done) * self.unit.len() as u64)?;
        self.done = until;
        Ok(bits)
    }

    fn ac_first<'b>(&mut self, mut bits: Bits<'b>, until: u64) -> Result<Bits<'b>, Fault> {
        let table = self.tables[0].ac()?;
        let (first, last) = self.band;
        while self.done < until {
            let mut present = 0u64;
            let mut k = first;
            let mut ended = 0;
            while k <= last {
                let symbol = bits.symbol(table)?;
                let (run, size) = (u32::from(symbol >> 4), u32::from(symbol & 15));
                if size == 0 && run < 15 {
                    // This block and more after it end here.
                    ended = (1 << run) - 1 + u64::from(bits.bits(run)?);
                    break;
                }
                k += run as usize;
                if k > last {
                    return Err(Fault::Overrun);
                }
                if size + self.low > MAX_AC_BITS {
                    return Err(Fault::BadSymbol);
                }
                if size > 0 {
                    bits.skip(size)?;
                    present |= 1 << k;
                }
                k += 1;
            }
            if let Some(block) = self.non_zero.get_mut(self.done as usize) {
                *block |= present;
            }
            // Viewers do not mind a run that goes on behind the last block.
            self.done = until.min(self.done + 1 + ended);
        }
        Ok(bits)
    }

    fn ac_refinement<'b>(&mut self, mut bits: Bits<'b>, until: u64) -> Result<Bits<'b>, Fault> {
        let table = self.tables[0].ac()?;
        let (first, last) = self.band;
        let mut ended = 0u64;
        while self.done < until {
            let block = self
                .non_zero
                .get_mut(self.done as usize)
                .ok_or(Fault::DataEnd)?;
            let mut k = first;
            while ended == 0 && k <= last {
                let symbol = bits.symbol(table)?;
                let (run, size) = (u32::from(symbol >> 4), symbol & 15);
                match size {
                    0 if run < 15 => {
                        ended = (1 << run) + u64::from(bits.bits(run)?);
                        break;
                    }
                    0 => {}
                    1 => bits.skip(1)?,
                    _ => return Err(Fault::BadSymbol),
                }
                // Coefficients that are passed over have a correction bit each, unless zero.
                let (end, corrections) = pass_zeros(*block, k, last, run);
                bits.skip_many(corrections)?;
                if end > last && size == 1 {
                    return Err(Fault::Overrun);
                }
                if size == 1 {
                    *block |= 1 << end;
                }
                k = end + 1;
            }
            if ended > 0 {
                let up_to_last = u64::MAX >> (COEFFICIENTS - 1 - last);
                let rest = *block & up_to_last & (u64::MAX << k);
                bits.skip_many(u64::from(rest.count_ones()))?;
                ended -= 1;
            }
            self.done += 1;
        }
        Ok(bits)
    }
}

/// From coefficient `k` on, passes `zeros` zero coefficients; returns the place of the next zero
/// one (beyond `last` if there is none), and how many others were passed.
fn pass_zeros(block: u64, mut k: usize, last: usize, mut zeros: u32) -> (usize, u64) {
    let mut others = 0;
    while k <= last {
        if block >> k & 1 == 1 {
            others += 1;
        } else if zeros == 0 {
            break;
        } else {
            zeros -= 1;
        }
        k += 1;
    }
    (k, others)
}

#[inline]
fn dc_difference(bits: &mut Bits<'_>, table: &HuffmanTable<'_>) -> Result<(), Fault> {
    let size = bits.symbol(table)?;
    if size > MAX_DC_BITS {
        return Err(Fault::BadSymbol);
    }
    bits.skip(u32::from(size))
}

/// Which classes of tables the codes of a scan are in.
#[derive(Debug, Clone, Copy)]
pub(super) struct TablesNeeded {
    pub dc: bool,
    pub ac: bool,
}

/// Which classes of tables the codes of `scan` are in: a refinement of the means has no codes.
pub(super) fn tables_needed(scan: &Scan<'_>) -> TablesNeeded {
    TablesNeeded {
        dc: scan.is_dc() && !scan.is_refinement(),
        ac: scan.band.1 > 0,
    }
}

fn block_tables<'a>(
    part: &ScanPart<'a>,
    needed: TablesNeeded,
    number: usize,
) -> Result<BlockTables<'a>, Fault> {
    let stored = |in_use: TableInUse<'a>| in_use.table.ok_or(Fault::TableMissing(number));
    let dc = needed.dc.then(|| stored(part.dc)).transpose()?;
    let ac = needed.ac.then(|| stored(part.ac)).transpose()?;
    let dc = dc.map(HuffmanTable::for_dc).transpose()?;
    let ac = ac.map(HuffmanTable::new).transpose()?;
    // Only a sequential scan needs both tables.
    let steps = ac
        .as_ref()
        .filter(|_| needed.dc)
        .map(|ac| Box::new(BlockSteps::new(ac)));
    Ok(BlockTables { dc, ac, steps })
}

impl<'a> BlockTables<'a> {
    fn dc(&self) -> Result<&HuffmanTable<'a>, Fault> {
        self.dc.as_ref().ok_or(Fault::BadTable)
    }

    fn ac(&self) -> Result<&HuffmanTable<'a>, Fault> {
        self.ac.as_ref().ok_or(Fault::BadTable)
    }
}
