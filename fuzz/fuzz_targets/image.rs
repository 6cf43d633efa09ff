//! Image bytes: whatever arrives is an image within the limits or a typed error, never a panic and
//! never more pixels than allowed.
//!
//! The libraries that decode may panic; this target checks that such a panic never leaves `decode`.
#![no_main]

use libfuzzer_sys::fuzz_target;
use placeformer_core::types::ImageSize;
use placeformer_vision::image::{ImageConfig, decode, load_tensor, read_exif};

// libFuzzer's panic hook would abort before `decode` could contain the panic, so it is taken out.
fuzz_target!(init: drop(std::panic::take_hook()), |bytes: &[u8]| {
    // With small limits, each round runs the same checks with less memory.
    let config = ImageConfig { max_bytes: 1 << 20, max_side: 2048, max_pixels: 1 << 20 };
    let _ = read_exif(bytes);
    if let Ok(image) = decode(bytes, &config) {
        let width = u64::from(image.size.width);
        let height = u64::from(image.size.height);
        assert!(width > 0 && height > 0);
        assert!(
            width <= 2048 && height <= 2048 && width * height <= 1 << 20,
            "{width} x {height} is beyond the limits"
        );
        assert_eq!(image.pixels.len() as u64, 3 * width * height);
        let size = ImageSize { width: 28, height: 14 };
        let tensor = load_tensor(bytes, &config, size).expect("what decodes can be resized");
        assert!(tensor.data.iter().all(|value| value.is_finite()));
    }
});
