//! EXIF blocks and XMP packets in every container: what is read of them is in range, and never takes
//! more than a walk.
#![no_main]

use libfuzzer_sys::fuzz_target;
use placeformer_core::types::Timestamp;
use placeformer_vision::image::read_exif;

fuzz_target!(|block: &[u8]| {
    let segment = &block[..block.len().min(65_000)];
    let files = [
        jpeg(b"Exif\0\0", segment),
        jpeg(b"http://ns.adobe.com/xap/1.0/\0", segment),
        png(b"eXIf", block),
        png(b"iTXt", &[b"XML:com.adobe.xmp\0\0\0\0\0", block].concat()),
        webp(b"EXIF", block),
        webp(b"XMP ", block),
        block.to_vec(),
    ];
    for file in files {
        let info = read_exif(&file);
        let sources = info.sources;
        assert_eq!(info.location.is_some(), sources.location.is_some());
        assert_eq!(info.heading.is_some(), sources.heading.is_some());
        assert_eq!(info.captured_at.is_some(), sources.captured_at.is_some());
        if let Some(time) = info.captured_at {
            let read: Timestamp = time.to_string().parse().expect("a time can be shown");
            assert_eq!(read, time);
        }
    }
});

fn jpeg(identifier: &[u8], block: &[u8]) -> Vec<u8> {
    let length = (identifier.len() + block.len() + 2) as u16;
    let head = [b"\xff\xd8\xff\xe1".as_slice(), &length.to_be_bytes()].concat();
    [&head, identifier, block, b"\xff\xd9"].concat()
}

fn png(kind: &[u8; 4], block: &[u8]) -> Vec<u8> {
    let length = (block.len() as u32).to_be_bytes();
    let head = [b"\x89PNG\r\n\x1a\n".as_slice(), &length, kind].concat();
    [&head, block, b"crc!"].concat()
}

fn webp(kind: &[u8; 4], block: &[u8]) -> Vec<u8> {
    let length = (block.len() as u32).to_le_bytes();
    [b"RIFF\0\0\0\0WEBP".as_slice(), kind, &length, block].concat()
}
