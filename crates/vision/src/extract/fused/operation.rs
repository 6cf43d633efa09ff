//! The fused encoder as one operation of candle, for graphs that go on after it.
//!
//! An operation sees the storage of its input and gives one fresh tensor, so tokens and attention
//! share it: `[batch, 1 + n, dim + heads]`, row 0 for the CLS token. The last `heads` columns of a
//! patch's row are the CLS attention it gets, those of row 0 are zero. There is no gradient:
//! training runs the encoder of [`train`](placeformer_lab::train).

use super::FusedEncoder;
use crate::extract::encoder::{EncodedImage, Encoder};
use candle_core::{CpuStorage, CustomOp1, Layout, Shape, bail};

impl CustomOp1 for FusedEncoder {
    fn name(&self) -> &'static str {
        "fused-vit"
    }

    /// Takes contiguous f32 pixels `[batch, 3, height, width]` of the spec's size.
    fn cpu_fwd(
        &self,
        storage: &CpuStorage,
        layout: &Layout,
    ) -> candle_core::Result<(CpuStorage, Shape)> {
        let (CpuStorage::F32(values), Some((from, to))) = (storage, layout.contiguous_offsets())
        else {
            bail!("{} takes contiguous f32 pixels", CustomOp1::name(self));
        };
        let size = self.spec().input_size;
        let (height, width) = (size.height as usize, size.width as usize);
        let (batch, channels, rows, columns) = layout.shape().dims4()?;
        if (channels, rows, columns) != (3, height, width) {
            bail!(
                "{} takes [batch, 3, {height}, {width}], not {:?}",
                CustomOp1::name(self),
                layout.shape()
            );
        }
        let images: Vec<&[f32]> = values[from..to].chunks_exact(3 * height * width).collect();
        let encoded = self
            .encode_pixels(&images)
            .map_err(candle_core::Error::wrap)?;
        let (tokens, width) = (1 + self.grid.len(), self.geometry.dim + self.geometry.heads);
        let mut out = Vec::with_capacity(batch * tokens * width);
        encoded.iter().for_each(|image| append(image, &mut out));
        Ok((CpuStorage::F32(out), Shape::from((batch, tokens, width))))
    }
}

/// The rows of one image.
fn append(image: &EncodedImage, out: &mut Vec<f32>) {
    out.extend_from_slice(&image.cls_token);
    out.extend(std::iter::repeat_n(0.0, image.heads));
    let patches = image.grid.len();
    for (patch, token) in image.tokens.chunks_exact(image.dim).enumerate() {
        out.extend_from_slice(token);
        out.extend((0..image.heads).map(|head| image.cls_attention[head * patches + patch]));
    }
}
