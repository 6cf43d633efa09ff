//! The worst and the best queries as pictures: the query, its nearest places before and after
//! re-ranking, and what the key patches saw (the paper's visualisation figure).

use crate::datasets::{Dataset, Item, Truth};
use crate::draw::{jpeg_data_uri, thumbnail};
use crate::eval::error::EvalError;
use crate::eval::evidence::{Seen, picture};
use crate::eval::measure::first_hit;
use crate::eval::run::Answer;
use maud::{Markup, PreEscaped, html};
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
///
/// # Errors
/// The model fails, or a picture cannot be drawn. Images that cannot be read are shown as such.
pub fn gallery(
    painter: &Painter<'_>,
    dataset: &Dataset,
    answers: &[Answer],
    count: usize,
) -> Result<Markup, EvalError> {
    let mut sections = Vec::new();
    for (title, chosen) in choose(dataset, answers, count) {
        let mut queries = Vec::new();
        for answer in chosen {
            queries.push(painter.query(dataset, answer)?);
        }
        if !queries.is_empty() {
            sections.push((title, queries));
        }
    }
    Ok(html! {
        @for (title, queries) in sections {
            h2 { (title) }
            @for query in queries {
                (query)
            }
        }
    })
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
    let mut wrong = Vec::new();
    let mut right = Vec::new();
    let mut unknown = Vec::new();
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
    /// Everything about one query.
    fn query(&self, dataset: &Dataset, answer: &Answer) -> Result<Markup, EvalError> {
        let query = &dataset.queries[answer.query];
        let truth = &dataset.truth[answer.query];
        let photo = self.thumbnail(query, "", "query")?;
        let right_answer = self.right_answer(dataset, truth)?;
        let nearest = self.nearest(dataset, answer)?;
        let best = self.best(dataset, answer)?;
        let evidence = match answer.reranked.first() {
            Some(best) => self.evidence(query, &dataset.database[best.index])?,
            None => html! {},
        };
        Ok(html! {
            details open {
                summary { (query.name) }
                h3 { "Query" }
                div.row { (photo) (right_answer) }
                h3 { "Nearest by global distance" }
                div.row { (nearest) }
                h3 { "Best after re-ranking" }
                div.row { (best) }
                (evidence)
            }
        })
    }

    /// The nearest places by global distance.
    fn nearest(&self, dataset: &Dataset, answer: &Answer) -> Result<Markup, EvalError> {
        let mut pictures = Vec::new();
        for neighbour in answer.global.iter().take(SHOWN) {
            let item = &dataset.database[neighbour.index];
            let class = outline(&dataset.truth[answer.query], neighbour.index);
            let caption = format!("distance {:.3}", neighbour.distance);
            pictures.push(self.thumbnail(item, class, &caption)?);
        }
        Ok(joined(pictures))
    }

    /// The best places by S.
    fn best(&self, dataset: &Dataset, answer: &Answer) -> Result<Markup, EvalError> {
        let mut pictures = Vec::new();
        for candidate in answer.reranked.iter().take(SHOWN) {
            let item = &dataset.database[candidate.index];
            let class = outline(&dataset.truth[answer.query], candidate.index);
            let combinations = candidate.score.combinations.iter();
            let parts: Vec<String> = combinations
                .map(|c| format!("{} {}/{}", c.scales.score_name(), c.inliers, c.matches))
                .collect();
            let score = candidate.score.spatial_score;
            let caption = format!("S = {score} ({})", parts.join(", "));
            pictures.push(self.thumbnail(item, class, &caption)?);
        }
        Ok(joined(pictures))
    }

    /// The first positive that can be read. Images that could not be read took no part, but the
    /// truth still names them.
    fn right_answer(&self, dataset: &Dataset, truth: &Truth) -> Result<Markup, EvalError> {
        let mut first_reason = None;
        for &positive in truth.positives() {
            let item = &dataset.database[positive];
            match open(item, self.limits) {
                Ok(image) => return picture_of(item, &image, "right", "a right answer"),
                Err(error) => {
                    first_reason.get_or_insert(format!("{}: {error}", item.name));
                }
            }
        }
        Ok(match first_reason {
            Some(reason) => placeholder("no right answer could be read", &reason),
            None => html! {},
        })
    }

    fn thumbnail(&self, item: &Item, class: &str, caption: &str) -> Result<Markup, EvalError> {
        match open(item, self.limits) {
            Ok(image) => picture_of(item, &image, class, caption),
            // It was readable when it was described: a long run may outlive its images.
            Err(error) => Ok(placeholder(caption, &format!("{}: {error}", item.name))),
        }
    }

    fn evidence(&self, query: &Item, reference: &Item) -> Result<Markup, EvalError> {
        let shown = match (read(query), read(reference)) {
            (Ok(query_bytes), Ok(reference_bytes)) => {
                let uri = self.match_uri(&query_bytes, &reference_bytes)?;
                let alt = format!("inliers between {} and {}", query.name, reference.name);
                html! {
                    figure {
                        img loading="lazy" alt=(alt) src=(uri);
                        figcaption {
                            "Attention with the key patches of the three scales, then the inliers \
                             of each combination."
                        }
                    }
                }
            }
            (Err(error), _) | (_, Err(error)) => {
                placeholder("no longer readable", &error.to_string())
            }
        };
        Ok(html! {
            h3 { "What the key patches saw: query left, best answer right" }
            (shown)
        })
    }

    /// The picture of a match, as a URI that holds it.
    fn match_uri(&self, query: &[u8], reference: &[u8]) -> Result<String, EvalError> {
        let query = Seen::new(self.extractor, self.limits, query)?;
        let reference = Seen::new(self.extractor, self.limits, reference)?;
        let matches = self.reranker.explain(&query.patches, &reference.patches);
        let drawn = picture(&query, &reference, &matches)?;
        Ok(jpeg_data_uri(&thumbnail(&drawn, PICTURE_PX)?, QUALITY)?)
    }
}

fn joined(parts: Vec<Markup>) -> Markup {
    PreEscaped(parts.into_iter().map(PreEscaped::into_string).collect())
}

fn picture_of(
    item: &Item,
    image: &RgbImage,
    class: &str,
    caption: &str,
) -> Result<Markup, EvalError> {
    let uri = jpeg_data_uri(&thumbnail(image, THUMBNAIL_PX)?, QUALITY)?;
    Ok(html! {
        figure {
            img class=(class) loading="lazy" alt=(item.name) src=(uri);
            figcaption { (caption) br; span.soft { (item.name) } }
        }
    })
}

/// What stands where a picture would.
fn placeholder(caption: &str, reason: &str) -> Markup {
    html! {
        figure {
            figcaption { (caption) br; span.soft { (reason) } }
        }
    }
}

fn open(item: &Item, limits: &ImageConfig) -> Result<RgbImage, EvalError> {
    Ok(decode(&read(item)?, limits)?)
}

/// The class that outlines a picture by whether it answers the query.
fn outline(truth: &Truth, index: usize) -> &'static str {
    if truth.positives().binary_search(&index).is_ok() {
        "right"
    } else {
        "wrong"
    }
}

fn read(item: &Item) -> Result<Vec<u8>, EvalError> {
    std::fs::read(&item.path).map_err(EvalError::io(&item.path))
}
