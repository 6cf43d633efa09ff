//! Match two images and draw the evidence.

use super::model_args::ModelOptions;
use crate::cli::output::{OutputError, note, say};
use crate::cli::progress::ProgressBars;
use anyhow::{Context, bail};
use placeformer_core::types::ScaleSet;
use placeformer_lab::eval::evidence::{Seen, picture};
use placeformer_models::open_extractor;
use placeformer_vision::image::{ImageConfig, encode_jpeg, encode_png};
use placeformer_vision::rerank::{CombinationMatch, RerankConfig, Reranker};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

/// Arguments of this subcommand.
#[derive(Debug, clap::Args)]
pub struct MatchArgs {
    /// Query image.
    query: PathBuf,
    /// Reference image.
    reference: PathBuf,
    /// Where both images, their attention and key patches, and the inliers are drawn, as PNG or
    /// JPEG.
    #[arg(long, value_name = "FILE", default_value = "match.png")]
    out: PathBuf,
    /// Draw nothing.
    #[arg(long, conflicts_with = "out")]
    no_picture: bool,
    /// Print the correspondences and homographies as JSON.
    #[arg(long)]
    json: bool,
    /// Scale combinations whose inliers add up to S.
    #[arg(
        long,
        value_delimiter = ',',
        default_value = "1,1+2,2+3",
        value_name = "SET,..."
    )]
    scales: Vec<ScaleSet>,
    #[command(flatten)]
    model: ModelOptions,
}

/// Runs it.
pub fn run(args: MatchArgs) -> anyhow::Result<()> {
    let rerank = RerankConfig {
        scales: args.scales.clone(),
        ..Default::default()
    };
    rerank.check()?;
    placeformer_kernels::self_check()?;
    let encode = if args.no_picture {
        None
    } else {
        Some(encoder(&args.out)?)
    };
    let extractor = open_extractor(&args.model.extract_config()?, &ProgressBars::default())?;
    let limits = ImageConfig::default();
    let see = |path: &Path| {
        let bytes =
            std::fs::read(path).with_context(|| format!("cannot read {}", path.display()))?;
        Seen::new(&extractor, &limits, &bytes)
            .with_context(|| format!("cannot use {}", path.display()))
    };
    let query = see(&args.query)?;
    let reference = see(&args.reference)?;
    let reranker = Reranker::new(rerank);
    let matches = reranker.explain(&query.patches, &reference.patches);
    if args.json {
        say!(
            "{}",
            serde_json::to_string_pretty(&as_json(&query, &reference, &matches))?
        )?;
    } else {
        print_counts(&query, &reference, &matches)?;
    }
    if let Some(encode) = encode {
        let path = &args.out;
        let bytes = encode(&picture(&query, &reference, &matches)?)?;
        std::fs::write(path, bytes).with_context(|| format!("cannot write {}", path.display()))?;
        note!("wrote {}", path.display());
    }
    Ok(())
}

type Encode = fn(&placeformer_vision::image::RgbImage) -> anyhow::Result<Vec<u8>>;

/// Chosen before the model is loaded, so that a wrong name costs nothing.
fn encoder(path: &Path) -> anyhow::Result<Encode> {
    let extension = path
        .extension()
        .and_then(|extension| extension.to_str())
        .unwrap_or_default();
    match extension.to_ascii_lowercase().as_str() {
        "png" => Ok(|image| Ok(encode_png(image)?)),
        "jpg" | "jpeg" => Ok(|image| Ok(encode_jpeg(image, 90)?)),
        _ => bail!(
            "{}: the picture must end in .png, .jpg or .jpeg",
            path.display()
        ),
    }
}

fn spatial_score(matches: &[CombinationMatch]) -> u32 {
    matches.iter().map(|found| found.score.inliers).sum()
}

fn global_distance(query: &Seen, reference: &Seen) -> f32 {
    query
        .global
        .iter()
        .zip(&reference.global)
        .map(|(a, b)| (a - b) * (a - b))
        .sum::<f32>()
        .sqrt()
}

fn print_counts(
    query: &Seen,
    reference: &Seen,
    matches: &[CombinationMatch],
) -> Result<(), OutputError> {
    let counts = |seen: &Seen| {
        seen.patches
            .counts
            .map(|count| count.to_string())
            .join(" / ")
    };
    say!("key patches   {} and {}", counts(query), counts(reference))?;
    say!("distance      {:.4}", global_distance(query, reference))?;
    for found in matches {
        let score = found.score;
        say!(
            "{:<13} {} inliers of {} matches",
            score.scales.score_name(),
            score.inliers,
            score.matches
        )?;
    }
    say!("S             {}", spatial_score(matches))
}

fn as_json(query: &Seen, reference: &Seen, matches: &[CombinationMatch]) -> Value {
    let side = |seen: &Seen| {
        let grid = seen.patches.grid;
        let input =
            [u32::from(grid.columns), u32::from(grid.rows)].map(|n| n * u32::from(grid.patch_px));
        json!({ "key_patches": seen.patches.counts, "input_size": input })
    };
    let combination = |found: &CombinationMatch| {
        let pair = |pair: &placeformer_vision::rerank::Correspondence| {
            let from = pair.query as usize;
            let to = pair.reference as usize;
            json!({
                "query": query.patches.centre(from),
                "reference": reference.patches.centre(to),
                "scales": [query.patches.scale_of(from), reference.patches.scale_of(to)],
                "inlier": pair.inlier,
            })
        };
        json!({
            "score": found.score.scales.score_name(),
            "matches": found.score.matches,
            "inliers": found.score.inliers,
            "homography": found.homography,
            "correspondences": found.correspondences.iter().map(pair).collect::<Vec<_>>(),
        })
    };
    json!({
        "spatial_score": spatial_score(matches),
        "global_distance": global_distance(query, reference),
        "query": side(query),
        "reference": side(reference),
        "combinations": matches.iter().map(combination).collect::<Vec<_>>(),
    })
}
