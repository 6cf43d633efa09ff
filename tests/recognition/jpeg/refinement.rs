//! The scans that add one bit to coefficients (ITU-T T.81, G.1.2.3).

use crate::jpeg::bits::Bits;
use crate::jpeg::encoder::{Scan, end_run};

pub struct Refinement {
    bits: Bits,
    /// Blocks that are not yet ended, and the corrections of their coefficients.
    run: u32,
    run_corrections: Vec<u32>,
}

impl Refinement {
    pub fn encode<'a>(scan: &Scan, blocks: impl Iterator<Item = &'a [i32; 64]>) -> Vec<u8> {
        let mut refinement = Self {
            bits: Bits::default(),
            run: 0,
            run_corrections: Vec::new(),
        };
        for block in blocks {
            refinement.block(&block[scan.band.0..=scan.band.1], scan.bits.1);
        }
        refinement.end_run();
        refinement.bits.finish()
    }

    fn block(&mut self, band: &[i32], low: u32) {
        let known = |value: &i32| value.unsigned_abs() >> low;
        let last_new = band.iter().rposition(|value| known(value) == 1);
        let mut zeros = 0;
        let mut corrections = Vec::new();
        for (k, value) in band.iter().enumerate() {
            let level = known(value);
            if level == 0 {
                zeros += 1;
                continue;
            }
            while zeros > 15 && last_new.is_some_and(|last| k <= last) {
                self.end_run();
                self.bits.ac(0xf0);
                self.correct(&mut corrections);
                zeros -= 16;
            }
            if level > 1 {
                corrections.push(level & 1);
                continue;
            }
            self.end_run();
            self.bits.ac(zeros << 4 | 1);
            self.bits.put(u32::from(*value > 0), 1);
            self.correct(&mut corrections);
            zeros = 0;
        }
        if zeros > 0 || !corrections.is_empty() {
            self.run += 1;
            self.run_corrections.extend(corrections);
        }
        if self.run == 0x7fff {
            self.end_run();
        }
    }

    fn correct(&mut self, corrections: &mut Vec<u32>) {
        corrections.drain(..).for_each(|bit| self.bits.put(bit, 1));
    }

    fn end_run(&mut self) {
        end_run(&mut self.bits, &mut self.run);
        let mut corrections = std::mem::take(&mut self.run_corrections);
        self.correct(&mut corrections);
    }
}
