//! The facts of an XMP block, which is RDF in XML.
//!
//! A property is an attribute of a description or an element of its own; here both are read, and
//! everything around them is passed over. Of a block that is cut off or malformed, what comes
//! before counts. Entities are not expanded, because no value that is used contains any.

use super::block::Blocks;
use super::gps::{Angle, is_null, position};
use placeformer_core::clock::Clock;
use placeformer_core::types::{GeoPoint, Heading};
use quick_xml::Reader;
use quick_xml::events::{BytesStart, Event};
use std::panic::{AssertUnwindSafe, catch_unwind};

/// Longest value that is read.
const MAX_VALUE_BYTES: usize = 64;

/// What the XMP blocks of a photo say.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Xmp {
    pub(super) location: Option<GeoPoint>,
    pub(super) heading: Option<Heading>,
    pub(super) clock: Option<Clock>,
}

/// A property that is used. Of those with the same meaning, the first counts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Property {
    Status,
    /// `48,51.5N`
    Latitude,
    Longitude,
    /// Signed degrees, as drones of DJI write them.
    DroneLatitude,
    DroneLongitude,
    Direction,
    /// Where the camera looked, seen from the ground.
    GimbalYaw,
    /// Where the drone looked, as that of the camera if it has none of its own.
    FlightYaw,
    /// The compass heading of the centre of a panorama.
    PoseHeading,
    DateTimeOriginal,
    DateCreated,
    CreateDate,
}

const PROPERTIES: [(&str, Property); 13] = [
    ("exif:GPSStatus", Property::Status),
    ("exif:GPSLatitude", Property::Latitude),
    ("exif:GPSLongitude", Property::Longitude),
    ("drone-dji:GpsLatitude", Property::DroneLatitude),
    ("drone-dji:GpsLongitude", Property::DroneLongitude),
    // The first drones misspelled it.
    ("drone-dji:GpsLongtitude", Property::DroneLongitude),
    ("exif:GPSImgDirection", Property::Direction),
    ("drone-dji:GimbalYawDegree", Property::GimbalYaw),
    ("drone-dji:FlightYawDegree", Property::FlightYaw),
    ("GPano:PoseHeadingDegrees", Property::PoseHeading),
    ("exif:DateTimeOriginal", Property::DateTimeOriginal),
    ("photoshop:DateCreated", Property::DateCreated),
    ("xmp:CreateDate", Property::CreateDate),
];

/// Namespaces of the prefixes in [`PROPERTIES`], by the beginning of their address. A writer may
/// use another prefix for them.
const NAMESPACES: [(&str, &str); 5] = [
    ("exif", "http://ns.adobe.com/exif/1.0/"),
    ("drone-dji", "http://www.dji.com/drone-dji/"),
    ("GPano", "http://ns.google.com/photos/1.0/panorama/"),
    ("photoshop", "http://ns.adobe.com/photoshop/1.0/"),
    ("xmp", "http://ns.adobe.com/xap/1.0/"),
];

impl Xmp {
    /// The facts of all blocks; of each the first that there is.
    pub(super) fn merged(blocks: &Blocks<'_>) -> Self {
        let facts = blocks.xmp.iter().map(|packet| {
            // If the XML reader panics, the photo itself may still be good.
            catch_unwind(AssertUnwindSafe(|| Values::read(packet).facts())).unwrap_or_default()
        });
        facts.fold(Self::default(), |known, more| Self {
            location: known.location.or(more.location),
            heading: known.heading.or(more.heading),
            clock: known.clock.or(more.clock),
        })
    }
}

/// The properties of a block with their values.
#[derive(Debug, Default)]
struct Values {
    found: Vec<(Property, String)>,
    /// Prefixes that stand for one of [`NAMESPACES`] under another name.
    aliases: Vec<(Vec<u8>, &'static str)>,
}

impl Values {
    fn read(packet: &[u8]) -> Self {
        let mut values = Self::default();
        let mut reader = Reader::from_reader(packet);
        reader.config_mut().check_end_names = false;
        // The property whose element has begun.
        let mut open = None;
        loop {
            match reader.read_event() {
                Ok(Event::Start(element)) => {
                    values.take_attributes(&element);
                    open = values.property(element.name().as_ref());
                }
                Ok(Event::Empty(element)) => {
                    values.take_attributes(&element);
                    open = None;
                }
                Ok(Event::Text(text)) => {
                    if let Some(property) = open {
                        values.add(property, &text);
                    }
                }
                Ok(Event::End(_)) => open = None,
                Ok(Event::Eof) | Err(_) => return values,
                Ok(_) => {}
            }
        }
    }

