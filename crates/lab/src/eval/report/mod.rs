//! Results for people: text, and a self-contained HTML page.

mod ablation;
mod evaluation;
mod gallery;
mod html;
mod plots;
mod svg;
mod text;

pub use ablation::{ablation_html, ablation_text};
pub use evaluation::html;
pub use gallery::{Painter, gallery};
pub use html::{page, table};
pub use plots::plots;
pub use svg::{Histogram, LineChart, Series};
pub use text::text;
