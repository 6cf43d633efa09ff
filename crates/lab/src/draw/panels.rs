//! The two pictures, laid out in panels.

use super::canvas::{Canvas, Panel, Rgba};
use super::error::DrawError;
use placeformer_core::types::{ImageSize, PackedPatches, SCALES, ScaleSet};
use placeformer_vision::image::RgbImage;

/// Height of every panel in pixels.
const PANEL_HEIGHT: u32 = 360;
/// Widest panel; a panorama is squashed to it.
const PANEL_MAX_WIDTH: u32 = 960;
/// Space between panels and around a row.
const GAP: u32 = 8;
/// Height of the label above a row of lines.
const CAPTION: u32 = 24;
const BACKGROUND: [u8; 3] = [20, 22, 27];
/// Scales 1, 2, 3, which differ in hue, in lightness and in size.
const SCALE_COLOURS: [Rgba; SCALES] = [
    [86, 214, 255, 235],
    [255, 196, 61, 240],
    [255, 98, 190, 245],
];
/// One colour per combination, repeated beyond five.
const LINE_COLOURS: [Rgba; 5] = [
    [94, 231, 138, 255],
    [255, 179, 71, 255],
    [122, 183, 255, 255],
    [255, 122, 158, 255],
    [214, 173, 255, 255],
];

/// The attention of one image: one value per patch of the grid, any positive unit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AttentionMap<'a> {
    /// `[rows, columns]` row-major.
    pub values: &'a [f32],
    /// Patches per row.
    pub columns: usize,
    /// Rows of patches.
    pub rows: usize,
}

/// One of the two images of a match.
#[derive(Debug, Clone, Copy)]
pub struct DrawnSide<'a> {
    /// The photo, of any size.
    pub image: &'a RgbImage,
    /// Its attention, where it is at hand.
    pub attention: Option<AttentionMap<'a>>,
    /// Its key patches.
    pub patches: &'a PackedPatches,
}

/// What one scale combination found.
#[derive(Debug, Clone, Copy)]
pub struct CombinationLines<'a> {
    /// Which scales were matched jointly.
    pub scales: ScaleSet,
    /// How many mutual nearest neighbours there were.
    pub matches: usize,
    /// Rows of the inliers in the query's and the reference's key patches.
    pub inliers: &'a [(u32, u32)],
}

/// Both images side by side: a row with attention and key patches (scale 1 blue, 2 amber, 3 pink),
/// then a row of inlier lines per combination, labelled `s12 inliers/matches`.
///
/// # Errors
/// An image without pixels, an attention map that does not fill its grid, or an inlier that names
/// no patch.
pub fn match_picture(
    query: &DrawnSide,
    reference: &DrawnSide,
    combinations: &[CombinationLines],
) -> Result<RgbImage, DrawError> {
    let layout = Layout {
        widths: [panel_width(query.image)?, panel_width(reference.image)?],
    };
    let mut canvas = Canvas::new(layout.size(combinations.len()), BACKGROUND)?;
    let top = layout.panels(GAP);
    let photos = [
        query.image.resized(top[0].size)?,
        reference.image.resized(top[1].size)?,
    ];

    for ((side, panel), photo) in [query, reference].into_iter().zip(top).zip(&photos) {
        match side.attention {
            Some(attention) => canvas.place(&heated(photo, attention)?, panel),
            None => canvas.place(photo, panel),
        }
        draw_patches(&mut canvas, side.patches, panel);
    }

    let patches = [query.patches, reference.patches];
    for (row, combination) in combinations.iter().enumerate() {
        let caption_top = layout.caption_top(row);
        let colour = LINE_COLOURS[row % LINE_COLOURS.len()];
        let caption = format!(
            "{} {}/{}",
            combination.scales.score_name(),
            combination.inliers.len(),
            combination.matches
        );
        canvas.label(&caption, GAP as f32, caption_top as f32 + 4.0, 2.0, colour);
        let panels = layout.panels(caption_top + CAPTION);
        for (photo, panel) in photos.iter().zip(panels) {
            canvas.place(photo, panel);
        }
        draw_lines(&mut canvas, patches, panels, combination.inliers, colour)?;
    }
    Ok(canvas.finish())
}

