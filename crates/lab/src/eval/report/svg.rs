//! Plots as inline SVG: no script, no external asset; colours come from the page's style sheet, so
//! that they follow the reader's light or dark setting.

use maud::{Markup, PreEscaped, html};
use std::fmt::Write;

const WIDTH: f64 = 460.0;
const HEIGHT: f64 = 300.0;
const LEFT: f64 = 52.0;
const RIGHT: f64 = 14.0;
const TOP: f64 = 16.0;
const BOTTOM: f64 = 46.0;

/// A named line. `class` picks its colour: `a`, `b`, `c` or `muted`.
#[derive(Debug, Clone, PartialEq)]
pub struct Series {
    /// Shown in the legend; empty for none.
    pub name: String,
    /// Colour class.
    pub class: &'static str,
    /// In data coordinates.
    pub points: Vec<(f64, f64)>,
    /// Whether to mark each point.
    pub dots: bool,
}

/// Lines over two axes.
#[derive(Debug, Clone, PartialEq)]
pub struct LineChart {
    /// Read out by screen readers.
    pub title: String,
    /// Below the axis.
    pub x_label: String,
    /// Beside the axis.
    pub y_label: String,
    /// Data range of the horizontal axis.
    pub x_range: (f64, f64),
    /// Data range of the vertical axis.
    pub y_range: (f64, f64),
    /// The lines.
    pub series: Vec<Series>,
}

impl LineChart {
    /// The chart as an `<svg>` element.
    pub fn render(&self) -> Markup {
        let mut canvas = Canvas::new(&self.title, self.x_range, self.y_range);
        canvas.axes(
            &self.x_label,
            &self.y_label,
            &ticks(self.x_range),
            &ticks(self.y_range),
        );
        for series in &self.series {
            canvas.line(series);
        }
        canvas.legend(
            self.series
                .iter()
                .map(|series| (series.name.as_str(), series.class)),
        );
        canvas.finish()
    }
}

/// Counts in bins of equal width, one colour per series, drawn over each other half transparent.
#[derive(Debug, Clone, PartialEq)]
pub struct Histogram {
    /// Read out by screen readers.
    pub title: String,
    /// Below the axis.
    pub x_label: String,
    /// Name, colour class and values of each series.
    pub series: Vec<(String, &'static str, Vec<f64>)>,
    /// Number of bins.
    pub bins: usize,
}

impl Histogram {
    /// The histogram as an `<svg>` element.
    pub fn render(&self) -> Markup {
        let values = self.series.iter().flat_map(|(_, _, values)| values);
        let low = values.clone().copied().fold(0f64, f64::min);
        let high = values.copied().fold(low + 1.0, f64::max);
        let bins = self.bins.max(1);
        let width = (high - low) / bins as f64;
        let count = |values: &[f64]| {
            let mut counts = vec![0usize; bins];
            for value in values {
                counts[(((value - low) / width) as usize).min(bins - 1)] += 1;
            }
            counts
        };
        let counts: Vec<Vec<usize>> = self
            .series
            .iter()
            .map(|(_, _, values)| count(values))
            .collect();
        let top = counts.iter().flatten().copied().max().unwrap_or(0).max(1) as f64;
        let mut canvas = Canvas::new(&self.title, (low, high), (0.0, top));
        canvas.axes(
            &self.x_label,
            "queries",
            &ticks((low, high)),
            &ticks((0.0, top)),
        );
        for ((_, class, _), counts) in self.series.iter().zip(&counts) {
            for (bin, &count) in counts.iter().enumerate().filter(|&(_, &count)| count > 0) {
                let start = low + bin as f64 * width;
                canvas.bar((start, start + width), count as f64, class);
            }
        }
        canvas.legend(
            self.series
                .iter()
                .map(|(name, class, _)| (name.as_str(), *class)),
        );
        canvas.finish()
    }
}

/// Round numbers inside a range, about five of them.
fn ticks((low, high): (f64, f64)) -> Vec<f64> {
    let span = high - low;
    if span.is_nan() || span <= 0.0 {
        return vec![low];
    }
    let rough = span / 5.0;
    let power = 10f64.powf(rough.log10().floor());
    let step = [1.0, 2.0, 2.5, 5.0, 10.0]
        .into_iter()
        .map(|m| m * power)
        .find(|s| *s >= rough - 1e-12)
        .unwrap_or(span);
    let first = (low / step - 1e-9).ceil() as i64;
    let last = (high / step + 1e-9).floor() as i64;
    (first..=last).map(|i| i as f64 * step).collect()
}

/// Text made safe for content and for attributes in double quotes.
fn escaped(text: &str) -> String {
    html! { (text) }.into_string()
}

/// A number without needless digits.
fn short(value: f64) -> String {
    let text = format!("{value:.3}");
    let text = text.trim_end_matches('0').trim_end_matches('.');
    if text == "-0" {
        "0".into()
    } else {
        text.into()
    }
}

/// An `<svg>` element under construction, with the data ranges that its axes show.
struct Canvas {
    svg: String,
    x_range: (f64, f64),
    y_range: (f64, f64),
}

// Writing into a `String` cannot fail, so the results of `write!` below are dropped.
impl Canvas {
    fn new(title: &str, x_range: (f64, f64), y_range: (f64, f64)) -> Self {
        let title = escaped(title);
        let svg = format!(
            "<svg class=\"plot\" viewBox=\"0 0 {WIDTH} {HEIGHT}\" role=\"img\" \
             aria-label=\"{title}\"><title>{title}</title>"
        );
        Self {
            svg,
            x_range,
            y_range,
        }
    }

