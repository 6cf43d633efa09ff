//! The linear projection from the pooled tokens to the global descriptor (paper III-A), bound to
//! one backbone.
//!
//! A head is a small safetensors file: `weight` `[256, d]`, `bias` `[256]`, and metadata that says
//! which backbone's tokens it was made for, and how these are pooled: `aggregate` is `mean` (also
//! where it is missing), `gem` with its power in a tensor `gem_p` `[1]`, or `vlad` with its words
//! in `vlad_words` `[k, token width]`, for which d is k times that width. It is applied to the
//! L2-normalised pooled vector, and its output is L2-normalised. Heads for the models that ship are
//! built into the binary.

use super::aggregate::{Aggregate, VladWords};
use super::error::ExtractError;
use super::global::l2_normalise;
use super::weights::to_f32;
use placeformer_core::files::write_atomically;
use placeformer_core::types::GLOBAL_DIM;
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use sha2::{Digest, Sha256};
use std::collections::{BTreeMap, HashMap};
use std::path::Path;

/// Heads that ship, one per backbone.
const BUILT_IN: [&[u8]; 1] = [include_bytes!(
    "../../../../models/dinov2-vits14-b8.safetensors"
)];

/// A projection d -> 256, and the pooling before it.
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
    /// How it was made, for people.
    notes: BTreeMap<String, String>,
}

impl Head {
    /// Builds a head for `backbone` from `weight` `[256, d]` and `bias` `[256]`, where d is the
    /// length of what `aggregate` makes; `notes` say how it was made.
    pub fn new(
        aggregate: Aggregate,
        weight: Vec<f32>,
        bias: Vec<f32>,
        backbone: impl Into<String>,
        notes: BTreeMap<String, String>,
    ) -> Result<Self, ExtractError> {
        let bad = |reason| {
            Err(ExtractError::BadFile {
                path: "head".into(),
                reason,
            })
        };
        let dim = weight.len() / GLOBAL_DIM;
        let finite = weight.iter().chain(&bias).all(|value| value.is_finite());
        if dim == 0 || weight.len() != dim * GLOBAL_DIM || bias.len() != GLOBAL_DIM || !finite {
            return bad(format!(
                "a head needs a finite [{GLOBAL_DIM}, d] weight and a [{GLOBAL_DIM}] bias"
            ));
        }
        if let Aggregate::Vlad(words) = &aggregate
            && words.values().len() != dim
        {
            let length = words.values().len();
            return bad(format!(
                "weight takes {dim} values, its {} visual words make {length}",
                words.count()
            ));
        }
        Ok(Self {
            aggregate,
            weight,
            bias,
            dim,
            backbone: backbone.into(),
            notes,
        })
    }

    /// The same head with another `weight` `[256, d]` and `bias` `[256]`, as training makes it, and
    /// other notes.
    pub fn with_weights(
        &self,
        weight: Vec<f32>,
        bias: Vec<f32>,
        notes: BTreeMap<String, String>,
    ) -> Result<Self, ExtractError> {
        Self::new(
            self.aggregate.clone(),
            weight,
            bias,
            self.backbone.clone(),
            notes,
        )
    }

    /// Loads a head file; refuses anything but its tensors and its metadata.
    pub fn load(path: &Path) -> Result<Self, ExtractError> {
        Self::from_bytes(&std::fs::read(path).map_err(ExtractError::io(path))?, path)
    }

    /// The head built in for `backbone`, if there is one.
    pub fn built_in(backbone: &str) -> Result<Option<Self>, ExtractError> {
        for bytes in BUILT_IN {
            let head = Self::from_bytes(bytes, Path::new("built-in head"))?;
            if head.backbone == backbone {
                return Ok(Some(head));
            }
        }
        Ok(None)
    }

    /// As [`Head::load`], from the bytes of the file that `path` names in errors.
    pub fn from_bytes(bytes: &[u8], path: &Path) -> Result<Self, ExtractError> {
        let bad = |reason: String| ExtractError::BadFile {
            path: path.to_owned(),
            reason,
        };
        let broken = |e| bad(format!("truncated or not a safetensors file: {e}"));
        let (_, metadata) = SafeTensors::read_metadata(bytes).map_err(broken)?;
        let tensors = SafeTensors::deserialize(bytes).map_err(broken)?;
        let mut notes: BTreeMap<_, _> = metadata
            .metadata()
            .clone()
            .unwrap_or_default()
            .into_iter()
            .collect();
        let backbone = notes
            .remove("backbone")
            .ok_or_else(|| bad("no head: its metadata names no backbone".into()))?;
        let kind = notes.remove("aggregate").unwrap_or_else(|| "mean".into());
        let file = HeadFile {
            tensors: &tensors,
            path,
        };
        let aggregate = file.aggregate(&kind)?;
        let (weight, bias) = (
            file.take("weight", &[GLOBAL_DIM, 0])?,
            file.take("bias", &[GLOBAL_DIM])?,
        );
        // Told with the file's own path, which `new` does not know.
        Self::new(aggregate, weight, bias, backbone, notes).map_err(|error| match error {
            ExtractError::BadFile { reason, .. } => bad(reason),
            other => other,
        })
    }