/// Where the panels of a picture of a match lie: a row of two, then a caption and a row of two for
/// each combination.
struct Layout {
    /// Widths of the query's and the reference's panels in pixels.
    widths: [u32; 2],
}

impl Layout {
    /// Height of a caption and the row below it.
    const LINE_ROW: u32 = CAPTION + PANEL_HEIGHT + GAP;

    fn size(&self, combinations: usize) -> ImageSize {
        ImageSize {
            width: self.widths[0] + self.widths[1] + 3 * GAP,
            height: self.caption_top(combinations),
        }
    }

    /// Top of the caption of a combination, by its number.
    fn caption_top(&self, row: usize) -> u32 {
        GAP + PANEL_HEIGHT + GAP + row as u32 * Self::LINE_ROW
    }

    fn panels(&self, top: u32) -> [Panel; 2] {
        let panel = |left, width| Panel {
            left,
            top,
            size: ImageSize {
                width,
                height: PANEL_HEIGHT,
            },
        };
        let reference_left = 2 * GAP + self.widths[0];
        [
            panel(GAP, self.widths[0]),
            panel(reference_left, self.widths[1]),
        ]
    }
}

/// `image` at its own size under its attention as heat.
///
/// # Errors
/// An image without pixels, or an attention map that does not fill its grid.
pub fn attention_picture(image: &RgbImage, attention: AttentionMap) -> Result<RgbImage, DrawError> {
    if image.pixels.is_empty() {
        return Err(DrawError::Size(image.size));
    }
    heated(image, attention)
}

/// Width of the panel of a photo, which keeps its shape.
fn panel_width(image: &RgbImage) -> Result<u32, DrawError> {
    let ImageSize { width, height } = image.size;
    if width == 0 || height == 0 {
        return Err(DrawError::Size(image.size));
    }
    let width = u64::from(width) * u64::from(PANEL_HEIGHT) / u64::from(height);
    // The clamp makes it a number of three digits, so the cast loses nothing.
    Ok(width.clamp(16, u64::from(PANEL_MAX_WIDTH)) as u32)
}

/// Where a point in model input pixels lies on the canvas.
fn on_canvas(patches: &PackedPatches, row: usize, panel: Panel) -> [f32; 2] {
    let [x, y] = patches.centre(row);
    let [across, down] = pixels_per_input_pixel(patches, panel);
    [panel.left as f32 + x * across, panel.top as f32 + y * down]
}

/// Pixels of the canvas for a pixel of the model input, across and down.
fn pixels_per_input_pixel(patches: &PackedPatches, panel: Panel) -> [f32; 2] {
    let input = |count: u16| f32::from(count) * f32::from(patches.grid.patch_px);
    [
        panel.size.width as f32 / input(patches.grid.columns),
        panel.size.height as f32 / input(patches.grid.rows),
    ]
}

/// Outlines every key patch in the colour and the size of its scale.
fn draw_patches(canvas: &mut Canvas, patches: &PackedPatches, panel: Panel) {
    let [across, down] = pixels_per_input_pixel(patches, panel);
    for scale in 1..=SCALES {
        // A little smaller than the patch itself, so that neighbours stay apart.
        let side = f32::from(patches.grid.patch_px) * scale as f32 * across.min(down) - 3.0;
        for row in patches.rows(scale) {
            canvas.square(
                on_canvas(patches, row, panel),
                side.max(2.0),
                SCALE_COLOURS[scale - 1],
                scale as f32 * 0.6 + 0.4,
            );
        }
    }
}

