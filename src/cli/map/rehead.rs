//! Give maps another head, through a running server or in the data directory of a stopped one.

use crate::cli::client::{ServerArgs, ServerClient, TrustArgs};
use crate::cli::output::say;
use crate::cli::progress::ProgressBars;
use crate::config::{Config, Overrides};
use anyhow::{Context, bail, ensure};
use placeformer_core::progress::Task;
use placeformer_core::types::{MapName, ModelId};
use placeformer_store::{HeadExchange, MapInfo, NewHead, PlaceStore, StoreError};
use placeformer_vision::extract::Head;
use rayon::prelude::*;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Arguments of this subcommand.
#[derive(Debug, clap::Args)]
#[command(group(clap::ArgGroup::new("target").required(true).args(["server", "data"])))]
#[command(group(clap::ArgGroup::new("wish").required(true).args(["head", "server_head"])))]
pub(super) struct ReheadArgs {
    /// The maps.
    #[arg(required = true, value_name = "MAP")]
    maps: Vec<MapName>,
    /// The new head, as `head fit`, `head train` or `train` wrote it.
    #[arg(long, value_name = "FILE")]
    head: Option<PathBuf>,
    /// Let the maps go with the head that the server runs; also brings over maps that a server with
    /// another head made.
    #[arg(long, conflicts_with = "data")]
    server_head: bool,
    /// The running server.
    #[arg(long, value_name = "URL")]
    server: Option<String>,
    /// Data directory of a stopped server.
    #[arg(long, value_name = "DIR")]
    data: Option<PathBuf>,
    /// Settings of that directory's store, as the server reads them (TOML).
    #[arg(long, env = "PLACEFORMER_CONFIG", value_name = "FILE")]
    config: Option<PathBuf>,
    /// API key, where the server wants one.
    #[arg(
        long,
        env = "PLACEFORMER_API_KEY",
        hide_env_values = true,
        value_name = "KEY"
    )]
    api_key: Option<String>,
    #[command(flatten)]
    trust: TrustArgs,
    /// Seconds to wait for one map. A server that is no longer waited for goes on all the same.
    #[arg(long, default_value_t = 3600, value_name = "SECONDS")]
    timeout: u64,
}

/// A head with the bytes of its file, which the store keeps.
struct HeadFile {
    head: Head,
    bytes: Vec<u8>,
}

impl HeadFile {
    fn read(path: &Path) -> anyhow::Result<Self> {
        let bytes =
            std::fs::read(path).with_context(|| format!("cannot read {}", path.display()))?;
        let head = Head::from_bytes(&bytes, path)?;
        Ok(Self { head, bytes })
    }
}

/// Runs it.
pub(super) fn run(args: ReheadArgs) -> anyhow::Result<()> {
    // The file is read here even for a server, so that one that is no head is named before any map
    // is touched.
    let head = match &args.head {
        Some(path) => Some(HeadFile::read(path)?),
        None => None,
    };
    match (args.server, args.data, head) {
        (Some(server), _, head) => {
            let client = ServerClient::new(ServerArgs {
                server,
                api_key: args.api_key,
                trust: args.trust,
                timeout: args.timeout,
            })?;
            through_server(&client, &args.maps, head.as_ref())
        }
        (None, Some(data), Some(head)) => {
            let config = Config::load(args.config.as_deref(), &Overrides::default())?;
            ensure!(data.is_dir(), "there is no store in {}", data.display());
            let store = crate::server::open_store(&data, &config.store)?;
            in_store(&*store, &args.maps, &head)
        }
        // The groups of the arguments leave nothing else.
        _ => bail!("give --head with --data, or --head or --server-head with --server"),
    }
}

/// Asks a server to exchange the heads; without a file the maps go with the server's own head.
fn through_server(
    client: &ServerClient,
    maps: &[MapName],
    head: Option<&HeadFile>,
) -> anyhow::Result<()> {
    for map in maps {
        let path = format!("/maps/{map}/head");
        let begun = Instant::now();
        let answer = match head {
            Some(head) => client.put_file(&path, &head.bytes),
            None => client.delete(&path),
        };
        let answer = answer.with_context(|| format!("map {map} was not given another head"))?;
        let references = &answer["references"];
        let model = answer["model"].as_str().unwrap_or_default();
        let seconds = begun.elapsed().as_secs_f64();
        say!("map {map}: {references} references, now {model} ({seconds:.1} s)")?;
    }
    Ok(())
}

/// Exchanges the heads in a store that no server has open.
fn in_store(store: &dyn PlaceStore, maps: &[MapName], head: &HeadFile) -> anyhow::Result<()> {
    // All maps are checked before any is changed.
    let mut plan = Vec::new();
    for map in maps {
        let info = store.map(map)?;
        let model = head
            .head
            .rebind(&info.model)
            .with_context(|| format!("map {map} cannot take this head"))?;
        plan.push((info, model));
    }
    for (info, model) in plan {
        exchange(store, &info, model, head)?;
    }
    Ok(())
}

/// Gives one map the head, unless it has it.
fn exchange(
    store: &dyn PlaceStore,
    info: &MapInfo,
    model: ModelId,
    head: &HeadFile,
) -> anyhow::Result<()> {
    let map = &info.name;
    // A head whose copy in the store is damaged is written again.
    let is_whole = matches!(store.head(map), Ok(Some(_)));
    if info.model == model && is_whole {
        say!("map {map} has this head already: {model}")?;
        return Ok(());
    }
    let new = NewHead {
        model: model.clone(),
        file: Some(head.bytes.clone()),
    };
    let bars = ProgressBars::default();
    let mut projection = Projection {
        head: &head.head,
        task: Task::begin(&bars, "projecting", info.references),
    };
    store.replace_globals(map, new, &mut projection)?;
    drop(projection);
    say!("map {map}: {} references, now {model}", info.references)?;
    Ok(())
}

/// Projects pooled patch tokens by the new head, on all cores.
struct Projection<'a> {
    head: &'a Head,
    task: Task<'a>,
}

impl HeadExchange for Projection<'_> {
    fn project(&mut self, pooled: &[Vec<f32>]) -> Result<Vec<Vec<f32>>, StoreError> {
        self.task.add(pooled.len() as u64);
        pooled
            .par_iter()
            .map(|pooled| self.head.project_stored(pooled))
            .collect::<Result<_, _>>()
            .map_err(|error| StoreError::HeadNotApplied {
                source: error.into(),
            })
    }
}
