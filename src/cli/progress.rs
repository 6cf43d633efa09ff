//! Draws the progress of long tasks as bars on standard error.
//!
//! There is one style for all commands. Where standard error is no terminal, nothing is drawn.

use indicatif::{MultiProgress, ProgressBar, ProgressStyle};
use placeformer_core::progress::{Progress, Step, Unit};
use std::collections::HashMap;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

const ITEMS: &str = "{msg} {wide_bar} {pos}/{len} {per_sec} {eta} {prefix}";
const BYTES: &str = "{msg} [{bar:30}] {bytes}/{total_bytes} {bytes_per_sec} {eta} {prefix}";
const UNMEASURED: &str = "{msg} {spinner} {elapsed} {prefix}";

/// Time between two redraws of a bar that does not move, which shows that the program still works.
const TICK: Duration = Duration::from_millis(500);

/// The bars of all tasks that run.
#[derive(Default)]
pub(super) struct ProgressBars {
    screen: MultiProgress,
    /// By the name of the task.
    bars: Mutex<HashMap<String, ProgressBar>>,
}

impl ProgressBars {
    fn bars(&self) -> MutexGuard<'_, HashMap<String, ProgressBar>> {
        // The map is whole whenever a thread that holds the lock can panic.
        self.bars.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn open(&self, task: &str) -> ProgressBar {
        let bar = self.screen.add(ProgressBar::no_length());
        bar.set_message(task.to_owned());
        bar.enable_steady_tick(TICK);
        bar
    }
}

impl Progress for ProgressBars {
    fn update(&self, step: Step<'_>) {
        let mut bars = self.bars();
        let is_new = !bars.contains_key(step.task);
        let bar = bars
            .entry(step.task.to_owned())
            .or_insert_with(|| self.open(step.task));
        if is_new || bar.length() != step.total {
            bar.set_style(style(step.unit, step.total));
        }
        if let Some(total) = step.total {
            bar.set_length(total);
        }
        if bar.prefix() != step.note {
            bar.set_prefix(step.note.to_owned());
        }
        bar.set_position(step.done);
    }

    fn end(&self, task: &str) {
        if let Some(bar) = self.bars().remove(task) {
            bar.finish_and_clear();
            self.screen.remove(&bar);
        }
    }

    fn suspend(&self, action: &mut dyn FnMut()) {
        self.screen.suspend(action);
    }
}

fn style(unit: Unit, total: Option<u64>) -> ProgressStyle {
    let template = match (total, unit) {
        (None, _) => UNMEASURED,
        (Some(_), Unit::Items) => ITEMS,
        (Some(_), Unit::Bytes) => BYTES,
    };
    // A test reads all templates, so that the plain bar is never drawn.
    ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar())
}

#[cfg(test)]
mod tests {
    use super::*;
    use placeformer_core::progress::Task;

    #[test]
    fn every_template_can_be_read() {
        for template in [ITEMS, BYTES, UNMEASURED] {
            assert!(ProgressStyle::with_template(template).is_ok(), "{template}");
        }
    }

    #[test]
    fn bars_live_as_long_as_their_tasks() {
        let bars = ProgressBars::default();
        let outer = Task::begin(&bars, "settings", 2);
        let inner = Task::begin_bytes(&bars, "file");
        inner.set_total(10);
        inner.set_done(4);
        inner.set_note("half a file");
        assert_eq!(bars.bars().len(), 2);
        let file = bars.bars()["file"].clone();
        assert_eq!((file.position(), file.length()), (4, Some(10)));
        assert_eq!(file.prefix(), "half a file");
        drop(inner);
        assert!(file.is_finished());
        assert_eq!(bars.bars().len(), 1);
        drop(outer);
        assert!(bars.bars().is_empty());
    }
}
