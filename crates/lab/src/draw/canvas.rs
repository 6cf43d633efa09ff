//! A tiny-skia surface with the few marks these pictures need: images, squares, lines, dots and
//! score labels.

use super::error::DrawError;
use placeformer_core::types::ImageSize;
use placeformer_vision::image::RgbImage;
use tiny_skia::{
    Color, FillRule, Paint, PathBuilder, Pixmap, PremultipliedColorU8, Rect, Stroke, Transform,
};

/// A colour with its opacity, each 0 to 255.
pub(super) type Rgba = [u8; 4];

/// A rectangle of the canvas in pixels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Panel {
    pub left: u32,
    pub top: u32,
    pub size: ImageSize,
}

pub(super) struct Canvas(Pixmap);

impl Canvas {
    pub(super) fn new(size: ImageSize, background: [u8; 3]) -> Result<Self, DrawError> {
        let mut pixmap = Pixmap::new(size.width, size.height).ok_or(DrawError::Size(size))?;
        pixmap.fill(Color::from_rgba8(
            background[0],
            background[1],
            background[2],
            255,
        ));
        Ok(Self(pixmap))
    }

    /// Copies `image` with its top left corner at the panel's; both have the panel's size.
    pub(super) fn place(&mut self, image: &RgbImage, panel: Panel) {
        let stride = self.0.width() as usize;
        let width = panel.size.width as usize;
        let rows = image.pixels.chunks_exact(width * 3);
        for (row, rgb_row) in rows.take(panel.size.height as usize).enumerate() {
            let start = (panel.top as usize + row) * stride + panel.left as usize;
            let out = &mut self.0.pixels_mut()[start..start + width];
            for (out, rgb) in out.iter_mut().zip(rgb_row.chunks_exact(3)) {
                // Opaque colours are always valid premultiplied ones.
                *out = PremultipliedColorU8::from_rgba(rgb[0], rgb[1], rgb[2], 255).unwrap_or(*out);
            }
        }
    }

    /// Outlines a square of `side` pixels.
    pub(super) fn square(&mut self, centre: [f32; 2], side: f32, colour: Rgba, width: f32) {
        let half = side / 2.0;
        if let Some(rect) = Rect::from_xywh(centre[0] - half, centre[1] - half, side, side) {
            let stroke = Stroke {
                width,
                ..Default::default()
            };
            self.0.stroke_path(
                &PathBuilder::from_rect(rect),
                &paint(colour),
                &stroke,
                Transform::identity(),
                None,
            );
        }
    }

    pub(super) fn line(&mut self, from: [f32; 2], to: [f32; 2], colour: Rgba, width: f32) {
        let mut path = PathBuilder::new();
        path.move_to(from[0], from[1]);
        path.line_to(to[0], to[1]);
        if let Some(path) = path.finish() {
            let stroke = Stroke {
                width,
                ..Default::default()
            };
            self.0
                .stroke_path(&path, &paint(colour), &stroke, Transform::identity(), None);
        }
    }

    pub(super) fn dot(&mut self, centre: [f32; 2], radius: f32, colour: Rgba) {
        if let Some(path) = PathBuilder::from_circle(centre[0], centre[1], radius) {
            self.0.fill_path(
                &path,
                &paint(colour),
                FillRule::Winding,
                Transform::identity(),
                None,
            );
        }
    }

    pub(super) fn fill(&mut self, left: f32, top: f32, width: f32, height: f32, colour: Rgba) {
        if let Some(rect) = Rect::from_xywh(left, top, width, height) {
            self.0
                .fill_rect(rect, &paint(colour), Transform::identity(), None);
        }
    }

    /// Writes digits, `s`, `/`, `+` and spaces in cells of 6x7 dots of `dot` pixels; returns the
    /// width used.
    pub(super) fn label(&mut self, text: &str, left: f32, top: f32, dot: f32, colour: Rgba) -> f32 {
        for (cell, glyph) in text.chars().map(glyph).enumerate() {
            for (row, bits) in glyph.into_iter().enumerate() {
                for column in (0..5).filter(|column| bits >> (4 - column) & 1 == 1) {
                    let x = left + (cell * 6 + column) as f32 * dot;
                    self.fill(x, top + row as f32 * dot, dot, dot, colour);
                }
            }
        }
        text.chars().count() as f32 * 6.0 * dot
    }

    pub(super) fn finish(self) -> RgbImage {
        let size = ImageSize {
            width: self.0.width(),
            height: self.0.height(),
        };
        // The background is opaque, so premultiplied colours are the colours themselves.
        let pixels = self
            .0
            .pixels()
            .iter()
            .flat_map(|pixel| [pixel.red(), pixel.green(), pixel.blue()])
            .collect();
        RgbImage { size, pixels }
    }
}

fn paint([r, g, b, a]: Rgba) -> Paint<'static> {
    let mut paint = Paint::default();
    paint.set_color_rgba8(r, g, b, a);
    paint
}

/// Five columns, seven rows; other characters are blank.
fn glyph(character: char) -> [u8; 7] {
    match character {
        '0' => [14, 17, 19, 21, 25, 17, 14],
        '1' => [4, 12, 4, 4, 4, 4, 14],
        '2' => [14, 17, 1, 2, 4, 8, 31],
        '3' => [31, 2, 4, 2, 1, 17, 14],
        '4' => [2, 6, 10, 18, 31, 2, 2],
        '5' => [31, 16, 30, 1, 1, 17, 14],
        '6' => [6, 8, 16, 30, 17, 17, 14],
        '7' => [31, 1, 2, 4, 8, 8, 8],
        '8' => [14, 17, 17, 14, 17, 17, 14],
        '9' => [14, 17, 17, 15, 1, 2, 12],
        's' => [0, 0, 14, 16, 14, 1, 30],
        '/' => [1, 1, 2, 4, 8, 16, 16],
        '+' => [0, 4, 4, 31, 4, 4, 0],
        _ => [0; 7],
    }
}
