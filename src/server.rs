//! The running server: settings to a model, a store, a pipeline, and a surface that serves them.
//!
//! The listener is bound before anything slow begins, so that `/livez` and `/readyz` answer from the
//! first moment. The model and the store load on a thread of their own; requests are served once
//! both are there.

use crate::config::Config;
use crate::http::{AppState, serve};
use crate::ops::{Health, Metrics, disk, shutdown};
use crate::pipeline::{DescriptorSource, Parts, PipelineError, Service};
use placeformer_core::progress::Progress;
use placeformer_core::types::InvalidValue;
use placeformer_models::open_extractor;
use placeformer_store::{PlaceStore, SqliteStore, StoreConfig, StoreError};
use placeformer_vision::extract::ExtractConfig;
use std::error::Error;
use std::future::Future;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;
use tokio::net::TcpListener;
use tokio::task::spawn_blocking;

/// Time between two looks at the disk.
const DISK_CHECK: Duration = Duration::from_secs(2);

/// How long blocking work may go on after the last request was answered.
const BLOCKING_GRACE: Duration = Duration::from_secs(5);

/// What a loader said when it failed.
pub type LoadError = Box<dyn Error + Send + Sync>;

/// Makes one of the parts that take long to open; runs on a blocking thread.
pub type Loader<T> = Box<dyn FnOnce() -> Result<Arc<T>, LoadError> + Send>;

/// The parts a server opens with.
pub struct Loaders {
    /// Loads the model.
    pub source: Loader<dyn DescriptorSource>,
    /// Opens the store.
    pub store: Loader<dyn PlaceStore>,
}

