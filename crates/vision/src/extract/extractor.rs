//! Weights, head and settings put together: from normalised images to descriptors.

use super::aggregate::Aggregate;
use super::config::{ExtractConfig, HeadChoice};
use super::encoder::{EncodedImage, Encoder, EncoderSpec, Precision, check_image, token_grid};
use super::error::ExtractError;
use super::fused::FusedEncoder;
use super::head::Head;
use super::preset::Geometry;
use super::trace::ExtractionTrace;
use super::weights::VitWeights;
use super::{fusion, model_id, positions, record, selection};
use crate::extract::pack;

use placeformer_core::types::{
    Descriptor, ImageSize, ImageTensor, InvalidValue, KeyPatches, ModelId, PatchGrid,
};
use std::path::Path;

/// A loaded model with its head.
pub struct Extractor {
    config: ExtractConfig,
    geometry: Geometry,
    encoder: Box<dyn Encoder>,
    /// `None` only where the settings say `head = "none"`.
    head: Option<Head>,
    /// Interpolated positions, kept for traces.
    positions: Vec<f32>,
    parameters: usize,
    backbone: String,
    model_id: ModelId,
}

impl Extractor {
    /// Loads weights and head; refuses files that do not fit by name, shape or hash.
    pub fn load(config: &ExtractConfig, weights: &Path) -> Result<Self, ExtractError> {
        config.encoder_spec()?;
        record::verify(weights)?;
        let weights = VitWeights::load(weights, config.preset, config.heads)?;
        Self::from_weights(config, &weights, &config.head)
    }

    /// As [`Extractor::load`], from weights in memory.
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
        let (from, to) = (weights.position_grid, (grid.rows, grid.columns));
        Ok(Self {
            config: config.effective()?,
            geometry,
            encoder: build_encoder(weights, &spec, config.precision)?,
            head,
            positions: positions::interpolate(&weights.positions, geometry.dim, from, to),
            parameters: weights.parameters(),
            backbone,
            model_id,
        })
    }

    /// The same model computed by another encoder, such as the plain one that the fused one is
    /// tested against.
    ///
    /// # Errors
    /// One that computes something else than the settings say.
    pub fn with_encoder(self, encoder: Box<dyn Encoder>) -> Result<Self, ExtractError> {
        if encoder.spec() != self.encoder.spec() {
            return Err(
                InvalidValue::new("encoder", format!("it computes {:?}", encoder.spec())).into(),
            );
        }
        Ok(Self { encoder, ..self })
    }

    /// What its descriptors may be compared with.
    pub fn model_id(&self) -> &ModelId {
        &self.model_id
    }

    /// The part of the [`ModelId`] a head is bound to: preset, weights, exit block and norm.
    pub fn backbone(&self) -> &str {
        &self.backbone
    }

    /// The settings in force, the preset's own values filled in.
    pub fn config(&self) -> &ExtractConfig {
        &self.config
    }

    /// The backbone's shape.
    pub fn geometry(&self) -> &Geometry {
        &self.geometry
    }

    /// The head in use.
    pub fn head(&self) -> Option<&Head> {
        self.head.as_ref()
    }

    /// Learned values of the whole backbone, including blocks that are not computed.
    pub fn parameters(&self) -> usize {
        self.parameters
    }

    /// The size images must be resized to.
    pub fn input_size(&self) -> ImageSize {
        self.encoder.spec().input_size
    }

    /// Length of a token and of a key patch's descriptor.
    pub fn dim(&self) -> usize {
        self.geometry.dim
    }

    /// The encoder's implementation and precision, for reports.
    pub fn encoder_name(&self) -> String {
        self.encoder.name()
    }

    /// Bytes of weights held.
    pub fn weight_bytes(&self) -> usize {
        self.encoder.weight_bytes()
    }

    /// One descriptor per image; a batch gives bit for bit what single images give.
    pub fn extract(&self, images: &[ImageTensor]) -> Result<Vec<Descriptor>, ExtractError> {
        let describe = |encoded: &EncodedImage| {
            let pooled = pool(encoded, self.aggregate())?;
            let global = self.global(&pooled);
            Ok(Descriptor {
                global,
                pooled,
                patches: pack(&self.key_patches(encoded)),
            })
        };
        self.encoder.encode(images)?.iter().map(describe).collect()
    }

    /// Key patches in full precision beside the descriptor, for measuring what quantisation costs.
    pub fn extract_full(
        &self,
        images: &[ImageTensor],
    ) -> Result<Vec<(Descriptor, KeyPatches)>, ExtractError> {
        let describe = |encoded: &EncodedImage| {
            let pooled = pool(encoded, self.aggregate())?;
            let (global, keys) = (self.global(&pooled), self.key_patches(encoded));
            Ok((
                Descriptor {
                    global,
                    pooled,
                    patches: pack(&keys),
                },
                keys,
            ))
        };
        self.encoder.encode(images)?.iter().map(describe).collect()
    }

    /// The pooled tokens of each image, by the head's own aggregate: all that training a head
    /// needs.
    pub fn pooled(&self, images: &[ImageTensor]) -> Result<Vec<Vec<f32>>, ExtractError> {
        self.pooled_by(images, self.aggregate())
    }

    /// The tokens of each image pooled by `aggregate`, of unit length, for fitting a head of it.
    pub fn pooled_by(
        &self,
        images: &[ImageTensor],
        aggregate: &Aggregate,
    ) -> Result<Vec<Vec<f32>>, ExtractError> {
        self.encoder
            .encode(images)?
            .iter()
            .map(|encoded| pool(encoded, aggregate))
            .collect()
    }

    /// How tokens become the vector that the head takes; the mean where there is no head.
    pub fn aggregate(&self) -> &Aggregate {
        self.head.as_ref().map_or(&Aggregate::Mean, Head::aggregate)
    }

    /// Tokens and attention of each image, as the transformer gives them.
    pub fn encode(&self, images: &[ImageTensor]) -> Result<Vec<EncodedImage>, ExtractError> {
        self.encoder.encode(images)
    }

    /// Every intermediate of one image.
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

    /// Runs one image through, so that the first request pays for no page fault and no thread
    /// start.
    pub fn warm_up(&self) -> Result<(), ExtractError> {
        let size = self.input_size();
        let wave = |i: usize| ((i % 251) as f32 / 125.0 - 1.0) * ((i / 251 % 13) as f32 / 6.0);
        let data = (0..3 * size.width as usize * size.height as usize)
            .map(wave)
            .collect();
        self.extract(&[ImageTensor { size, data }]).map(drop)
    }

    fn global(&self, pooled: &[f32]) -> Vec<f32> {
        self.head
            .as_ref()
            .map_or_else(|| pooled.to_vec(), |head| head.project(pooled))
    }

    fn key_patches(&self, encoded: &EncodedImage) -> KeyPatches {
        let grid = PatchGrid {
            columns: encoded.grid.columns as u16,
            rows: encoded.grid.rows as u16,
            patch_px: self.geometry.patch as u16,
            stride: self.config.stride,
        };
        let (caps, tau) = (self.config.caps, self.config.tau);
        selection::key_patches(
            &encoded.tokens,
            &encoded.cls_attention,
            encoded.heads,
            grid,
            caps,
            tau,
        )
    }
}

