//! The same query as users assemble it today, from a script beside the benches, in the same run.

use anyhow::{Context, ensure};
use placeformer_core::types::ImageSize;
use placeformer_lab::bench::scenes::street;
use placeformer_vision::extract::Extractor;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// The script, from the project's folder.
const SCRIPT: &str = "benches/peers/pipeline.py";

/// What one measurement gives, ours or the script's.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct QueryFigures {
    /// Answers.
    pub(super) queries: u64,
    pub(super) p50_ms: f64,
    pub(super) p99_ms: f64,
    pub(super) queries_per_second: f64,
    /// Median of each stage.
    pub(super) stages_ms: BTreeMap<String, f64>,
    /// Resident memory: of our server at the end, of the script at its highest.
    pub(super) resident_bytes: u64,
}

/// Everything the script needs, in one folder.
pub(super) struct Peers<'a> {
    python: &'a Path,
    folder: PathBuf,
    weights: PathBuf,
    size: String,
    exit_block: usize,
}

impl<'a> Peers<'a> {
    /// Writes the photos (`drawn` references as the store has them, and the queries) and the head.
    pub(super) fn prepare(
        python: &'a Path,
        folder: &Path,
        (extractor, weights): (&Extractor, &Path),
        (drawn, size): (u64, ImageSize),
        queries: &[bytes::Bytes],
    ) -> anyhow::Result<Self> {
        ensure!(
            Path::new(SCRIPT).exists(),
            "{SCRIPT} is not here: run --peers in the project's folder"
        );
        let folder = folder.join("peers");
        let photo = |kind: &str, number: u64| folder.join(kind).join(format!("{number:06}.jpg"));
        for kind in ["references", "queries", "patches"] {
            std::fs::create_dir_all(folder.join(kind))
                .with_context(|| folder.display().to_string())?;
        }
        for place in (0..drawn).filter(|&place| !photo("references", place).exists()) {
            std::fs::write(photo("references", place), street(place, 0, size)?)?;
        }
        for (number, query) in (0..).zip(queries) {
            std::fs::write(photo("queries", number), query)?;
        }
        extractor
            .head()
            .context("the peers need a head too")?
            .save(&folder.join("head.safetensors"))?;
        let exit_block = extractor
            .config()
            .exit_block
            .context("the settings in force name an exit block")?;
        let size = extractor.input_size().to_string();
        Ok(Self {
            python,
            folder,
            weights: weights.to_owned(),
            size,
            exit_block,
        })
    }

    /// Runs the script for `seconds` at a map of `references`.
    pub(super) fn measure(&self, references: u64, seconds: f64) -> anyhow::Result<QueryFigures> {
        let output = Command::new(self.python)
            .arg(SCRIPT)
            .args(["--weights".as_ref(), self.weights.as_os_str()])
            .args([
                "--head".as_ref(),
                self.folder.join("head.safetensors").as_os_str(),
            ])
            .args(["--photos".as_ref(), self.folder.as_os_str()])
            .args(["--work".as_ref(), self.folder.join("patches").as_os_str()])
            .args([
                "--references",
                &references.to_string(),
                "--seconds",
                &seconds.to_string(),
            ])
            .args([
                "--size",
                &self.size,
                "--exit-block",
                &self.exit_block.to_string(),
            ])
            .args(["--threads", &rayon::current_num_threads().to_string()])
            .stderr(Stdio::inherit())
            .output()
            .with_context(|| format!("cannot start {}", self.python.display()))?;
        ensure!(
            output.status.success(),
            "{SCRIPT} failed: {}",
            output.status
        );
        let text = String::from_utf8_lossy(&output.stdout);
        let last = text.lines().last().unwrap_or_default();
        serde_json::from_str(last).with_context(|| format!("{SCRIPT} printed {last:?}"))
    }
}
