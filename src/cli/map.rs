//! Inspect and delete maps of a running server; give maps in a data directory another head.

use super::client::{ServerArgs, ServerClient};
use crate::config::{Config, Overrides};
use crate::extract::Head;
use crate::types::MapName;
use anyhow::{Context, ensure};
use clap::Subcommand;
use indicatif::{ProgressBar, ProgressStyle};
use serde_json::Value;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

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
    /// A reference keeps its pooled patch tokens beside its key patches. They are projected anew, and one
    /// transaction then binds the map to the new model: interrupted before, it is as it was. Key
    /// patches, metadata and identities stay; a map's calibration is cleared, because distances mean something else.
    ///
    /// The head must be made for the map's backbone and pool tokens as the map's old head did: a mean cannot become a
    /// VLAD, nor one generalised mean another, without the images. Such a head is refused.
    ///
    /// The data directory must not be in use: stop the server first. A server runs one model, so start it again with
    /// the same head (extract.head, or PLACEFORMER_EXTRACT__HEAD=FILE); it answers 409 for maps of another model, so
    /// name every map it is to serve. For a change without a pause, do this on a backup of the data directory and let
    /// a second server with the new head take over.
    Rehead {
        /// The maps.
        #[arg(required = true, value_name = "MAP")]
        maps: Vec<MapName>,
        /// The new head, as `head fit`, `head train` or `train` wrote it.
        #[arg(long, value_name = "FILE")]
        head: PathBuf,
        /// Data directory of the stopped server.
        #[arg(long, value_name = "DIR")]
        data: PathBuf,
        /// Settings of the store, as the server reads them (TOML).
        #[arg(long, env = "PLACEFORMER_CONFIG", value_name = "FILE")]
        config: Option<PathBuf>,
    },
}

/// Runs it.
pub fn run(args: MapArgs) -> anyhow::Result<()> {
    match args.action {
        Action::List { server } => list(&ServerClient::new(server)?),
        Action::Show { map, server } => {
            let answer = ServerClient::new(server)?.get(&format!("/maps/{map}"))?;
            println!("{}", serde_json::to_string_pretty(&answer)?);
            Ok(())
        }
        Action::Delete { map, yes, server } => delete(&ServerClient::new(server)?, &map, yes),
        Action::Rehead { maps, head, data, config } => rehead(&maps, &head, &data, config.as_deref()),
    }
}

fn list(client: &ServerClient) -> anyhow::Result<()> {
    let answer = client.get("/maps")?;
    let maps = answer["maps"].as_array().map(Vec::as_slice).unwrap_or_default();
    println!("{:<32} {:>12}  model", "map", "references");
    for map in maps {
        let text = |key: &str| map[key].as_str().unwrap_or_default();
        println!("{:<32} {:>12}  {}", text("name"), map["references"].as_u64().unwrap_or_default(), text("model"));
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
    println!("deleted map {map} with {deleted} references");
    Ok(())
}

fn confirmed(map: &MapName, references: &Value) -> io::Result<bool> {
    print!("delete map {map} with {references} references? Type its name to go on: ");
    io::stdout().flush()?;
    let mut line = String::new();
    io::stdin().read_line(&mut line)?;
    Ok(line.trim() == map.as_str())
}

fn rehead(maps: &[MapName], head: &Path, data: &Path, config: Option<&Path>) -> anyhow::Result<()> {
    let config = Config::load(config, &Overrides::default())?;
    let head = Head::load(head)?;
    ensure!(data.is_dir(), "there is no store in {}", data.display());
    let store = super::serve::open_store(data, &config.store)?;
    // All are looked at before any is changed.
    let mut plan = Vec::new();
    for map in maps {
        let info = store.map(map)?;
        let model = head.rebind(&info.model).with_context(|| format!("map {map} cannot take this head"))?;
        plan.push((info, model));
    }
    for (info, model) in plan {
        if info.model == model {
            println!("map {} has this head already: {model}", info.name);
            continue;
        }
        let style = ProgressStyle::with_template("projecting {wide_bar} {pos}/{len} {per_sec} {eta}")?;
        let bar = ProgressBar::new(info.references).with_style(style);
        let mut project = |pooled: &[f32]| {
            bar.inc(1);
            // The store refuses an empty vector by name, which is what a stored one of another length deserves.
            if pooled.len() == head.dim() { head.project(pooled) } else { Vec::new() }
        };
        store.replace_globals(&info.name, model.clone(), &mut project)?;
        bar.finish_and_clear();
        println!("map {}: {} references, now {model}", info.name, info.references);
    }
    Ok(())
}
