//! The worst and the best queries as pictures: the query, its nearest places before and after
//! re-ranking, and what the key patches saw (the paper's visualisation figure).

use super::html::escape;
use crate::datasets::{Dataset, Item, Truth};
use crate::draw::{jpeg_data_uri, thumbnail};
use crate::eval::EvalError;
use crate::eval::evidence::{Seen, picture};
use crate::eval::measure::first_hit;
use crate::eval::run::Answer;
use placeformer_vision::extract::Extractor;
use placeformer_vision::image::{ImageConfig, RgbImage, decode};
use placeformer_vision::rerank::Reranker;

/// What draws the pictures.
pub struct Painter<'a> {
    /// The model.
    pub extractor: &'a Extractor,
    /// Limits on images.
    pub limits: &'a ImageConfig,
    /// The matcher.
    pub reranker: &'a Reranker,
}

const THUMBNAIL_PX: u32 = 320;
const PICTURE_PX: u32 = 1400;
const QUALITY: u8 = 78;
const SHOWN: usize = 3;

/// Up to `count` queries of each kind: those that went most wrong, those answered though no match
/// exists, and those answered best. Empty where nothing was re-ranked.
pub fn gallery(
    painter: &Painter<'_>,
    dataset: &Dataset,
    answers: &[Answer],
    count: usize,
) -> Result<String, EvalError> {
    let mut out = String::new();
    for (title, chosen) in choose(dataset, answers, count) {
        if chosen.is_empty() {
            continue;
        }
        out += &format!("<h2>{title}</h2>\n");
        for answer in chosen {
            out += &painter.query(dataset, answer)?;
        }
    }
    Ok(out)
}

fn choose<'a>(
    dataset: &Dataset,
    answers: &'a [Answer],
    count: usize,
) -> [(&'static str, Vec<&'a Answer>); 3] {
    let score = |answer: &Answer| {
        answer
            .reranked
            .first()
            .map_or(0, |best| best.score.spatial_score)
    };
    let rank = |answer: &Answer| {
        first_hit(
            &answer.reranked_ranking(),
            dataset.truth[answer.query].positives(),
        )
    };
    let (mut wrong, mut right, mut unknown) = (Vec::new(), Vec::new(), Vec::new());
    for answer in answers.iter().filter(|answer| !answer.reranked.is_empty()) {
        match (&dataset.truth[answer.query], rank(answer)) {
            (Truth::Positives(_), Some(0)) => right.push(answer),
            (Truth::Positives(_), _) => wrong.push(answer),
            (Truth::NoMatch, _) => unknown.push(answer),
            (Truth::Unknown, _) => {}
        }
    }
    // Worst first: the positive ranked lowest or not found, then the surest mistake.
    wrong.sort_by_key(|answer| {
        std::cmp::Reverse((rank(answer).unwrap_or(usize::MAX), score(answer)))
    });
    unknown.sort_by_key(|answer| std::cmp::Reverse(score(answer)));
    right.sort_by_key(|answer| std::cmp::Reverse(score(answer)));
    let cut = |mut list: Vec<&'a Answer>| {
        list.truncate(count);
        list
    };
    [
        ("Worst queries", cut(wrong)),
        ("Surest answers where no match exists", cut(unknown)),
        ("Best queries", cut(right)),
    ]
}

