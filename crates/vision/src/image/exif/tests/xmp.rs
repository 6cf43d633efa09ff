//! The same facts from XMP.

use super::writer::{Container, Exif, Order, Value, jpeg_of};
use crate::image::{ExifInfo, MetadataBlock, read_exif};
use placeformer_core::types::Timestamp;
use proptest::prelude::*;
use time::macros::datetime;

fn packet(properties: &str) -> String {
    format!(
        "<?xpacket begin=\"\u{feff}\" id=\"W5M0MpCehiHzreSzNTczkc9d\"?>\n\
         <x:xmpmeta xmlns:x=\"adobe:ns:meta/\"><rdf:RDF \
         xmlns:rdf=\"http://www.w3.org/1999/02/22-rdf-syntax-ns#\">{properties}</rdf:RDF>\
         </x:xmpmeta><?xpacket end=\"w\"?>"
    )
}

fn attributes(properties: &str) -> String {
    packet(&format!("<rdf:Description rdf:about=\"\" {properties}/>"))
}

fn read(packet: &str) -> ExifInfo {
    let all = Container::ALL.map(|container| read_exif(&container.with_xmp(packet)));
    assert!(all.windows(2).all(|pair| pair[0] == pair[1]), "{all:?}");
    all[0]
}

fn place(packet: &str) -> Option<(f64, f64)> {
    let round = |degrees: f64| (degrees * 1e4).round() / 1e4;
    let location = read(packet).location?;
    Some((round(location.lat()), round(location.lon())))
}

#[test]
fn attributes_and_elements_of_every_writer_are_read() {
    let paris = Some((48.8583, 2.2945));
    for properties in [
        "exif:GPSLatitude=\"48,51.5N\" exif:GPSLongitude=\"2,17.67E\"",
        "exif:GPSLatitude='48,51,30N' exif:GPSLongitude='2,17,40.2E'",
        "drone-dji:GpsLatitude=\"+48.8583\" drone-dji:GpsLongitude=\"+2.2945\"",
        "drone-dji:GpsLatitude=\"48.8583\" drone-dji:GpsLongtitude=\"2.2945\"",
        "xmlns:e=\"http://ns.adobe.com/exif/1.0/\" e:GPSLatitude=\"48,51.5N\" \
         e:GPSLongitude=\"2,17.67E\"",
    ] {
        assert_eq!(place(&attributes(properties)), paris, "{properties}");
    }
    let elements = "<rdf:Description><exif:GPSLatitude> 48,51.5N\n</exif:GPSLatitude>\
                    <exif:GPSLongitude>2,17.67E</exif:GPSLongitude>\
                    <exif:GPSImgDirection>2705/10</exif:GPSImgDirection></rdf:Description>";
    let info = read(&packet(elements));
    assert_eq!(place(&packet(elements)), paris);
    assert_eq!(info.heading.unwrap().degrees(), 270.5);
    assert_eq!(info.sources.heading, Some(MetadataBlock::Xmp));
    let west = "exif:GPSLatitude=\"33,51.5s\" exif:GPSLongitude=\"70,30w\"";
    assert_eq!(place(&attributes(west)), Some((-33.8583, -70.5)));
    let signed = "exif:GPSLatitude=\"-33.8583\" exif:GPSLongitude=\"151.21\"";
    assert_eq!(place(&attributes(signed)), Some((-33.8583, 151.21)));
}

#[test]
fn what_is_no_position_is_none() {
    for properties in [
        "exif:GPSLatitude=\"48,51.5\" exif:GPSLongitude=\"2,17.67\"",
        "exif:GPSLatitude=\"95N\" exif:GPSLongitude=\"2E\"",
        "exif:GPSLatitude=\"N\" exif:GPSLongitude=\"E\"",
        "exif:GPSLatitude=\"NaNN\" exif:GPSLongitude=\"2E\"",
        "exif:GPSLatitude=\"48N\"",
        "drone-dji:GpsLatitude=\"0.000000\" drone-dji:GpsLongitude=\"0.000000\"",
        "drone-dji:GpsLatitude=\"inf\" drone-dji:GpsLongitude=\"2\"",
        "exif:GPSLatitude=\"48N\" exif:GPSLongitude=\"2E\" exif:GPSStatus=\"V\"",
        "xmlns:exif=\"http://ns.adobe.com/exif/1.0/\" other:GPSLatitude=\"48N\" \
         other:GPSLongitude=\"2E\"",
    ] {
        assert_eq!(
            read(&attributes(properties)),
            ExifInfo::default(),
            "{properties}"
        );
    }
}

