//! Where things are on the Earth: positions, headings, UTM zones, and image names that carry them.

mod named_position;
mod position;
mod utm_name;
mod utm_zone;

pub use named_position::NamedPosition;
pub use position::{Altitude, GeoCircle, GeoPoint, Heading};
pub use utm_name::UtmName;
pub use utm_zone::{MetricPoint, UtmZone};
