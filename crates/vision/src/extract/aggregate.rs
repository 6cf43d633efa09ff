//! How the patch tokens of an image become the one vector that the head projects.
//!
//! The paper takes their mean (III-A). Two alternatives from the field can be carried by a head
//! file in its place: the generalised mean (GeM, Radenovic et al. 2018), which lets strong
//! activations weigh more, and VLAD (Jegou et al. 2010; on such tokens: AnyLoc, 2023), which keeps
//! one sum of residuals per visual word. The result is what a store keeps beside the key patches so
//! that a map can be given another head, and only a head with the very same aggregate can take it:
//! the mean cannot be turned into a VLAD without the image.

use super::error::ExtractError;
use super::global::{l2_normalise, mean_token, squared_distance};

use rand::seq::index;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use sha2::{Digest, Sha256};
use std::fmt;

/// How patch tokens become one pooled vector. Every kind ends in L2 normalisation.
#[derive(Debug, Clone, PartialEq, Default)]
pub enum Aggregate {
    /// Their mean (the paper's); `d` values.
    #[default]
    Mean,
    /// Their generalised mean; `d` values. Tokens have signs, so the power keeps them: with
    /// `f(x) = sign(x) |x|^p` it is `f^-1(mean(f(token)))`, which for p = 1 is the mean.
    Gem {
        /// The power, from 1 to 64.
        p: f32,
    },
    /// Sums of residuals to visual words; `words * d` values. For the 16 words of 384 values that
    /// `head fit` makes unless told otherwise that is 12 kB of half floats in every stored
    /// reference, against 0.8 kB of a mean and some 117 kB of key patches; what is searched stays
    /// 256 values.
    Vlad(VladWords),
}

/// The visual words of a VLAD.
#[derive(Debug, Clone, PartialEq)]
pub struct VladWords {
    /// `[words, dim]` row-major.
    words: Vec<f32>,
    dim: usize,
}

impl Aggregate {
    /// A generalised mean, if `p` is a power it can use.
    pub fn gem(p: f32) -> Result<Self, String> {
        if (1.0..=64.0).contains(&p) {
            Ok(Self::Gem { p })
        } else {
            Err(format!(
                "the power of a generalised mean must lie from 1 to 64, not {p}"
            ))
        }
    }

    /// Its kind: `mean`, `gem` or `vlad`.
    pub fn kind(&self) -> &'static str {
        match self {
            Self::Mean => "mean",
            Self::Gem { .. } => "gem",
            Self::Vlad(_) => "vlad",
        }
    }

    /// Length of the pooled vector of tokens `dim` wide.
    pub fn pooled_dim(&self, dim: usize) -> usize {
        match self {
            Self::Mean | Self::Gem { .. } => dim,
            Self::Vlad(vlad) => vlad.words.len(),
        }
    }

    /// The pooled vector of tokens `[n, dim]`, of unit length.
    pub fn pool(&self, tokens: &[f32], dim: usize) -> Vec<f32> {
        let mut pooled = match self {
            Self::Mean => mean_token(tokens, dim),
            Self::Gem { p } => generalised_mean(tokens, dim, f64::from(*p)),
            Self::Vlad(vlad) => vlad.residuals(tokens),
        };
        l2_normalise(&mut pooled);
        pooled
    }

    /// What it adds to the hash of a head; nothing for the mean, so that heads made before there
    /// was a choice keep their hash.
    pub(super) fn hash_into(&self, hasher: &mut Sha256) {
        match self {
            Self::Mean => {}
            Self::Gem { p } => {
                hasher.update(b"gem");
                hasher.update(p.to_le_bytes());
            }
            Self::Vlad(vlad) => {
                hasher.update(b"vlad");
                hasher.update(bytemuck::cast_slice::<f32, u8>(&vlad.words));
            }
        }
    }
}

/// Equal text means equal pooled vectors: `mean`, `gem3`, `vlad16-0f1e2d3c` (words, and the start
/// of their hash).
impl fmt::Display for Aggregate {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Mean => f.write_str("mean"),
            Self::Gem { p } => write!(f, "gem{p}"),
            Self::Vlad(vlad) => {
                let mut hasher = Sha256::new();
                self.hash_into(&mut hasher);
                write!(
                    f,
                    "vlad{}-{}",
                    vlad.count(),
                    &hex::encode(hasher.finalize())[..8]
                )
            }
        }
    }
}

fn generalised_mean(tokens: &[f32], dim: usize, p: f64) -> Vec<f32> {
    let power = |value: f64, p: f64| value.abs().powf(p).copysign(value);
    let mut sums = vec![0f64; dim];
    for token in tokens.chunks_exact(dim) {
        sums.iter_mut()
            .zip(token)
            .for_each(|(sum, &value)| *sum += power(f64::from(value), p));
    }
    let count = (tokens.len() / dim).max(1) as f64;
    sums.iter()
        .map(|sum| power(sum / count, 1.0 / p) as f32)
        .collect()
}

