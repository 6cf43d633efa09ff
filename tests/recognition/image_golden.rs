//! The tensor of a PNG against Pillow's resize and ImageNet normalisation.

use crate::golden::{Golden, largest_difference, stored};
use placeformer_core::types::ImageSize;
use placeformer_vision::image::{ImageConfig, load_tensor};

#[test]
fn pixels_equal_those_of_the_reference() {
    let png = stored("street_a.png");
    for (width, height) in [(224, 224), (448, 336), (644, 476)] {
        let golden = Golden::load("street_a", (width, height));
        let expected = &golden.floats["pixels"];
        let size = ImageSize { width, height };
        let tensor = load_tensor(&png, &ImageConfig::default(), size).unwrap();
        assert_eq!(tensor.data.len(), expected.len());
        let worst = largest_difference(&tensor.data, expected);
        println!("{width}x{height}: largest deviation {worst}");
        // One step of an 8-bit sample is 0.0175 after normalisation.
        assert!(worst < 0.0176, "{width}x{height}: {worst}");
    }
}
