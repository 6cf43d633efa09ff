//! Inspect and delete maps of a running server; give maps another head, there or in a data
//! directory.

mod rehead;

use crate::cli::client::{ServerArgs, ServerClient};
use crate::cli::output::{say, say_part};
use anyhow::ensure;
use clap::Subcommand;
use placeformer_core::types::MapName;
use rehead::ReheadArgs;
use serde_json::Value;
use std::io;

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
        Action::Rehead(args) => rehead::run(args),
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
