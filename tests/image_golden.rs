//! The tensor of a PNG against Pillow's resize and ImageNet normalisation.

use placeformer::image::{ImageConfig, load_tensor};
use placeformer::types::ImageSize;
use std::path::{Path, PathBuf};

fn golden() -> Option<PathBuf> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let folders = [root.join("tests/golden"), root.join("../shared/golden")];
    folders.into_iter().find(|folder| folder.join("street_a.png").exists())
}

#[test]
fn pixels_equal_those_of_the_reference() {
    let Some(folder) = golden() else {
        println!("skipped: no golden data");
        return;
    };
    let png = std::fs::read(folder.join("street_a.png")).unwrap();
    let mut compared = 0;
    for (width, height) in [(224, 224), (448, 336), (644, 476)] {
        let Ok(file) = std::fs::read(folder.join(format!("street_a_{width}x{height}.safetensors"))) else { continue };
        let tensors = safetensors::SafeTensors::deserialize(&file).unwrap();
        let expected = tensors.tensor("pixels").unwrap();
        let expected: Vec<f32> =
            expected.data().chunks_exact(4).map(|raw| f32::from_le_bytes(raw.try_into().unwrap())).collect();
        let tensor = load_tensor(&png, &ImageConfig::default(), ImageSize { width, height }).unwrap();
        assert_eq!(tensor.data.len(), expected.len());
        let worst = tensor.data.iter().zip(&expected).map(|(a, b)| (a - b).abs()).fold(0f32, f32::max);
        println!("{width}x{height}: largest deviation {worst}");
        // One step of an 8-bit sample is 0.0175 after normalisation.
        assert!(worst < 0.0176, "{width}x{height}: {worst}");
        compared += 1;
    }
    assert!(compared > 0, "golden images without golden tensors in {}", folder.display());
}
