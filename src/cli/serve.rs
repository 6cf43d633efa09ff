//! Run the service.
//!
//! The listener is bound before anything slow begins, so that `/livez` and `/readyz` answer from
//! the first moment; the model and the store load on a thread of their own and open the surface
//! when they are done.

use crate::cli::output::{say, say_part};
use crate::config::{Config, Overrides};
use placeformer_vision::extract::{ExtractConfig, Extractor};
use crate::http::{AppState, serve};
use crate::ops::{Health, Metrics, disk, logging, shutdown};
use crate::pipeline::{DescriptorSource, Parts, Service};
use placeformer_store::{PlaceStore, SqliteStore, StoreConfig};
use anyhow::{Context, anyhow};
use std::future::Future;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;
use tokio::net::TcpListener;
use tokio::task::spawn_blocking;

/// Time between two looks at the disk.
const DISK_CHECK: Duration = Duration::from_secs(2);

/// Arguments of this subcommand.
#[derive(Debug, clap::Args)]
pub struct ServeArgs {
    #[command(flatten)]
    overrides: Overrides,
    /// Configuration file (TOML).
    #[arg(long, env = "PLACEFORMER_CONFIG", value_name = "FILE")]
    config: Option<PathBuf>,
    /// Print the configuration in force, with every key explained, and stop.
    #[arg(long)]
    print_config: bool,
}

/// What the server opens with: the slow part, run on a blocking thread.
pub struct Loaders {
    /// Loads the model.
    pub source: Box<dyn FnOnce() -> anyhow::Result<Arc<dyn DescriptorSource>> + Send>,
    /// Opens the store.
    pub store: Box<dyn FnOnce() -> anyhow::Result<Arc<dyn PlaceStore>> + Send>,
}

/// Runs it.
pub fn run(args: ServeArgs) -> anyhow::Result<()> {
    let config = Config::load(args.config.as_deref(), &args.overrides)?;
    if args.print_config {
        say_part!("{}", config.to_annotated_toml()?)?;
        return Ok(());
    }
    logging::init(&config.log)?;
    placeformer_kernels::self_check()?;
    let loaders = loaders(&config);
    serve_until_signal(config, loaders)
}

/// Serves where `config` says, prints the address, and drains once the process is asked to stop.
pub(super) fn serve_until_signal(config: Config, loaders: Loaders) -> anyhow::Result<()> {
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()?;
    let outcome = runtime.block_on(async {
        let listen = &config.http.listen;
        let listener = TcpListener::bind(listen).await.with_context(|| format!("cannot listen on {listen}"))?;
        let address = listener.local_addr()?;
        // A server outlives whoever started it and read this line.
        if let Err(error) = say!("listening on http://{address}") {
            tracing::warn!(%error, %address, "the address was not printed");
        }
        run_server(listener, config, loaders, async {
            if let Err(error) = shutdown::requested().await {
                tracing::error!(%error, "signals cannot be handled; stop the process to stop the server");
                std::future::pending::<()>().await;
            }
        })
        .await
    });
    // Blocking work that outlived the drain must not hold the process up.
    runtime.shutdown_timeout(Duration::from_secs(5));
    outcome
}

fn loaders(config: &Config) -> Loaders {
    let (extract, data, store) = (
        config.extract.clone(),
        config.data.directory.clone(),
        config.store.clone(),
    );
    Loaders {
        source: Box::new(move || open_model(&extract)),
        store: Box::new(move || open_store(&data, &store)),
    }
}

/// The model, after its first image.
pub(super) fn open_model(config: &ExtractConfig) -> anyhow::Result<Arc<dyn DescriptorSource>> {
    let extractor = Extractor::open(config)?;
    extractor.warm_up()?;
    Ok(Arc::new(extractor))
}

pub(super) fn open_store(data: &Path, config: &StoreConfig) -> anyhow::Result<Arc<dyn PlaceStore>> {
    let store = SqliteStore::open(data, config)
        .with_context(|| format!("cannot open the store in {}", data.display()))?;
    Ok(Arc::new(store))
}

/// Serves on `listener` until `shutdown` resolves and all is drained, or start-up fails.
pub async fn run_server(
    listener: TcpListener,
    config: Config,
    loaders: Loaders,
    shutdown: impl Future<Output = ()>,
) -> anyhow::Result<()> {
    let (metrics, health) = (Arc::new(Metrics::new()?), Arc::new(Health::default()));
    let state = AppState::new(
        config.http.clone(),
        &config.auth,
        config.image.max_bytes,
        metrics.clone(),
        health.clone(),
    )?;
    let disk_watch = tokio::spawn(watch_disk(config.clone(), health.clone(), metrics.clone()));
    let opening = open(state.clone(), config, loaders);
    let serving = serve(listener, state, shutdown);
    tokio::pin!(serving);
    let outcome = tokio::select! {
        biased;
        () = &mut serving => Ok(()),
        failed = opening => match failed {
            Ok(()) => { serving.await; Ok(()) }
            Err(error) => Err(error),
        },
    };
    disk_watch.abort();
    outcome
}

async fn open(state: AppState, config: Config, loaders: Loaders) -> anyhow::Result<()> {
    let (metrics, health) = (state.metrics.clone(), state.health.clone());
    let loading = spawn_blocking(move || -> anyhow::Result<Arc<Service>> {
        let source = (loaders.source)().context("cannot load the model")?;
        health.migrating();
        let store = (loaders.store)()?;
        let Config {
            image,
            rerank,
            pipeline,
            ..
        } = config;
        Ok(Service::start(Parts {
            store,
            source,
            image,
            rerank,
            pipeline,
            metrics,
            health,
        })?)
    });
    let service = loading
        .await
        .map_err(|error| anyhow!("start-up failed: {error}"))??;
    tracing::info!(model = %service.info().model, "ready");
    state.open(service);
    Ok(())
}

/// Keeps `disk_full` and the gauge of free bytes true to the disk.
async fn watch_disk(config: Config, health: Arc<Health>, metrics: Arc<Metrics>) {
    loop {
        let (data, reserve) = (
            config.data.directory.clone(),
            config.pipeline.disk_reserve_bytes,
        );
        if let Ok(Ok(space)) = spawn_blocking(move || disk::space(&data)).await {
            metrics.set_disk_free(space.free);
            health.set_disk_full(space.is_short_of(reserve));
        }
        tokio::time::sleep(DISK_CHECK).await;
    }
}