    fn x(&self, value: f64) -> f64 {
        let (low, high) = self.x_range;
        LEFT + (value - low) / (high - low).max(f64::MIN_POSITIVE) * (WIDTH - LEFT - RIGHT)
    }

    fn y(&self, value: f64) -> f64 {
        let (low, high) = self.y_range;
        HEIGHT
            - BOTTOM
            - (value - low) / (high - low).max(f64::MIN_POSITIVE) * (HEIGHT - TOP - BOTTOM)
    }

    fn axes(&mut self, x_label: &str, y_label: &str, x_ticks: &[f64], y_ticks: &[f64]) {
        let bottom = HEIGHT - BOTTOM;
        let right = WIDTH - RIGHT;
        for &tick in y_ticks {
            let y = self.y(tick);
            let label = short(tick);
            let _ = write!(
                self.svg,
                "<line class=\"grid\" x1=\"{LEFT}\" x2=\"{right}\" y1=\"{y:.1}\" y2=\"{y:.1}\"/>\
                 <text class=\"tick\" x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">{label}</text>",
                LEFT - 6.0,
                y + 4.0
            );
        }
        for &tick in x_ticks {
            let x = self.x(tick);
            let label = short(tick);
            let _ = write!(
                self.svg,
                "<line class=\"grid\" x1=\"{x:.1}\" x2=\"{x:.1}\" y1=\"{bottom}\" y2=\"{:.1}\"/>\
                 <text class=\"tick\" x=\"{x:.1}\" y=\"{:.1}\" \
                 text-anchor=\"middle\">{label}</text>",
                bottom + 4.0,
                bottom + 17.0
            );
        }
        let _ = write!(
            self.svg,
            "<line class=\"axis\" x1=\"{LEFT}\" x2=\"{right}\" y1=\"{bottom}\" y2=\"{bottom}\"/>\
             <text class=\"label\" x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{}</text>\
             <text class=\"label\" transform=\"translate(13 {:.1}) rotate(-90)\" \
             text-anchor=\"middle\">{}</text>",
            (LEFT + right) / 2.0,
            HEIGHT - 10.0,
            escaped(x_label),
            (TOP + bottom) / 2.0,
            escaped(y_label)
        );
    }

