//! The drawn town as a person knows it: places by number, and a small map of what was asked.

use super::report::Asked;
use maud::{Markup, html};
use placeformer_core::geography::{MetricPoint, UtmName};

/// Width of the map; its height follows the town's shape.
const WIDTH: f64 = 460.0;

/// Room around the outermost places.
const MARGIN: f64 = 16.0;

/// `place 12, view 1` for a photo of the town, whose name has `p000012v1` among its fields; any
/// other name as it is.
pub(super) fn place_and_view(name: &str) -> String {
    let Ok(parts) = UtmName::parse(name) else {
        return name.to_owned();
    };
    numbers_of(&parts.pano_id).map_or(parts.pano_id, |(place, view)| {
        format!("place {place}, view {view}")
    })
}

/// The numbers in `p000012v1`. Views are counted from one.
fn numbers_of(id: &str) -> Option<(u64, u64)> {
    let (place, view) = id.strip_prefix('p')?.split_once('v')?;
    let view: u64 = view.parse().ok()?;
    Some((place.parse().ok()?, view + 1))
}

/// What the map shows of a query.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Mark {
    /// Found where it was taken.
    Right,
    /// Taken for another place.
    Wrong,
    /// Its place is not mapped, so that no answer is right.
    Unmapped,
}

impl Mark {
    /// Class of the style sheet, and the words of the legend.
    fn style(self) -> (&'static str, &'static str) {
        match self {
            Self::Right => ("c", "found"),
            Self::Wrong => ("b", "taken for another place"),
            Self::Unmapped => ("muted", "asked from a place that is not mapped"),
        }
    }
}

/// From metres to the map.
struct Frame {
    west: f64,
    north: f64,
    scale: f64,
    height: f64,
}

impl Frame {
    /// A frame around these points; `None` without any.
    fn around(points: &[MetricPoint]) -> Option<Self> {
        let first = points.first()?;
        let mut low = *first;
        let mut high = *first;
        for point in points {
            low.east = low.east.min(point.east);
            low.north = low.north.min(point.north);
            high.east = high.east.max(point.east);
            high.north = high.north.max(point.north);
        }
        let across = (high.east - low.east).max(1.0);
        let scale = (WIDTH - 2.0 * MARGIN) / across;
        Some(Self {
            west: low.east,
            north: high.north,
            scale,
            height: (high.north - low.north) * scale + 2.0 * MARGIN,
        })
    }

    fn x(&self, point: MetricPoint) -> String {
        format!("{:.1}", MARGIN + (point.east - self.west) * self.scale)
    }

    fn y(&self, point: MetricPoint) -> String {
        format!("{:.1}", MARGIN + (self.north - point.north) * self.scale)
    }
}

/// The town with its mapped photos, and what became of each query. Nothing if the names have no
/// positions.
pub(super) fn map(references: &[String], asked: &[Asked]) -> Markup {
    let position = |name: &str| UtmName::parse(name).ok().map(|parts| parts.point);
    let mapped: Vec<MetricPoint> = references
        .iter()
        .filter_map(|name| position(name))
        .collect();
    let mut marks = Vec::new();
    for one in asked {
        if let Some(point) = position(&one.query) {
            marks.push((point, one));
        }
    }
    let mut all = mapped.clone();
    all.extend(marks.iter().map(|(point, _)| *point));
    let Some(frame) = Frame::around(&all) else {
        return html! {};
    };
    let view_box = format!("0 0 {WIDTH} {:.0}", frame.height);
    html! {
        figure.map {
            svg.plot viewBox=(view_box) role="img" aria-label="The town from above" {
                @for point in &mapped {
                    circle cx=(frame.x(*point)) cy=(frame.y(*point)) r="2.5" class="key a" {}
                }
                @for (point, one) in &marks {
                    (query_mark(&frame, *point, one))
                }
            }
            figcaption { (legend()) }
        }
    }
}

/// A ring around a query, which says what became of it to whoever points at it.
fn query_mark(frame: &Frame, point: MetricPoint, one: &Asked) -> Markup {
    let (class, words) = one.mark().style();
    html! {
        circle cx=(frame.x(point)) cy=(frame.y(point)) r="6" class=(format!("line {class}")) {
            title { (place_and_view(&one.query)) ": " (words) }
        }
    }
}

/// The colours in words.
fn legend() -> Markup {
    html! {
        "The town from above. Dots are mapped photos; rings are queries: "
        @for (index, mark) in [Mark::Right, Mark::Wrong, Mark::Unmapped].into_iter().enumerate() {
            @if index > 0 { ", " }
            svg width="14" height="14" aria-hidden="true" {
                circle cx="7" cy="7" r="5" class=(format!("line {}", mark.style().0)) {}
            }
            " " (mark.style().1)
        }
        "."
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const NAME: &str = "@359666.47@5651730.78@32@U@51.0@6.9@p000012v1@@128.0@@@@20260504@dusk@.jpg";

    #[test]
    fn photos_are_named_as_a_person_would() {
        assert_eq!(place_and_view(NAME), "place 12, view 2");
        let other = NAME.replace("p000012v1", "frame7");
        assert_eq!(place_and_view(&other), "frame7");
        assert_eq!(place_and_view("harbour.jpg"), "harbour.jpg");
    }

    #[test]
    fn the_map_keeps_the_shape_of_the_town() {
        let at = |east: f64, north: f64| MetricPoint { east, north };
        let corners = [at(100.0, 1000.0), at(528.0, 1107.0)];
        let frame = Frame::around(&corners).unwrap();
        // 428 metres across fill what the margins leave, and north is above.
        assert_eq!(
            (frame.x(corners[0]), frame.y(corners[0])),
            ("16.0".into(), "123.0".into())
        );
        assert_eq!(
            (frame.x(corners[1]), frame.y(corners[1])),
            ("444.0".into(), "16.0".into())
        );
        assert_eq!(frame.height, 139.0);
        assert!(Frame::around(&[]).is_none());
    }
}
