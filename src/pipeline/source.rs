//! The seam between the pipeline and the model, so that tests of the service need no weights.

use placeformer_core::types::{Descriptor, ImageSize, ImageTensor, ModelId};
use placeformer_vision::extract::{ExtractError, Extractor, Head};
use placeformer_vision::image::{self, ImageConfig, ImageError};

/// What turns images into descriptors. Production uses [`Extractor`].
pub trait DescriptorSource: Send + Sync + 'static {
    /// The model, which only descriptors of the same model may be compared with.
    fn model_id(&self) -> &ModelId;
    /// The head behind its global descriptors; without one they are the pooled tokens.
    fn head(&self) -> Option<&Head>;
    /// The size in pixels that images must be resized to.
    fn input_size(&self) -> ImageSize;
    /// The tensor that the model takes, from the bytes of an image as it was sent. Blocks for the
    /// whole computation.
    ///
    /// # Errors
    /// The image is refused or cannot be decoded.
    fn decode(&self, bytes: &[u8], config: &ImageConfig) -> Result<ImageTensor, ImageError> {
        image::load_tensor(bytes, config, self.input_size())
    }
    /// One descriptor per image. Blocks for the whole computation.
    ///
    /// # Errors
    /// The tensors have another shape than the model takes, or its computation fails.
    fn describe(&self, images: &[ImageTensor]) -> Result<Vec<Descriptor>, ExtractError>;
    /// As [`DescriptorSource::describe`], and calls `pause` now and then. Within it another thread
    /// may use this source, while this call computes nothing.
    ///
    /// # Errors
    /// As [`DescriptorSource::describe`].
    fn describe_with_pauses(
        &self,
        images: &[ImageTensor],
        pause: &dyn Fn(),
    ) -> Result<Vec<Descriptor>, ExtractError>;
    /// Bytes of weights in memory.
    fn memory_bytes(&self) -> u64;
}

impl DescriptorSource for Extractor {
    fn model_id(&self) -> &ModelId {
        Extractor::model_id(self)
    }

    fn head(&self) -> Option<&Head> {
        Extractor::head(self)
    }

    fn input_size(&self) -> ImageSize {
        Extractor::input_size(self)
    }

    fn describe(&self, images: &[ImageTensor]) -> Result<Vec<Descriptor>, ExtractError> {
        self.extract(images)
    }

    fn describe_with_pauses(
        &self,
        images: &[ImageTensor],
        pause: &dyn Fn(),
    ) -> Result<Vec<Descriptor>, ExtractError> {
        self.extract_with_pauses(images, pause)
    }

    fn memory_bytes(&self) -> u64 {
        self.weight_bytes() as u64
    }
}
