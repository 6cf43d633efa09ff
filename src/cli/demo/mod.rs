//! Serve a demo map, query it, write a report.
//!
//! What a new user would do by hand, done for them and shown: draw a small town, start the server,
//! import the photos, ask where each query was taken, picture the evidence, stop. Every step runs
//! this same program through its public commands and its HTTP surface, so a demo that works is a
//! product that works.

mod report;
mod town;

use super::client::{ServerArgs, ServerClient, TrustArgs};
use crate::cli::child_server::ChildServer;
use crate::cli::output::say;
use crate::cli::progress::ProgressBars;
use anyhow::{Context, bail, ensure};
use placeformer_models::resolve_weights;
use placeformer_vision::extract::ExtractConfig;
use report::{Asked, Demo, Evidence};
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Instant;

/// Marks a folder this command may empty.
const MARKER: &str = ".placeformer-demo";
const MAP: &str = "demo";
/// Candidates fetched and re-ranked, the paper's number.
const CANDIDATES: usize = 100;

/// Arguments of this subcommand.
#[derive(Debug, clap::Args)]
pub struct DemoArgs {
    /// Folder for the town, the store, the server's log and the report; emptied if an earlier demo
    /// made it.
    #[arg(long, default_value = "demo-report", value_name = "DIR")]
    out: PathBuf,
    /// Places of the town.
    #[arg(long, default_value_t = 64)]
    places: u64,
    /// Reference photos of each place.
    #[arg(long, default_value_t = 2)]
    views: u64,
    /// Which town. Town 1 is among the pictures that the built-in head was fitted on.
    #[arg(long, default_value_t = 7)]
    seed: u64,
    /// Queries whose evidence is pictured.
    #[arg(long, default_value_t = 6)]
    pictures: usize,
}

/// Runs it.
pub fn run(args: DemoArgs) -> anyhow::Result<()> {
    let town = args.out.join("town");
    let data = args.out.join("data");
    prepare(&args.out)?;
    resolve_weights(&ExtractConfig::default(), &ProgressBars::default())
        .context("the demo needs the default model")?;

    draw_town(&args, &town)?;
    let server = start_server(&data, &args.out)?;
    let import_seconds = import(&town, &server)?;

    say!("\n4. Ask where each query photo was taken")?;
    let client = ServerClient::new(ServerArgs {
        server: server.url().into(),
        api_key: None,
        trust: TrustArgs::default(),
        timeout: 60,
    })?;
    let truth = read_truth(&town.join("ground_truth.csv"))?;
    let asked = ask_all(&client, &town.join("queries"), &truth)?;
    report::print_table(&asked)?;

    say!("\n5. Picture the evidence")?;
    let evidence = picture(&town, &args.out, &asked, args.pictures)?;
    let info = client.get("/info")?;
    server.stop()?;
    let path = args.out.join("index.html");
    let demo = Demo {
        town: &town,
        references: &file_names(&town.join("database"))?,
        asked: &asked,
        evidence: &evidence,
        info: &info,
        import_seconds,
    };
    report::write(&path, &demo)?;

    say!("\n{}", report::summary(&asked))?;
    say!("report: {}", path.display())?;
    say!("ask more:  placeformer serve --data {}", data.display())?;
    Ok(())
}

fn draw_town(args: &DemoArgs, town: &Path) -> anyhow::Result<()> {
    say!(
        "\n1. Draw a town of {} places, {} photos each",
        args.places,
        args.views
    )?;
    let places = args.places.to_string();
    let views = args.views.to_string();
    let seed = args.seed.to_string();
    placeformer(&[
        "synth",
        "--out",
        text(town)?,
        "--places",
        &places,
        "--views",
        &views,
        "--seed",
        &seed,
    ])
}

fn start_server(data: &Path, out: &Path) -> anyhow::Result<ChildServer> {
    say!("\n2. Start the server")?;
    let arguments = ["serve", "--listen", "127.0.0.1:0", "--data"];
    say!(
        "   $ placeformer {} {}",
        arguments.join(" "),
        data.display()
    )?;
    let arguments = arguments.map(OsString::from).into_iter();
    let arguments = arguments.chain([data.into()]);
    let server = ChildServer::start(arguments, out.join("server.log"))?;
    say!("   ready at {}", server.url())?;
    Ok(server)
}

/// Imports the town's references; returns how many seconds that took.
fn import(town: &Path, server: &ChildServer) -> anyhow::Result<f64> {
    say!("\n3. Import the photos into the map {MAP:?}")?;
    let started = Instant::now();
    let database = town.join("database");
    let database = text(&database)?;
    placeformer(&["import", database, "--map", MAP, "--server", server.url()])?;
    Ok(started.elapsed().as_secs_f64())
}

