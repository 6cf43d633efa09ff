//! Inspect and delete maps of a running server; give maps another head, there or in a data
//! directory.

use super::client::{ServerArgs, ServerClient};
use crate::cli::output::{say, say_part};
use crate::config::{Config, Overrides};
use anyhow::{Context, bail, ensure};
use clap::Subcommand;
use indicatif::{ProgressBar, ProgressStyle};
use placeformer_core::types::MapName;
use placeformer_store::{HeadExchange, NewHead, StoreError};
use placeformer_vision::extract::Head;
use rayon::prelude::*;
use serde_json::Value;
use std::io;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Arguments of this subcommand.
#[derive(Debug, clap::Args)]
pub struct MapArgs {
    #[command(subcommand)]
    action: Action,
}

#[derive(Debug, Subcommand)]
enum Action {
    /// List all maps.
    List {
        #[command(flatten)]
        server: ServerArgs,
    },
    /// Show one map.
    Show {
        /// Its name.
        map: MapName,
        #[command(flatten)]
        server: ServerArgs,
    },
    /// Delete a map with every reference in it.
    Delete {
        /// Its name.
        map: MapName,
        /// Do not ask.
        #[arg(long)]
        yes: bool,
        #[command(flatten)]
        server: ServerArgs,
    },
    /// Give maps another head, without their images.
    ///
    /// A reference keeps its pooled patch tokens beside its key patches. They are projected anew,
    /// and one transaction then binds the map to the new model: interrupted before, it is as it
    /// was. Key patches, metadata and identities stay; a map's calibration is cleared, because
    /// distances mean something else.
    ///
    /// The head must be made for the map's backbone and pool tokens as the map's old head did: a
    /// mean cannot become a VLAD, nor one generalised mean another, without the images. Such a head
    /// is refused.
    ///
    /// A map keeps its head, whatever head its server runs. Through a running server, queries are
    /// answered throughout: with the old head until all is ready, with the new one from then on.
    Rehead(ReheadArgs),
}

#[derive(Debug, clap::Args)]
#[command(group(clap::ArgGroup::new("target").required(true).args(["server", "data"])))]
#[command(group(clap::ArgGroup::new("wish").required(true).args(["head", "server_head"])))]
struct ReheadArgs {
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
    /// Seconds to wait for one map. A server that is no longer waited for goes on all the same.
    #[arg(long, default_value_t = 3600, value_name = "SECONDS")]
    timeout: u64,
}

/// Runs it.
pub fn run(args: MapArgs) -> anyhow::Result<()> {
    match args.action {
        Action::List { server } => list(&ServerClient::new(server)?),
        Action::Show { map, server } => {
            let answer = ServerClient::new(server)?.get(&format!("/maps/{map}"))?;
            say!("{}", serde_json::to_string_pretty(&answer)?)?;
            Ok(())
        }
        Action::Delete { map, yes, server } => delete(&ServerClient::new(server)?, &map, yes),
        Action::Rehead(args) => rehead(args),
    }
}

fn list(client: &ServerClient) -> anyhow::Result<()> {
    let answer = client.get("/maps")?;
    let maps = answer["maps"]
        .as_array()
        .map(Vec::as_slice)
        .unwrap_or_default();
    say!("{:<32} {:>12}  model", "map", "references")?;
    for map in maps {
        let text = |key: &str| map[key].as_str().unwrap_or_default();
        say!(
            "{:<32} {:>12}  {}",
            text("name"),
            map["references"].as_u64().unwrap_or_default(),
            text("model")
        )?;
    }
    Ok(())
}

fn delete(client: &ServerClient, map: &MapName, yes: bool) -> anyhow::Result<()> {
    let path = format!("/maps/{map}");
    if !yes {
        let count = client.get(&path)?["references"].clone();
        ensure!(confirmed(map, &count)?, "nothing was deleted");
    }
    let deleted = client.delete(&path)?["references_deleted"].clone();
    say!("deleted map {map} with {deleted} references")?;
    Ok(())
}

