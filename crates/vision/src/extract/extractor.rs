//! Weights, head and settings put together: from normalised images to descriptors.

use super::aggregate::Aggregate;
use super::config::{ExtractConfig, HeadChoice};
use super::encoder::{EncodedImage, Encoder, EncoderSpec, Precision, check_image, token_grid};
use super::error::ExtractError;
use super::fused::FusedEncoder;
use super::head::Head;
use super::packing::pack;
use super::preset::Geometry;
use super::trace::ExtractionTrace;
use super::weights::VitWeights;
use super::{fusion, model_id, positions, record, selection};
use placeformer_core::types::{
    Descriptor, ImageSize, ImageTensor, InvalidValue, KeyPatches, ModelId, PatchGrid,
};
use std::path::Path;

/// A loaded model with its head (paper III-A to III-C).
pub struct Extractor {
    config: ExtractConfig,
    geometry: Geometry,
    encoder: Box<dyn Encoder>,
    /// `None` only if the settings say `head = "none"`.
    head: Option<Head>,
    /// Interpolated positions, `[1 + n, d]`; only traces need them.
    positions: Vec<f32>,
    parameters: usize,
    backbone: String,
    model_id: ModelId,
}

impl Extractor {
    /// Loads the weights at `weights`, and the head that the settings name.
    ///
    /// # Errors
    /// Settings that do not fit the preset, files that cannot be read, tensors of a wrong name or
    /// shape, weights whose hash is not the recorded one, and a head for another backbone.
    pub fn load(config: &ExtractConfig, weights: &Path) -> Result<Self, ExtractError> {
        config.encoder_spec()?;
        record::verify(weights)?;
        let weights = config.load_weights(weights)?;
        Self::from_weights(config, &weights, &config.head)
    }

    /// As [`Extractor::load`], from weights in memory, with which a difference was merged already.
    ///
    /// # Errors
    /// As [`Extractor::load`], but for reading the weights.
    pub fn from_weights(
        config: &ExtractConfig,
        weights: &VitWeights,
        head: &HeadChoice,
    ) -> Result<Self, ExtractError> {
        let spec = config.encoder_spec()?;
        let geometry = weights.geometry;
        let grid = token_grid(&geometry, &spec);
        let backbone = model_id::backbone_id(config, &spec, weights);
        let head = choose_head(head, &backbone, geometry.dim)?;
        let model_id = model_id::compose(&backbone, config, &spec, head.as_ref());
        let positions = positions::interpolate(
            &weights.positions,
            geometry.dim,
            weights.position_grid,
            (grid.rows, grid.columns),
        );
        Ok(Self {
            config: config.effective()?,
            geometry,
            encoder: build_encoder(weights, &spec, config.precision)?,
            head,
            positions,
            parameters: weights.parameters(),
            backbone,
            model_id,
        })
    }

    /// The same model, computed by another encoder; for example by the plain one, with which the
    /// fused one is compared.
    ///
    /// # Errors
    /// [`ExtractError::Config`] if the encoder computes something else than the settings say.
    pub fn with_encoder(self, encoder: Box<dyn Encoder>) -> Result<Self, ExtractError> {
        if encoder.spec() != self.encoder.spec() {
            let reason = format!("it computes {:?}", encoder.spec());
            return Err(InvalidValue::new("encoder", reason).into());
        }
        Ok(Self { encoder, ..self })
    }

    /// The identity of the model. Only descriptors of the same identity may be compared.
    pub fn model_id(&self) -> &ModelId {
        &self.model_id
    }

    /// The part of the [`ModelId`] that a head is bound to: preset, weights, exit block and final
    /// LayerNorm.
    pub fn backbone(&self) -> &str {
        &self.backbone
    }

    /// The settings in force, with the preset's values filled in.
    pub fn config(&self) -> &ExtractConfig {
        &self.config
    }

    /// The backbone's geometry.
    pub fn geometry(&self) -> &Geometry {
        &self.geometry
    }

    /// The head in use.
    pub fn head(&self) -> Option<&Head> {
        self.head.as_ref()
    }

