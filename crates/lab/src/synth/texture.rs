//! Painted surfaces, kept at every size from full to one texel so that distant ones neither shimmer
//! nor alias.

use super::paint::Painting;

/// One sample of a texture.
#[derive(Debug, Clone, Copy)]
pub(super) struct Texel {
    /// Linear albedo.
    pub colour: [f32; 3],
    /// Opacity.
    pub alpha: f32,
    /// Share of light given off at night.
    pub glow: f32,
}

#[derive(Debug)]
struct Level {
    width: usize,
    height: usize,
    /// Premultiplied red, green, blue in linear light, alpha, glow.
    texels: Vec<[f32; 5]>,
}

/// A texture with all its reductions.
#[derive(Debug)]
pub(super) struct Texture {
    levels: Vec<Level>,
}

impl Texture {
    pub(super) fn new(painting: &Painting) -> Self {
        let (width, height) = painting.size();
        let base = Level {
            width,
            height,
            texels: painting.linear_texels(),
        };
        let mut levels = vec![base];
        while let Some(last) = levels
            .last()
            .filter(|level| level.width.max(level.height) > 1)
        {
            levels.push(last.halved());
        }
        Self { levels }
    }

    /// Width and height of the full size in texels.
    pub(super) fn size(&self) -> [f32; 2] {
        [self.levels[0].width as f32, self.levels[0].height as f32]
    }

    /// The colour at (u, v) in 0..1, averaged over `footprint` texels.
    pub(super) fn sample(&self, u: f32, v: f32, footprint: f32) -> Texel {
        let level = footprint.log2().clamp(0.0, (self.levels.len() - 1) as f32);
        let fine = level as usize;
        let along = level.fract();
        let mut mixed = self.levels[fine].bilinear(u, v);
        if along > 0.0 {
            let coarse = self.levels[(fine + 1).min(self.levels.len() - 1)].bilinear(u, v);
            mixed = std::array::from_fn(|c| mixed[c] + (coarse[c] - mixed[c]) * along);
        }
        let [r, g, b, alpha, glow] = mixed;
        let unmultiply = 1.0 / alpha.max(1e-4);
        Texel {
            colour: [r * unmultiply, g * unmultiply, b * unmultiply],
            alpha,
            glow,
        }
    }
}

impl Level {
    fn bilinear(&self, u: f32, v: f32) -> [f32; 5] {
        let x = (u * self.width as f32 - 0.5).clamp(0.0, (self.width - 1) as f32);
        let y = (v * self.height as f32 - 0.5).clamp(0.0, (self.height - 1) as f32);
        let left = x as usize;
        let top = y as usize;
        let right = (left + 1).min(self.width - 1);
        let bottom = (top + 1).min(self.height - 1);
        let fx = x - left as f32;
        let fy = y - top as f32;
        let at = |x: usize, y: usize| &self.texels[y * self.width + x];
        let a = at(left, top);
        let b = at(right, top);
        let c = at(left, bottom);
        let d = at(right, bottom);
        std::array::from_fn(|i| {
            let upper = a[i] + (b[i] - a[i]) * fx;
            let lower = c[i] + (d[i] - c[i]) * fx;
            upper + (lower - upper) * fy
        })
    }

    fn halved(&self) -> Self {
        let width = self.width.div_ceil(2);
        let height = self.height.div_ceil(2);
        let mut texels = Vec::with_capacity(width * height);
        for y in 0..height {
            for x in 0..width {
                let x0 = x * 2;
                let y0 = y * 2;
                let x1 = (x0 + 1).min(self.width - 1);
                let y1 = (y0 + 1).min(self.height - 1);
                let four = [(x0, y0), (x1, y0), (x0, y1), (x1, y1)]
                    .map(|(x, y)| self.texels[y * self.width + x]);
                texels.push(std::array::from_fn(|i| {
                    (four[0][i] + four[1][i] + four[2][i] + four[3][i]) * 0.25
                }));
            }
        }
        Self {
            width,
            height,
            texels,
        }
    }
}
