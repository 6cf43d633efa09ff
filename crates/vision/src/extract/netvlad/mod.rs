//! Sums of residuals to visual words in which every token takes part in every word (NetVLAD,
//! Arandjelovic et al. 2016), over tokens that were projected to fewer dimensions first.
//!
//! A token `[dim]` is scaled to unit length, centred and projected to `[width]`, and scaled to unit
//! length again. Its weights over the words are the softmax of its products with the words'
//! assignment vectors. What it differs from a word is added to the word's sum by that weight. Each
//! word's sum is scaled to unit length.
//!
//! Unlike a VLAD, all of this is differentiable, so that training can move words, assignment and
//! projection together with the transformer's last blocks.

mod fit;
#[cfg(test)]
mod tests;

use super::global::l2_normalise;
use super::vlad::LONGEST_WORD;
pub use fit::NetVladShape;
use placeformer_kernels::gemm::{PackedMatrix, Tiling, multiply_panel};
use placeformer_kernels::operand::{Format, WordRows};
use placeformer_kernels::{Simd, simd};
use sha2::{Digest, Sha256};

/// Largest magnitude of a value. Sums and squares stay far within the range of 32-bit floats, and
/// parts of use have values below 100.
const LARGEST: f32 = 1e6;

/// The learned parts of a NetVLAD.
#[derive(Debug, Clone, PartialEq)]
pub struct NetVladParameters {
    /// Mean of the tokens of unit length, `[dim]`.
    pub mean: Vec<f32>,
    /// Projection of centred tokens, `[width, dim]` row-major.
    pub projection: Vec<f32>,
    /// The visual words, `[words, width]` row-major.
    pub words: Vec<f32>,
    /// What a projected token is multiplied with to be assigned, `[words, width]` row-major.
    pub assignment: Vec<f32>,
}

impl NetVladParameters {
    /// All parts, in the order of the fields.
    fn parts(&self) -> [&[f32]; 4] {
        [&self.mean, &self.projection, &self.words, &self.assignment]
    }
}

/// A NetVLAD, ready to pool tokens.
#[derive(Debug, Clone)]
pub struct NetVlad {
    parameters: NetVladParameters,
    /// Width of a projected token.
    width: usize,
    simd: Simd,
    /// The transposed projection, `[dim, width]`.
    projection: PackedMatrix,
    /// The transposed assignment, `[width, words]`.
    assignment: PackedMatrix,
    /// The projected mean, `[width]`, which is taken away from projected tokens.
    projected_mean: Vec<f32>,
}

impl PartialEq for NetVlad {
    fn eq(&self, other: &Self) -> bool {
        self.parameters == other.parameters
    }
}

impl NetVlad {
    /// Takes the learned parts.
    ///
    /// # Errors
    /// A sentence for people, if their shapes do not fit, or if they hold values that cannot be
    /// computed with or that make all images alike.
    pub fn new(parameters: NetVladParameters) -> Result<Self, String> {
        let dim = parameters.mean.len();
        let width = width_of(&parameters)?;
        let simd = simd::selected();
        let projection = &parameters.projection;
        let assignment = &parameters.assignment;
        let words = parameters.words.len() / width;
        let projected_mean = projection
            .chunks_exact(dim)
            .map(|row| dot(row, &parameters.mean))
            .collect();
        Ok(Self {
            width,
            simd,
            projection: PackedMatrix::pack(simd, Format::F32, (dim, width), dim, |row, column| {
                projection[column * dim + row]
            }),
            assignment: PackedMatrix::pack(
                simd,
                Format::F32,
                (width, words),
                width,
                |row, column| assignment[column * width + row],
            ),
            projected_mean,
            parameters,
        })
    }

    /// The learned parts.
    pub fn parameters(&self) -> &NetVladParameters {
        &self.parameters
    }

    /// Width of the tokens that it takes.
    pub fn dim(&self) -> usize {
        self.parameters.mean.len()
    }

    /// Width of a projected token.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Number of visual words.
    pub fn count(&self) -> usize {
        self.parameters.words.len() / self.width
    }

    /// Adds the learned parts to the hash of a head.
    pub(super) fn hash_into(&self, hasher: &mut Sha256) {
        hasher.update(b"netvlad");
        // The width tells apart parts of other shapes with the same values.
        hasher.update((self.width as u64).to_le_bytes());
        for part in self.parameters.parts() {
            hasher.update(bytemuck::cast_slice::<f32, u8>(part));
        }
    }

    /// The residuals of tokens `[n, dim]`, `[words * width]`; each word's part has unit length.
    pub(super) fn residuals(&self, tokens: &[f32]) -> Vec<f32> {
        let projected = self.project(tokens);
        let count = projected.len() / self.width;
        let mut weights = multiply(self.simd, &projected, self.width, &self.assignment);
        weights.chunks_exact_mut(self.count()).for_each(softmax);

        let by_word = transpose(&weights, self.count());
        let width = self.width;
        let right = PackedMatrix::pack(
            self.simd,
            Format::F32,
            (count, width),
            count,
            |token, column| projected[token * width + column],
        );
        let mut residuals = multiply(self.simd, &by_word, count, &right);
        let words = self.parameters.words.chunks_exact(width);
        let sums = residuals.chunks_exact_mut(width);
        for ((sum, word), weights) in sums.zip(words).zip(by_word.chunks_exact(count.max(1))) {
            let weight: f64 = weights.iter().map(|&weight| f64::from(weight)).sum();
            for (sum, &value) in sum.iter_mut().zip(word) {
                *sum -= weight as f32 * value;
            }
            l2_normalise(sum);
        }
        residuals
    }

