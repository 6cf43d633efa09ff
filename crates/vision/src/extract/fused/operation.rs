//! The fused encoder as one operation of candle, for graphs that go on after it.
//!
//! A custom operation of candle reads the storage of its input and returns one new tensor. Tokens
//! and attention therefore share a tensor `[batch, 1 + n, dim + heads]`, whose row 0 is the CLS
//! token. The last `heads` columns of a patch's row hold the CLS attention that the patch gets; in
//! row 0 they are zero. The operation has no gradient: training has an encoder of its own.

use super::encoder::FusedEncoder;
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
        let height = size.height as usize;
        let width = size.width as usize;
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
            .encode_pixels(&images, &|| ())
            .map_err(candle_core::Error::wrap)?;
        let shape = (batch, self.token_count(), self.token_and_attention_width());
        let mut out = Vec::with_capacity(shape.0 * shape.1 * shape.2);
        for image in &encoded {
            append_rows(image, &mut out);
        }
        Ok((CpuStorage::F32(out), Shape::from(shape)))
    }
}

/// Appends the rows of one image, `[1 + n, dim + heads]`.
fn append_rows(image: &EncodedImage, out: &mut Vec<f32>) {
    out.extend_from_slice(&image.cls_token);
    out.extend(std::iter::repeat_n(0.0, image.heads));
    let patches = image.grid.len();
    for (patch, token) in image.tokens.chunks_exact(image.dim).enumerate() {
        out.extend_from_slice(token);
        out.extend((0..image.heads).map(|head| image.cls_attention[head * patches + patch]));
    }
}
