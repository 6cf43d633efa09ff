//! A bounded pool of reading connections, opened on demand.
//!
//! A connection is opened by the database's name, which may stand for another database once the
//! data directory was exchanged. Then no more are opened, and those that are open serve.

use super::engine::open_reader;
use super::storage::Storage;
use crate::config::StoreConfig;
use crate::error::StoreError;
use rusqlite::Connection;
use std::path::PathBuf;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};

/// The pool. A reader waits while all of its connections are in use.
pub(super) struct Readers {
    path: PathBuf,
    config: StoreConfig,
    storage: Arc<Storage>,
    pool: Mutex<Pool>,
    returned: Condvar,
}

#[derive(Default)]
struct Pool {
    idle: Vec<Connection>,
    /// Connections idle or lent.
    open: usize,
}

impl Readers {
    /// A pool of at most `config.readers` connections to the database at `path`.
    pub(super) fn new(path: PathBuf, config: StoreConfig, storage: Arc<Storage>) -> Self {
        Self {
            path,
            config,
            storage,
            pool: Mutex::default(),
            returned: Condvar::new(),
        }
    }

    /// Runs `work` with a connection of its own, waiting while all are in use.
    pub(super) fn with<T>(
        &self,
        work: impl FnOnce(&Connection) -> Result<T, StoreError>,
    ) -> Result<T, StoreError> {
        let lease = self.lease()?;
        match &lease.connection {
            Some(connection) => work(connection),
            // `lease` has just put one there; it leaves only when the lease is dropped.
            None => Err(StoreError::Closing),
        }
    }

    /// Connections open now.
    pub(super) fn open(&self) -> usize {
        self.lock().open
    }

    fn lock(&self) -> MutexGuard<'_, Pool> {
        self.pool.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn lease(&self) -> Result<Lease<'_>, StoreError> {
        let mut pool = self.lock();
        loop {
            if let Some(connection) = pool.idle.pop() {
                return Ok(Lease {
                    readers: self,
                    connection: Some(connection),
                });
            }
            let may_open = pool.open == 0 || self.storage.check_names().is_ok();
            if pool.open < self.config.readers.max(1) && may_open {
                pool.open += 1;
                drop(pool);
                return self.open_another();
            }
            pool = self
                .returned
                .wait(pool)
                .unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// Opens a connection that is already counted as open.
    fn open_another(&self) -> Result<Lease<'_>, StoreError> {
        // If opening fails, dropping the empty lease takes the connection out of the count.
        let mut lease = Lease {
            readers: self,
            connection: None,
        };
        self.storage.check_names()?;
        lease.connection = Some(open_reader(&self.path, &self.config)?);
        // The name may have changed hands while the connection was opened.
        self.storage.check_names()?;
        Ok(lease)
    }
}

/// A connection on loan; goes back when dropped, also when its user panics.
struct Lease<'a> {
    readers: &'a Readers,
    connection: Option<Connection>,
}

impl Drop for Lease<'_> {
    fn drop(&mut self) {
        let mut pool = self.readers.lock();
        match self.connection.take() {
            // A panic may have left a transaction open; such a connection is closed instead.
            Some(connection) if connection.is_autocommit() => pool.idle.push(connection),
            _ => pool.open -= 1,
        }
        self.readers.returned.notify_one();
    }
}
