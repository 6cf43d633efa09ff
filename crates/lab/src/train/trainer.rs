//! The loop: mine, step, validate, keep the best, checkpoint; stop when validation no longer
//! improves.

use super::adam::Adam;
use super::checkpoint::Checkpoint;
use super::config::{Keep, TrainConfig, ValidationRecall};
use super::cycle::Cycle;
use super::error::TrainError;
use super::log::{CycleRecord, TrainLog};
use super::model::TripletModel;
use super::triplets::TripletSet;
use super::validation::validate;
use placeformer_core::progress::{Progress, Task};
use serde::Serialize;
use std::path::PathBuf;
use std::time::Instant;

/// How a run ended.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Outcome {
    /// Steps taken over all interruptions.
    pub steps: u64,
    /// Whether validation stopped improving before the schedule ended.
    pub stopped_early: bool,
    /// Recall before the first step.
    pub initial: ValidationRecall,
    /// Recall of the weights that were kept.
    pub kept: ValidationRecall,
    /// Mean loss of the last cycle.
    pub last_loss: f32,
}

/// Where a run keeps its checkpoint and its log, and whom it tells.
pub struct Session<'a> {
    /// Folder of the checkpoint and the log; an existing checkpoint is continued.
    pub folder: PathBuf,
    /// What the run depends on besides its settings: data, starting weights. A checkpoint of
    /// another identity is refused.
    pub identity: String,
    /// Told of the steps, and of the images embedded for each mining and validation.
    pub progress: &'a dyn Progress,
}

/// Trains `model` on `training`, watching `validation`, and leaves it with the best weights seen.
pub(super) fn run(
    model: &dyn TripletModel,
    training: &TripletSet,
    validation: &TripletSet,
    config: &TrainConfig,
    session: Session<'_>,
) -> Result<Outcome, TrainError> {
    config.check()?;
    let Session {
        folder,
        identity,
        progress,
    } = session;
    let mut adam = Adam::new(model.variables(), config.weight_decay)?;
    let watch = || watch(model, training, validation, progress);
    let mut checkpoint = match Checkpoint::resume(&folder, config, &identity, &mut adam)? {
        Some(checkpoint) => checkpoint,
        None => Checkpoint::start(&adam, watch()?)?,
    };
    let mut log = TrainLog::open(&folder, checkpoint.steps)?;
    let steps = Task::begin(progress, "training", config.schedule.total);
    steps.set_done(checkpoint.steps);
    let cycle = Cycle {
        model,
        set: training,
        config,
        progress,
        steps: &steps,
    };
    let usable: Vec<usize> = training.usable().collect();

    while checkpoint.steps < config.schedule.total
        && checkpoint.cycles_without_gain < config.patience
    {
        let started = Instant::now();
        let until = (checkpoint.steps + config.steps_per_cycle).min(config.schedule.total);
        let taken = cycle.run(&usable, &mut adam, checkpoint.steps..until)?;
        let recall = watch()?;
        checkpoint.record(&adam, until, taken.loss, recall)?;
        checkpoint.save(&folder, config, &identity, &adam)?;
        let record = CycleRecord {
            step: until,
            learning_rate: config.schedule.rate(until - 1),
            loss: taken.loss,
            recall,
            step_seconds: taken.seconds,
            seconds: started.elapsed().as_secs_f64(),
        };
        log.append(&record)?;
        steps.set_note(cycle_note(&record));
    }

    let kept = match config.keep {
        Keep::Best => {
            checkpoint.restore_best(&adam)?;
            checkpoint.best
        }
        Keep::Last => checkpoint.last,
    };
    Ok(Outcome {
        steps: checkpoint.steps,
        stopped_early: checkpoint.steps < config.schedule.total,
        initial: checkpoint.initial,
        kept,
        last_loss: checkpoint.last_loss,
    })
}

/// Recall of what would come out if the run ended now.
fn watch(
    model: &dyn TripletModel,
    training: &TripletSet,
    validation: &TripletSet,
    progress: &dyn Progress,
) -> Result<ValidationRecall, TrainError> {
    match model.outcome(training, progress)? {
        Some(outcome) => validate(outcome.as_ref(), validation, progress),
        None => validate(model, validation, progress),
    }
}

/// What is shown beside the steps after a cycle was validated, checkpointed and logged.
fn cycle_note(record: &CycleRecord) -> String {
    format!(
        "mean loss {:.4}, R@1 {:.1}, R@10 {:.1}, {:.1} s a step",
        record.loss, record.recall.at_1, record.recall.at_10, record.step_seconds
    )
}

#[cfg(test)]
mod tests;