fn confirmed(map: &MapName, references: &Value) -> anyhow::Result<bool> {
    say_part!("delete map {map} with {references} references? Type its name to go on: ")?;
    let mut line = String::new();
    io::stdin().read_line(&mut line)?;
    Ok(line.trim() == map.as_str())
}

fn rehead(args: ReheadArgs) -> anyhow::Result<()> {
    let ReheadArgs {
        maps,
        head,
        server,
        data,
        config,
        api_key,
        timeout,
        ..
    } = args;
    // Read here first, so that a file that is no head is told by its name and before any map is
    // touched.
    let head = head.map(|path| read_head(&path)).transpose()?;
    match (server, data, head) {
        (Some(server), _, head) => {
            let client = ServerClient::new(ServerArgs {
                server,
                api_key,
                timeout,
            })?;
            rehead_live(&client, &maps, head.map(|(_, file)| file).as_deref())
        }
        (None, Some(data), Some((head, file))) => {
            rehead_stopped(&maps, &head, &file, (&data, config.as_deref()))
        }
        // The groups of the arguments leave nothing else.
        _ => bail!("give --head with --data, or --head or --server-head with --server"),
    }
}

fn read_head(path: &Path) -> anyhow::Result<(Head, Vec<u8>)> {
    let file = std::fs::read(path).with_context(|| format!("cannot read {}", path.display()))?;
    Ok((Head::from_bytes(&file, path)?, file))
}

fn rehead_live(client: &ServerClient, maps: &[MapName], file: Option<&[u8]>) -> anyhow::Result<()> {
    for map in maps {
        let (path, begun) = (format!("/maps/{map}/head"), Instant::now());
        let answer = match file {
            Some(file) => client.put_file(&path, file),
            None => client.delete(&path),
        };
        let answer = answer.with_context(|| format!("map {map} was not given another head"))?;
        let (references, model) = (
            &answer["references"],
            answer["model"].as_str().unwrap_or_default(),
        );
        say!(
            "map {map}: {references} references, now {model} ({:.1} s)",
            begun.elapsed().as_secs_f64()
        )?;
    }
    Ok(())
}

fn rehead_stopped(
    maps: &[MapName],
    head: &Head,
    file: &[u8],
    (data, config): (&Path, Option<&Path>),
) -> anyhow::Result<()> {
    let config = Config::load(config, &Overrides::default())?;
    ensure!(data.is_dir(), "there is no store in {}", data.display());
    let store = crate::server::open_store(data, &config.store)?;
    // All are looked at before any is changed.
    let mut plan = Vec::new();
    for map in maps {
        let info = store.map(map)?;
        let model = head
            .rebind(&info.model)
            .with_context(|| format!("map {map} cannot take this head"))?;
        plan.push((info, model));
    }
    for (info, model) in plan {
        // One that is kept damaged is given again.
        if info.model == model && matches!(store.head(&info.name), Ok(Some(_))) {
            say!("map {} has this head already: {model}", info.name)?;
            continue;
        }
        let style =
            ProgressStyle::with_template("projecting {wide_bar} {pos}/{len} {per_sec} {eta}")?;
        let bar = ProgressBar::new(info.references).with_style(style);
        let new = NewHead {
            model: model.clone(),
            file: Some(file.to_vec()),
        };
        store.replace_globals(&info.name, new, &mut Projecting { head, bar: &bar })?;
        bar.finish_and_clear();
        say!(
            "map {}: {} references, now {model}",
            info.name,
            info.references
        )?;
    }
    Ok(())
}

struct Projecting<'a> {
    head: &'a Head,
    bar: &'a ProgressBar,
}

impl HeadExchange for Projecting<'_> {
    fn project(&mut self, pooled: &[Vec<f32>]) -> Result<Vec<Vec<f32>>, StoreError> {
        self.bar.inc(pooled.len() as u64);
        pooled
            .par_iter()
            .map(|pooled| self.head.project_stored(pooled))
            .collect::<Result<_, _>>()
            .map_err(|error| StoreError::HeadNotApplied {
                source: error.into(),
            })
    }
}
