//! A bounded queue in front of the one compute worker.
//!
//! Requests wait here instead of fighting for the cores: one worker thread takes up to `max_batch` jobs at a time and
//! spreads each batch over the compute pool. A full queue refuses at once. Jobs whose client has gone or whose deadline
//! has passed are dropped before they cost any computing, also to make room for others.

use super::error::ExtractError;
use super::extractor::Extractor;
use crate::error::ErrorCode;
use crate::types::{Deadline, Descriptor, ImageTensor};
use std::collections::VecDeque;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};
use tokio::sync::oneshot;

/// Why a job was not computed.
#[derive(Debug, thiserror::Error)]
pub enum BatchError<E: std::error::Error + 'static> {
    /// The queue is full.
    #[error("{capacity} requests are waiting already")]
    Overloaded {
        /// Places in the queue.
        capacity: usize,
    },
    /// The deadline passed before the result was ready.
    #[error("the deadline passed before the image was described")]
    DeadlineExceeded,
    /// The batcher is stopping.
    #[error("the server is stopping")]
    ShuttingDown,
    /// The computation panicked; the next one starts afresh.
    #[error("the computation crashed")]
    Crashed,
    /// The computation failed.
    #[error(transparent)]
    Failed(#[from] E),
}

impl BatchError<ExtractError> {
    /// The row of the error table.
    pub fn code(&self) -> ErrorCode {
        match self {
            Self::Overloaded { .. } => ErrorCode::Overloaded,
            Self::DeadlineExceeded => ErrorCode::DeadlineExceeded,
            Self::ShuttingDown => ErrorCode::ShuttingDown,
            Self::Crashed => ErrorCode::Internal,
            Self::Failed(error) => error.code(),
        }
    }
}

/// A result with where its time went.
#[derive(Debug, Clone, PartialEq)]
pub struct Computed<R> {
    /// The result.
    pub value: R,
    /// Time spent waiting in the queue.
    pub queued: Duration,
    /// Duration of the batch it was part of.
    pub computing: Duration,
}

type Answer<R, E> = Result<Computed<R>, BatchError<E>>;

struct Job<J, R, E: std::error::Error + 'static> {
    input: J,
    deadline: Option<Deadline>,
    entered: Instant,
    answer: oneshot::Sender<Answer<R, E>>,
}

impl<J, R, E: std::error::Error> Job<J, R, E> {
    fn has_expired(&self) -> bool {
        self.deadline.is_some_and(Deadline::has_passed)
    }

    fn is_wanted(&self) -> bool {
        !self.answer.is_closed() && !self.has_expired()
    }

    /// Tells a client that still listens why it gets nothing.
    fn drop_unwanted(self) {
        if self.has_expired() {
            // The client may leave at any moment; then nobody misses the answer.
            let _ = self.answer.send(Err(BatchError::DeadlineExceeded));
        }
    }
}

struct Queue<J, R, E: std::error::Error + 'static> {
    jobs: VecDeque<Job<J, R, E>>,
    closed: bool,
}

impl<J, R, E: std::error::Error> Queue<J, R, E> {
    fn purge(&mut self) {
        let (wanted, unwanted) = std::mem::take(&mut self.jobs).into_iter().partition(Job::is_wanted);
        self.jobs = wanted;
        let unwanted: VecDeque<Job<J, R, E>> = unwanted;
        unwanted.into_iter().for_each(Job::drop_unwanted);
    }
}

struct Shared<J, R, E: std::error::Error + 'static> {
    queue: Mutex<Queue<J, R, E>>,
    arrived: Condvar,
    capacity: usize,
}

impl<J, R, E: std::error::Error> Shared<J, R, E> {
    /// No code that holds the lock can leave the queue half-changed, so a poisoned lock is as good as any.
    fn lock(&self) -> MutexGuard<'_, Queue<J, R, E>> {
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Waits for work; `None` once closed.
    fn next_batch(&self, max_batch: usize) -> Option<Vec<Job<J, R, E>>> {
        let mut queue = self.lock();
        loop {
            if queue.closed {
                return None;
            }
            queue.purge();
            if !queue.jobs.is_empty() {
                let count = queue.jobs.len().min(max_batch);
                return Some(queue.jobs.drain(..count).collect());
            }
            queue = self.arrived.wait(queue).unwrap_or_else(PoisonError::into_inner);
        }
    }
}

/// A bounded queue and its worker. Dropping it refuses what waits and joins the worker after its current batch.
pub struct Batcher<J, R, E: std::error::Error + 'static> {
    shared: Arc<Shared<J, R, E>>,
    worker: Option<JoinHandle<()>>,
}

/// A place in the queue; dropping it gives up the job.
pub struct Pending<R, E: std::error::Error + 'static> {
    answer: oneshot::Receiver<Answer<R, E>>,
    deadline: Option<Deadline>,
}

