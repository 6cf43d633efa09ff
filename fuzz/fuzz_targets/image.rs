//! Image bytes: whatever arrives is an image within the limits or a typed error, never a panic and
//! never more pixels than allowed; and the same at every size.
//!
//! The libraries that decode may panic; this target checks that such a panic never leaves `decode`.
#![no_main]

use libfuzzer_sys::fuzz_target;
use placeformer_core::types::ImageSize;
use placeformer_vision::image::{ImageConfig, decode, load_tensor, read_exif};

// libFuzzer's panic hook would abort before `decode` could contain the panic, so it is taken out.
fuzz_target!(init: drop(std::panic::take_hook()), |bytes: &[u8]| {
    // The limit on bytes is that of the service. With fewer pixels, each round runs the same checks
    // with less memory.
    let config = ImageConfig {
        max_side: 2048,
        max_pixels: 1 << 20,
        max_jpeg_samples: 20 << 20,
        ..ImageConfig::default()
    };
    let _ = read_exif(bytes);
    let whole = decode(bytes, &config);
    // So small that pictures from 16 x 16 pixels on are reduced while they are decoded.
    for (width, height) in [(28, 14), (2, 2)] {
        let size = ImageSize { width, height };
        let tensor = load_tensor(bytes, &config, size);
        assert_eq!(
            whole.is_ok(),
            tensor.is_ok(),
            "at full size {:?}, for {width} x {height} {:?}",
            whole.as_ref().err(),
            tensor.as_ref().err()
        );
        if let Ok(tensor) = tensor {
            assert_eq!(tensor.size, size);
            assert_eq!(tensor.data.len(), 3 * (width * height) as usize);
            assert!(tensor.data.iter().all(|value| value.is_finite()));
        }
    }
    if let Ok(image) = whole {
        let width = u64::from(image.size.width);
        let height = u64::from(image.size.height);
        assert!(width > 0 && height > 0);
        assert!(
            width <= 2048 && height <= 2048 && width * height <= 1 << 20,
            "{width} x {height} is beyond the limits"
        );
        assert_eq!(image.pixels.len() as u64, 3 * width * height);
    }
});
