//! What is wrong with a JPEG, in words that its sender understands.

use super::super::error::ImageError;
use super::super::header::ImageFormat;

/// What is wrong with a JPEG.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub(super) enum Fault {
    #[error("truncated: the bytes end before the image data")]
    NoImageData,
    #[error("truncated: the bytes end inside a segment")]
    SegmentEnd,
    #[error("truncated: image data are missing")]
    DataEnd,
    #[error("truncated: image data are missing, scan {scan} has {done} of {all} units")]
    UnitsMissing { scan: usize, done: u64, all: u64 },
    #[error("truncated: component {0} has no image data")]
    ComponentMissing(usize),
    #[error("truncated: the end-of-image marker is missing, and so may be scans")]
    ScansMissing,
    #[error("a {0} segment has a wrong length")]
    Length(&'static str),
    #[error("a {0} segment comes before the frame header")]
    BeforeFrame(&'static str),
    #[error("it has a second {0}")]
    Second(&'static str),
    #[error("it has a marker of an unknown kind, FF {0:02X}")]
    UnknownMarker(u8),
    #[error("its coding ({0}) is not supported")]
    Coding(&'static str),
    #[error("its height stands behind the image data (DNL), which is not supported")]
    NoHeight,
    #[error("it has {0} bits a sample; only 8 are supported")]
    Depth(u8),
    #[error("it has {0} components; only 1, 3 and 4 are supported")]
    Components(usize),
    #[error("its sampling factors are not supported: {0}")]
    Sampling(String),
    #[error("it uses a table of a kind or slot that does not exist")]
    Slot,
    #[error("it has more than {0} scans")]
    Scans(usize),
    #[error("scan {0} has wrong parameters")]
    ScanHeader(usize),
    #[error("scan {0} does not continue the scans before it")]
    Progression(usize),
    #[error("scan {0} uses a Huffman table that is missing")]
    TableMissing(usize),
    #[error("a component uses quantisers that are missing")]
    QuantisersMissing,
    #[error("a Huffman table is corrupt")]
    BadTable,
    #[error("the image data are corrupt: a code that no table has")]
    BadCode,
    #[error("the image data are corrupt: a coefficient outside its block")]
    Overrun,
    #[error("the image data are corrupt: a symbol without meaning")]
    BadSymbol,
}

impl From<Fault> for ImageError {
    fn from(fault: Fault) -> Self {
        ImageFormat::Jpeg.undecodable(fault.to_string())
    }
}