#[test]
fn headings_of_drones_and_panoramas_are_read() {
    let heading = |properties: &str| {
        let heading = read(&attributes(properties)).heading;
        heading.map(|heading| heading.degrees())
    };
    assert_eq!(heading("drone-dji:GimbalYawDegree=\"-90.5\""), Some(269.5));
    assert_eq!(heading("drone-dji:FlightYawDegree=\"+12.5\""), Some(12.5));
    let both = "drone-dji:FlightYawDegree=\"+1\" drone-dji:GimbalYawDegree=\"+2\"";
    assert_eq!(heading(both), Some(2.0));
    assert_eq!(heading("GPano:PoseHeadingDegrees=\"350.0\""), Some(350.0));
    assert_eq!(heading("GPano:PoseHeadingDegrees=\"1/0\""), None);
}

#[test]
fn times_are_read() {
    let time = |properties: &str| {
        let info = read(&attributes(properties));
        info.captured_at.map(Timestamp::instant)
    };
    let at = datetime!(2026-03-01 12:30:05.847 UTC);
    assert_eq!(
        time("exif:DateTimeOriginal=\"2026-03-01T14:30:05.847+02:00\""),
        Some(at)
    );
    let several = "xmp:CreateDate=\"1999-01-01T00:00:00Z\" \
                   photoshop:DateCreated=\"2026-03-01T14:30:05.847+02:00\"";
    assert_eq!(time(several), Some(at));
    assert_eq!(time("xmp:CreateDate=\"2026-03-01\""), None);
}

#[test]
fn exif_comes_before_xmp_field_by_field() {
    let properties = "exif:GPSLatitude=\"10N\" exif:GPSLongitude=\"20E\" \
                      GPano:PoseHeadingDegrees=\"45\" xmp:CreateDate=\"1999-01-01T00:00:00Z\"";
    let xmp = attributes(properties);
    let with = |exif: Exif| {
        read_exif(&jpeg_of(&[
            (b"Exif\0\0", &exif.write(Order::Big)),
            (b"http://ns.adobe.com/xap/1.0/\0", xmp.as_bytes()),
        ]))
    };
    let info = with(Exif::paris().time("2026:03:01 14:30:05"));
    assert!((info.location.unwrap().lat() - 48.8584).abs() < 1e-6);
    assert_eq!(info.captured_at.unwrap().instant().year(), 2026);
    assert_eq!(info.heading.unwrap().degrees(), 45.0);
    assert_eq!(info.sources.location, Some(MetadataBlock::Exif));
    assert_eq!(info.sources.captured_at, Some(MetadataBlock::Exif));
    assert_eq!(info.sources.heading, Some(MetadataBlock::Xmp));
    let info = with(Exif::default());
    assert_eq!(info.location.unwrap().lat(), 10.0);
    // A copy of what the receiver calls void is void, too.
    let info = with(Exif::paris().gps(9, Value::Text("V")));
    assert_eq!(info.location, None);
}

#[test]
fn hostile_packets_cost_a_walk() {
    let facts = "exif:GPSLatitude=\"48N\" exif:GPSLongitude=\"2E\"";
    let entities = "<!DOCTYPE x [<!ENTITY a \"lol\"><!ENTITY b \"&a;&a;&a;&a;\">]>&b;";
    let deep = "<a>".repeat(20_000);
    let wide = (0..5_000).map(|index| format!("a{}=\"\" ", index % 7));
    let wide = format!("<rdf:Description {} {facts}/>", wide.collect::<String>());
    assert_eq!(place(&attributes(facts)), Some((48.0, 2.0)));
    assert_eq!(
        place(&format!("{entities}{}", attributes(facts))),
        Some((48.0, 2.0))
    );
    assert_eq!(place(&wide), Some((48.0, 2.0)));
    assert_eq!(place(&deep), None);
    // Padding before the facts hides them in a file that can hold so much.
    let far = format!("{}{}", " ".repeat(70_000), attributes(facts));
    for container in [Container::Png, Container::WebP] {
        assert_eq!(read_exif(&container.with_xmp(&far)), ExifInfo::default());
    }
    // A compressed text is passed over.
    let mut compressed = Container::Png.with_xmp(&attributes(facts));
    let keyword = b"XML:com.adobe.xmp\0";
    let at = compressed
        .windows(keyword.len())
        .position(|part| part == keyword);
    compressed[at.unwrap() + keyword.len()] = 1;
    assert_eq!(read_exif(&compressed), ExifInfo::default());
}

proptest! {
    #[test]
    fn any_text_is_read_or_passed_over(text in "[<>/=\"' a-zA-Z:;&!?\\[\\]0-9.,-]{0,200}") {
        for container in Container::ALL {
            let _ = read_exif(&container.with_xmp(&text));
        }
    }
}
