//! Buffers that outlive one call, so that a running service allocates nothing but its answers.

use std::sync::{Mutex, MutexGuard, PoisonError};

/// Buffers that are not in use at the moment. Every user takes one out and puts it back.
pub(super) struct BufferPool<T>(Mutex<Vec<T>>);

impl<T: Default> BufferPool<T> {
    pub fn new() -> Self {
        Self(Mutex::default())
    }

    /// Calls `work` with a buffer that an earlier call left, or with a new one.
    ///
    /// If `work` panics, its buffer is dropped instead of being put back.
    pub fn with<R>(&self, work: impl FnOnce(&mut T) -> R) -> R {
        let unused = self.lock().pop();
        let mut buffer = unused.unwrap_or_default();
        let result = work(&mut buffer);
        self.lock().push(buffer);
        result
    }

    /// The list is locked only while one buffer is pushed or popped. So even after a panic in
    /// another thread it holds nothing but complete buffers, and the poison flag can be ignored.
    fn lock(&self) -> MutexGuard<'_, Vec<T>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
