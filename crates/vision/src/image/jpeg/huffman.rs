//! Huffman tables, and the bits of compressed data.

use super::fault::Fault;
use super::frame::StoredTable;

/// Bits that the table is looked up with. Longer codes are rare.
const LOOKUP_BITS: u32 = 12;
/// Coefficients of a block.
const BLOCK: u32 = super::COEFFICIENTS as u32;
/// What the code that ends a block advances by: more than any others together.
const BLOCK_END: u16 = 128;

/// A Huffman table, ready for decoding.
pub(super) struct HuffmanTable<'a> {
    symbols: &'a [u8],
    /// By the next bits: the length of the code in the high byte, its symbol in the low one; 0 for
    /// a longer code.
    lookup: [u16; 1 << LOOKUP_BITS],
    /// For each length: one past the last code of that length, moved to the top of 16 bits.
    ends: [u32; 17],
    /// For each length: what to add to a code to get the place of its symbol.
    offsets: [i32; 17],
}

impl<'a> HuffmanTable<'a> {
    /// Derives the codes (ITU-T T.81, annex C).
    ///
    /// # Errors
    /// More codes than fit, or one that consists of 1 bits only, which the standard forbids.
    pub fn new(stored: StoredTable<'a>) -> Result<Self, Fault> {
        let mut table = Self {
            symbols: stored.symbols,
            lookup: [0; 1 << LOOKUP_BITS],
            ends: [0; 17],
            offsets: [0; 17],
        };
        let mut code = 0u32;
        let mut place = 0usize;
        for (length, &count) in (1u32..).zip(stored.counts) {
            table.offsets[length as usize] = place as i32 - code as i32;
            for _ in 0..count {
                table.enter(length, code, place);
                code += 1;
                place += 1;
            }
            if count > 0 && code >= 1 << length {
                return Err(Fault::BadTable);
            }
            table.ends[length as usize] = code << (16 - length);
            code <<= 1;
        }
        Ok(table)
    }

    /// As [`HuffmanTable::new`], for the table of the DC differences.
    ///
    /// # Errors
    /// As [`HuffmanTable::new`], or a symbol that is no number of bits. Viewers refuse such a table
    /// even if no code of the picture has that symbol.
    pub fn for_dc(stored: StoredTable<'a>) -> Result<Self, Fault> {
        if stored.symbols.iter().any(|&symbol| symbol > 15) {
            return Err(Fault::BadTable);
        }
        Self::new(stored)
    }

    fn enter(&mut self, length: u32, code: u32, place: usize) {
        if length > LOOKUP_BITS {
            return;
        }
        let spare = LOOKUP_BITS - length;
        let first = (code << spare) as usize;
        let symbol = self.symbols.get(place).copied().unwrap_or_default();
        let entry = (length as u16) << 8 | u16::from(symbol);
        // A table with too many codes is refused right afterwards; here it must not go beyond.
        if let Some(entries) = self.lookup.get_mut(first..first + (1 << spare)) {
            entries.fill(entry);
        }
    }

    /// Length and symbol of the code that `bits` (16 of them) begin with.
    #[inline]
    fn find(&self, bits: u32) -> Option<(u32, u8)> {
        let entry = self.lookup[(bits >> (16 - LOOKUP_BITS)) as usize];
        if entry != 0 {
            return Some((u32::from(entry >> 8), entry as u8));
        }
        self.find_long(bits)
    }

    #[cold]
    fn find_long(&self, bits: u32) -> Option<(u32, u8)> {
        let lengths = LOOKUP_BITS + 1..=16;
        let length = lengths
            .into_iter()
            .find(|&length| bits < self.ends[length as usize])?;
        let code = (bits >> (16 - length)) as i32;
        let place = usize::try_from(code + self.offsets[length as usize]).ok()?;
        Some((length, *self.symbols.get(place)?))
    }
}

/// For the next bits of a sequential block: how many bits the next code takes together with the
/// value behind it, in the low byte, and how many coefficients it advances by, in the high one; 0
/// where a single look-up cannot tell.
///
/// Most codes are short, so that one look-up often tells of two.
pub(super) struct BlockSteps {
    one: [u16; 1 << LOOKUP_BITS],
    two: [u16; 1 << LOOKUP_BITS],
}

impl BlockSteps {
    pub fn new(table: &HuffmanTable<'_>) -> Self {
        let one = table.lookup.map(step);
        let two = std::array::from_fn(|window| {
            let first = one[window];
            let taken = u32::from(first & 0xff);
            if first == 0 || first >> 8 >= BLOCK_END || taken >= LOOKUP_BITS {
                return first;
            }
            let next = (window << taken) & ((1 << LOOKUP_BITS) - 1);
            let code_bits = u32::from(table.lookup[next] >> 8);
            let is_known = code_bits + taken <= LOOKUP_BITS;
            // Both bytes are sums that fit: at most 12 + 15 bits and 16 + 128 coefficients.
            if is_known && one[next] != 0 {
                first + one[next]
            } else {
                first
            }
        });
        Self { one, two }
    }
}

