//! What the demo showed: a table on the terminal, a page that leads with pictures.

use super::town::{Mark, map, place_and_view};
use crate::cli::output::{OutputError, say};
use anyhow::Context;
use maud::{Markup, html};
use placeformer_lab::draw::{jpeg_data_uri, thumbnail};
use placeformer_lab::eval::report::{page, table};
use placeformer_vision::image::{ImageConfig, decode};
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// One place in an answer.
pub(super) struct Found {
    pub(super) reference: String,
    distance: f64,
    score: u64,
    right: bool,
}

/// One query and its answer.
pub(super) struct Asked {
    pub(super) query: String,
    /// Whether the town's map shows the place at all.
    mapped: bool,
    /// In the server's order.
    pub(super) results: Vec<Found>,
    /// Whether the server trusts its best answer, and how sure it is.
    trust: Option<(bool, f64)>,
    /// Milliseconds per stage.
    stages: BTreeMap<String, f64>,
}

/// A picture of a query beside its best answer.
pub(super) struct Evidence {
    /// Which query.
    pub(super) asked: usize,
    /// The file.
    pub(super) picture: PathBuf,
}

impl Asked {
    /// Reads an answer of `POST /query`; `None` if it lacks what every answer has.
    pub(super) fn read(query: &str, right: &BTreeSet<String>, answer: &Value) -> Option<Self> {
        let found = |result: &Value| {
            let reference = result["external_id"].as_str()?.to_owned();
            let right = right.contains(&reference);
            let distance = result["global_distance"].as_f64()?;
            let score = result["spatial_score"].as_u64()?;
            Some(Found {
                reference,
                distance,
                score,
                right,
            })
        };
        let results = answer["results"]
            .as_array()?
            .iter()
            .map(found)
            .collect::<Option<_>>()?;
        let stages = answer["timings_ms"].as_object()?.iter();
        let stages = stages
            .map(|(stage, ms)| Some((stage.clone(), ms.as_f64()?)))
            .collect::<Option<_>>()?;
        let trust = answer["matched"]
            .as_bool()
            .zip(answer["confidence"].as_f64());
        Some(Self {
            query: query.into(),
            mapped: !right.is_empty(),
            results,
            trust,
            stages,
        })
    }

    /// The answer without re-ranking.
    fn global_best(&self) -> Option<&Found> {
        self.results
            .iter()
            .min_by(|a, b| a.distance.total_cmp(&b.distance))
    }

    fn right(&self) -> bool {
        self.results.first().is_some_and(|best| best.right)
    }

    fn globally_right(&self) -> bool {
        self.global_best().is_some_and(|best| best.right)
    }

    /// Whether re-ranking turned a wrong answer into the right one.
    pub(super) fn reranking_helped(&self) -> bool {
        self.right() && !self.globally_right()
    }

    /// S of the best answer.
    pub(super) fn best_score(&self) -> u64 {
        self.results.first().map_or(0, |best| best.score)
    }

    /// `97%`, with a question mark where the server does not trust it.
    fn confidence(&self) -> String {
        self.trust.map_or("-".into(), |(matched, confidence)| {
            format!(
                "{:.0}%{}",
                100.0 * confidence,
                if matched { "" } else { "?" }
            )
        })
    }

    /// What the map shows of it.
    pub(super) fn mark(&self) -> Mark {
        match (self.mapped, self.right()) {
            (false, _) => Mark::Unmapped,
            (true, true) => Mark::Right,
            (true, false) => Mark::Wrong,
        }
    }

    fn verdict(&self) -> &'static str {
        match (self.mapped, self.right(), self.globally_right()) {
            (false, ..) => "not in the map",
            (true, true, true) => "right",
            (true, true, false) => "right after re-ranking",
            (true, false, _) => "wrong",
        }
    }
}

/// A line per query.
pub(super) fn print_table(asked: &[Asked]) -> Result<(), OutputError> {
    say!(
        "   {:<19} {:<19} {:>5} {:>6} {:>9} {:>8} {:>8}  verdict",
        "query",
        "best reference",
        "S",
        "sure",
        "extract",
        "search",
        "re-rank"
    )?;
    for one in asked {
        let best = one
            .results
            .first()
            .map_or("-".into(), |best| place_and_view(&best.reference));
        let stage = |name: &str| one.stages.get(name).copied().unwrap_or_default();
        say!(
            "   {:<19} {best:<19} {:>5} {:>6} {:>6.0} ms {:>5.2} ms {:>5.0} ms  {}",
            place_and_view(&one.query),
            one.best_score(),
            one.confidence(),
            stage("extract"),
            stage("search"),
            stage("load") + stage("rerank"),
            one.verdict()
        )?;
    }
    Ok(())
}

