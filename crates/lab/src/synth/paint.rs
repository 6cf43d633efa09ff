//! A canvas measured in metres for painting surfaces, with a second one for what glows at night.

use tiny_skia::{
    Color, FillRule, GradientStop, LinearGradient, Paint, PathBuilder, Pixmap, Point,
    PremultipliedColorU8, Rect, SpreadMode, Stroke, Transform,
};

/// A painted surface.
pub(super) struct Painting {
    colour: Pixmap,
    glow: Pixmap,
    /// Texels per metre.
    scale: f32,
}

impl Painting {
    /// A transparent surface of `width` by `height` metres at `scale` texels per metre.
    pub(super) fn new(width: f32, height: f32, scale: f32) -> Self {
        let texels = |metres: f32| ((metres * scale).round() as u32).clamp(1, 4096);
        // Both sides are 1 to 4096 texels, which a pixmap always accepts.
        let pixmap =
            || Pixmap::new(texels(width), texels(height)).expect("sides are positive and bounded");
        Self {
            colour: pixmap(),
            glow: pixmap(),
            scale,
        }
    }

    /// Width and height in texels.
    pub(super) fn size(&self) -> (usize, usize) {
        (self.colour.width() as usize, self.colour.height() as usize)
    }

    /// A filled rectangle; metres from the top left.
    pub(super) fn rect(&mut self, left: f32, top: f32, width: f32, height: f32, colour: [u8; 3]) {
        self.tint(left, top, width, height, colour, 1.0);
    }

    /// A rectangle of partial opacity.
    pub(super) fn tint(
        &mut self,
        left: f32,
        top: f32,
        width: f32,
        height: f32,
        colour: [u8; 3],
        opacity: f32,
    ) {
        if let Some(rect) = Rect::from_xywh(left, top, width, height) {
            self.colour
                .fill_rect(rect, &solid(colour, opacity), self.transform(), None);
        }
    }

    /// A rectangle shaded from `upper` to `lower`.
    pub(super) fn gradient(
        &mut self,
        left: f32,
        top: f32,
        width: f32,
        height: f32,
        upper: [u8; 3],
        lower: [u8; 3],
    ) {
        let Some(rect) = Rect::from_xywh(left, top, width, height) else {
            return;
        };
        let colour = |c: [u8; 3]| Color::from_rgba8(c[0], c[1], c[2], 255);
        let stops = vec![
            GradientStop::new(0.0, colour(upper)),
            GradientStop::new(1.0, colour(lower)),
        ];
        let from = Point::from_xy(left, top);
        let to = Point::from_xy(left + width * 0.4, top + height);
        if let Some(shader) =
            LinearGradient::new(from, to, stops, SpreadMode::Pad, Transform::identity())
        {
            let paint = Paint {
                shader,
                ..Default::default()
            };
            self.colour.fill_rect(rect, &paint, self.transform(), None);
        }
    }

    /// Light given off by a rectangle at night, 0 to 1.
    pub(super) fn glow(&mut self, left: f32, top: f32, width: f32, height: f32, strength: f32) {
        if let Some(rect) = Rect::from_xywh(left, top, width, height) {
            self.glow
                .fill_rect(rect, &solid([255; 3], strength), self.transform(), None);
        }
    }

    /// A filled ellipse.
    pub(super) fn ellipse(
        &mut self,
        centre: [f32; 2],
        radii: [f32; 2],
        colour: [u8; 3],
        opacity: f32,
    ) {
        let oval = Rect::from_xywh(
            centre[0] - radii[0],
            centre[1] - radii[1],
            2.0 * radii[0],
            2.0 * radii[1],
        );
        if let Some(path) = oval.and_then(PathBuilder::from_oval) {
            self.colour.fill_path(
                &path,
                &solid(colour, opacity),
                FillRule::Winding,
                self.transform(),
                None,
            );
        }
    }

    /// A filled polygon.
    pub(super) fn polygon(&mut self, points: &[[f32; 2]], colour: [u8; 3]) {
        if let Some(path) = path(points, true) {
            self.colour.fill_path(
                &path,
                &solid(colour, 1.0),
                FillRule::Winding,
                self.transform(),
                None,
            );
        }
    }

    /// A line through `points`.
    pub(super) fn line(&mut self, points: &[[f32; 2]], width: f32, colour: [u8; 3]) {
        if let Some(path) = path(points, false) {
            let stroke = Stroke {
                width,
                ..Default::default()
            };
            self.colour
                .stroke_path(&path, &solid(colour, 1.0), &stroke, self.transform(), None);
        }
    }

    /// Multiplies every texel by `factor(x, y)`, position in metres.
    pub(super) fn modulate(&mut self, factor: impl Fn(f32, f32) -> f32) {
        let width = self.colour.width() as usize;
        let scale = self.scale;
        for (at, texel) in self.colour.pixels_mut().iter_mut().enumerate() {
            if texel.alpha() == 0 {
                continue;
            }
            let x = ((at % width) as f32 + 0.5) / scale;
            let y = ((at / width) as f32 + 0.5) / scale;
            let factor = factor(x, y);
            let alpha = texel.alpha();
            let scaled = [texel.red(), texel.green(), texel.blue()]
                .map(|channel| ((f32::from(channel) * factor).clamp(0.0, 255.0) as u8).min(alpha));
            // Each channel is at most alpha, as premultiplied colours must be.
            *texel = PremultipliedColorU8::from_rgba(scaled[0], scaled[1], scaled[2], alpha)
                .unwrap_or(*texel);
        }
    }

    /// Premultiplied linear red, green, blue, then alpha and glow.
    pub(super) fn linear_texels(&self) -> Vec<[f32; 5]> {
        let linear: [f32; 256] = std::array::from_fn(|value| (value as f32 / 255.0).powf(2.2));
        let texels = self.colour.pixels().iter().zip(self.glow.pixels());
        texels
            .map(|(texel, glow)| {
                let straight = texel.demultiply();
                let alpha = f32::from(texel.alpha()) / 255.0;
                let [r, g, b] = [straight.red(), straight.green(), straight.blue()]
                    .map(|v| linear[usize::from(v)]);
                [
                    r * alpha,
                    g * alpha,
                    b * alpha,
                    alpha,
                    f32::from(glow.alpha()) / 255.0,
                ]
            })
            .collect()
    }

    fn transform(&self) -> Transform {
        Transform::from_scale(self.scale, self.scale)
    }
}

fn solid(colour: [u8; 3], opacity: f32) -> Paint<'static> {
    let mut paint = Paint::default();
    paint.set_color_rgba8(
        colour[0],
        colour[1],
        colour[2],
        (opacity.clamp(0.0, 1.0) * 255.0) as u8,
    );
    paint
}

fn path(points: &[[f32; 2]], closed: bool) -> Option<tiny_skia::Path> {
    let mut builder = PathBuilder::new();
    let (first, rest) = points.split_first()?;
    builder.move_to(first[0], first[1]);
    rest.iter()
        .for_each(|point| builder.line_to(point[0], point[1]));
    if closed {
        builder.close();
    }
    builder.finish()
}

/// `colour` scaled by `factor`.
pub(super) fn shaded(colour: [u8; 3], factor: f32) -> [u8; 3] {
    colour.map(|channel| (f32::from(channel) * factor).clamp(0.0, 255.0) as u8)
}