/// Why a server did not start.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ServerError {
    /// The runtime of the asynchronous tasks cannot be made.
    #[error("the runtime cannot start")]
    Runtime(#[source] std::io::Error),
    /// The address cannot be listened on.
    #[error("cannot listen on {address}")]
    Listen {
        /// As the settings give it.
        address: String,
        /// What the system said.
        source: std::io::Error,
    },
    /// A metric cannot be registered.
    #[error("the metrics cannot be registered")]
    Metrics(#[from] prometheus::Error),
    /// A setting of the surface is not valid.
    #[error(transparent)]
    Setting(#[from] InvalidValue),
    /// The model cannot be loaded.
    #[error("cannot load the model")]
    Model(#[source] LoadError),
    /// The store cannot be opened.
    #[error(transparent)]
    Store(LoadError),
    /// The pipeline does not start upon them.
    #[error(transparent)]
    Pipeline(#[from] PipelineError),
    /// The thread that opens the parts ended before it was done.
    #[error("start-up failed: {0}")]
    Interrupted(String),
}

/// The store of a directory could not be opened.
#[derive(Debug, thiserror::Error)]
#[error("cannot open the store in {}", directory.display())]
pub struct OpenStoreError {
    /// The directory.
    pub directory: PathBuf,
    /// What the store said.
    pub source: StoreError,
}

/// The parts that `config` names; `progress` shows a download of the model.
pub fn loaders(config: &Config, progress: Arc<dyn Progress>) -> Loaders {
    let extract = config.extract.clone();
    let directory = config.data.directory.clone();
    let store = config.store.clone();
    Loaders {
        source: Box::new(move || open_model(&extract, &*progress)),
        store: Box::new(move || Ok(open_store(&directory, &store)?)),
    }
}

/// Loads the model and has it describe one image, so that the first request is as fast as the next.
/// `progress` shows a download.
///
/// # Errors
/// The weights cannot be obtained, or weights, head and settings do not fit.
pub fn open_model(
    config: &ExtractConfig,
    progress: &dyn Progress,
) -> Result<Arc<dyn DescriptorSource>, LoadError> {
    let extractor = open_extractor(config, progress)?;
    extractor.warm_up()?;
    Ok(Arc::new(extractor))
}

/// Opens the embedded store in `directory`.
///
/// # Errors
/// Another process has it open, it is damaged or of a later version, or the disk refuses.
pub fn open_store(
    directory: &Path,
    config: &StoreConfig,
) -> Result<Arc<dyn PlaceStore>, OpenStoreError> {
    let store = SqliteStore::open(directory, config).map_err(|source| OpenStoreError {
        directory: directory.to_owned(),
        source,
    })?;
    Ok(Arc::new(store))
}

/// Serves where `config` says and drains once the process is asked to stop. `announce` is called
/// with the address as soon as connections are taken.
///
/// # Errors
/// The server does not start.
pub fn serve_until_signal(
    config: Config,
    loaders: Loaders,
    announce: impl FnOnce(SocketAddr),
) -> Result<(), ServerError> {
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()
        .map_err(ServerError::Runtime)?;
    let outcome = runtime.block_on(async {
        let listen_error = |source| ServerError::Listen {
            address: config.http.listen.clone(),
            source,
        };
        let listener = TcpListener::bind(&config.http.listen)
            .await
            .map_err(listen_error)?;
        announce(listener.local_addr().map_err(listen_error)?);
        run_server(listener, config, loaders, stop_requested()).await
    });
    // Blocking work that outlived the drain must not keep the process alive.
    runtime.shutdown_timeout(BLOCKING_GRACE);
    outcome
}

/// Resolves when the process is asked to stop, and never if signals cannot be received.
async fn stop_requested() {
    if let Err(error) = shutdown::requested().await {
        tracing::error!(%error, "signals cannot be received: kill the process to stop the server");
        std::future::pending::<()>().await;
    }
}

/// Serves on `listener` until `shutdown` resolves and all requests are answered.
///
/// # Errors
/// The server does not start.
pub async fn run_server(
    listener: TcpListener,
    config: Config,
    loaders: Loaders,
    shutdown: impl Future<Output = ()>,
) -> Result<(), ServerError> {
    let metrics = Arc::new(Metrics::new()?);
    let health = Arc::new(Health::default());
    let state = AppState::new(
        config.http.clone(),
        &config.auth,
        config.image.max_bytes,
        metrics.clone(),
        health.clone(),
    )?;
    let disk_watch = tokio::spawn(watch_disk(config.clone(), health, metrics));
    let opening = open(state.clone(), config, loaders);
    let serving = serve(listener, state, shutdown);
    tokio::pin!(serving);
    let outcome = tokio::select! {
        biased;
        () = &mut serving => Ok(()),
        opened = opening => match opened {
            Ok(()) => {
                serving.await;
                Ok(())
            }
            Err(error) => Err(error),
        },
    };
    disk_watch.abort();
    outcome
}

/// Opens the parts, starts the pipeline upon them, and lets requests in.
async fn open(state: AppState, config: Config, loaders: Loaders) -> Result<(), ServerError> {
    let metrics = state.metrics.clone();
    let health = state.health.clone();
    let service = spawn_blocking(move || start_service(config, loaders, metrics, health))
        .await
        .map_err(|error| ServerError::Interrupted(error.to_string()))??;
    tracing::info!(model = %service.info().model, "ready");
    state.open(service);
    Ok(())
}

fn start_service(
    config: Config,
    loaders: Loaders,
    metrics: Arc<Metrics>,
    health: Arc<Health>,
) -> Result<Arc<Service>, ServerError> {
    let source = (loaders.source)().map_err(ServerError::Model)?;
    health.migrating();
    let store = (loaders.store)().map_err(ServerError::Store)?;
    let service = Service::start(Parts {
        store,
        source,
        image: config.image,
        rerank: config.rerank,
        pipeline: config.pipeline,
        metrics,
        health,
    })?;
    Ok(service)
}

/// Keeps `disk_full` and the gauge of free bytes true to the disk.
async fn watch_disk(config: Config, health: Arc<Health>, metrics: Arc<Metrics>) {
    let reserve = config.pipeline.disk_reserve_bytes;
    loop {
        let directory = config.data.directory.clone();
        if let Ok(Ok(space)) = spawn_blocking(move || disk::space(&directory)).await {
            metrics.set_disk_free(space.free);
            health.set_disk_full(space.is_short_of(reserve));
        }
        tokio::time::sleep(DISK_CHECK).await;
    }
}