/// An empty folder: new, or left by an earlier demo.
fn prepare(out: &Path) -> anyhow::Result<()> {
    let marker = out.join(MARKER);
    if out.exists() && !marker.exists() {
        let mut entries =
            std::fs::read_dir(out).with_context(|| format!("cannot read {}", out.display()))?;
        if entries.next().is_some() {
            bail!(
                "{} holds files that no demo made; choose another --out",
                out.display()
            );
        }
    }
    if marker.exists() {
        std::fs::remove_dir_all(out).with_context(|| format!("cannot empty {}", out.display()))?;
    }
    std::fs::create_dir_all(out)
        .and_then(|()| std::fs::write(&marker, b""))
        .with_context(|| format!("cannot write to {}", out.display()))
}

/// Runs a subcommand of this program as a user would, and shows it.
fn placeformer(arguments: &[&str]) -> anyhow::Result<()> {
    say!("   $ placeformer {}", arguments.join(" "))?;
    let program = std::env::current_exe().context("cannot find this program's own file")?;
    let status = Command::new(program)
        .args(arguments)
        .status()
        .context("cannot start a subcommand")?;
    ensure!(
        status.success(),
        "placeformer {} failed",
        arguments.first().copied().unwrap_or_default()
    );
    Ok(())
}

/// The names of the files in a folder.
fn file_names(folder: &Path) -> anyhow::Result<Vec<String>> {
    let cannot_read = || format!("cannot read {}", folder.display());
    let mut names = Vec::new();
    for entry in std::fs::read_dir(folder).with_context(cannot_read)? {
        let name = entry.with_context(cannot_read)?.file_name();
        names.push(name.to_string_lossy().into_owned());
    }
    Ok(names)
}

fn text(path: &Path) -> anyhow::Result<&str> {
    path.to_str()
        .with_context(|| format!("{} is not a name in UTF-8", path.display()))
}

/// For every query the references that show its place; none where the place is not mapped.
fn read_truth(path: &Path) -> anyhow::Result<BTreeMap<String, BTreeSet<String>>> {
    let mut truth: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
    for row in csv::Reader::from_path(path)
        .with_context(|| format!("cannot read {}", path.display()))?
        .deserialize()
    {
        let (query, reference): (String, String) = row?;
        let references = truth.entry(query).or_default();
        if !reference.is_empty() {
            references.insert(reference);
        }
    }
    Ok(truth)
}

fn ask_all(
    client: &ServerClient,
    queries: &Path,
    truth: &BTreeMap<String, BTreeSet<String>>,
) -> anyhow::Result<Vec<Asked>> {
    let parameters = [
        ("map", MAP.to_owned()),
        ("top_k", CANDIDATES.to_string()),
        ("candidates", CANDIDATES.to_string()),
    ];
    truth
        .iter()
        .map(|(query, right)| {
            let answer: Value = client.post_image("/query", &queries.join(query), &parameters)?;
            Asked::read(query, right, &answer)
                .with_context(|| format!("the answer to {query} has an unknown shape"))
        })
        .collect()
}

/// Queries on which re-ranking changed the answer first, then those with the most and the fewest
/// inliers.
fn picture(
    town: &Path,
    out: &Path,
    asked: &[Asked],
    wanted: usize,
) -> anyhow::Result<Vec<Evidence>> {
    let mut order: Vec<usize> = (0..asked.len())
        .filter(|&i| !asked[i].results.is_empty())
        .collect();
    order.sort_by_key(|&i| std::cmp::Reverse((asked[i].reranking_helped(), asked[i].best_score())));
    let fewest = wanted / 3;
    let chosen = order
        .iter()
        .take(wanted - fewest)
        .chain(order.iter().rev().take(fewest));
    let chosen: BTreeSet<usize> = chosen.copied().collect();
    let mut evidence = Vec::new();
    for index in order.into_iter().filter(|index| chosen.contains(index)) {
        let query = &asked[index];
        let reference = &query.results[0].reference;
        let picture = out.join(format!("match-{}.png", evidence.len() + 1));
        let a = town.join("queries").join(&query.query);
        let b = town.join("database").join(reference);
        placeformer(&["match", text(&a)?, text(&b)?, "--out", text(&picture)?])?;
        evidence.push(Evidence {
            asked: index,
            picture,
        });
    }
    Ok(evidence)
}
