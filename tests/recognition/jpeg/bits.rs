//! Writing the bits of compressed data.

/// Bits, with a zero behind each byte `FF`.
#[derive(Default)]
pub struct Bits {
    pub bytes: Vec<u8>,
    buffer: u32,
    count: u32,
}

impl Bits {
    /// The lowest `count` bits of `value`, at most 16.
    pub fn put(&mut self, value: u32, count: u32) {
        self.buffer = self.buffer << count | value & ((1 << count) - 1);
        self.count += count;
        while self.count >= 8 {
            let byte = (self.buffer >> (self.count - 8)) as u8;
            self.bytes.push(byte);
            if byte == 0xff {
                self.bytes.push(0);
            }
            self.count -= 8;
        }
    }

    /// A symbol of the DC tables of [`crate::jpeg::encoder`]: its code has four bits.
    pub fn dc(&mut self, symbol: u32) {
        self.put(symbol, 4);
    }

    /// A symbol of the AC tables of [`crate::jpeg::encoder`]: its code has eight bits.
    pub fn ac(&mut self, symbol: u32) {
        self.put(symbol, 8);
    }

    /// The bits behind a symbol that say which of the values of `size` bits it is.
    pub fn value(&mut self, value: i32, size: u32) {
        let bits = if value < 0 { value - 1 } else { value };
        self.put(bits as u32, size);
    }

    /// Fills up the last byte with ones.
    pub fn finish(mut self) -> Vec<u8> {
        if self.count > 0 {
            self.put(0xff, 8 - self.count);
        }
        self.bytes
    }
}

/// Bits that a value needs.
pub fn size(value: i32) -> u32 {
    32 - value.unsigned_abs().leading_zeros()
}