    /// Number of learned values of the whole backbone, including blocks that are not computed.
    pub fn parameters(&self) -> usize {
        self.parameters
    }

    /// The size in pixels that images must have.
    pub fn input_size(&self) -> ImageSize {
        self.encoder.spec().input_size
    }

    /// Width of a token, which is also the length of a key patch's descriptor.
    pub fn dim(&self) -> usize {
        self.geometry.dim
    }

    /// The encoder's implementation and precision, for reports.
    pub fn encoder_name(&self) -> String {
        self.encoder.name()
    }

    /// Bytes of weights in memory.
    pub fn weight_bytes(&self) -> usize {
        self.encoder.weight_bytes()
    }

    /// One descriptor for each image. A batch gives bit for bit what single images give.
    ///
    /// # Errors
    /// An image of another size than [`Extractor::input_size`], or an output that is not finite.
    pub fn extract(&self, images: &[ImageTensor]) -> Result<Vec<Descriptor>, ExtractError> {
        self.extract_with_pauses(images, &|| ())
    }

    /// As [`Extractor::extract`], and calls `pause` between the blocks of the transformer, on the
    /// calling thread, where the caller may let something more urgent compute.
    ///
    /// # Errors
    /// As [`Extractor::extract`].
    pub fn extract_with_pauses(
        &self,
        images: &[ImageTensor],
        pause: &dyn Fn(),
    ) -> Result<Vec<Descriptor>, ExtractError> {
        let encoded = self.encoder.encode_with_pauses(images, pause)?;
        encoded
            .iter()
            .map(|image| self.describe(image).map(|(descriptor, _)| descriptor))
            .collect()
    }

    /// As [`Extractor::extract`], with the key patches in full precision too, for measuring what
    /// quantisation costs.
    ///
    /// # Errors
    /// As [`Extractor::extract`].
    pub fn extract_full(
        &self,
        images: &[ImageTensor],
    ) -> Result<Vec<(Descriptor, KeyPatches)>, ExtractError> {
        let encoded = self.encoder.encode(images)?;
        encoded.iter().map(|image| self.describe(image)).collect()
    }

    /// The pooled tokens of each image, by the head's own aggregate: all that training a head
    /// needs.
    ///
    /// # Errors
    /// As [`Extractor::extract`].
    pub fn pooled(&self, images: &[ImageTensor]) -> Result<Vec<Vec<f32>>, ExtractError> {
        self.pooled_by(images, self.aggregate())
    }

    /// The tokens of each image pooled by `aggregate`, of unit length, for fitting a head with that
    /// aggregate.
    ///
    /// # Errors
    /// As [`Extractor::extract`].
    pub fn pooled_by(
        &self,
        images: &[ImageTensor],
        aggregate: &Aggregate,
    ) -> Result<Vec<Vec<f32>>, ExtractError> {
        let encoded = self.encoder.encode(images)?;
        encoded.iter().map(|image| pool(image, aggregate)).collect()
    }

    /// How tokens become the vector that the head takes; the mean if there is no head.
    pub fn aggregate(&self) -> &Aggregate {
        match &self.head {
            Some(head) => head.aggregate(),
            None => &Aggregate::Mean,
        }
    }

    /// Tokens and attention of each image, as the transformer gives them.
    ///
    /// # Errors
    /// As [`Extractor::extract`].
    pub fn encode(&self, images: &[ImageTensor]) -> Result<Vec<EncodedImage>, ExtractError> {
        self.encoder.encode(images)
    }

    /// Every intermediate result of one image.
    ///
    /// # Errors
    /// As [`Extractor::extract`].
    pub fn trace(&self, image: &ImageTensor) -> Result<ExtractionTrace, ExtractError> {
        check_image(image, self.encoder.spec())?;
        let encoded = self.encoder.encode(std::slice::from_ref(image))?.remove(0);
        let pooled = pool(&encoded, self.aggregate())?;
        Ok(ExtractionTrace {
            spec: *self.encoder.spec(),
            pooling: self.aggregate().kind(),
            depth: self.geometry.depth,
            image: image.clone(),
            positions: self.positions.clone(),
            attention: fusion::attention_map(&encoded.cls_attention, encoded.heads),
            global: self.global(&pooled),
            key_patches: self.key_patches(&encoded),
            pooled,
            encoded,
        })
    }

