//! The running server: from settings to a model, a store, a pipeline, and the web surface over it.
//!
//! The listener is bound before anything slow begins, so that `/livez` and `/readyz` answer from
//! the start. The model and the store are opened on a blocking thread; requests are served once
//! both are open.

use crate::config::{Config, ConfigError, LoadedFrom};
use crate::http::problem::error_chain;
use crate::http::{AppState, Certificate, TlsError, serve_encrypted};
use crate::ops::{Health, Metrics, disk, reload, shutdown};
use crate::pipeline::{DescriptorSource, Parts, PipelineError, Service};
use placeformer_core::progress::Progress;
use placeformer_core::types::InvalidValue;
use placeformer_models::open_extractor;
use placeformer_store::{LostTail, PlaceStore, SqliteStore, StoreConfig, StoreError};
use placeformer_track::{KeyError, TrackKey};
use placeformer_vision::extract::ExtractConfig;
use std::error::Error;
use std::future::Future;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;
use tokio::net::{TcpListener, lookup_host};
use tokio::task::spawn_blocking;
use tokio_util::task::AbortOnDropHandle;

/// Time between two checks of the disk's free space.
const DISK_CHECK_INTERVAL: Duration = Duration::from_secs(2);

/// Longest time in which a disk answers.
const DISK_ANSWER_LIMIT: Duration = Duration::from_secs(20);

/// How long blocking work may go on after the last request was answered.
const BLOCKING_GRACE: Duration = Duration::from_secs(5);

/// The key of tracks in the data directory.
const TRACK_KEY_FILE: &str = "track.key";

/// The error of a loader.
pub type LoadError = Box<dyn Error + Send + Sync>;

/// Opens one of the parts that take long; runs on a blocking thread.
pub type Loader<T> = Box<dyn FnOnce() -> Result<Arc<T>, LoadError> + Send>;