/// Draws a line for every inlier, with dots at its ends.
fn draw_lines(
    canvas: &mut Canvas,
    patches: [&PackedPatches; 2],
    panels: [Panel; 2],
    inliers: &[(u32, u32)],
    colour: Rgba,
) -> Result<(), DrawError> {
    let end = |side: usize, row: u32| {
        if row as usize >= patches[side].len() {
            return Err(DrawError::NoSuchPatch {
                row,
                patches: patches[side].len(),
            });
        }
        Ok(on_canvas(patches[side], row as usize, panels[side]))
    };
    let ends = inliers
        .iter()
        .map(|&(query, reference)| Ok((end(0, query)?, end(1, reference)?)));
    let ends = ends.collect::<Result<Vec<_>, DrawError>>()?;
    // Many lines thin out, so that the pictures beneath stay visible.
    let opacity = if ends.len() > 60 { 120 } else { 200 };
    for &(from, to) in &ends {
        canvas.line(from, to, [0, 0, 0, opacity / 2], 2.6);
        canvas.line(from, to, [colour[0], colour[1], colour[2], opacity], 1.2);
    }
    for point in ends.into_iter().flat_map(|(from, to)| [from, to]) {
        canvas.dot(point, 3.6, [0, 0, 0, 200]);
        canvas.dot(point, 2.6, colour);
    }
    Ok(())
}

/// `image` darkened where attention is low and coloured where it is high, smoothly between patch
/// centres.
fn heated(image: &RgbImage, attention: AttentionMap) -> Result<RgbImage, DrawError> {
    let AttentionMap {
        values,
        columns,
        rows,
    } = attention;
    if values.is_empty() || values.len() != columns * rows {
        return Err(DrawError::AttentionShape {
            values: values.len(),
            columns,
            rows,
        });
    }
    // A few patches (often sky or lens artefacts) tower above the rest: the 98th percentile is
    // already full heat.
    let finite = values.iter().copied().filter(|value| value.is_finite());
    let mut sorted: Vec<f32> = finite.collect();
    sorted.sort_by(f32::total_cmp);
    let rank = (sorted.len() * 98).div_ceil(100).saturating_sub(1);
    let peak = sorted.get(rank).copied().unwrap_or(0.0);
    let peak = peak.max(f32::MIN_POSITIVE);
    let width = image.size.width as usize;
    let height = image.size.height as usize;
    let mut pixels = Vec::with_capacity(image.pixels.len());
    for (at, rgb) in image.pixels.chunks_exact(3).enumerate() {
        let x = ((at % width) as f32 + 0.5) / width as f32 * columns as f32 - 0.5;
        let y = ((at / width) as f32 + 0.5) / height as f32 * rows as f32 - 0.5;
        let heat = (interpolate(attention, x, y) / peak).clamp(0.0, 1.0).sqrt();
        let colour = heat_colour(heat);
        let share = 0.25 + 0.4 * heat;
        for (value, heat) in rgb.iter().zip(colour) {
            pixels.push((f32::from(*value) * (1.0 - share) + heat * share) as u8);
        }
    }
    Ok(RgbImage {
        size: image.size,
        pixels,
    })
}

/// The map between patch centres, at `x`, `y` in patches.
fn interpolate(attention: AttentionMap, x: f32, y: f32) -> f32 {
    let left = x.floor();
    let top = y.floor();
    let at = |column: f32, row: f32| {
        let column = column.clamp(0.0, (attention.columns - 1) as f32) as usize;
        let row = row.clamp(0.0, (attention.rows - 1) as f32) as usize;
        attention.values[row * attention.columns + column]
    };
    let fx = x - left;
    let fy = y - top;
    let upper = at(left, top) * (1.0 - fx) + at(left + 1.0, top) * fx;
    let lower = at(left, top + 1.0) * (1.0 - fx) + at(left + 1.0, top + 1.0) * fx;
    upper * (1.0 - fy) + lower * fy
}

/// Black through violet, red and orange to pale yellow: lightness rises all the way, so it also
/// reads in grey.
fn heat_colour(heat: f32) -> [f32; 3] {
    const STOPS: [[f32; 3]; 5] = [
        [4.0, 4.0, 20.0],
        [87.0, 16.0, 110.0],
        [188.0, 55.0, 84.0],
        [249.0, 142.0, 9.0],
        [252.0, 255.0, 164.0],
    ];
    let position = heat * (STOPS.len() - 1) as f32;
    let stop = (position as usize).min(STOPS.len() - 2);
    let along = position - stop as f32;
    std::array::from_fn(|c| STOPS[stop][c] * (1.0 - along) + STOPS[stop + 1][c] * along)
}

#[cfg(test)]
mod tests;
