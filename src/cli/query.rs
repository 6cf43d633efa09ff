//! Ask a running server which place a photo shows.

use super::client::{ServerArgs, ServerClient};
use crate::cli::output::{OutputError, say};
use placeformer_core::types::MapName;
use serde_json::Value;
use std::path::PathBuf;

/// Arguments of this subcommand.
#[derive(Debug, clap::Args)]
pub struct QueryArgs {
    /// The photo.
    image: PathBuf,
    /// The map to look in.
    #[arg(long)]
    map: MapName,
    /// Results wanted.
    #[arg(long, default_value_t = 5)]
    top_k: usize,
    /// Nearest neighbours that are re-ranked; the server's default unless given.
    #[arg(long)]
    candidates: Option<usize>,
    /// Answer with the global ranking.
    #[arg(long)]
    no_rerank: bool,
    /// Only references around this position; needs --radius-m.
    #[arg(
        long,
        value_name = "LAT,LON",
        requires = "radius_m",
        allow_hyphen_values = true
    )]
    near: Option<String>,
    /// Radius around --near in metres.
    #[arg(long, requires = "near")]
    radius_m: Option<f64>,
    /// Milliseconds for the answer.
    #[arg(long)]
    deadline_ms: Option<u64>,
    /// Print the answer as JSON.
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    server: ServerArgs,
}

/// Runs it.
pub fn run(args: QueryArgs) -> anyhow::Result<()> {
    let mut parameters = vec![
        ("map", args.map.to_string()),
        ("top_k", args.top_k.to_string()),
        ("rerank", (!args.no_rerank).to_string()),
    ];
    parameters.extend(
        args.candidates
            .map(|count| ("candidates", count.to_string())),
    );
    parameters.extend(args.near.map(|near| ("near", near)));
    parameters.extend(args.radius_m.map(|radius| ("radius_m", radius.to_string())));
    parameters.extend(args.deadline_ms.map(|ms| ("deadline_ms", ms.to_string())));
    let answer = ServerClient::new(args.server)?.post_image("/query", &args.image, &parameters)?;
    if args.json {
        say!("{}", serde_json::to_string_pretty(&answer)?)?;
    } else {
        print_table(&answer)?;
    }
    Ok(())
}

fn print_table(answer: &Value) -> Result<(), OutputError> {
    let results = answer["results"]
        .as_array()
        .map(Vec::as_slice)
        .unwrap_or_default();
    say!(
        "{:>4} {:>6} {:>8}  {:<22} reference",
        "rank",
        "S",
        "distance",
        "position"
    )?;
    for result in results {
        let score = result["spatial_score"]
            .as_u64()
            .map_or("-".into(), |score| score.to_string());
        let position = match (
            result["location"]["lat"].as_f64(),
            result["location"]["lon"].as_f64(),
        ) {
            (Some(lat), Some(lon)) => format!("{lat:.6},{lon:.6}"),
            _ => "-".into(),
        };
        let name = result["external_id"]
            .as_str()
            .or(result["reference_id"].as_str())
            .unwrap_or_default();
        let distance = result["global_distance"].as_f64().unwrap_or_default();
        say!(
            "{:>4} {score:>6} {distance:>8.4}  {position:<22} {name}",
            result["rank"]
        )?;
    }
    if results.is_empty() {
        say!("nothing in this map fits")?;
    }
    if let (Some(matched), Some(confidence)) =
        (answer["matched"].as_bool(), answer["confidence"].as_f64())
    {
        let verdict = if matched { "trusted" } else { "not trusted" };
        say!("the best answer is {verdict}: confidence {confidence:.3}")?;
    }
    let stages = answer["timings_ms"].as_object().into_iter().flatten();
    let stages: Vec<String> = stages
        .map(|(stage, ms)| format!("{stage} {:.1}", ms.as_f64().unwrap_or_default()))
        .collect();
    let order = if answer["reranked"] == true {
        "re-ranked"
    } else {
        "global ranking only"
    };
    say!("{order}; milliseconds: {}", stages.join(", "))
}