/// How a server opens its model and its store. Tests put their own in the place of these.
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
    /// Everyone who reaches the address could read and change everything.
    #[error(
        "http.listen: {address} can be reached from other machines, and there are no API keys, so \
         everyone there could read and change everything: set auth.keys, listen on 127.0.0.1, or \
         say --insecure (http.insecure = true) if only people you trust reach it"
    )]
    Exposed {
        /// The address in the settings.
        address: String,
    },
    /// The certificate cannot be used.
    #[error(transparent)]
    Tls(#[from] TlsError),
    /// The server cannot listen on its address.
    #[error("cannot listen on {address}")]
    Listen {
        /// The address in the settings.
        address: String,
        /// The system's error.
        source: std::io::Error,
    },
    /// A metric cannot be registered.
    #[error("the metrics cannot be registered")]
    Metrics(#[from] prometheus::Error),
    /// A setting of the web surface is not valid.
    #[error(transparent)]
    Setting(#[from] InvalidValue),
    /// The model cannot be loaded.
    #[error("cannot load the model")]
    Model(#[source] LoadError),
    /// The store cannot be opened.
    #[error(transparent)]
    Store(LoadError),
    /// There is no key for the tokens of tracks.
    #[error(transparent)]
    TrackKey(#[from] KeyError),
    /// The pipeline cannot start on the model and the store.
    #[error(transparent)]
    Pipeline(#[from] PipelineError),
    /// It cannot be told when keys are to be read again.
    #[error("SIGHUP cannot be received")]
    Reload(#[source] std::io::Error),
    /// The thread that opens the model and the store panicked, or the runtime shut down.
    #[error("start-up failed: {0}")]
    Interrupted(String),
}

/// The store of a directory could not be opened.
#[derive(Debug, thiserror::Error)]
#[error("cannot open the store in {}", directory.display())]
pub struct OpenStoreError {
    /// The directory.
    pub directory: PathBuf,
    /// The store's error.
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
/// Another process has it open, it is damaged or of a later version, acknowledged commits are
/// missing, or the disk fails.
pub fn open_store(
    directory: &Path,
    config: &StoreConfig,
) -> Result<Arc<dyn PlaceStore>, OpenStoreError> {
    open_store_with(directory, config, LostTail::Refuse)
}

/// As [`open_store`]; `tail` says what to do if acknowledged commits are missing.
///
/// # Errors
/// As [`open_store`].
pub fn open_store_with(
    directory: &Path,
    config: &StoreConfig,
    tail: LostTail,
) -> Result<Arc<dyn PlaceStore>, OpenStoreError> {
    let store =
        SqliteStore::open_with(directory, config, tail).map_err(|source| OpenStoreError {
            directory: directory.to_owned(),
            source,
        })?;
    Ok(Arc::new(store))
}

/// Serves on the address of `config`, and drains once the process is asked to stop. `announce` is
/// called with the address as soon as connections are accepted.
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
        let listener = listen(&config, announce).await?;
        run_server(listener, config, loaders, stop_requested()).await
    });
    // Blocking work that goes on after the drain must not keep the process alive.
    runtime.shutdown_timeout(BLOCKING_GRACE);
    outcome
}

/// Binds the listener and announces the address that it has.
async fn listen(
    config: &Config,
    announce: impl FnOnce(SocketAddr),
) -> Result<TcpListener, ServerError> {
    let address = &config.http.listen;
    let failed = |source| ServerError::Listen {
        address: address.to_owned(),
        source,
    };
    let addresses: Vec<_> = lookup_host(address).await.map_err(failed)?.collect();
    let is_open = config.auth.keys.is_empty() && !config.http.insecure;
    let is_local = |address: &SocketAddr| address.ip().to_canonical().is_loopback();
    if is_open && !addresses.iter().all(is_local) {
        let address = address.to_owned();
        return Err(ServerError::Exposed { address });
    }
    let listener = TcpListener::bind(&*addresses).await.map_err(failed)?;
    announce(listener.local_addr().map_err(failed)?);
    Ok(listener)
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
        metrics,
        health,
    )?;
    let certificate = Certificate::open(&config.http).await?;
    let _following = follow_keys(&state, config.loaded_from.clone())?;
    let watching = tokio::spawn(watch_disk(config.clone(), state.clone()));
    let _watching = AbortOnDropHandle::new(watching);
    let opening = open(state.clone(), config, loaders);
    let serving = serve_encrypted(listener, state, certificate, shutdown);
    tokio::pin!(serving);
    // A shutdown during start-up ends the server without waiting for the model and the store.
    tokio::select! {
        biased;
        () = &mut serving => Ok(()),
        opened = opening => match opened {
            Ok(()) => {
                serving.await;
                Ok(())
            }
            Err(error) => Err(error),
        },
    }
}

/// Opens the model and the store, starts the pipeline on them, and lets requests in.
async fn open(state: AppState, config: Config, loaders: Loaders) -> Result<(), ServerError> {
    let metrics = state.metrics.clone();
    let health = state.health.clone();
    let starting = spawn_blocking(move || start_service(config, loaders, metrics, health));
    let service = starting
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
    let track_key = open_track_key(&config)?;
    let service = Service::start(Parts {
        store,
        source,
        image: config.image,
        rerank: config.rerank,
        pipeline: config.pipeline,
        tracks: config.tracks,
        track_key,
        metrics,
        health,
    })?;
    Ok(service)
}

/// The key of tracks: the one in the settings, or else this node's own, next to its store.
fn open_track_key(config: &Config) -> Result<TrackKey, KeyError> {
    match &config.tracks.key_file {
        Some(path) => TrackKey::read(path),
        None => TrackKey::read_or_create(&config.data.directory.join(TRACK_KEY_FILE)),
    }
}

/// Reads the keys again whenever there is a reason to, for as long as the result lives. Settings
/// that a program made are not read again.
fn follow_keys(
    state: &AppState,
    loaded_from: Option<LoadedFrom>,
) -> Result<Option<AbortOnDropHandle<()>>, ServerError> {
    let Some(loaded_from) = loaded_from else {
        return Ok(None);
    };
    let files = loaded_from.file.iter().cloned().collect();
    let mut reasons = reload::watch(files).map_err(ServerError::Reload)?;
    let state = state.clone();
    let following = async move {
        // The file may have changed after the settings were read and before it was watched.
        loop {
            let loaded_from = loaded_from.clone();
            let read = spawn_blocking(move || loaded_from.load_again()).await;
            // It fails only if the runtime ends, or if reading panicked, which is in the log.
            if let Ok(read) = read {
                renew_keys(&state, read);
            }
            if reasons.changed().await.is_err() {
                return;
            }
        }
    };
    Ok(Some(AbortOnDropHandle::new(tokio::spawn(following))))
}

/// Puts keys that were read again in force, if they are good and others than before.
fn renew_keys(state: &AppState, read: Result<Config, ConfigError>) {
    let renewed = match read {
        Ok(config) => state
            .renew_auth(&config.auth)
            .map_err(|error| error.to_string()),
        Err(error) => Err(error_chain(&error)),
    };
    match renewed {
        Ok(true) => tracing::info!("other keys are in force"),
        Ok(false) => tracing::debug!("the keys are the same as before"),
        Err(error) => tracing::error!(
            error,
            "the keys cannot be read again; the old ones stay in force"
        ),
    }
}

/// Brings the health and the gauge of free bytes up to date with the disk, again and again.
async fn watch_disk(config: Config, state: AppState) {
    loop {
        let look = {
            let (config, state) = (config.clone(), state.clone());
            spawn_blocking(move || look_at_disk(&config, &state))
        };
        tokio::pin!(look);
        // A disk that does not answer is lost as long as that lasts. No second look is begun
        // meanwhile, so that no threads pile up behind it.
        if tokio::time::timeout(DISK_ANSWER_LIMIT, &mut look)
            .await
            .is_err()
        {
            let seconds = DISK_ANSWER_LIMIT.as_secs();
            let reason = format!("the disk has not answered for {seconds} seconds");
            state.health.set_storage_lost(Some(reason));
            // A look that panicked has found out nothing; the next is as good.
            let _ = look.await;
        }
        tokio::time::sleep(DISK_CHECK_INTERVAL).await;
    }
}

/// Looks at the disk once. Blocks.
fn look_at_disk(config: &Config, state: &AppState) {
    let service = state.started();
    match disk::space(&config.data.directory) {
        Ok(space) => {
            state.metrics.set_disk_free(space.free);
            let reserve = config.pipeline.disk_reserve_bytes;
            state.health.set_disk_full(space.is_short_of(reserve));
        }
        // Before the store is open the directory may not have been made.
        Err(_) if service.is_none() => {}
        // The store looks at its files itself, below, and says what it misses.
        Err(error) => tracing::debug!(%error, "the free space of the disk cannot be read"),
    }
    if let Some(service) = service {
        service.check_storage();
    }
}