    fn take_attributes(&mut self, element: &BytesStart<'_>) {
        // Looking for attributes that are there twice would take quadratic time.
        let mut attributes = element.attributes();
        for attribute in attributes.with_checks(false).flatten() {
            if let Some(prefix) = attribute.key.as_ref().strip_prefix(b"xmlns:") {
                self.add_namespace(prefix, &attribute.value);
            }
        }
        let mut attributes = element.attributes();
        for attribute in attributes.with_checks(false).flatten() {
            if let Some(property) = self.property(attribute.key.as_ref()) {
                self.add(property, &attribute.value);
            }
        }
    }

    fn add_namespace(&mut self, prefix: &[u8], address: &[u8]) {
        let named = |(_, known): &&(&str, &str)| address.starts_with(known.as_bytes());
        let Some((usual, _)) = NAMESPACES.iter().find(named) else {
            return;
        };
        let is_usual = prefix == usual.as_bytes();
        if !is_usual && self.aliases.len() < NAMESPACES.len() {
            self.aliases.push((prefix.to_owned(), usual));
        }
    }

    fn property(&self, name: &[u8]) -> Option<Property> {
        let colon = name.iter().position(|&byte| byte == b':')?;
        let (prefix, local) = (&name[..colon], &name[colon + 1..]);
        let alias = self.aliases.iter().find(|(alias, _)| alias == prefix);
        let prefix = alias.map_or(prefix, |(_, usual)| usual.as_bytes());
        let is_named = |known: &str| {
            let (known_prefix, known_local) = known.split_once(':').unwrap_or_default();
            known_prefix.as_bytes() == prefix && known_local.as_bytes() == local
        };
        let found = PROPERTIES.iter().find(|(known, _)| is_named(known));
        found.map(|(_, property)| *property)
    }

    fn add(&mut self, property: Property, value: &[u8]) {
        if value.len() > MAX_VALUE_BYTES || self.text(property).is_some() {
            return;
        }
        let value = String::from_utf8_lossy(value).trim().to_owned();
        if !value.is_empty() {
            self.found.push((property, value));
        }
    }

    fn text(&self, property: Property) -> Option<&str> {
        let found = self.found.iter().find(|(known, _)| *known == property);
        found.map(|(_, value)| value.as_str())
    }

    fn facts(&self) -> Xmp {
        let headings = [
            Property::Direction,
            Property::GimbalYaw,
            Property::FlightYaw,
            Property::PoseHeading,
        ];
        let heading = |property| Heading::new(number(self.text(property)?)?).ok();
        let clocks = [
            Property::DateTimeOriginal,
            Property::DateCreated,
            Property::CreateDate,
        ];
        Xmp {
            location: self.location(),
            heading: headings.into_iter().find_map(heading),
            clock: clocks
                .into_iter()
                .find_map(|property| Clock::parse(self.text(property)?)),
        }
    }

    fn location(&self) -> Option<GeoPoint> {
        let status = self.text(Property::Status);
        if status.is_some_and(|status| status.starts_with(['V', 'v'])) {
            return None;
        }
        let camera = || {
            let lat = angle(self.text(Property::Latitude)?, ['N', 'S'])?;
            position(lat, angle(self.text(Property::Longitude)?, ['E', 'W'])?)
        };
        let drone = || {
            let lat = number(self.text(Property::DroneLatitude)?)?;
            GeoPoint::new(lat, number(self.text(Property::DroneLongitude)?)?).ok()
        };
        camera()
            .filter(|point| !is_null(*point))
            .or_else(|| drone().filter(|point| !is_null(*point)))
    }
}

/// A finite number, or a fraction of two.
fn number(text: &str) -> Option<f64> {
    let value = match text.split_once('/') {
        Some((numerator, denominator)) => {
            numerator.trim().parse::<f64>().ok()? / denominator.trim().parse::<f64>().ok()?
        }
        None => text.parse().ok()?,
    };
    Some(value).filter(|value| value.is_finite())
}

/// `48,51.5N`, `48,51,30N` or `48.858N`; also without a letter.
fn angle(text: &str, [positive, negative]: [char; 2]) -> Option<Angle> {
    let upper = text.to_ascii_uppercase();
    let (numbers, is_negative) = match upper.strip_suffix(negative) {
        Some(numbers) => (numbers, Some(true)),
        None => match upper.strip_suffix(positive) {
            Some(numbers) => (numbers, Some(false)),
            None => (upper.as_str(), None),
        },
    };
    let mut degrees = 0.0;
    let mut unit = 1.0;
    for part in numbers.splitn(3, ',') {
        degrees += number(part.trim())?.abs() * unit;
        unit /= 60.0;
    }
    let is_signed = numbers.trim_start().starts_with('-');
    Some(Angle {
        degrees: if is_signed { -degrees } else { degrees },
        is_negative,
    })
}
