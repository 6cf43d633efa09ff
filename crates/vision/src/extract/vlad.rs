//! Visual words, and the sums of residuals to them (VLAD, Jegou et al. 2010).
//!
//! Each token is assigned to its nearest word, and what it differs from the word is added to the
//! word's sum. The words are learnt by k-means from the tokens of many images. Tokens are scaled to
//! unit length first, for learning and for assigning.

use super::error::ExtractError;
use super::global::{l2_normalise, squared_distance};
use rand::seq::index;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use std::ops::Range;

/// Most rounds of k-means. Some twenty are usual; the limit is for tokens that stay equally near to
/// two words and could change sides for ever.
const MOST_ROUNDS: usize = 100;

/// Largest length of a visual word. Words are means of tokens of unit length, so that theirs is at
/// most 1. All residuals to a word that is far away point in one direction, whatever the image.
pub(super) const LONGEST_WORD: f64 = 10.0;

/// The visual words of a VLAD.
#[derive(Debug, Clone, PartialEq)]
pub struct VladWords {
    /// `[words, dim]` row-major.
    words: Vec<f32>,
    dim: usize,
}

impl VladWords {
    /// Takes words `[words, dim]`.
    ///
    /// # Errors
    /// A sentence for people, if there is no word, a word is not `dim` long or far too long as a
    /// vector, or a value is not finite.
    pub fn new(words: Vec<f32>, dim: usize) -> Result<Self, String> {
        let is_whole = dim > 0 && !words.is_empty() && words.len().is_multiple_of(dim);
        let is_finite = words.iter().all(|value| value.is_finite());
        if !is_whole || !is_finite {
            let len = words.len();
            return Err(format!(
                "visual words must be finite rows of one length; {len} values do not fit"
            ));
        }
        let length = |word: &[f32]| -> f64 {
            let squares = word.iter().map(|&value| f64::from(value).powi(2));
            squares.sum::<f64>().sqrt()
        };
        if let Some(far) = words
            .chunks_exact(dim)
            .map(length)
            .find(|length| *length > LONGEST_WORD)
        {
            return Err(format!(
                "a visual word is {far:e} long; the tokens it stands for have length 1"
            ));
        }
        Ok(Self { words, dim })
    }

    /// Learns `count` words from tokens `[n, dim]` by k-means with k-means++ seeding. Equal `seed`s
    /// give equal words.
    ///
    /// # Errors
    /// [`ExtractError::TooFewTokens`] if there are fewer tokens than words.
    pub fn fit(tokens: &[f32], dim: usize, count: usize, seed: u64) -> Result<Self, ExtractError> {
        let rows: Vec<Vec<f32>> = tokens.par_chunks_exact(dim).map(unit).collect();
        if count == 0 || rows.len() < count {
            return Err(ExtractError::TooFewTokens {
                words: count,
                tokens: rows.len(),
            });
        }
        let mut fitted = Self {
            words: first_words(&rows, count, seed),
            dim,
        };
        let mut assigned = vec![usize::MAX; rows.len()];
        for _ in 0..MOST_ROUNDS {
            let next: Vec<usize> = rows.par_iter().map(|row| fitted.nearest(row)).collect();
            if next == assigned {
                break;
            }
            assigned = next;
            fitted.move_to_means(&rows, &assigned);
        }
        Ok(fitted)
    }

    /// Number of words.
    pub fn count(&self) -> usize {
        self.words.len() / self.dim
    }

    /// Width of the tokens that are assigned to them.
    pub fn dim(&self) -> usize {
        self.dim
    }

    /// The words, `[count, dim]` row-major.
    pub fn values(&self) -> &[f32] {
        &self.words
    }

    /// Sums of the residuals of tokens `[n, dim]` to their nearest words, `[count * dim]`.
    ///
    /// Each word's sum is scaled to unit length, so that a texture that repeats all over the image
    /// does not outweigh everything else.
    pub(super) fn residuals(&self, tokens: &[f32]) -> Vec<f32> {
        let mut sums = vec![0f64; self.words.len()];
        for token in tokens.chunks_exact(self.dim).map(unit) {
            let range = self.range_of(self.nearest(&token));
            let word = &self.words[range.clone()];
            for (i, sum) in sums[range].iter_mut().enumerate() {
                *sum += f64::from(token[i] - word[i]);
            }
        }
        let mut residuals: Vec<f32> = sums.iter().map(|&sum| sum as f32).collect();
        for of_word in residuals.chunks_exact_mut(self.dim) {
            l2_normalise(of_word);
        }
        residuals
    }

