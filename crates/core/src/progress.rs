//! How far a long task has come, told to whoever shows it.
//!
//! Libraries must not draw on a terminal: they may run in a server or in a test. They are given a
//! [`Progress`] instead and report each task by a [`Task`], which counts and says when it ends. The
//! command line draws bars from it, and [`Silent`] drops it.

use std::sync::{Mutex, PoisonError};

/// What a task counts.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Unit {
    /// Things, such as images or steps.
    #[default]
    Items,
    /// Bytes, shown as kibibytes and mebibytes.
    Bytes,
}

/// Where one task stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Step<'a> {
    /// The name of the task, such as `describing images`; no two tasks of one name run at once.
    pub task: &'a str,
    /// How many are done.
    pub done: u64,
    /// How many there are in all, if that is known.
    pub total: Option<u64>,
    /// What is counted.
    pub unit: Unit,
    /// What else is worth showing at this moment, such as the loss; often empty.
    pub note: &'a str,
}

/// Shows how far tasks have come. Tasks may run inside one another and on several threads.
pub trait Progress: Send + Sync {
    /// A task has begun or come further.
    fn update(&self, step: Step<'_>);

    /// A task has ended, with success or without.
    fn end(&self, task: &str);

    /// Runs `action`, which writes to the terminal itself, while nothing is drawn there.
    fn suspend(&self, action: &mut dyn FnMut()) {
        action();
    }
}

/// Shows nothing.
#[derive(Debug, Clone, Copy, Default)]
pub struct Silent;

impl Progress for Silent {
    fn update(&self, _step: Step<'_>) {}

    fn end(&self, _task: &str) {}
}

/// A task that reports itself: from [`Task::begin`] until it is dropped.
pub struct Task<'a> {
    progress: &'a dyn Progress,
    name: String,
    unit: Unit,
    state: Mutex<State>,
}

/// What changes while a task runs.
#[derive(Default)]
struct State {
    done: u64,
    total: Option<u64>,
    note: String,
}

impl<'a> Task<'a> {
    /// Begins a task of `total` things.
    pub fn begin(progress: &'a dyn Progress, name: impl Into<String>, total: u64) -> Self {
        Self::new(progress, name.into(), Unit::Items, Some(total))
    }

    /// Begins a task that counts bytes, whose number is not known yet.
    pub fn begin_bytes(progress: &'a dyn Progress, name: impl Into<String>) -> Self {
        Self::new(progress, name.into(), Unit::Bytes, None)
    }

    /// Begins a task whose end cannot be foreseen, such as another program's run.
    pub fn begin_unmeasured(progress: &'a dyn Progress, name: impl Into<String>) -> Self {
        Self::new(progress, name.into(), Unit::Items, None)
    }

    fn new(progress: &'a dyn Progress, name: String, unit: Unit, total: Option<u64>) -> Self {
        let state = State {
            total,
            ..State::default()
        };
        let task = Self {
            progress,
            name,
            unit,
            state: Mutex::new(state),
        };
        task.change(|_| {});
        task
    }

    /// Adds `count` to what is done.
    pub fn add(&self, count: u64) {
        self.change(|state| state.done += count);
    }

    /// Sets what is done, where a task starts in the middle or goes back.
    pub fn set_done(&self, done: u64) {
        self.change(|state| state.done = done);
    }

    /// Sets how many there are in all, once it is known.
    pub fn set_total(&self, total: u64) {
        self.change(|state| state.total = Some(total));
    }

    /// Sets what is shown beside the numbers.
    pub fn set_note(&self, note: impl Into<String>) {
        let note = note.into();
        self.change(|state| state.note = note);
    }

    /// Changes the state and reports it while the lock is still there, so that reports of several
    /// threads arrive in order.
    fn change(&self, change: impl FnOnce(&mut State)) {
        // A thread that panicked left numbers that are at worst one report old.
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        change(&mut state);
        self.progress.update(Step {
            task: &self.name,
            done: state.done,
            total: state.total,
            unit: self.unit,
            note: &state.note,
        });
    }
}

impl Drop for Task<'_> {
    fn drop(&mut self) {
        self.progress.end(&self.name);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Writes down what it is told.
    #[derive(Default)]
    struct Recorder(Mutex<Vec<String>>);

    impl Progress for Recorder {
        fn update(&self, step: Step<'_>) {
            let Step {
                task, done, note, ..
            } = step;
            let total = step.total.map_or("?".to_owned(), |total| total.to_string());
            let line = format!("{task} {done}/{total} {note}");
            self.0.lock().unwrap().push(line.trim_end().to_owned());
        }

        fn end(&self, task: &str) {
            self.0.lock().unwrap().push(format!("{task} ends"));
        }
    }

    #[test]
    fn a_task_reports_every_change_and_its_end() {
        let recorder = Recorder::default();
        {
            let outer = Task::begin(&recorder, "settings", 2);
            let inner = Task::begin_bytes(&recorder, "file");
            inner.set_total(10);
            inner.set_done(4);
            drop(inner);
            outer.add(1);
            outer.set_note("loss 0.5");
        }
        let lines = recorder.0.into_inner().unwrap();
        let expected = [
            "settings 0/2",
            "file 0/?",
            "file 0/10",
            "file 4/10",
            "file ends",
            "settings 1/2",
            "settings 1/2 loss 0.5",
            "settings ends",
        ];
        assert_eq!(lines, expected);
    }

    #[test]
    fn counts_of_several_threads_add_up() {
        let recorder = Recorder::default();
        let task = Task::begin(&recorder, "images", 400);
        std::thread::scope(|scope| {
            for _ in 0..4 {
                scope.spawn(|| (0..100).for_each(|_| task.add(1)));
            }
        });
        let lines = recorder.0.lock().unwrap();
        assert_eq!(lines.last().unwrap(), "images 400/400");
    }
}
