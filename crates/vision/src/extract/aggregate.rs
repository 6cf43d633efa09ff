//! How the patch tokens of an image become the one vector that the head projects.
//!
//! The paper takes their mean (III-A). A head file may ask for one of three alternatives from the
//! field: the generalised mean (GeM, Radenovic et al. 2018), in which strong activations count
//! more; VLAD (Jegou et al. 2010; on such tokens: AnyLoc, 2023), which keeps a sum of residuals for
//! each visual word; and NetVLAD (Arandjelovic et al. 2016), whose parts can be trained.
//!
//! Stores keep the pooled vector, so that a map can be given another head without its images. That
//! works only for a head with the very same aggregate: a VLAD, for example, cannot be made of the
//! mean.

use super::global::{l2_normalise, mean_token};
use super::netvlad::NetVlad;
use super::vlad::VladWords;
use sha2::{Digest, Sha256};
use std::fmt;

/// How patch tokens become one pooled vector, which every kind L2-normalises at the end.
#[derive(Debug, Clone, PartialEq, Default)]
pub enum Aggregate {
    /// Their mean (paper III-A), `[d]`.
    #[default]
    Mean,
    /// Their generalised mean, `[d]`. Tokens have signs, which the power keeps: with `f(x) =
    /// sign(x) |x|^p` it is `f^-1(mean(f(token)))`, so p = 1 gives the mean.
    Gem {
        /// The power, from 1 to 64.
        p: f32,
    },
    /// Sums of residuals to visual words, `[words * d]`.
    ///
    /// With the 16 words of 384 values that `head fit` makes by default, every stored reference
    /// keeps 12 kB of half floats, compared to 0.8 kB for a mean and some 117 kB of key patches.
    /// The searched vector has 256 values in any case.
    Vlad(VladWords),
    /// Sums of residuals of projected tokens to visual words, `[words * width]`, to which every
    /// token contributes by its likeness with the word.
    NetVlad(Box<NetVlad>),
}

impl Aggregate {
    /// A generalised mean.
    ///
    /// # Errors
    /// A sentence for people, if `p` is not a power from 1 to 64.
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
            Self::NetVlad(_) => "netvlad",
        }
    }

    /// Length of the pooled vector of tokens that are `dim` wide.
    pub fn pooled_dim(&self, dim: usize) -> usize {
        match self {
            Self::Mean | Self::Gem { .. } => dim,
            Self::Vlad(words) => words.values().len(),
            Self::NetVlad(netvlad) => netvlad.count() * netvlad.width(),
        }
    }

    /// The pooled vector of tokens `[n, dim]`, of unit length.
    pub fn pool(&self, tokens: &[f32], dim: usize) -> Vec<f32> {
        let mut pooled = match self {
            Self::Mean => mean_token(tokens, dim),
            Self::Gem { p } => generalised_mean(tokens, dim, f64::from(*p)),
            Self::Vlad(words) => words.residuals(tokens),
            Self::NetVlad(netvlad) => netvlad.residuals(tokens),
        };
        l2_normalise(&mut pooled);
        pooled
    }

    /// The first digits of the hash of its parameters.
    fn short_hash(&self) -> String {
        let mut hasher = Sha256::new();
        self.hash_into(&mut hasher);
        hex::encode(hasher.finalize())[..8].to_owned()
    }

    /// Adds its parameters to the hash of a head. The mean adds nothing, so that heads made before
    /// there was a choice keep their hash.
    pub(super) fn hash_into(&self, hasher: &mut Sha256) {
        match self {
            Self::Mean => {}
            Self::Gem { p } => {
                hasher.update(b"gem");
                hasher.update(p.to_le_bytes());
            }
            Self::Vlad(words) => {
                hasher.update(b"vlad");
                hasher.update(bytemuck::cast_slice::<f32, u8>(words.values()));
            }
            Self::NetVlad(netvlad) => netvlad.hash_into(hasher),
        }
    }
}

/// `mean`, `gem3`, or `vlad16-0f1e2d3c` (number of words, and the start of the hash of all parts).
/// Equal text means equal pooled vectors.
impl fmt::Display for Aggregate {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Mean => f.write_str("mean"),
            Self::Gem { p } => write!(f, "gem{p}"),
            Self::Vlad(words) => write!(f, "vlad{}-{}", words.count(), self.short_hash()),
            Self::NetVlad(netvlad) => {
                write!(f, "netvlad{}-{}", netvlad.count(), self.short_hash())
            }
        }
    }
}