impl VladWords {
    /// Takes words `[words, dim]`; at least one, finite.
    pub fn new(words: Vec<f32>, dim: usize) -> Result<Self, String> {
        if dim == 0
            || words.is_empty()
            || !words.len().is_multiple_of(dim)
            || words.iter().any(|value| !value.is_finite())
        {
            return Err(format!(
                "visual words must be finite rows of one length; {} values do not fit",
                words.len()
            ));
        }
        Ok(Self { words, dim })
    }

    /// Learns `count` words from tokens `[n, dim]` by k-means with k-means++ seeding; `seed`
    /// decides every draw.
    ///
    /// # Errors
    /// There are fewer tokens than words.
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
        // It settles within some twenty rounds; the bound is for ties that never do.
        for _ in 0..100 {
            let next: Vec<usize> = rows.par_iter().map(|row| fitted.nearest(row)).collect();
            if next == assigned {
                break;
            }
            assigned = next;
            fitted.move_to_means(&rows, &assigned);
        }
        Ok(fitted)
    }

    /// How many.
    pub fn count(&self) -> usize {
        self.words.len() / self.dim
    }

    /// Width of the tokens they quantise.
    pub fn dim(&self) -> usize {
        self.dim
    }

    /// The words, `[count, dim]` row-major.
    pub fn values(&self) -> &[f32] {
        &self.words
    }

    /// Index of the nearest word; of equally near ones the first.
    fn nearest(&self, token: &[f32]) -> usize {
        let distances = self
            .words
            .chunks_exact(self.dim)
            .map(|word| squared_distance(word, token));
        distances
            .enumerate()
            .min_by(|a, b| a.1.total_cmp(&b.1))
            .map_or(0, |(index, _)| index)
    }

    /// Sums of the residuals of unit-length tokens to their nearest words, each word's sum scaled
    /// to unit length so that a repeated texture does not drown the rest.
    fn residuals(&self, tokens: &[f32]) -> Vec<f32> {
        let mut sums = vec![0f64; self.words.len()];
        for token in tokens.chunks_exact(self.dim).map(unit) {
            let start = self.nearest(&token) * self.dim;
            let word = &self.words[start..start + self.dim];
            let sum = &mut sums[start..start + self.dim];
            sum.iter_mut()
                .zip(token.iter().zip(word))
                .for_each(|(sum, (t, w))| *sum += f64::from(t - w));
        }
        let mut residuals: Vec<f32> = sums.iter().map(|&sum| sum as f32).collect();
        residuals.chunks_exact_mut(self.dim).for_each(l2_normalise);
        residuals
    }

    /// Moves every word to the mean of the rows assigned to it; one without rows stays.
    fn move_to_means(&mut self, rows: &[Vec<f32>], assigned: &[usize]) {
        let mut sums = vec![0f64; self.words.len()];
        let mut counts = vec![0usize; self.count()];
        for (row, &word) in rows.iter().zip(assigned) {
            counts[word] += 1;
            let sum = &mut sums[word * self.dim..(word + 1) * self.dim];
            sum.iter_mut()
                .zip(row)
                .for_each(|(sum, &value)| *sum += f64::from(value));
        }
        for (word, &count) in counts.iter().enumerate().filter(|&(_, &count)| count > 0) {
            let place = word * self.dim..(word + 1) * self.dim;
            let means = sums[place.clone()]
                .iter()
                .map(|sum| (sum / count as f64) as f32);
            self.words[place]
                .iter_mut()
                .zip(means)
                .for_each(|(value, mean)| *value = mean);
        }
    }
}

/// k-means++: each further word is a row drawn in proportion to its squared distance from the words
/// so far.
fn first_words(rows: &[Vec<f32>], count: usize, seed: u64) -> Vec<f32> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut words = rows[rng.random_range(0..rows.len())].clone();
    let mut distances = vec![f32::INFINITY; rows.len()];
    let dim = words.len();
    for _ in 1..count {
        let last = &words[words.len() - dim..];
        distances
            .par_iter_mut()
            .zip(rows)
            .for_each(|(near, row)| *near = near.min(squared_distance(last, row)));
        let total: f64 = distances.iter().map(|&distance| f64::from(distance)).sum();
        let mut left = rng.random::<f64>() * total;
        let drawn = distances.iter().position(|&distance| {
            left -= f64::from(distance);
            left < 0.0
        });
        // Only where all rows are words already is nothing drawn; then any will do.
        let drawn = drawn.unwrap_or_else(|| rng.random_range(0..rows.len()));
        words.extend_from_slice(&rows[drawn]);
    }
    words
}

