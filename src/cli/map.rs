//! Inspect and delete maps of a running server.

use super::client::{ServerArgs, ServerClient};
use crate::types::MapName;
use anyhow::ensure;
use clap::Subcommand;
use serde_json::Value;
use std::io::{self, Write};

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
