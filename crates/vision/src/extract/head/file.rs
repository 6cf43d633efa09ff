//! Heads in files.
//!
//! A head is a small safetensors file: `weight` `[256, d]`, `bias` `[256]`, and metadata. The
//! metadata `backbone` says which backbone's tokens the head was fitted to, and `aggregate` how
//! they are pooled: `mean` (also if it is missing); `gem`, with its power in a tensor `gem_p`
//! `[1]`; `vlad`, with its visual words in a tensor `vlad_words` `[k, token width]`, for which d is
//! k times that width; or `netvlad`, with the tensors `netvlad_mean` `[token width]`,
//! `netvlad_projection` `[w, token width]`, `netvlad_words` and `netvlad_assignment` `[k, w]`, for
//! which d is k times w. All other metadata are notes for people.

use super::projection::Head;
use crate::extract::aggregate::Aggregate;
use crate::extract::error::ExtractError;
use crate::extract::netvlad::{NetVlad, NetVladParameters};
use crate::extract::tensor_file::{TensorFile, to_f32};
use crate::extract::vlad::VladWords;
use placeformer_core::files::write_atomically;
use placeformer_core::types::GLOBAL_DIM;
use safetensors::tensor::{Dtype, SafeTensorError, TensorView};
use std::collections::{BTreeMap, HashMap};
use std::path::Path;

/// Heads that are part of the binary, one for each backbone that ships.
const BUILT_IN: [&[u8]; 1] = [include_bytes!(
    "../../../../../models/dinov2-vits14-b8.safetensors"
)];

/// Name of the tensor with the power of a generalised mean.
pub(super) const GEM_P: &str = "gem_p";

/// Name of the tensor with the visual words of a VLAD.
pub(super) const VLAD_WORDS: &str = "vlad_words";

/// Names of the tensors of a NetVLAD: mean, projection, words, assignment.
pub(super) const NETVLAD: [&str; 4] = [
    "netvlad_mean",
    "netvlad_projection",
    "netvlad_words",
    "netvlad_assignment",
];

/// Stands for any positive length in the shape that a tensor must have.
const ANY: usize = 0;

impl Head {
    /// Loads the head file at `path`.
    ///
    /// # Errors
    /// [`ExtractError::Io`] if it cannot be read; [`ExtractError::BadFile`] if a tensor or the
    /// backbone is missing, or the file holds any other tensor.
    pub fn load(path: &Path) -> Result<Self, ExtractError> {
        let bytes = std::fs::read(path).map_err(ExtractError::io(path))?;
        Self::from_bytes(&bytes, path)
    }

    /// The head built in for `backbone`, if there is one.
    ///
    /// # Errors
    /// As [`Head::from_bytes`], if the binary itself is damaged.
    pub fn built_in(backbone: &str) -> Result<Option<Self>, ExtractError> {
        for bytes in BUILT_IN {
            let head = Self::from_bytes(bytes, Path::new("built-in head"))?;
            if head.backbone() == backbone {
                return Ok(Some(head));
            }
        }
        Ok(None)
    }

    /// As [`Head::load`], from the bytes of the file; `path` is named in errors.
    ///
    /// # Errors
    /// As [`Head::load`], but for reading the file.
    pub fn from_bytes(bytes: &[u8], path: &Path) -> Result<Self, ExtractError> {
        let file = TensorFile::parse(bytes, path)?;
        let mut notes: BTreeMap<String, String> = file.metadata.clone().into_iter().collect();
        let Some(backbone) = notes.remove("backbone") else {
            return Err(file.bad("no head: its metadata names no backbone"));
        };
        let kind = notes.remove("aggregate").unwrap_or_else(|| "mean".into());
        let aggregate = read_aggregate(&file, &kind)?;
        let weight = read_tensor(&file, "weight", &[GLOBAL_DIM, ANY])?;
        let bias = read_tensor(&file, "bias", &[GLOBAL_DIM])?;
        let head = Self::new(aggregate, weight, bias, backbone, notes);
        // `new` does not know the file, so its error is given the path here.
        head.map_err(|error| match error {
            ExtractError::BadFile { reason, .. } => file.bad(reason),
            other => other,
        })
    }

    /// Writes the head to `path`. The file appears complete or not at all.
    ///
    /// # Errors
    /// [`ExtractError::Io`] if the file cannot be written.
    pub fn save(&self, path: &Path) -> Result<(), ExtractError> {
        let bad = |error: SafeTensorError| ExtractError::BadFile {
            path: path.to_owned(),
            reason: error.to_string(),
        };
        let (weight, bias) = self.weights();
        let mut tensors = vec![
            (
                "weight",
                view(&[GLOBAL_DIM, self.dim()], weight).map_err(bad)?,
            ),
            ("bias", view(&[GLOBAL_DIM], bias).map_err(bad)?),
        ];
        match self.aggregate() {
            Aggregate::Mean => {}
            Aggregate::Gem { p } => {
                let power = std::slice::from_ref(p);
                tensors.push((GEM_P, view(&[1], power).map_err(bad)?));
            }
            Aggregate::Vlad(words) => {
                let shape = [words.count(), words.dim()];
                tensors.push((VLAD_WORDS, view(&shape, words.values()).map_err(bad)?));
            }
            Aggregate::NetVlad(netvlad) => {
                let parts = netvlad.parameters();
                let words = [netvlad.count(), netvlad.width()];
                let views = [
                    view(&[netvlad.dim()], &parts.mean),
                    view(&[netvlad.width(), netvlad.dim()], &parts.projection),
                    view(&words, &parts.words),
                    view(&words, &parts.assignment),
                ];
                for (name, view) in NETVLAD.into_iter().zip(views) {
                    tensors.push((name, view.map_err(bad)?));
                }
            }
        }

        let mut metadata: HashMap<String, String> = self.notes().clone().into_iter().collect();
        metadata.insert("backbone".into(), self.backbone().to_owned());
        metadata.insert("aggregate".into(), self.aggregate().kind().into());
        let bytes = safetensors::serialize(tensors, Some(metadata)).map_err(bad)?;
        write_atomically(path, &bytes).map_err(ExtractError::io(path))
    }
}