    fn line(&mut self, series: &Series) {
        let points: Vec<String> = series
            .points
            .iter()
            .map(|&(x, y)| format!("{:.1},{:.1}", self.x(x), self.y(y)))
            .collect();
        let _ = write!(
            self.svg,
            "<polyline class=\"line {}\" points=\"{}\"/>",
            series.class,
            points.join(" ")
        );
        if series.dots {
            for &(x, y) in &series.points {
                let _ = write!(
                    self.svg,
                    "<circle class=\"dot {}\" cx=\"{:.1}\" cy=\"{:.1}\" r=\"3.5\">\
                     <title>{}: {}</title></circle>",
                    series.class,
                    self.x(x),
                    self.y(y),
                    short(x),
                    short(y)
                );
            }
        }
    }

    fn bar(&mut self, (start, end): (f64, f64), value: f64, class: &str) {
        let left = self.x(start);
        let right = self.x(end);
        let top = self.y(value);
        let bottom = self.y(0.0);
        let _ = write!(
            self.svg,
            "<rect class=\"bar {class}\" x=\"{:.1}\" y=\"{top:.1}\" \
             width=\"{:.1}\" height=\"{:.1}\">\
             <title>{} to {}: {}</title></rect>",
            left + 0.5,
            (right - left - 1.0).max(0.5),
            bottom - top,
            short(start),
            short(end),
            short(value)
        );
    }

    fn legend<'a>(&mut self, names: impl Iterator<Item = (&'a str, &'static str)>) {
        let named = names.filter(|(name, _)| !name.is_empty());
        for (row, (name, class)) in named.enumerate() {
            let y = TOP + 6.0 + 16.0 * row as f64;
            let _ = write!(
                self.svg,
                "<rect class=\"key {class}\" x=\"{:.1}\" y=\"{:.1}\" width=\"10\" height=\"10\"/>\
                 <text class=\"legend\" x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">{}</text>",
                WIDTH - RIGHT - 12.0,
                y - 9.0,
                WIDTH - RIGHT - 18.0,
                y,
                escaped(name)
            );
        }
    }

    fn finish(mut self) -> Markup {
        self.svg.push_str("</svg>");
        PreEscaped(self.svg)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_and_inside() {
        assert_eq!(ticks((0.0, 100.0)), [0.0, 20.0, 40.0, 60.0, 80.0, 100.0]);
        assert_eq!(ticks((0.0, 7.0)), [0.0, 2.0, 4.0, 6.0]);
        assert_eq!(ticks((3.0, 3.0)), [3.0]);
        for (low, high) in [(-3.2, 9.9), (0.0, 1e-3), (0.0, 12345.0)] {
            let ticks = ticks((low, high));
            assert!((2..=7).contains(&ticks.len()), "{ticks:?}");
            assert!(
                ticks.iter().all(|t| (low - 1e-9..=high + 1e-9).contains(t)),
                "{ticks:?}"
            );
        }
    }

    #[test]
    fn ends_of_the_data_lie_on_the_frame() {
        let series = Series {
            name: "<x>".into(),
            class: "a",
            points: vec![(0.0, 0.0), (10.0, 100.0)],
            dots: true,
        };
        let x_label = "k".into();
        let y_label = "%".into();
        let chart = LineChart {
            title: "t \"q\"".into(),
            x_label,
            y_label,
            x_range: (0.0, 10.0),
            y_range: (0.0, 100.0),
            series: vec![series],
        };
        let svg = chart.render().into_string();
        assert!(svg.contains("points=\"52.0,254.0 446.0,16.0\""), "{svg}");
        assert!(
            svg.contains("&lt;x&gt;") && svg.contains("t &quot;q&quot;") && !svg.contains("NaN")
        );
    }

    #[test]
    fn every_value_is_counted_once() {
        let series = vec![
            ("right".to_owned(), "a", vec![0.0, 5.0, 10.0, 10.0]),
            ("none".to_owned(), "b", vec![]),
        ];
        let svg = Histogram {
            title: "S".into(),
            x_label: "S".into(),
            series,
            bins: 2,
        }
        .render()
        .into_string();
        assert_eq!(svg.matches("<rect class=\"bar a\"").count(), 2);
        assert!(
            svg.contains("<title>0 to 5: 1</title>") && svg.contains("<title>5 to 10: 3</title>"),
            "{svg}"
        );
    }
}
