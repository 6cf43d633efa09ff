//! What turns images into descriptors: the model, or a stand-in in tests.

use super::record::{ExtractionSeconds, Record};
use crate::eval::error::EvalError;
use placeformer_core::types::{
    ContentHash, Descriptor, ImageSize, ImageTensor, KeyPatches, ModelId,
};
use placeformer_vision::extract::Extractor;
use placeformer_vision::image::{ImageConfig, RgbImage, encode_jpeg, load_tensor};

/// What turns image bytes into descriptors.
pub trait Describe: Sync {
    /// Identity of everything the descriptors depend on.
    fn model(&self) -> &ModelId;
    /// The name of what computes them, for people.
    fn computed_by(&self) -> String;
    /// A hash of what a fixed picture gives, from its bytes on. Descriptors of one model compare
    /// whatever computed them, but a measurement must not mix those of two builds whose kernels,
    /// decoder or resizing differ.
    fn fingerprint(&self) -> Result<ContentHash, EvalError>;
    /// Decodes and normalises; the error says what is wrong with the image.
    fn tensor(&self, bytes: &[u8]) -> Result<ImageTensor, String>;
    /// One descriptor per image.
    fn describe(&self, images: &[ImageTensor]) -> Result<Vec<Descriptor>, EvalError>;
    /// The key patches of an image in full precision.
    fn key_patches(&self, image: &ImageTensor) -> Result<KeyPatches, EvalError>;
}

/// The model at work.
pub struct ModelDescriber {
    /// The model.
    pub extractor: Extractor,
    /// Limits on images.
    pub limits: ImageConfig,
}

impl Describe for ModelDescriber {
    fn model(&self) -> &ModelId {
        self.extractor.model_id()
    }

    fn computed_by(&self) -> String {
        self.extractor.encoder_name()
    }

    fn fingerprint(&self) -> Result<ContentHash, EvalError> {
        let setting = |error: String| {
            EvalError::Setting(format!("the picture that tells builds apart: {error}"))
        };
        let picture = encode_jpeg(&probe_picture(self.extractor.input_size()), 90);
        let bytes = picture.map_err(|error| setting(error.to_string()))?;
        let descriptor = self
            .describe(&[self.tensor(&bytes).map_err(setting)?])?
            .pop();
        let descriptor = descriptor.ok_or_else(|| setting("no descriptor".into()))?;
        let mut untimed = Record {
            seconds: ExtractionSeconds::default(),
            blob_bytes: 0,
            descriptor,
        };
        Ok(ContentHash::of(&untimed.encode()?))
    }

    fn tensor(&self, bytes: &[u8]) -> Result<ImageTensor, String> {
        load_tensor(bytes, &self.limits, self.extractor.input_size())
            .map_err(|error| error.to_string())
    }

    fn describe(&self, images: &[ImageTensor]) -> Result<Vec<Descriptor>, EvalError> {
        Ok(self.extractor.extract(images)?)
    }

    fn key_patches(&self, image: &ImageTensor) -> Result<KeyPatches, EvalError> {
        let described = self
            .extractor
            .extract_full(std::slice::from_ref(image))?
            .pop();
        described
            .map(|(_, patches)| patches)
            .ok_or_else(|| EvalError::Setting("one image gave no descriptor".into()))
    }
}

/// Waves and steps of all three colours, half as large again as the model's input so that it is
/// resized.
fn probe_picture(input: ImageSize) -> RgbImage {
    let size = ImageSize {
        width: input.width * 3 / 2,
        height: input.height * 3 / 2,
    };
    let pixel = |x: u32, y: u32| {
        [x * 7 + y, (x / 24 * 50) ^ (y / 40 * 90), x * y / 64].map(|value| (value % 256) as u8)
    };
    let pixels = (0..size.height)
        .flat_map(|y| (0..size.width).flat_map(move |x| pixel(x, y)))
        .collect();
    RgbImage { size, pixels }
}