impl<R, E: std::error::Error> Pending<R, E> {
    /// Waits for the result, at most until the deadline.
    ///
    /// Cancel safety: dropping the future gives up the job; if it has not started, it never will.
    pub async fn wait(self) -> Result<Computed<R>, BatchError<E>> {
        let settled = |answer: Result<Answer<R, E>, _>| answer.unwrap_or(Err(BatchError::ShuttingDown));
        match self.deadline {
            None => settled(self.answer.await),
            Some(deadline) => match tokio::time::timeout(deadline.remaining(), self.answer).await {
                Ok(answer) => settled(answer),
                Err(_) => Err(BatchError::DeadlineExceeded),
            },
        }
    }
}

impl<J: Send + 'static, R: Send + 'static, E: std::error::Error + Send + 'static> Batcher<J, R, E> {
    /// Starts the worker. `run` turns a batch of at most `max_batch` inputs into as many results, in order.
    ///
    /// Fails where the system grants no thread.
    pub fn new(
        capacity: usize,
        max_batch: usize,
        mut run: impl FnMut(Vec<J>) -> Vec<Result<R, E>> + Send + 'static,
    ) -> std::io::Result<Self> {
        let queue = Mutex::new(Queue { jobs: VecDeque::with_capacity(capacity), closed: false });
        let shared = Arc::new(Shared { queue, arrived: Condvar::new(), capacity: capacity.max(1) });
        let worker_shared = Arc::clone(&shared);
        let worker = std::thread::Builder::new().name("extract".into()).spawn(move || {
            while let Some(jobs) = worker_shared.next_batch(max_batch.max(1)) {
                run_batch(jobs, &mut run);
            }
        })?;
        Ok(Self { shared, worker: Some(worker) })
    }

    /// Takes a place in the queue, or says at once that there is none.
    pub fn try_submit(&self, input: J, deadline: Option<Deadline>) -> Result<Pending<R, E>, BatchError<E>> {
        let mut queue = self.shared.lock();
        if queue.closed {
            return Err(BatchError::ShuttingDown);
        }
        if queue.jobs.len() >= self.shared.capacity {
            queue.purge();
        }
        if queue.jobs.len() >= self.shared.capacity {
            return Err(BatchError::Overloaded { capacity: self.shared.capacity });
        }
        let (answer, receiver) = oneshot::channel();
        queue.jobs.push_back(Job { input, deadline, entered: Instant::now(), answer });
        drop(queue);
        self.shared.arrived.notify_one();
        Ok(Pending { answer: receiver, deadline })
    }

    /// Submits and waits.
    ///
    /// Cancel safety: dropping the future gives up the job; if it has not started, it never will.
    pub async fn submit(&self, input: J, deadline: Option<Deadline>) -> Result<Computed<R>, BatchError<E>> {
        self.try_submit(input, deadline)?.wait().await
    }

    /// Jobs waiting, the running batch not counted.
    pub fn depth(&self) -> usize {
        self.shared.lock().jobs.len()
    }

    /// Places in the queue.
    pub fn capacity(&self) -> usize {
        self.shared.capacity
    }

    /// Refuses new work and what waits; the running batch is finished.
    pub fn close(&self) {
        let mut queue = self.shared.lock();
        queue.closed = true;
        for job in queue.jobs.drain(..) {
            // A client that left needs no refusal.
            let _ = job.answer.send(Err(BatchError::ShuttingDown));
        }
        drop(queue);
        self.shared.arrived.notify_all();
    }
}

impl<J, R, E: std::error::Error> Drop for Batcher<J, R, E> {
    fn drop(&mut self) {
        let mut queue = self.shared.lock();
        queue.closed = true;
        // Their senders are dropped with them, which their clients read as a stop.
        queue.jobs.clear();
        drop(queue);
        self.shared.arrived.notify_all();
        if let Some(worker) = self.worker.take() {
            // Panics of the computation are caught inside; there is nothing to learn from the join.
            let _ = worker.join();
        }
    }
}

fn run_batch<J, R, E: std::error::Error>(jobs: Vec<Job<J, R, E>>, run: &mut impl FnMut(Vec<J>) -> Vec<Result<R, E>>) {
    let started = Instant::now();
    let (inputs, clients): (Vec<J>, Vec<_>) =
        jobs.into_iter().map(|job| (job.input, (job.answer, started - job.entered))).unzip();
    let outcome = catch_unwind(AssertUnwindSafe(|| run(inputs)));
    let computing = started.elapsed();
    let results = match outcome {
        Ok(results) if results.len() == clients.len() => results.into_iter().map(Some).collect(),
        Ok(_) | Err(_) => {
            tracing::error!(jobs = clients.len(), "a batch crashed or lost results");
            clients.iter().map(|_| None).collect::<Vec<_>>()
        }
    };
    for (result, (answer, queued)) in results.into_iter().zip(clients) {
        let settled = match result {
            Some(Ok(value)) => Ok(Computed { value, queued, computing }),
            Some(Err(error)) => Err(BatchError::Failed(error)),
            None => Err(BatchError::Crashed),
        };
        // The client may have left while its image was computed.
        let _ = answer.send(settled);
    }
}

/// The queue in front of an extractor.
pub type ExtractBatcher = Batcher<ImageTensor, Descriptor, ExtractError>;

