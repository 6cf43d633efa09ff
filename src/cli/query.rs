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
    let parameters = parameters(&args);
    let client = ServerClient::new(args.server)?;
    let answer = client.post_image("/query", &args.image, &parameters)?;
    if args.json {
        say!("{}", serde_json::to_string_pretty(&answer)?)?;
    } else {
        print_answer(&answer)?;
    }
    Ok(())
}

fn parameters(args: &QueryArgs) -> Vec<(&'static str, String)> {
    let mut parameters = vec![
        ("map", args.map.to_string()),
        ("top_k", args.top_k.to_string()),
        ("rerank", (!args.no_rerank).to_string()),
    ];
    if let Some(count) = args.candidates {
        parameters.push(("candidates", count.to_string()));
    }
    if let Some(near) = &args.near {
        parameters.push(("near", near.clone()));
    }
    if let Some(radius) = args.radius_m {
        parameters.push(("radius_m", radius.to_string()));
    }
    if let Some(deadline) = args.deadline_ms {
        parameters.push(("deadline_ms", deadline.to_string()));
    }
    parameters
}

fn print_answer(answer: &Value) -> Result<(), OutputError> {
    let results = answer["results"].as_array();
    let results = results.map(Vec::as_slice).unwrap_or_default();
    say!("rank      S distance  {:<22} reference", "position")?;
    for result in results {
        print_result(result)?;
    }
    if results.is_empty() {
        say!("nothing in this map fits")?;
    }
    let matched = answer["matched"].as_bool();
    let confidence = answer["confidence"].as_f64();
    if let (Some(matched), Some(confidence)) = (matched, confidence) {
        let trust = if matched { "trusted" } else { "not trusted" };
        say!("the best answer is {trust}: confidence {confidence:.3}")?;
    }
    if answer["unmatched_reason"] == "image_uninformative" {
        say!("the photo shows nothing to know a place by")?;
    }
    print_estimate(&answer["estimate"])?;
    print_timings(answer)
}

fn print_estimate(estimate: &Value) -> Result<(), OutputError> {
    let number = |field: &str| estimate[field].as_f64();
    if let (Some(lat), Some(lon), Some(accuracy)) =
        (number("lat"), number("lon"), number("accuracy_m"))
    {
        say!("the photo was taken at {lat:.6},{lon:.6} within {accuracy:.0} m")?;
    }
    Ok(())
}

fn print_result(result: &Value) -> Result<(), OutputError> {
    let score = match result["spatial_score"].as_u64() {
        Some(score) => score.to_string(),
        None => "-".to_owned(),
    };
    let lat = result["location"]["lat"].as_f64();
    let lon = result["location"]["lon"].as_f64();
    let position = match (lat, lon) {
        (Some(lat), Some(lon)) => format!("{lat:.6},{lon:.6}"),
        _ => "-".to_owned(),
    };
    let external_id = result["external_id"].as_str();
    let name = external_id.or(result["reference_id"].as_str());
    let name = name.unwrap_or_default();
    let distance = result["global_distance"].as_f64().unwrap_or_default();
    let rank = &result["rank"];
    say!("{rank:>4} {score:>6} {distance:>8.4}  {position:<22} {name}")
}

fn print_timings(answer: &Value) -> Result<(), OutputError> {
    let mut stages = Vec::new();
    for (stage, ms) in answer["timings_ms"].as_object().into_iter().flatten() {
        stages.push(format!("{stage} {:.1}", ms.as_f64().unwrap_or_default()));
    }
    let order = if answer["reranked"] == true {
        "re-ranked"
    } else {
        "global ranking only"
    };
    say!("{order}; milliseconds: {}", stages.join(", "))
}
