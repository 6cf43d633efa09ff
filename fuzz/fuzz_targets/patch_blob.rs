//! Patch blobs: damaged bytes are refused; what is accepted is written back as the same bytes.
//!
//! Nearly every mutation fails the checksum. So each input is also tried with its checksum repaired,
//! which lets the mutation reach the checks behind it.
#![no_main]

use libfuzzer_sys::fuzz_target;
use placeformer_store::codec::{decode, decode_f16, decode_f32, encode};

fuzz_target!(|bytes: &[u8]| {
    let _ = (decode_f32(bytes), decode_f16(bytes));
    check(bytes);
    if let Some(body) = bytes.len().checked_sub(4) {
        let mut repaired = bytes.to_vec();
        let checksum = crc32fast::hash(&repaired[..body]);
        repaired[body..].copy_from_slice(&checksum.to_le_bytes());
        check(&repaired);
    }
});

fn check(bytes: &[u8]) {
    if let Ok(patches) = decode(bytes) {
        for row in 0..patches.len() {
            let _ = (patches.scale_of(row), patches.centre(row));
        }
        assert_eq!(
            encode(&patches).expect("what was decoded can be encoded"),
            bytes
        );
    }
}