fn view<'a>(shape: &[usize], values: &'a [f32]) -> Result<TensorView<'a>, SafeTensorError> {
    let bytes = bytemuck::cast_slice::<f32, u8>(values);
    TensorView::new(Dtype::F32, shape.to_vec(), bytes)
}

/// The aggregate of this kind. Refuses tensors that a head of this kind does not have.
fn read_aggregate(file: &TensorFile<'_>, kind: &str) -> Result<Aggregate, ExtractError> {
    let of_kind: &[&str] = match kind {
        "mean" => &[],
        "gem" => &[GEM_P],
        "vlad" => &[VLAD_WORDS],
        "netvlad" => &NETVLAD,
        _ => {
            let reason = format!("its aggregate {kind:?} is not one of mean, gem, vlad, netvlad");
            return Err(file.bad(reason));
        }
    };
    let known = [&["weight", "bias"], of_kind].concat();
    let names = file.tensors.names();
    if let Some(name) = names.into_iter().find(|name| !known.contains(name)) {
        let known = known.join(", ");
        return Err(file.bad(format!(
            "unexpected tensor {name}; a {kind} head holds {known}"
        )));
    }
    match kind {
        "gem" => {
            let power = read_tensor(file, GEM_P, &[1])?[0];
            Aggregate::gem(power).map_err(|reason| file.bad(reason))
        }
        "vlad" => {
            let values = read_tensor(file, VLAD_WORDS, &[ANY, ANY])?;
            let tensor = file.tensors.tensor(VLAD_WORDS);
            let count = tensor.map_or(1, |view| view.shape()[0]);
            let dim = values.len() / count;
            let words = VladWords::new(values, dim).map_err(|reason| file.bad(reason))?;
            Ok(Aggregate::Vlad(words))
        }
        "netvlad" => {
            let parts = read_netvlad(file)?;
            let netvlad = NetVlad::new(parts).map_err(|reason| file.bad(reason))?;
            Ok(Aggregate::NetVlad(Box::new(netvlad)))
        }
        _ => Ok(Aggregate::Mean),
    }
}

/// The parts of a NetVLAD, whose shapes must fit each other.
fn read_netvlad(file: &TensorFile<'_>) -> Result<NetVladParameters, ExtractError> {
    let [mean, projection, words, assignment] = NETVLAD;
    let mean = read_tensor(file, mean, &[ANY])?;
    let projection = read_tensor(file, projection, &[ANY, mean.len()])?;
    let width = projection.len() / mean.len();
    let words = read_tensor(file, words, &[ANY, width])?;
    let count = words.len() / width;
    let assignment = read_tensor(file, assignment, &[count, width])?;
    Ok(NetVladParameters {
        mean,
        projection,
        words,
        assignment,
    })
}

/// The values of a tensor of `shape`, in which [`ANY`] stands for any positive length.
fn read_tensor(
    file: &TensorFile<'_>,
    name: &str,
    shape: &[usize],
) -> Result<Vec<f32>, ExtractError> {
    let Ok(view) = file.tensors.tensor(name) else {
        return Err(file.bad(format!("{name} is missing")));
    };
    let values = to_f32(&view).filter(|_| has_shape(view.shape(), shape));
    let Some(values) = values else {
        let dtype = view.dtype();
        let found = view.shape();
        let asked = describe_shape(shape);
        return Err(file.bad(format!(
            "{name} is {dtype:?} {found:?}, not a float {asked}"
        )));
    };
    if values.iter().any(|value| !value.is_finite()) {
        return Err(file.bad(format!("{name} holds values that are not finite")));
    }
    Ok(values)
}

fn has_shape(found: &[usize], asked: &[usize]) -> bool {
    let fits = |(&found, &asked): (&usize, &usize)| found > 0 && (asked == ANY || asked == found);
    found.len() == asked.len() && found.iter().zip(asked).all(fits)
}

/// `[256, any]`.
fn describe_shape(shape: &[usize]) -> String {
    let lengths: Vec<String> = shape
        .iter()
        .map(|&length| match length {
            ANY => "any".to_owned(),
            _ => length.to_string(),
        })
        .collect();
    format!("[{}]", lengths.join(", "))
}