    /// Tokens `[n, dim]` centred, projected and of unit length, `[n, width]`.
    fn project(&self, tokens: &[f32]) -> Vec<f32> {
        let mut unit = tokens.to_vec();
        unit.chunks_exact_mut(self.dim()).for_each(l2_normalise);
        let mut projected = multiply(self.simd, &unit, self.dim(), &self.projection);
        for token in projected.chunks_exact_mut(self.width) {
            for (value, mean) in token.iter_mut().zip(&self.projected_mean) {
                *value -= mean;
            }
            l2_normalise(token);
        }
        projected
    }
}

/// The width of a projected token, if all parts fit together.
fn width_of(parameters: &NetVladParameters) -> Result<usize, String> {
    let NetVladParameters {
        mean,
        projection,
        words,
        assignment,
    } = parameters;
    let dim = mean.len();
    let width = projection.len().checked_div(dim).unwrap_or(0);
    let is_whole = width > 0
        && projection.len() == width * dim
        && !words.is_empty()
        && words.len().is_multiple_of(width)
        && assignment.len() == words.len();
    if !is_whole {
        return Err(format!(
            "a NetVLAD needs a mean [d], a projection [w, d], words and assignment [k, w]; {}, \
             {}, {} and {} values do not fit",
            dim,
            projection.len(),
            words.len(),
            assignment.len()
        ));
    }
    check_values(parameters, width)?;
    Ok(width)
}

/// Says which part cannot be computed with, or would make all images alike.
fn check_values(parameters: &NetVladParameters, width: usize) -> Result<(), String> {
    let NetVladParameters {
        mean,
        projection,
        words,
        ..
    } = parameters;
    let mut values = parameters.parts().into_iter().flatten();
    // NaN is outside of every range.
    let is_sound = |value: &f32| (-LARGEST..=LARGEST).contains(value);
    if let Some(value) = values.find(|value| !is_sound(value)) {
        return Err(format!(
            "a NetVLAD holds {value:e}; its values must lie within {LARGEST:e}"
        ));
    }
    let mut rows = projection.chunks_exact(mean.len());
    if let Some(row) = rows.position(|row| row.iter().all(|&value| value == 0.0)) {
        return Err(format!(
            "row {row} of a NetVLAD's projection is all zeros, so that it says nothing of a token"
        ));
    }
    let length = |word: &[f32]| f64::from(dot(word, word)).sqrt();
    let lengths = words.chunks_exact(width).map(length);
    if let Some(far) = lengths.into_iter().find(|length| *length > LONGEST_WORD) {
        return Err(format!(
            "a visual word is {far:e} long; the tokens it stands for have length 1"
        ));
    }
    Ok(())
}

/// The product of rows `[n, k]` and a packed matrix `[k, columns]`, `[n, columns]`.
fn multiply(simd: Simd, rows: &[f32], k: usize, right: &PackedMatrix) -> Vec<f32> {
    let tiling = Tiling::of(simd);
    let count = rows.len() / k.max(1);
    // Products take whole steps of rows; the rows that fill up the last step are zero.
    let padded = count.next_multiple_of(tiling.row_step);
    let mut left = rows.to_vec();
    left.resize(padded * k, 0.0);
    let stride = right.panels() * tiling.columns;
    let mut wide = vec![0.0; padded * stride];
    for panel in 0..right.panels() {
        let out = &mut wide[panel * tiling.columns..];
        let left = WordRows::f32(&left, k);
        let panel = right.panel(panel, 0);
        multiply_panel(simd, Format::F32, padded, left, panel, out, stride);
    }
    let mut product = Vec::with_capacity(count * right.n());
    for row in wide.chunks_exact(stride).take(count) {
        product.extend_from_slice(&row[..right.n()]);
    }
    product
}

/// Replaces scores by their softmax.
fn softmax(scores: &mut [f32]) {
    let largest = scores.iter().fold(f32::NEG_INFINITY, |a, &b| a.max(b));
    let mut sum = 0f64;
    for score in scores.iter_mut() {
        *score = (*score - largest).exp();
        sum += f64::from(*score);
    }
    let factor = (1.0 / sum) as f32;
    for score in scores {
        *score *= factor;
    }
}

/// A matrix `[n, columns]` as `[columns, n]`.
fn transpose(values: &[f32], columns: usize) -> Vec<f32> {
    let count = values.len() / columns;
    let mut turned = vec![0.0; values.len()];
    for (row, values) in values.chunks_exact(columns).enumerate() {
        for (column, &value) in values.iter().enumerate() {
            turned[column * count + row] = value;
        }
    }
    turned
}

fn dot(a: &[f32], b: &[f32]) -> f32 {
    let products = a.iter().zip(b).map(|(&a, &b)| f64::from(a) * f64::from(b));
    products.sum::<f64>() as f32
}