    /// Writes the head, atomically.
    pub fn save(&self, path: &Path) -> Result<(), ExtractError> {
        let bad = |e: safetensors::SafeTensorError| ExtractError::BadFile {
            path: path.to_owned(),
            reason: e.to_string(),
        };
        let view = |shape: Vec<usize>, values| {
            TensorView::new(Dtype::F32, shape, bytemuck::cast_slice::<f32, u8>(values)).map_err(bad)
        };
        let mut tensors = vec![
            ("weight", view(vec![GLOBAL_DIM, self.dim], &self.weight)?),
            ("bias", view(vec![GLOBAL_DIM], &self.bias)?),
        ];
        match &self.aggregate {
            Aggregate::Mean => {}
            Aggregate::Gem { p } => tensors.push((GEM_P, view(vec![1], std::slice::from_ref(p))?)),
            Aggregate::Vlad(words) => {
                tensors.push((
                    VLAD_WORDS,
                    view(vec![words.count(), words.dim()], words.values())?,
                ));
            }
        }
        let mut metadata: HashMap<String, String> = self.notes.clone().into_iter().collect();
        metadata.insert("backbone".into(), self.backbone.clone());
        metadata.insert("aggregate".into(), self.aggregate.kind().into());
        let bytes = safetensors::serialize(tensors, Some(metadata)).map_err(bad)?;
        write_atomically(path, &bytes).map_err(ExtractError::io(path))
    }

    /// Length of the pooled vector it takes.
    pub fn dim(&self) -> usize {
        self.dim
    }

    /// Width of the tokens that are pooled.
    pub fn token_dim(&self) -> usize {
        match &self.aggregate {
            Aggregate::Mean | Aggregate::Gem { .. } => self.dim,
            Aggregate::Vlad(words) => words.dim(),
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

    /// The backbone whose tokens it takes, as [`crate::extract::Extractor::backbone`] writes it.
    pub fn backbone(&self) -> &str {
        &self.backbone
    }

    /// How it was made.
    pub fn notes(&self) -> &BTreeMap<String, String> {
        &self.notes
    }

    /// SHA-256 over weight, bias and what the aggregate has of its own, hexadecimal: the head's
    /// part of a `ModelId`.
    pub fn content_hash(&self) -> String {
        let mut hasher = Sha256::new();
        hasher.update(bytemuck::cast_slice::<f32, u8>(&self.weight));
        hasher.update(bytemuck::cast_slice::<f32, u8>(&self.bias));
        self.aggregate.hash_into(&mut hasher);
        hex::encode(hasher.finalize())
    }

    /// The global descriptor `[256]` of an L2-normalised pooled vector `[dim]`.
    pub fn project(&self, pooled: &[f32]) -> Vec<f32> {
        let mut global: Vec<f32> = self
            .affine(pooled)
            .iter()
            .map(|&value| value as f32)
            .collect();
        l2_normalise(&mut global);
        global
    }

    /// As [`Head::project`], for a vector from a store: one of another length gives an empty
    /// vector, which the store refuses by name.
    pub fn project_stored(&self, pooled: &[f32]) -> Vec<f32> {
        if pooled.len() == self.dim {
            self.project(pooled)
        } else {
            Vec::new()
        }
    }

    /// W x + b, before normalisation.
    pub(super) fn affine(&self, pooled: &[f32]) -> Vec<f64> {
        assert_eq!(
            pooled.len(),
            self.dim,
            "a head takes tokens of its own width"
        );
        let mut projected = Vec::with_capacity(GLOBAL_DIM);
        // Each sum waits for its last addition, so rows are summed side by side: whole maps pass
        // through here.
        for (rows, biases) in self
            .weight
            .chunks_exact(ROWS * self.dim)
            .zip(self.bias.chunks_exact(ROWS))
        {
            let mut sums = [0f64; ROWS];
            for (k, &x) in pooled.iter().enumerate() {
                for (r, sum) in sums.iter_mut().enumerate() {
                    *sum += f64::from(rows[r * self.dim + k]) * f64::from(x);
                }
            }
            projected.extend(
                sums.iter()
                    .zip(biases)
                    .map(|(sum, &bias)| sum + f64::from(bias)),
            );
        }
        projected
    }
}

/// Rows of the weight that are summed side by side; divides their number.
const ROWS: usize = 8;
const _: () = assert!(GLOBAL_DIM.is_multiple_of(ROWS));

const GEM_P: &str = "gem_p";
const VLAD_WORDS: &str = "vlad_words";

/// The tensors of a head's file, taken by name; `path` is named in errors.
struct HeadFile<'a> {
    tensors: &'a SafeTensors<'a>,
    path: &'a Path,
}

impl HeadFile<'_> {
    fn bad(&self, reason: String) -> ExtractError {
        ExtractError::BadFile {
            path: self.path.to_owned(),
            reason,
        }
    }

