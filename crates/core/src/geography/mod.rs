//! Where things are on the Earth: positions, headings, UTM zones, and image names that carry them.

mod position;
mod named_position;
mod utm_name;
mod utm_zone;

pub use position::{GeoCircle, GeoPoint, Heading};
pub use named_position::NamedPosition;
pub use utm_name::UtmName;
pub use utm_zone::{MetricPoint, UtmZone};