    /// Encodes an artificial image, so that the first request does not have to wait for page faults
    /// and starting threads.
    ///
    /// # Errors
    /// As [`Extractor::extract`], if the model does not work at all.
    pub fn warm_up(&self) -> Result<(), ExtractError> {
        let size = self.input_size();
        let len = 3 * size.width as usize * size.height as usize;
        let wave = |i: usize| {
            let fast = (i % 251) as f32 / 125.0 - 1.0;
            let slow = (i / 251 % 13) as f32 / 6.0;
            fast * slow
        };
        let data = (0..len).map(wave).collect();
        self.extract(&[ImageTensor { size, data }])?;
        Ok(())
    }

    /// The descriptor of an encoded image, and its key patches in full precision.
    fn describe(&self, encoded: &EncodedImage) -> Result<(Descriptor, KeyPatches), ExtractError> {
        let pooled = pool(encoded, self.aggregate())?;
        let key_patches = self.key_patches(encoded);
        let descriptor = Descriptor {
            global: self.global(&pooled),
            pooled,
            patches: pack(&key_patches),
        };
        Ok((descriptor, key_patches))
    }

    /// The global descriptor of a pooled vector.
    fn global(&self, pooled: &[f32]) -> Vec<f32> {
        match &self.head {
            Some(head) => head.project(pooled),
            None => pooled.to_vec(),
        }
    }

    fn key_patches(&self, encoded: &EncodedImage) -> KeyPatches {
        let grid = PatchGrid {
            columns: encoded.grid.columns as u16,
            rows: encoded.grid.rows as u16,
            patch_px: self.geometry.patch as u16,
            stride: self.config.stride,
        };
        selection::key_patches(
            &encoded.tokens,
            &encoded.cls_attention,
            encoded.heads,
            grid,
            self.config.caps,
            self.config.tau,
        )
    }
}

/// Pools the tokens of an image, and checks that the transformer's output is finite.
fn pool(encoded: &EncodedImage, aggregate: &Aggregate) -> Result<Vec<f32>, ExtractError> {
    let pooled = aggregate.pool(&encoded.tokens, encoded.dim);
    let mut values = pooled.iter().chain(&encoded.cls_attention);
    if values.any(|value| !value.is_finite()) {
        return Err(ExtractError::NotFinite);
    }
    Ok(pooled)
}

/// The encoder that the service runs, after a check that every kernel it may use agrees with its
/// scalar twin on this machine.
///
/// # Errors
/// Those of [`FusedEncoder::new`], and a kernel that does not agree.
pub fn build_encoder(
    weights: &VitWeights,
    spec: &EncoderSpec,
    precision: Precision,
) -> Result<Box<dyn Encoder>, ExtractError> {
    let simd = placeformer_kernels::self_check()?;
    let encoder = FusedEncoder::new(weights, *spec, simd, precision)?;
    Ok(Box::new(encoder))
}

/// Loads the head that the settings name, and checks that it belongs to this backbone, whose tokens
/// are `dim` wide.
fn choose_head(
    choice: &HeadChoice,
    backbone: &str,
    dim: usize,
) -> Result<Option<Head>, ExtractError> {
    let head = match choice {
        HeadChoice::None => return Ok(None),
        HeadChoice::Default => Head::built_in(backbone)?.ok_or_else(|| ExtractError::NoHead {
            backbone: backbone.to_owned(),
        })?,
        HeadChoice::File(path) => Head::load(path)?,
    };
    if head.backbone() != backbone || head.token_dim() != dim {
        let path = match choice {
            HeadChoice::File(path) => Some(path.clone()),
            HeadChoice::Default | HeadChoice::None => None,
        };
        return Err(ExtractError::HeadMismatch {
            path,
            head_backbone: format!("{} ({}-d)", head.backbone(), head.token_dim()),
            backbone: format!("{backbone} ({dim}-d)"),
        });
    }
    Ok(Some(head))
}