impl Painter<'_> {
    fn query(&self, dataset: &Dataset, answer: &Answer) -> Result<String, EvalError> {
        let (query, truth) = (&dataset.queries[answer.query], &dataset.truth[answer.query]);
        let is_right = |index: usize| truth.positives().binary_search(&index).is_ok();
        let mut out = format!("<details open><summary>{}</summary>\n", escape(&query.name));
        out += "<h3>Query</h3><div class=\"row\">";
        out += &self.thumbnail(query, "", "query")?;
        out += &self.right_answer(dataset, truth)?;
        out += "</div><h3>Nearest by global distance</h3><div class=\"row\">";
        for neighbour in answer.global.iter().take(SHOWN) {
            let caption = format!("distance {:.3}", neighbour.distance);
            out += &self.thumbnail(
                &dataset.database[neighbour.index],
                outline(is_right(neighbour.index)),
                &caption,
            )?;
        }
        out += "</div><h3>Best after re-ranking</h3><div class=\"row\">";
        for candidate in answer.reranked.iter().take(SHOWN) {
            let parts: Vec<String> = candidate
                .score
                .combinations
                .iter()
                .map(|c| format!("{} {}/{}", c.scales.score_name(), c.inliers, c.matches))
                .collect();
            let caption = format!(
                "S = {} ({})",
                candidate.score.spatial_score,
                parts.join(", ")
            );
            out += &self.thumbnail(
                &dataset.database[candidate.index],
                outline(is_right(candidate.index)),
                &caption,
            )?;
        }
        out += "</div>\n";
        if let Some(best) = answer.reranked.first() {
            out += &self.evidence(query, &dataset.database[best.index])?;
        }
        Ok(out + "</details>\n")
    }

    /// The first positive that can be read. Images that could not be read took no part, but the
    /// truth still names them.
    fn right_answer(&self, dataset: &Dataset, truth: &Truth) -> Result<String, EvalError> {
        let mut reasons = Vec::new();
        for &positive in truth.positives() {
            let item = &dataset.database[positive];
            match open(item, self.limits) {
                Ok(image) => return picture_of(item, &image, "right", "a right answer"),
                Err(error) => reasons.push(format!("{}: {error}", item.name)),
            }
        }
        let named = reasons
            .first()
            .map(|first| placeholder("no right answer could be read", first));
        Ok(named.unwrap_or_default())
    }

    fn thumbnail(&self, item: &Item, class: &str, caption: &str) -> Result<String, EvalError> {
        match open(item, self.limits) {
            Ok(image) => picture_of(item, &image, class, caption),
            // It was readable when it was described: a long run may outlive its images.
            Err(error) => Ok(placeholder(caption, &format!("{}: {error}", item.name))),
        }
    }

    fn evidence(&self, query: &Item, reference: &Item) -> Result<String, EvalError> {
        let title = "<h3>What the key patches saw: query left, best answer right</h3>";
        let (query_bytes, reference_bytes) = match (read(query), read(reference)) {
            (Ok(query), Ok(reference)) => (query, reference),
            (Err(error), _) | (_, Err(error)) => {
                return Ok(
                    title.to_owned() + &placeholder("no longer readable", &error.to_string())
                );
            }
        };
        let see = |bytes: &[u8]| Seen::new(self.extractor, self.limits, bytes);
        let (query_seen, reference_seen) = (see(&query_bytes)?, see(&reference_bytes)?);
        let matches = self
            .reranker
            .explain(&query_seen.patches, &reference_seen.patches);
        let drawn = picture(&query_seen, &reference_seen, &matches)?;
        let uri = jpeg_data_uri(&thumbnail(&drawn, PICTURE_PX)?, QUALITY)?;
        let alt = escape(&format!(
            "inliers between {} and {}",
            query.name, reference.name
        ));
        Ok(format!(
            "{title}<figure>\
             <img loading=\"lazy\" alt=\"{alt}\" src=\"{uri}\"><figcaption>Attention with the key patches of the three \
             scales, then the inliers of each combination.</figcaption></figure>\n"
        ))
    }
}

fn picture_of(
    item: &Item,
    image: &RgbImage,
    class: &str,
    caption: &str,
) -> Result<String, EvalError> {
    let uri = jpeg_data_uri(&thumbnail(image, THUMBNAIL_PX)?, QUALITY)?;
    let (name, caption) = (escape(&item.name), escape(caption));
    Ok(format!(
        "<figure><img class=\"{class}\" loading=\"lazy\" alt=\"{name}\" src=\"{uri}\">\
         <figcaption>{caption}<br><span class=\"soft\">{name}</span></figcaption></figure>"
    ))
}

/// What stands where a picture would.
fn placeholder(caption: &str, reason: &str) -> String {
    let (caption, reason) = (escape(caption), escape(reason));
    format!(
        "<figure><figcaption>{caption}<br><span class=\"soft\">{reason}</span></figcaption></figure>"
    )
}

fn open(item: &Item, limits: &ImageConfig) -> Result<RgbImage, EvalError> {
    Ok(decode(&read(item)?, limits)?)
}

fn outline(right: bool) -> &'static str {
    if right { "right" } else { "wrong" }
}

fn read(item: &Item) -> Result<Vec<u8>, EvalError> {
    std::fs::read(&item.path).map_err(EvalError::io(&item.path))
}