fn generalised_mean(tokens: &[f32], dim: usize, p: f64) -> Vec<f32> {
    let mut sums = vec![0f64; dim];
    for token in tokens.chunks_exact(dim) {
        for (sum, &value) in sums.iter_mut().zip(token) {
            *sum += signed_power(f64::from(value), p);
        }
    }
    let count = (tokens.len() / dim).max(1) as f64;
    sums.iter()
        .map(|sum| signed_power(sum / count, 1.0 / p) as f32)
        .collect()
}

/// `sign(x) |x|^p`.
fn signed_power(x: f64, p: f64) -> f64 {
    x.abs().powf(p).copysign(x)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::extract::netvlad::NetVladParameters;
    use proptest::prelude::*;

    fn tokens() -> impl Strategy<Value = Vec<f32>> {
        prop::collection::vec(prop_oneof![-4f32..-0.1, 0.1f32..4.0], 6 * 4)
    }

    fn is_close(a: &[f32], b: &[f32]) -> bool {
        a.len() == b.len() && a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-5)
    }

    fn kinds() -> [Aggregate; 4] {
        let some = |count| -> Vec<f32> {
            (0..count)
                .map(|i| ((i * 5) % 7) as f32 / 7.0 - 0.4)
                .collect()
        };
        let netvlad = NetVlad::new(NetVladParameters {
            mean: some(4),
            projection: some(8),
            words: some(6),
            assignment: some(6),
        });
        [
            Aggregate::Mean,
            Aggregate::gem(3.0).unwrap(),
            Aggregate::Vlad(VladWords::new(some(8), 4).unwrap()),
            Aggregate::NetVlad(Box::new(netvlad.unwrap())),
        ]
    }

    proptest! {
        #[test]
        fn the_generalised_mean_of_power_one_is_the_mean(tokens in tokens()) {
            prop_assert!(is_close(&generalised_mean(&tokens, 4, 1.0), &mean_token(&tokens, 4)));
        }

        #[test]
        fn a_vlad_of_one_word_is_the_centred_sum(
            tokens in tokens(),
            word in prop::collection::vec(-0.3f32..0.3, 4),
        ) {
            let mut expected = vec![0f32; 4];
            for token in tokens.chunks_exact(4) {
                let mut token = token.to_vec();
                l2_normalise(&mut token);
                for (i, sum) in expected.iter_mut().enumerate() {
                    *sum += token[i] - word[i];
                }
            }
            prop_assume!(expected.iter().map(|v| v * v).sum::<f32>() > 1e-2);
            l2_normalise(&mut expected);
            let vlad = Aggregate::Vlad(VladWords::new(word, 4).unwrap());
            prop_assert!(is_close(&vlad.pool(&tokens, 4), &expected));
        }

        #[test]
        fn the_order_of_tokens_does_not_matter_and_the_length_is_one(tokens in tokens()) {
            let reversed: Vec<f32> = tokens.chunks(4).rev().flatten().copied().collect();
            for aggregate in kinds() {
                let pooled = aggregate.pool(&tokens, 4);
                prop_assert_eq!(pooled.len(), aggregate.pooled_dim(4));
                prop_assert!(is_close(&pooled, &aggregate.pool(&reversed, 4)));
                let length = pooled.iter().map(|v| v * v).sum::<f32>();
                // Tokens of opposite sign may cancel, so that nothing is left to normalise.
                let is_unit = (length - 1.0).abs() < 1e-4;
                prop_assert!(length == 0.0 || is_unit, "{} {length}", aggregate);
            }
        }
    }

    #[test]
    fn a_high_power_approaches_the_largest_magnitude() {
        let pooled = generalised_mean(&[0.1, -3.0, 2.0, -0.5, 1.0, 0.2], 2, 60.0);
        assert!((pooled[0] - 2.0).abs() < 0.05, "{pooled:?}");
        assert!((pooled[1] + 3.0).abs() < 0.1, "{pooled:?}");
        assert!(Aggregate::gem(0.5).is_err());
        assert!(Aggregate::gem(f32::NAN).is_err());
    }

    #[test]
    fn its_text_tells_pooled_vectors_apart() {
        let texts = kinds().map(|aggregate| aggregate.to_string());
        assert_eq!(texts[..2], ["mean", "gem3"]);
        assert!(texts[2].starts_with("vlad2-"));
        assert!(texts[3].starts_with("netvlad3-"));
        let other = Aggregate::Vlad(VladWords::new(vec![0.5; 8], 4).unwrap()).to_string();
        assert_ne!(texts[2], other);
    }
}