/// The step of an entry of [`HuffmanTable::lookup`].
fn step(entry: u16) -> u16 {
    let (run, size) = (entry >> 4 & 15, entry & 15);
    let bits = (entry >> 8) + size;
    match (run, size) {
        _ if entry >> 8 == 0 => 0,
        (0, 0) => BLOCK_END << 8 | bits,
        // Other runs than these mean something in progressive pictures only.
        (1..15, 0) => 0,
        (run, _) => (run + 1) << 8 | bits,
    }
}

/// The bits of compressed data, up to the next marker.
///
/// In compressed data `FF` stands as `FF 00`; any other byte behind `FF` makes it a marker.
pub(super) struct Bits<'a> {
    data: &'a [u8],
    /// The next byte that is not yet in `buffer`.
    at: usize,
    /// The next bits, from the highest on. Below `count` there may be rubbish.
    buffer: u64,
    count: u32,
}

impl<'a> Bits<'a> {
    pub fn new(data: &'a [u8]) -> Self {
        Self {
            data,
            at: 0,
            buffer: 0,
            count: 0,
        }
    }

    /// Fills the buffer to at least 32 bits, unless a marker or the end comes first.
    #[inline]
    fn fill(&mut self) {
        if self.count >= 32 {
            return;
        }
        if let Some(next) = self
            .data
            .get(self.at..)
            .and_then(|rest| rest.first_chunk::<8>())
        {
            let word = u64::from_be_bytes(*next);
            if !has_ff(word) {
                self.buffer |= word >> self.count;
                let bytes = (63 - self.count) / 8;
                self.at += bytes as usize;
                self.count += 8 * bytes;
                return;
            }
        }
        self.fill_slowly();
    }

    fn fill_slowly(&mut self) {
        // The rubbish below `count` is what the fast way read ahead. It would mix with a byte that
        // is escaped.
        self.buffer &= !(u64::MAX.checked_shr(self.count).unwrap_or(0));
        while self.count <= 56 {
            let Some(&byte) = self.data.get(self.at) else {
                return;
            };
            let step = if byte == 0xff { 2 } else { 1 };
            if step == 2 && self.data.get(self.at + 1) != Some(&0) {
                return;
            }
            self.buffer |= u64::from(byte) << (56 - self.count);
            self.count += 8;
            self.at += step;
        }
    }

    #[inline]
    fn take(&mut self, bits: u32) -> Result<(), Fault> {
        if bits > self.count {
            return Err(Fault::DataEnd);
        }
        self.buffer <<= bits;
        self.count -= bits;
        Ok(())
    }

    /// The next symbol. At least 16 bits remain in the buffer behind it, unless the data end.
    #[inline]
    pub fn symbol(&mut self, table: &HuffmanTable<'_>) -> Result<u8, Fault> {
        self.fill();
        let found = table.find((self.buffer >> 48) as u32);
        let Some((length, symbol)) = found else {
            // With fewer bits than a code may have, the rest of it may only be missing.
            let missing = self.count < 16;
            return Err(if missing {
                Fault::DataEnd
            } else {
                Fault::BadCode
            });
        };
        self.take(length)?;
        Ok(symbol)
    }

    /// Skips up to 16 bits behind a symbol.
    #[inline]
    pub fn skip(&mut self, bits: u32) -> Result<(), Fault> {
        self.take(bits)
    }

    /// Skips the coefficients of a sequential block, but for the first.
    #[inline]
    pub fn skip_block(
        &mut self,
        table: &HuffmanTable<'_>,
        steps: &BlockSteps,
    ) -> Result<(), Fault> {
        let mut k = 1;
        while k < BLOCK {
            self.fill();
            let window = (self.buffer >> (64 - LOOKUP_BITS)) as usize;
            // Up to here the first of two codes cannot end the block.
            let is_early = k <= BLOCK / 2;
            let step = if is_early {
                steps.two[window]
            } else {
                steps.one[window]
            };
            if step == 0 {
                k += self.skip_long(table)?;
                continue;
            }
            self.take(u32::from(step & 0xff))?;
            k += u32::from(step >> 8);
        }
        if k > BLOCK && k < u32::from(BLOCK_END) {
            return Err(Fault::Overrun);
        }
        Ok(())
    }

    /// Skips a code that has no step, and the value behind it; returns by how many coefficients it
    /// advances.
    #[cold]
    fn skip_long(&mut self, table: &HuffmanTable<'_>) -> Result<u32, Fault> {
        // The length of its code is taken already, so that here any length says the same.
        let symbol = self.symbol(table)?;
        let step = step(1 << 8 | u16::from(symbol));
        if step == 0 {
            return Err(Fault::BadSymbol);
        }
        self.skip(u32::from(symbol & 15))?;
        Ok(u32::from(step >> 8))
    }

