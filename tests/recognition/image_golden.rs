//! The tensor of a PNG against Pillow's resize and ImageNet normalisation.

use placeformer_core::types::ImageSize;
use placeformer_vision::image::{ImageConfig, load_tensor};
use std::path::Path;

#[test]
fn pixels_equal_those_of_the_reference() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden");
    let png = std::fs::read(folder.join("street_a.png")).unwrap();
    for (width, height) in [(224, 224), (448, 336), (644, 476)] {
        let file =
            std::fs::read(folder.join(format!("street_a_{width}x{height}.safetensors"))).unwrap();
        let tensors = safetensors::SafeTensors::deserialize(&file).unwrap();
        let expected = tensors.tensor("pixels").unwrap();
        let expected: Vec<f32> = expected
            .data()
            .chunks_exact(4)
            .map(|raw| f32::from_le_bytes(raw.try_into().unwrap()))
            .collect();
        let tensor =
            load_tensor(&png, &ImageConfig::default(), ImageSize { width, height }).unwrap();
        assert_eq!(tensor.data.len(), expected.len());
        let worst = tensor
            .data
            .iter()
            .zip(&expected)
            .map(|(a, b)| (a - b).abs())
            .fold(0f32, f32::max);
        println!("{width}x{height}: largest deviation {worst}");
        // One step of an 8-bit sample is 0.0175 after normalisation.
        assert!(worst < 0.0176, "{width}x{height}: {worst}");
    }
}