/// `count` rows of tokens `[n, dim]` drawn without repetition, or all if there are fewer; for
/// [`VladWords::fit`].
pub fn sample_tokens(tokens: &[f32], dim: usize, count: usize, seed: u64) -> Vec<f32> {
    let n = tokens.len() / dim;
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut drawn = index::sample(&mut rng, n, count.min(n)).into_vec();
    drawn.sort_unstable();
    drawn
        .iter()
        .flat_map(|&row| &tokens[row * dim..(row + 1) * dim])
        .copied()
        .collect()
}

fn unit(token: &[f32]) -> Vec<f32> {
    let mut token = token.to_vec();
    l2_normalise(&mut token);
    token
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn tokens() -> impl Strategy<Value = Vec<f32>> {
        prop::collection::vec(prop_oneof![-4f32..-0.1, 0.1f32..4.0], 6 * 4)
    }

    fn close(a: &[f32], b: &[f32]) -> bool {
        a.len() == b.len() && a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-5)
    }

    fn kinds() -> [Aggregate; 3] {
        let words = (0..8).map(|i| ((i * 5) % 7) as f32 / 7.0 - 0.4).collect();
        [
            Aggregate::Mean,
            Aggregate::gem(3.0).unwrap(),
            Aggregate::Vlad(VladWords::new(words, 4).unwrap()),
        ]
    }

    proptest! {
        #[test]
        fn the_generalised_mean_of_power_one_is_the_mean(tokens in tokens()) {
            prop_assert!(close(&generalised_mean(&tokens, 4, 1.0), &mean_token(&tokens, 4)));
        }

        #[test]
        fn a_vlad_of_one_word_is_the_centred_sum(tokens in tokens(), word in prop::collection::vec(-0.3f32..0.3, 4)) {
            let mut expected = vec![0f32; 4];
            for token in tokens.chunks_exact(4).map(unit) {
                expected.iter_mut().zip(token.iter().zip(&word)).for_each(|(sum, (t, w))| *sum += t - w);
            }
            prop_assume!(expected.iter().map(|v| v * v).sum::<f32>() > 1e-2);
            l2_normalise(&mut expected);
            let vlad = Aggregate::Vlad(VladWords::new(word, 4).unwrap());
            prop_assert!(close(&vlad.pool(&tokens, 4), &expected));
        }

        #[test]
        fn the_order_of_tokens_does_not_matter_and_the_length_is_one(tokens in tokens()) {
            let reversed: Vec<f32> = tokens.chunks(4).rev().flatten().copied().collect();
            for aggregate in kinds() {
                let pooled = aggregate.pool(&tokens, 4);
                prop_assert_eq!(pooled.len(), aggregate.pooled_dim(4));
                prop_assert!(close(&pooled, &aggregate.pool(&reversed, 4)));
                let length = pooled.iter().map(|v| v * v).sum::<f32>();
                // The mean of opposite tokens may vanish.
                prop_assert!(length == 0.0 || (length - 1.0).abs() < 1e-4, "{} {length}", aggregate);
            }
        }
    }

    #[test]
    fn a_high_power_approaches_the_largest_magnitude() {
        let pooled = generalised_mean(&[0.1, -3.0, 2.0, -0.5, 1.0, 0.2], 2, 60.0);
        assert!(
            (pooled[0] - 2.0).abs() < 0.05 && (pooled[1] + 3.0).abs() < 0.1,
            "{pooled:?}"
        );
        assert!(Aggregate::gem(0.5).is_err() && Aggregate::gem(f32::NAN).is_err());
    }

    #[test]
    fn words_settle_on_the_clusters_of_the_tokens() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let centres = [[1.0f32, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]];
        let tokens: Vec<f32> = (0..300)
            .flat_map(|i| centres[i % 3].map(|value| 5.0 * (value + rng.random_range(-0.05..0.05))))
            .collect();
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
        let vlad = VladWords::new(vec![1.0, 0.0, 0.0, 1.0], 2).unwrap();
        let residuals = vlad.residuals(&[10.0, 1.0]);
        assert!(
            residuals[1] > 0.9 && residuals[2..] == [0.0, 0.0],
            "{residuals:?}"
        );
    }

    #[test]
    fn its_text_tells_pooled_vectors_apart() {
        let texts = kinds().map(|aggregate| aggregate.to_string());
        assert_eq!(texts[..2], ["mean", "gem3"]);
        assert!(texts[2].starts_with("vlad2-"));
        let other = Aggregate::Vlad(VladWords::new(vec![0.5; 8], 4).unwrap()).to_string();
        assert_ne!(texts[2], other);
    }
}