    /// Where the values of a word are.
    fn range_of(&self, word: usize) -> Range<usize> {
        word * self.dim..(word + 1) * self.dim
    }

    /// Index of the nearest word; the first of several that are equally near.
    fn nearest(&self, token: &[f32]) -> usize {
        let words = self.words.chunks_exact(self.dim);
        let distances = words.map(|word| squared_distance(word, token));
        let nearest = distances.enumerate().min_by(|a, b| a.1.total_cmp(&b.1));
        nearest.map_or(0, |(index, _)| index)
    }

    /// Moves every word to the mean of the rows assigned to it. A word without rows stays where it
    /// is.
    fn move_to_means(&mut self, rows: &[Vec<f32>], assigned: &[usize]) {
        let mut sums = vec![0f64; self.words.len()];
        let mut counts = vec![0usize; self.count()];
        for (row, &word) in rows.iter().zip(assigned) {
            counts[word] += 1;
            let sum = &mut sums[self.range_of(word)];
            for (sum, &value) in sum.iter_mut().zip(row) {
                *sum += f64::from(value);
            }
        }
        for (word, &count) in counts.iter().enumerate() {
            if count == 0 {
                continue;
            }
            let range = self.range_of(word);
            for (value, sum) in self.words[range.clone()].iter_mut().zip(&sums[range]) {
                *value = (sum / count as f64) as f32;
            }
        }
    }
}

/// The words that k-means starts from, chosen by k-means++: every word after the first is a row
/// drawn with a probability in proportion to its squared distance from the words so far.
fn first_words(rows: &[Vec<f32>], count: usize, seed: u64) -> Vec<f32> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut words = rows[rng.random_range(0..rows.len())].clone();
    let dim = words.len();
    let mut distances = vec![f32::INFINITY; rows.len()];
    for _ in 1..count {
        let last = &words[words.len() - dim..];
        distances
            .par_iter_mut()
            .zip(rows)
            .for_each(|(nearest, row)| *nearest = nearest.min(squared_distance(last, row)));
        let total: f64 = distances.iter().map(|&distance| f64::from(distance)).sum();
        let mut remaining = rng.random::<f64>() * total;
        let drawn = distances.iter().position(|&distance| {
            remaining -= f64::from(distance);
            remaining < 0.0
        });
        // If every row already is a word, all distances are zero and none is drawn. Then any row
        // will do.
        let drawn = drawn.unwrap_or_else(|| rng.random_range(0..rows.len()));
        words.extend_from_slice(&rows[drawn]);
    }
    words
}

/// At most `count` rows of tokens `[n, dim]`, drawn without repetition, in their order; for
/// [`VladWords::fit`].
pub fn sample_tokens(tokens: &[f32], dim: usize, count: usize, seed: u64) -> Vec<f32> {
    let n = tokens.len() / dim;
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut drawn = index::sample(&mut rng, n, count.min(n)).into_vec();
    drawn.sort_unstable();
    let mut rows = Vec::with_capacity(drawn.len() * dim);
    for row in drawn {
        rows.extend_from_slice(&tokens[row * dim..(row + 1) * dim]);
    }
    rows
}

/// The token scaled to unit length.
fn unit(token: &[f32]) -> Vec<f32> {
    let mut token = token.to_vec();
    l2_normalise(&mut token);
    token
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_converge_to_the_clusters_of_the_tokens() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let centres = [[1.0f32, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]];
        let mut around =
            |centre: [f32; 3]| centre.map(|value| 5.0 * (value + rng.random_range(-0.05..0.05)));
        let tokens: Vec<f32> = (0..300).flat_map(|i| around(centres[i % 3])).collect();
        let words = VladWords::fit(&tokens, 3, 3, 9).unwrap();
        for centre in centres {
            let nearest = words
                .values()
                .chunks(3)
                .map(|word| squared_distance(word, &centre))
                .fold(f32::MAX, f32::min);
            assert!(
                nearest < 0.01,
                "{centre:?} is {nearest} from the nearest word"
            );
        }
        assert_eq!(words, VladWords::fit(&tokens, 3, 3, 9).unwrap());
        assert!(VladWords::fit(&tokens[..6], 3, 3, 9).is_err());
        assert_eq!(sample_tokens(&tokens, 3, 10, 1).len(), 30);
    }

    #[test]
    fn a_residual_goes_to_the_nearest_word_alone() {
        let words = VladWords::new(vec![1.0, 0.0, 0.0, 1.0], 2).unwrap();
        let residuals = words.residuals(&[10.0, 1.0]);
        assert!(residuals[1] > 0.9, "{residuals:?}");
        assert_eq!(residuals[2..], [0.0, 0.0]);
    }
}
