//! What is known of the coefficients after each scan.

use super::COEFFICIENTS;
use super::fault::Fault;
use super::frame::{Frame, Scan};

/// For each coefficient of each component the lowest bit that is known, `None` before its first
/// scan.
pub(super) struct Progress(Vec<[Option<u8>; COEFFICIENTS]>);

/// Most bits that a scan may leave to later ones. The standard allows 13, of which `jpeg-decoder`
/// refuses those beyond the eight of a sample; encoders leave two or three.
const MAX_LOW: u8 = 7;

impl Progress {
    pub fn new(frame: &Frame) -> Self {
        Self(vec![[None; COEFFICIENTS]; frame.components.len()])
    }

    /// Takes note of a scan, the `number`-th.
    ///
    /// # Errors
    /// Parameters that the standard forbids, or a scan that neither begins a band nor adds the next
    /// bit to it. Decoders differ in what they make of such scans, and a picture needs none.
    pub fn add(&mut self, frame: &Frame, scan: &Scan<'_>, number: usize) -> Result<(), Fault> {
        let (first, last) = scan.band;
        if frame.progressive {
            let is_dc_alone = first == 0 && last == 0;
            let is_ac_alone = first > 0 && first <= last && scan.parts.len() == 1;
            let is_known = last < COEFFICIENTS && scan.low <= MAX_LOW;
            let is_next_bit = scan.high == 0 || scan.high == scan.low + 1;
            if !(is_dc_alone || is_ac_alone) || !is_known || !is_next_bit {
                return Err(Fault::ScanHeader(number));
            }
        }
        let expected = scan.is_refinement().then_some(scan.high);
        for part in &scan.parts {
            let known = &mut self.0[part.component];
            let lacks_means = first > 0 && known[0].is_none();
            if lacks_means || known[first..=last].iter().any(|&bit| bit != expected) {
                return Err(Fault::Progression(number));
            }
            known[first..=last].fill(Some(scan.low));
        }
        Ok(())
    }

    /// Checks that the scans make a picture.
    ///
    /// Every component needs the mean of each block. Without an end-of-image marker nothing says
    /// that the last scan was the last one, so there every bit of every coefficient must be known.
    pub fn finish(&self, ended: bool) -> Result<(), Fault> {
        if let Some(missing) = self.0.iter().position(|known| known[0].is_none()) {
            return Err(Fault::ComponentMissing(missing + 1));
        }
        if !ended && self.0.iter().flatten().any(|&bit| bit != Some(0)) {
            return Err(Fault::ScansMissing);
        }
        Ok(())
    }
}
