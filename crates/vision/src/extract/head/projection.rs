//! A head in memory: what it is bound to, and how it projects.

use crate::extract::aggregate::Aggregate;
use crate::extract::error::ExtractError;
use crate::extract::global::l2_normalise;
use crate::extract::head::check;
use placeformer_core::types::GLOBAL_DIM;
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;

/// Rows of the weight that are multiplied at the same time; see [`Head::affine`].
const PARALLEL_ROWS: usize = 8;

const _: () = assert!(GLOBAL_DIM.is_multiple_of(PARALLEL_ROWS));

/// A projection from d to 256 values, and the pooling before it.
#[derive(Debug, Clone, PartialEq)]
pub struct Head {
    aggregate: Aggregate,
    /// `[256, dim]` row-major.
    weight: Vec<f32>,
    /// `[256]`.
    bias: Vec<f32>,
    dim: usize,
    /// The backbone part of a `ModelId`.
    backbone: String,
    /// How it was made, for people to read.
    notes: BTreeMap<String, String>,
}

impl Head {
    /// Builds a head for `backbone` from `weight` `[256, d]` and `bias` `[256]`, where d is the
    /// length of the vectors that `aggregate` makes. `notes` say how it was made.
    ///
    /// # Errors
    /// [`ExtractError::BadFile`] if the shapes do not fit, a value is not finite or too large to
    /// compute with, a row of the weight is zero, or the head maps different images to one place.
    pub fn new(
        aggregate: Aggregate,
        weight: Vec<f32>,
        bias: Vec<f32>,
        backbone: impl Into<String>,
        notes: BTreeMap<String, String>,
    ) -> Result<Self, ExtractError> {
        let dim = weight.len() / GLOBAL_DIM;
        let broken = |reason| ExtractError::BadFile {
            path: "head".into(),
            reason,
        };
        check::shapes(&aggregate, &weight, &bias).map_err(broken)?;
        check::magnitudes(&weight, &bias).map_err(broken)?;
        let head = Self {
            aggregate,
            weight,
            bias,
            dim,
            backbone: backbone.into(),
            notes,
        };
        check::tells_images_apart(&head).map_err(broken)?;
        Ok(head)
    }

    /// The same head with another `weight` `[256, d]` and `bias` `[256]`, as training makes it, and
    /// other notes.
    ///
    /// # Errors
    /// As [`Head::new`].
    pub fn with_weights(
        &self,
        weight: Vec<f32>,
        bias: Vec<f32>,
        notes: BTreeMap<String, String>,
    ) -> Result<Self, ExtractError> {
        let aggregate = self.aggregate.clone();
        Self::new(aggregate, weight, bias, self.backbone.clone(), notes)
    }

    /// Length d of the pooled vector that it takes.
    pub fn dim(&self) -> usize {
        self.dim
    }

    /// Width of the tokens before pooling.
    pub fn token_dim(&self) -> usize {
        match &self.aggregate {
            Aggregate::Mean | Aggregate::Gem { .. } => self.dim,
            Aggregate::Vlad(words) => words.dim(),
            Aggregate::NetVlad(netvlad) => netvlad.dim(),
        }
    }

    /// How the tokens are pooled before it.
    pub fn aggregate(&self) -> &Aggregate {
        &self.aggregate
    }

    /// Its weight, `[256, dim]` row-major, and its bias, `[256]`.
    pub fn weights(&self) -> (&[f32], &[f32]) {
        (&self.weight, &self.bias)
    }

    /// The backbone that it was fitted for, as [`crate::extract::Extractor::backbone`] writes it.
    pub fn backbone(&self) -> &str {
        &self.backbone
    }

    /// How it was made.
    pub fn notes(&self) -> &BTreeMap<String, String> {
        &self.notes
    }

    /// SHA-256 over weight, bias and the parameters of the pooling, hexadecimal. Its first digits
    /// are the head's part of a `ModelId`.
    pub fn content_hash(&self) -> String {
        let mut hasher = Sha256::new();
        hasher.update(bytemuck::cast_slice::<f32, u8>(&self.weight));
        hasher.update(bytemuck::cast_slice::<f32, u8>(&self.bias));
        self.aggregate.hash_into(&mut hasher);
        hex::encode(hasher.finalize())
    }

    /// The global descriptor `[256]` of an L2-normalised pooled vector `[dim]`.
    ///
    /// # Panics
    /// If `pooled` has another length. An [`Extractor`](crate::extract::Extractor) makes sure that
    /// it does not; for vectors from elsewhere there is [`Head::project_stored`].
    pub fn project(&self, pooled: &[f32]) -> Vec<f32> {
        let projected = self.affine(pooled);
        let mut global: Vec<f32> = projected.iter().map(|&value| value as f32).collect();
        l2_normalise(&mut global);
        global
    }

    /// As [`Head::project`], for a pooled vector that a store has kept.
    ///
    /// # Errors
    /// [`ExtractError::WrongPooledLength`] if the vector is not as long as the head needs, so that
    /// its record must be damaged or belong to another model.
    pub fn project_stored(&self, pooled: &[f32]) -> Result<Vec<f32>, ExtractError> {
        if pooled.len() != self.dim {
            return Err(ExtractError::WrongPooledLength {
                expected: self.dim,
                actual: pooled.len(),
            });
        }
        Ok(self.project(pooled))
    }

    /// W x + b, before normalisation.
    ///
    /// All references of a map pass through here when it gets a new head, so speed matters. An
    /// addition has to wait for the one before it in the same sum; several independent sums at a
    /// time keep the processor busy in the meantime.
    pub(crate) fn affine(&self, pooled: &[f32]) -> Vec<f64> {
        assert_eq!(
            pooled.len(),
            self.dim,
            "a head takes pooled vectors of its own length"
        );
        let mut projected = Vec::with_capacity(GLOBAL_DIM);
        let weights = self.weight.chunks_exact(PARALLEL_ROWS * self.dim);
        let biases = self.bias.chunks_exact(PARALLEL_ROWS);
        for (rows, biases) in weights.zip(biases) {
            let mut sums = [0f64; PARALLEL_ROWS];
            for (column, &x) in pooled.iter().enumerate() {
                for (row, sum) in sums.iter_mut().enumerate() {
                    *sum += f64::from(rows[row * self.dim + column]) * f64::from(x);
                }
            }
            for (sum, &bias) in sums.iter().zip(biases) {
                projected.push(sum + f64::from(bias));
            }
        }
        projected
    }
}