/// The demo in a few sentences.
pub(super) fn summary(asked: &[Asked]) -> String {
    let mapped: Vec<&Asked> = asked.iter().filter(|one| one.mapped).collect();
    let unmapped = asked.iter().filter(|one| !one.mapped);
    let globally = mapped.iter().filter(|one| one.globally_right()).count();
    let reranked = mapped.iter().filter(|one| one.right()).count();
    let lowest_right = mapped
        .iter()
        .filter(|one| one.right())
        .map(|one| one.best_score())
        .min();
    let highest_unmapped = unmapped.map(Asked::best_score).max();
    let mut text = format!(
        "Right at rank 1: {globally} of {} by the global descriptor alone, \
         {reranked} after re-ranking.",
        mapped.len()
    );
    if let (Some(lowest), Some(highest)) = (lowest_right, highest_unmapped) {
        text += &format!(
            "\nPlaces that are not in the map score at most S = {highest}; \
             right answers score at least {lowest}."
        );
    }
    let trusted: Vec<&Asked> = asked
        .iter()
        .filter(|one| one.trust.is_some_and(|(matched, _)| matched))
        .collect();
    if asked.iter().any(|one| one.trust.is_some()) {
        let right = trusted.iter().filter(|one| one.right()).count();
        text += &format!(
            "\nThe server trusts {} of its {} best answers; {right} of them are right.",
            trusted.len(),
            asked.len()
        );
    }
    text
}

/// What the page is about.
pub(super) struct Demo<'a> {
    /// The folder of the town.
    pub(super) town: &'a Path,
    /// The mapped photos.
    pub(super) references: &'a [String],
    /// Every query with its answer.
    pub(super) asked: &'a [Asked],
    /// The pictures of some.
    pub(super) evidence: &'a [Evidence],
    /// The answer of `/info`.
    pub(super) info: &'a Value,
    /// How long importing took.
    pub(super) import_seconds: f64,
}

/// Writes the page: the summary and a map of the town, then pictures, then every query.
pub(super) fn write(path: &Path, demo: &Demo<'_>) -> anyhow::Result<()> {
    let Demo { town, asked, .. } = *demo;
    let info = demo.info;
    let model = &info["model"];
    let model = model["id"].as_str().or(model.as_str()).unwrap_or("unknown");
    let mut figures = Vec::new();
    for one in demo.evidence {
        figures.push(figure(town, &asked[one.asked], &one.picture)?);
    }
    let seconds = format!("{:.1}", demo.import_seconds);
    let body = html! {
        @for sentence in summary(asked).lines() {
            p.lead { (sentence) }
        }
        (map(demo.references, asked))
        h2 { "The evidence" }
        p {
            "Above: attention, with the key patches of three scales as squares. Below, for each \
             combination of scales: the correspondences that one homography explains."
        }
        @for figure in figures {
            (figure)
        }
        h2 { "All queries" }
        p.soft { "Model " code { (model) } "; importing took " (seconds) " s." }
        (all_queries(asked))
    };
    std::fs::write(path, page("PlaceFormer demo", &body))
        .with_context(|| format!("cannot write {}", path.display()))
}

fn all_queries(asked: &[Asked]) -> Markup {
    let name = |found: Option<&Found>| match found {
        Some(found) => place_and_view(&found.reference),
        None => "-".into(),
    };
    let row = |one: &Asked| {
        let total: f64 = one.stages.values().sum();
        vec![
            place_and_view(&one.query),
            name(one.global_best()),
            name(one.results.first()),
            one.best_score().to_string(),
            one.confidence(),
            format!("{total:.0}"),
            one.verdict().to_owned(),
        ]
    };
    let rows: Vec<Vec<String>> = asked.iter().map(row).collect();
    let headers = [
        "Query",
        "Best by global descriptor",
        "Best after re-ranking",
        "S",
        "Sure",
        "ms",
        "Verdict",
    ];
    table("Every query of the demo", &headers, &rows)
}

/// Query, best reference before and after re-ranking, and the picture of the match.
fn figure(town: &Path, asked: &Asked, picture: &Path) -> anyhow::Result<Markup> {
    let query = photo(&town.join("queries"), &asked.query, "query", "")?;
    let mut references = Vec::new();
    let captions = ["best by the global descriptor", "best after re-ranking"];
    for (found, caption) in [asked.global_best(), asked.results.first()]
        .into_iter()
        .zip(captions)
    {
        if let Some(found) = found {
            let class = if found.right { "right" } else { "wrong" };
            let caption = format!("{caption}: {}", place_and_view(&found.reference));
            references.push(photo(
                &town.join("database"),
                &found.reference,
                &caption,
                class,
            )?);
        }
    }
    let alt = format!(
        "Key patches and inlier lines of {} and its best reference",
        place_and_view(&asked.query)
    );
    let uri = embed(picture, 1400)?;
    Ok(html! {
        h3 { "Query of " (place_and_view(&asked.query)) ": " (asked.verdict()) }
        div.row {
            (query)
            @for reference in references {
                (reference)
            }
        }
        img src=(uri) alt=(alt);
    })
}

/// A photo of the town with what it is.
fn photo(folder: &Path, name: &str, caption: &str, class: &str) -> anyhow::Result<Markup> {
    let uri = embed(&folder.join(name), 420)?;
    Ok(html! {
        figure class=(class) {
            img src=(uri) alt=(place_and_view(name));
            figcaption { (caption) }
        }
    })
}

fn embed(path: &Path, longest_side: u32) -> anyhow::Result<String> {
    let bytes = std::fs::read(path).with_context(|| format!("cannot read {}", path.display()))?;
    let image =
        decode(&bytes, &ImageConfig::default()).with_context(|| path.display().to_string())?;
    Ok(jpeg_data_uri(&thumbnail(&image, longest_side)?, 85)?)
}