    /// The aggregate of this kind; refuses tensors that a head of this kind does not have.
    fn aggregate(&self, kind: &str) -> Result<Aggregate, ExtractError> {
        let own: &[&str] = match kind {
            "mean" => &["weight", "bias"],
            "gem" => &["weight", "bias", GEM_P],
            "vlad" => &["weight", "bias", VLAD_WORDS],
            _ => {
                return Err(self.bad(format!(
                    "its aggregate {kind:?} is not one of mean, gem, vlad"
                )));
            }
        };
        if let Some(name) = self
            .tensors
            .names()
            .into_iter()
            .find(|name| !own.contains(name))
        {
            return Err(self.bad(format!(
                "unexpected tensor {name}; a {kind} head holds {}",
                own.join(", ")
            )));
        }
        match kind {
            "gem" => Aggregate::gem(self.take(GEM_P, &[1])?[0]).map_err(|reason| self.bad(reason)),
            "vlad" => {
                let values = self.take(VLAD_WORDS, &[0, 0])?;
                let words = self
                    .tensors
                    .tensor(VLAD_WORDS)
                    .map_or(1, |view| view.shape()[0]);
                let dim = values.len() / words;
                VladWords::new(values, dim)
                    .map(Aggregate::Vlad)
                    .map_err(|reason| self.bad(reason))
            }
            _ => Ok(Aggregate::Mean),
        }
    }

