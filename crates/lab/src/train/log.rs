//! The diary of a run: one JSON line a cycle.

use super::config::ValidationRecall;
use super::error::TrainError;
use serde::{Deserialize, Serialize};
use std::fs::{File, OpenOptions};
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};

const FILE: &str = "train.jsonl";

/// One cycle of a run.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct CycleRecord {
    /// Steps taken so far.
    pub step: u64,
    /// Learning rate of the last of them.
    pub learning_rate: f64,
    /// Mean loss of the cycle.
    pub loss: f32,
    /// Recall on the validation images after it.
    pub recall: ValidationRecall,
    /// Mean seconds of a step.
    #[serde(default)]
    pub step_seconds: f64,
    /// How long the cycle took, with mining and validation.
    pub seconds: f64,
}

/// The open log of a run.
pub(super) struct TrainLog {
    path: PathBuf,
    file: File,
}

impl TrainLog {
    /// Opens the log in `folder`, cutting off lines behind `steps`: a cycle that was logged but not
    /// checkpointed is about to be repeated.
    pub(super) fn open(folder: &Path, steps: u64) -> Result<Self, TrainError> {
        let path = folder.join(FILE);
        let io = |source| TrainError::Io {
            path: path.clone(),
            source,
        };
        std::fs::create_dir_all(folder).map_err(io)?;
        let kept: Vec<CycleRecord> = if path.exists() {
            read_log(folder)?
                .into_iter()
                .filter(|r| r.step <= steps)
                .collect()
        } else {
            vec![]
        };
        let file = OpenOptions::new()
            .create(true)
            .write(true)
            .truncate(true)
            .open(&path)
            .map_err(io)?;
        let mut log = Self { path, file };
        for record in &kept {
            log.append(record)?;
        }
        Ok(log)
    }

    pub(super) fn append(&mut self, record: &CycleRecord) -> Result<(), TrainError> {
        let io = |source| TrainError::Io {
            path: self.path.clone(),
            source,
        };
        let mut line = serde_json::to_vec(record).map_err(|error| io(error.into()))?;
        line.push(b'\n');
        self.file.write_all(&line).map_err(io)
    }
}

/// Every cycle of the run in `folder`; a last line cut off by a kill is passed over.
///
/// # Errors
/// The file cannot be read, or a line of it is no record.
pub fn read_log(folder: &Path) -> Result<Vec<CycleRecord>, TrainError> {
    let path = folder.join(FILE);
    let io = |source| TrainError::Io {
        path: path.clone(),
        source,
    };
    let lines: Result<Vec<String>, _> = BufReader::new(File::open(&path).map_err(io)?)
        .lines()
        .collect();
    let lines = lines.map_err(io)?;
    let mut records = Vec::with_capacity(lines.len());
    for (number, line) in lines.iter().enumerate() {
        match serde_json::from_str(line) {
            Ok(record) => records.push(record),
            Err(_) if number + 1 == lines.len() => {}
            Err(error) => {
                let reason = format!("line {}: {error}", number + 1);
                return Err(TrainError::Checkpoint { path, reason });
            }
        }
    }
    Ok(records)
}