impl ExtractBatcher {
    /// Starts the worker of `extractor`. One bad image fails alone, not the batch it came in.
    pub fn for_extractor(extractor: Arc<Extractor>, capacity: usize, max_batch: usize) -> std::io::Result<Self> {
        Self::new(capacity, max_batch, move |images: Vec<ImageTensor>| match extractor.extract(&images) {
            Ok(descriptors) => descriptors.into_iter().map(Ok).collect(),
            Err(error) if images.len() == 1 => vec![Err(error)],
            Err(_) => {
                let alone = |image| extractor.extract(std::slice::from_ref(image)).map(|mut one| one.remove(0));
                images.iter().map(alone).collect()
            }
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::mpsc;

    #[derive(Debug, thiserror::Error)]
    #[error("odd")]
    struct Odd;

    type Doubler = Batcher<u32, u32, Odd>;

    /// A worker that reports each batch and waits for a nod before it computes.
    fn gated(capacity: usize, max_batch: usize) -> (Doubler, mpsc::Receiver<Vec<u32>>, mpsc::SyncSender<()>) {
        let (report, batches) = mpsc::sync_channel(16);
        let (go, wait) = mpsc::sync_channel(16);
        let batcher = Batcher::new(capacity, max_batch, move |inputs: Vec<u32>| {
            report.send(inputs.clone()).unwrap();
            wait.recv().unwrap();
            assert!(!inputs.contains(&13), "unlucky");
            inputs.into_iter().map(|i| if i % 2 == 0 { Ok(i * 2) } else { Err(Odd) }).collect()
        });
        (batcher.unwrap(), batches, go)
    }

    #[tokio::test]
    async fn jobs_are_batched_in_order_and_fail_alone() {
        let (batcher, batches, go) = gated(8, 3);
        let first = batcher.try_submit(2, None).unwrap();
        assert_eq!(batches.recv().unwrap(), [2]);
        let rest: Vec<_> = [4, 5, 6, 8].map(|i| batcher.try_submit(i, None).unwrap()).into();
        assert_eq!(batcher.depth(), 4);
        (0..3).for_each(|_| go.send(()).unwrap());
        assert_eq!(first.wait().await.unwrap().value, 4);
        let mut values = Vec::new();
        for pending in rest {
            values.push(pending.wait().await.map(|computed| computed.value).ok());
        }
        assert_eq!(values, [Some(8), None, Some(12), Some(16)]);
        assert_eq!([batches.recv().unwrap(), batches.recv().unwrap()], [vec![4, 5, 6], vec![8]]);
    }

    #[tokio::test]
    async fn a_full_queue_refuses_and_abandoned_jobs_make_room() {
        let (batcher, batches, go) = gated(2, 1);
        let running = batcher.try_submit(0, None).unwrap();
        batches.recv().unwrap();
        let kept = batcher.try_submit(2, None).unwrap();
        let abandoned = batcher.try_submit(4, None).unwrap();
        assert!(matches!(batcher.try_submit(6, None), Err(BatchError::Overloaded { capacity: 2 })));
        drop(abandoned);
        let late = batcher.try_submit(6, None).unwrap();
        (0..3).for_each(|_| go.send(()).unwrap());
        for pending in [running, kept, late] {
            pending.wait().await.unwrap();
        }
        assert_eq!(batches.iter().take(2).collect::<Vec<_>>(), [[2], [6]], "the abandoned job was never computed");
    }

    #[tokio::test]
    async fn expired_jobs_are_answered_and_never_computed() {
        let (batcher, batches, go) = gated(4, 4);
        let running = batcher.try_submit(0, None).unwrap();
        batches.recv().unwrap();
        let expired = batcher.try_submit(2, Some(Deadline::after(Duration::ZERO))).unwrap();
        let live = batcher.try_submit(4, Some(Deadline::after(Duration::from_secs(600)))).unwrap();
        (0..2).for_each(|_| go.send(()).unwrap());
        assert!(matches!(expired.wait().await, Err(BatchError::DeadlineExceeded)));
        assert_eq!(live.wait().await.unwrap().value, 8);
        running.wait().await.unwrap();
        assert_eq!(batches.recv().unwrap(), [4]);
    }

    #[tokio::test]
    async fn a_crash_is_reported_and_survived() {
        let (batcher, _batches, go) = gated(4, 1);
        (0..2).for_each(|_| go.send(()).unwrap());
        assert!(matches!(batcher.submit(13, None).await, Err(BatchError::Crashed)));
        assert_eq!(batcher.submit(2, None).await.unwrap().value, 4);
    }

    #[tokio::test]
    async fn closing_refuses_what_waits_and_finishes_what_runs() {
        let (batcher, batches, go) = gated(4, 1);
        let running = batcher.try_submit(2, None).unwrap();
        batches.recv().unwrap();
        let waiting = batcher.try_submit(4, None).unwrap();
        batcher.close();
        assert!(matches!(waiting.wait().await, Err(BatchError::ShuttingDown)));
        assert!(matches!(batcher.try_submit(6, None), Err(BatchError::ShuttingDown)));
        go.send(()).unwrap();
        assert_eq!(running.wait().await.unwrap().value, 4);
        drop(batcher);
    }
}
