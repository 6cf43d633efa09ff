//! What a run needs to continue bit for bit: weights, moments, the best weights so far, counters,
//! settings.
//!
//! One safetensors file, written under another name and renamed over the last one, so that a run
//! killed while saving keeps the previous checkpoint.

use super::adam::Adam;
use super::config::{TrainConfig, ValidationRecall};
use super::error::TrainError;
use candle_core::{Device, Shape, Tensor};
use placeformer_core::files::write_atomically;
use safetensors::SafeTensors;
use serde::{Deserialize, Serialize};
use std::collections::HashMap;
use std::path::Path;

const FILE: &str = "checkpoint.safetensors";
const STATE: &str = "placeformer.train";

/// The memory of a run between two cycles.
pub(super) struct Checkpoint {
    pub(super) steps: u64,
    pub(super) cycles_without_gain: u32,
    pub(super) initial: ValidationRecall,
    pub(super) best: ValidationRecall,
    pub(super) last: ValidationRecall,
    pub(super) last_loss: f32,
    best_weights: HashMap<String, Tensor>,
}

/// The part that is not tensors; kept in the file's header.
#[derive(Serialize, Deserialize)]
struct State {
    steps: u64,
    cycles_without_gain: u32,
    initial: ValidationRecall,
    best: ValidationRecall,
    last: ValidationRecall,
    last_loss: f32,
    config: TrainConfig,
    identity: String,
}

impl State {
    /// The state in the header of a checkpoint's bytes, or what is wrong with them.
    fn read(bytes: &[u8]) -> Result<Self, String> {
        let (_, header) =
            SafeTensors::read_metadata(bytes).map_err(|error| format!("not readable: {error}"))?;
        let metadata = header.metadata().as_ref();
        let state = metadata
            .and_then(|metadata| metadata.get(STATE))
            .ok_or("it is not a training checkpoint")?;
        serde_json::from_str(state).map_err(|error| format!("its header: {error}"))
    }

    /// Says why a run with these settings cannot go on from here.
    fn check(&self, config: &TrainConfig, identity: &str) -> Result<(), String> {
        if self.config != *config {
            return Err(
                "it belongs to a run with other settings; use them again or another folder".into(),
            );
        }
        if self.identity != identity {
            return Err("it belongs to a run on other data or from other weights; \
                 use these again or another folder"
                .into());
        }
        Ok(())
    }
}

/// Takes a tensor of this shape out of `tensors`, or says why not.
fn take_tensor(
    tensors: &mut HashMap<String, Tensor>,
    key: &str,
    shape: &Shape,
) -> Result<Tensor, String> {
    let tensor = tensors
        .remove(key)
        .ok_or_else(|| format!("{key} is missing"))?;
    if tensor.shape() == shape {
        Ok(tensor)
    } else {
        let found = tensor.shape();
        Err(format!("{key} has shape {found:?}, the model {shape:?}"))
    }
}

impl Checkpoint {
    /// The memory of a run that has not begun.
    pub(super) fn start(adam: &Adam, initial: ValidationRecall) -> Result<Self, TrainError> {
        let best_weights = weights_of(adam)?;
        Ok(Self {
            steps: 0,
            cycles_without_gain: 0,
            initial,
            best: initial,
            last: initial,
            last_loss: 0.0,
            best_weights,
        })
    }

    /// Notes the end of a cycle; keeps the weights if validation is better than ever.
    pub(super) fn record(
        &mut self,
        adam: &Adam,
        steps: u64,
        loss: f32,
        recall: ValidationRecall,
    ) -> Result<(), TrainError> {
        self.steps = steps;
        self.last = recall;
        self.last_loss = loss;
        if recall.criterion() > self.best.criterion() {
            self.best = recall;
            self.best_weights = weights_of(adam)?;
            self.cycles_without_gain = 0;
        } else {
            self.cycles_without_gain += 1;
        }
        Ok(())
    }