fn pool(encoded: &EncodedImage, aggregate: &Aggregate) -> Result<Vec<f32>, ExtractError> {
    let pooled = aggregate.pool(&encoded.tokens, encoded.dim);
    if pooled
        .iter()
        .chain(&encoded.cls_attention)
        .any(|value| !value.is_finite())
    {
        return Err(ExtractError::NotFinite);
    }
    Ok(pooled)
}

/// The encoder for `precision`, after every kernel it may use has agreed with its scalar twin on
/// this machine.
pub fn build_encoder(
    weights: &VitWeights,
    spec: &EncoderSpec,
    precision: Precision,
) -> Result<Box<dyn Encoder>, ExtractError> {
    let simd = placeformer_kernels::self_check()?;
    Ok(Box::new(FusedEncoder::new(
        weights, *spec, simd, precision,
    )?))
}

fn choose_head(
    choice: &HeadChoice,
    backbone: &str,
    dim: usize,
) -> Result<Option<Head>, ExtractError> {
    let (head, path) = match choice {
        HeadChoice::None => return Ok(None),
        HeadChoice::Default => match Head::built_in(backbone)? {
            Some(head) => (head, None),
            None => {
                return Err(ExtractError::NoHead {
                    backbone: backbone.to_owned(),
                });
            }
        },
        HeadChoice::File(path) => (Head::load(path)?, Some(path.clone())),
    };
    if head.backbone() != backbone || head.token_dim() != dim {
        let head_backbone = format!("{} ({}-d)", head.backbone(), head.token_dim());
        return Err(ExtractError::HeadMismatch {
            path,
            head_backbone,
            backbone: format!("{backbone} ({dim}-d)"),
        });
    }
    Ok(Some(head))
}