    /// The values of a tensor of `shape`, in which 0 stands for any positive number.
    fn take(&self, name: &str, shape: &[usize]) -> Result<Vec<f32>, ExtractError> {
        let view = self
            .tensors
            .tensor(name)
            .map_err(|_| self.bad(format!("{name} is missing")))?;
        let fits = |(&found, &asked): (&usize, &usize)| found > 0 && (asked == 0 || asked == found);
        let right = view.shape().len() == shape.len() && view.shape().iter().zip(shape).all(fits);
        match to_f32(&view).filter(|_| right) {
            Some(values) if values.iter().all(|v| v.is_finite()) => Ok(values),
            Some(_) => Err(self.bad(format!("{name} holds values that are not finite"))),
            None => {
                let asked: Vec<String> = shape
                    .iter()
                    .map(|&side| {
                        if side == 0 {
                            "any".into()
                        } else {
                            side.to_string()
                        }
                    })
                    .collect();
                let (dtype, found) = (view.dtype(), view.shape());
                Err(self.bad(format!(
                    "{name} is {dtype:?} {found:?}, not a float [{}]",
                    asked.join(", ")
                )))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn head() -> Head {
        let weight = (0..GLOBAL_DIM * 8)
            .map(|i| ((i * 37) % 101) as f32 / 50.0 - 1.0)
            .collect();
        let notes = [("method".to_owned(), "test".to_owned())].into();
        Head::new(
            Aggregate::Mean,
            weight,
            vec![0.5; GLOBAL_DIM],
            "backbone-x",
            notes,
        )
        .unwrap()
    }

    #[test]
    fn a_head_survives_its_file() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("h.safetensors");
        head().save(&path).unwrap();
        let back = Head::load(&path).unwrap();
        assert_eq!(back, head());
        assert_eq!(back.content_hash(), head().content_hash());
        assert_eq!(
            std::fs::read_dir(dir.path()).unwrap().count(),
            1,
            "no unfinished file is left"
        );
    }

    fn vlad(words: usize) -> Aggregate {
        Aggregate::Vlad(
            VladWords::new((0..words * 4).map(|i| i as f32 / 9.0).collect(), 4).unwrap(),
        )
    }

    #[test]
    fn the_aggregate_is_part_of_the_file_and_of_the_hash() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("h.safetensors");
        let mut hashes = std::collections::BTreeSet::new();
        for aggregate in [
            Aggregate::Mean,
            Aggregate::gem(3.0).unwrap(),
            Aggregate::gem(4.0).unwrap(),
            vlad(2),
        ] {
            let (weight, bias) = (head().weight, head().bias);
            let made =
                Head::new(aggregate.clone(), weight, bias, "backbone-x", head().notes).unwrap();
            made.save(&path).unwrap();
            let back = Head::load(&path).unwrap();
            assert_eq!(
                (&back, back.aggregate(), back.content_hash()),
                (&made, &aggregate, made.content_hash())
            );
            assert_eq!(back.dim(), aggregate.pooled_dim(back.token_dim()));
            assert!(
                hashes.insert(back.content_hash()),
                "{aggregate} shares its hash with another"
            );
        }
        assert!(
            hashes.contains(&head().content_hash()),
            "a mean head keeps the hash it always had"
        );
        let wrong = Head::new(vlad(3), head().weight, head().bias, "x", [].into())
            .unwrap_err()
            .to_string();
        assert!(
            wrong.contains("takes 8 values, its 3 visual words make 12"),
            "{wrong}"
        );
    }

    #[test]
    fn a_file_whose_aggregate_does_not_fit_is_refused() {
        let refusal = |kind: &str, extra: Option<(&str, Vec<usize>)>| {
            let (head, values) = (head(), vec![1.5f32; 64]);
            let view = |shape: Vec<usize>, values: &[f32]| {
                let bytes =
                    bytemuck::cast_slice::<f32, u8>(&values[..shape.iter().product()]).to_vec();
                (shape, bytes)
            };
            let mut parts = vec![
                ("weight", view(vec![256, 8], &head.weight)),
                ("bias", view(vec![256], &head.bias)),
            ];
            parts.extend(extra.map(|(name, shape)| (name, view(shape, &values))));
            let tensors: Vec<_> = parts
                .iter()
                .map(|(name, (shape, bytes))| {
                    (
                        *name,
                        TensorView::new(Dtype::F32, shape.clone(), bytes).unwrap(),
                    )
                })
                .collect();
            let meta: HashMap<_, _> = [
                ("backbone".to_owned(), "x".to_owned()),
                ("aggregate".to_owned(), kind.to_owned()),
            ]
            .into();
            let bytes = safetensors::serialize(tensors, Some(meta)).unwrap();
            Head::from_bytes(&bytes, Path::new("h"))
                .err()
                .map(|error| error.to_string())
                .unwrap_or_default()
        };
        assert_eq!(refusal("gem", Some((GEM_P, vec![1]))), "");
        assert_eq!(refusal("vlad", Some((VLAD_WORDS, vec![2, 4]))), "");
        for (kind, extra, part) in [
            ("median", None, "\"median\" is not one of"),
            ("mean", Some((GEM_P, vec![1])), "unexpected tensor gem_p"),
            ("gem", None, "gem_p is missing"),
            (
                "gem",
                Some((GEM_P, vec![2])),
                "gem_p is F32 [2], not a float [1]",
            ),
            ("vlad", Some((VLAD_WORDS, vec![3, 4])), "make 12"),
            (
                "vlad",
                Some((VLAD_WORDS, vec![8])),
                "not a float [any, any]",
            ),
        ] {
            let refusal = refusal(kind, extra);
            assert!(refusal.contains(part), "{kind}: {refusal}");
        }
    }

    #[test]
    fn a_damaged_head_is_refused_with_its_fault() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("h.safetensors");
        head().save(&path).unwrap();
        let bytes = std::fs::read(&path).unwrap();
        let truncated = Head::from_bytes(&bytes[..bytes.len() - 5], &path)
            .unwrap_err()
            .to_string();
        assert!(truncated.contains("truncated"), "{truncated}");
        let values = [0f32; 12];
        let view =
            || TensorView::new(Dtype::F32, vec![3, 4], bytemuck::cast_slice(&values)).unwrap();
        let meta: HashMap<_, _> = [("backbone".to_owned(), "x".to_owned())].into();
        let wrong =
            safetensors::serialize([("weight", view()), ("bias", view())], Some(meta.clone()))
                .unwrap();
        assert!(
            Head::from_bytes(&wrong, &path)
                .unwrap_err()
                .to_string()
                .contains("weight is F32 [3, 4]")
        );
        let extra = safetensors::serialize([("mu", view())], Some(meta)).unwrap();
        assert!(
            Head::from_bytes(&extra, &path)
                .unwrap_err()
                .to_string()
                .contains("unexpected tensor mu")
        );
        let unbound = safetensors::serialize([("weight", view())], None).unwrap();
        assert!(
            Head::from_bytes(&unbound, &path)
                .unwrap_err()
                .to_string()
                .contains("backbone")
        );
    }

    #[test]
    fn projection_is_affine_then_unit_length() {
        let global = head().project(&[0.25; 8]);
        assert_eq!(global.len(), GLOBAL_DIM);
        assert!((global.iter().map(|v| v * v).sum::<f32>() - 1.0).abs() < 1e-5);
        let raw: f32 = head().weight[..8].iter().sum::<f32>() * 0.25 + 0.5;
        let other: f32 = head().weight[8..16].iter().sum::<f32>() * 0.25 + 0.5;
        assert!((global[0] / global[1] - raw / other).abs() < 1e-4);
    }
}