    /// Puts the best weights into the model.
    pub(super) fn restore_best(&self, adam: &Adam) -> Result<(), TrainError> {
        for slot in &adam.slots {
            if let Some(weights) = self.best_weights.get(&slot.name) {
                slot.variable.set(weights)?;
            }
        }
        Ok(())
    }

    /// Continues the run in `folder`, if there is one: fills the optimiser and the model's weights.
    pub(super) fn resume(
        folder: &Path,
        config: &TrainConfig,
        identity: &str,
        adam: &mut Adam,
    ) -> Result<Option<Self>, TrainError> {
        let path = folder.join(FILE);
        let bytes = match std::fs::read(&path) {
            Ok(bytes) => bytes,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(None),
            Err(source) => return Err(TrainError::Io { path, source }),
        };
        let wrong = |reason: String| TrainError::Checkpoint {
            path: path.clone(),
            reason,
        };
        let state = State::read(&bytes).map_err(wrong)?;
        state.check(config, identity).map_err(wrong)?;
        let mut tensors = candle_core::safetensors::load_buffer(&bytes, &Device::Cpu)?;
        let mut take = |prefix: &str, name: &str, shape: &Shape| {
            take_tensor(&mut tensors, &format!("{prefix}.{name}"), shape).map_err(wrong)
        };
        let mut best_weights = HashMap::new();
        for slot in &mut adam.slots {
            let shape = slot.variable.shape().clone();
            slot.variable.set(&take("weights", &slot.name, &shape)?)?;
            slot.first = take("first", &slot.name, &shape)?;
            slot.second = take("second", &slot.name, &shape)?;
            best_weights.insert(slot.name.clone(), take("best", &slot.name, &shape)?);
        }
        adam.steps = state.steps;
        Ok(Some(Self {
            steps: state.steps,
            cycles_without_gain: state.cycles_without_gain,
            initial: state.initial,
            best: state.best,
            last: state.last,
            last_loss: state.last_loss,
            best_weights,
        }))
    }

    /// Replaces the checkpoint in `folder`.
    pub(super) fn save(
        &self,
        folder: &Path,
        config: &TrainConfig,
        identity: &str,
        adam: &Adam,
    ) -> Result<(), TrainError> {
        let mut tensors: HashMap<String, Tensor> = HashMap::new();
        for slot in &adam.slots {
            let weights = slot.variable.as_tensor().clone();
            tensors.insert(format!("weights.{}", slot.name), weights);
            tensors.insert(format!("first.{}", slot.name), slot.first.clone());
            tensors.insert(format!("second.{}", slot.name), slot.second.clone());
        }
        for (name, weights) in &self.best_weights {
            tensors.insert(format!("best.{name}"), weights.clone());
        }
        let state = State {
            steps: self.steps,
            cycles_without_gain: self.cycles_without_gain,
            initial: self.initial,
            best: self.best,
            last: self.last,
            last_loss: self.last_loss,
            config: config.clone(),
            identity: identity.to_owned(),
        };
        let path = folder.join(FILE);
        let state = serde_json::to_string(&state).map_err(|error| TrainError::Checkpoint {
            path: path.clone(),
            reason: error.to_string(),
        })?;
        let header = HashMap::from([(STATE.to_owned(), state)]);
        let bytes = safetensors::serialize(&tensors, Some(header)).map_err(|error| {
            TrainError::Checkpoint {
                path: path.clone(),
                reason: error.to_string(),
            }
        })?;
        write_atomically(&path, &bytes).map_err(|source| TrainError::Io { path, source })
    }
}

fn weights_of(adam: &Adam) -> Result<HashMap<String, Tensor>, TrainError> {
    // `Var::set` writes in place, so a tensor that is shared instead of copied would change as the
    // training goes on.
    adam.slots
        .iter()
        .map(|slot| Ok((slot.name.clone(), slot.variable.as_tensor().copy()?)))
        .collect()
}