    /// The next bits, at most 16.
    #[inline]
    pub fn bits(&mut self, bits: u32) -> Result<u32, Fault> {
        self.fill();
        let value = (self.buffer >> 32 >> (32 - bits)) as u32;
        self.take(bits)?;
        Ok(value)
    }

    /// Skips any number of bits.
    pub fn skip_many(&mut self, mut bits: u64) -> Result<(), Fault> {
        while bits > 0 {
            self.fill();
            let step = bits.min(32).min(u64::from(self.count));
            if step == 0 {
                return Err(Fault::DataEnd);
            }
            self.take(step as u32)?;
            bits -= step;
        }
        Ok(())
    }

    /// Bytes of which at least one bit was taken, with the zeros that escape an `FF`.
    pub fn bytes_taken(&self) -> usize {
        let mut at = self.at;
        for _ in 0..self.count / 8 {
            at -= 1;
            if at > 0 && self.data[at] == 0 && self.data[at - 1] == 0xff {
                at -= 1;
            }
        }
        at
    }
}

/// Whether one of the eight bytes is `FF`.
#[inline]
fn has_ff(word: u64) -> bool {
    const LOW: u64 = u64::MAX / 255;
    let inverted = !word;
    inverted.wrapping_sub(LOW) & word & (LOW << 7) != 0
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Bytes of which many are `FF`, as they are and as a file holds them.
    fn escaped() -> (Vec<u8>, Vec<u8>) {
        let plain = (0..200u32).map(|i| match i * i % 7 {
            1 | 4 => 0xff,
            _ => (i * 89) as u8,
        });
        let plain: Vec<u8> = plain.collect();
        let stored = plain.iter().flat_map(|&byte| match byte {
            0xff => vec![0xff, 0],
            _ => vec![byte],
        });
        (plain.clone(), stored.collect())
    }

    #[test]
    fn bits_come_in_order_whatever_their_number() {
        let (plain, stored) = escaped();
        let bit = |at: usize| u32::from(plain[at / 8] >> (7 - at % 8) & 1);
        for step in 1..=16 {
            let mut bits = Bits::new(&stored);
            let mut at = 0;
            while at + step <= 8 * plain.len() {
                let expected = (at..at + step).fold(0, |value, at| value << 1 | bit(at));
                assert_eq!(
                    bits.bits(step as u32).unwrap(),
                    expected,
                    "{step} bits at {at}"
                );
                at += step;
                let plain_bytes = at.div_ceil(8);
                let escapes = plain[..plain_bytes].iter().filter(|&&byte| byte == 0xff);
                assert_eq!(bits.bytes_taken(), plain_bytes + escapes.count());
            }
            let left = (8 * plain.len() - at) as u64;
            assert_eq!(bits.skip_many(left + 1), Err(Fault::DataEnd));
        }
    }

    #[test]
    fn a_marker_ends_the_data() {
        let mut bits = Bits::new(&[0x12, 0xff, 0xd0, 0x34]);
        assert_eq!(bits.bits(8).unwrap(), 0x12);
        assert_eq!(bits.bytes_taken(), 1);
        assert_eq!(bits.bits(1), Err(Fault::DataEnd));
    }

    #[test]
    fn codes_of_every_length_are_found() {
        // One code of each length: 0, 10, 110, and so on.
        let symbols: Vec<u8> = (101..=116).collect();
        let stored = StoredTable {
            counts: &[1; 16],
            symbols: &symbols,
        };
        let table = HuffmanTable::new(stored).unwrap();
        for length in 1..=16u32 {
            let code = u16::MAX.checked_shl(17 - length).unwrap_or(0);
            let data: Vec<u8> = code
                .to_be_bytes()
                .into_iter()
                .flat_map(|byte| match byte {
                    0xff => vec![0xff, 0],
                    _ => vec![byte],
                })
                .collect();
            let mut bits = Bits::new(&data);
            assert_eq!(bits.symbol(&table).unwrap(), 100 + length as u8);
            let left = 16 - length;
            bits.skip(left).unwrap();
            assert_eq!(bits.skip(1), Err(Fault::DataEnd));
        }
        let mut bits = Bits::new(&[0xff, 0, 0xff, 0]);
        assert_eq!(bits.symbol(&table), Err(Fault::BadCode));
    }

    #[test]
    fn tables_with_too_many_codes_are_refused() {
        let table = |counts: [u8; 16]| {
            let symbols = vec![0; counts.iter().map(|&count| usize::from(count)).sum()];
            let stored = StoredTable {
                counts: &counts,
                symbols: &symbols,
            };
            HuffmanTable::new(stored).is_ok()
        };
        let mut counts = [0; 16];
        counts[0] = 1;
        assert!(table(counts));
        counts[1] = 1;
        assert!(table(counts));
        // The code 11 has ones only.
        counts[1] = 2;
        assert!(!table(counts));
        counts[0] = 255;
        assert!(!table(counts));
        assert!(table([0; 16]), "no codes at all, which no data can use");
    }
}
