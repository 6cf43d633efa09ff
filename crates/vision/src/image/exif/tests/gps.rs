//! Positions and headings as receivers of all kinds write them.

use super::writer::{Exif, Value};

fn at(lat: (&'static str, Value), lon: (&'static str, Value)) -> Exif {
    Exif::default()
        .gps(1, Value::Text(lat.0))
        .gps(2, lat.1)
        .gps(3, Value::Text(lon.0))
        .gps(4, lon.1)
}

/// The position that is read, rounded to the last digits of the tests.
fn place(exif: &Exif) -> Option<(f64, f64)> {
    let round = |degrees: f64| (degrees * 1e5).round() / 1e5;
    let location = exif.read().location?;
    Some((round(location.lat()), round(location.lon())))
}

fn thirds(parts: [i32; 3]) -> Value {
    Value::SignedRational(parts.map(|part| (part, 1)).to_vec())
}

#[test]
fn numbers_of_every_type_are_read() {
    let sydney = Some((-33.85833, 151.21));
    let lon = Value::Rational(vec![(151, 1), (12, 1), (36, 1)]);
    for lat in [
        Value::Rational(vec![(33, 1), (51, 1), (3000, 100)]),
        Value::Rational(vec![(33, 1), (515, 10), (0, 1)]),
        Value::Rational(vec![(33, 1), (515, 10)]),
        Value::Rational(vec![(33, 1), (515, 10), (0, 0)]),
        Value::Rational(vec![(338_583_333, 10_000_000)]),
        thirds([33, 51, 30]),
        thirds([-33, 51, 30]),
        Value::Double(vec![33.0, 51.0, 30.0]),
        Value::Double(vec![33.858_333]),
        Value::Float(vec![33.0, 51.5, 0.0]),
        Value::Short(vec![33, 51, 30]),
        Value::Long(vec![33, 51, 30]),
        Value::Byte(vec![33, 51, 30]),
    ] {
        let exif = at(("S", lat.clone()), ("E", lon.clone()));
        assert_eq!(place(&exif), sydney, "{lat:?}");
    }
}

#[test]
fn the_reference_gives_the_sign_as_it_does_for_exiftool() {
    let lat = thirds([33, 51, 30]);
    let lon = thirds([70, 30, 0]);
    for (lat_ref, lon_ref, expected) in [
        ("S", "W", (-33.85833, -70.5)),
        ("s", "w", (-33.85833, -70.5)),
        ("South", " West", (-33.85833, -70.5)),
        ("N", "E", (33.85833, 70.5)),
        ("n", "e", (33.85833, 70.5)),
    ] {
        let exif = at((lat_ref, lat.clone()), (lon_ref, lon.clone()));
        assert_eq!(place(&exif), Some(expected), "{lat_ref} {lon_ref}");
        let negative = at(
            (lat_ref, thirds([-33, 51, 30])),
            (lon_ref, thirds([-70, 30, 0])),
        );
        assert_eq!(place(&negative), Some(expected), "{lat_ref} {lon_ref}");
    }
}

#[test]
fn an_unknown_hemisphere_is_no_position_unless_the_numbers_are_signed() {
    let plain = (thirds([33, 51, 30]), thirds([70, 30, 0]));
    let signed = (thirds([-33, 51, 30]), thirds([70, 30, 0]));
    for unknown in ["", "?", " ", "0", "E?"] {
        let exif = |(lat, lon): &(Value, Value)| at((unknown, lat.clone()), ("", lon.clone()));
        assert_eq!(place(&exif(&plain)), None, "{unknown:?}");
        assert_eq!(
            place(&exif(&signed)),
            Some((-33.85833, 70.5)),
            "{unknown:?}"
        );
    }
    let missing = |(lat, lon): (Value, Value)| Exif::default().gps(2, lat).gps(4, lon);
    assert_eq!(place(&missing(plain.clone())), None);
    assert_eq!(place(&missing(signed)), Some((-33.85833, 70.5)));
    let half = at(("S", plain.0), ("", plain.1));
    assert_eq!(place(&half), None);
}

#[test]
fn zero_is_a_place_only_if_something_says_so() {
    let zero = || Value::Rational(vec![(0, 1), (0, 1), (0, 1)]);
    let ten = || Value::Rational(vec![(10, 1)]);
    let null_island = at(("N", zero()), ("E", zero()));
    assert_eq!(place(&null_island), None);
    assert_eq!(place(&at(("S", zero()), ("W", zero()))), None);
    assert_eq!(place(&at(("N", ten()), ("E", zero()))), Some((10.0, 0.0)));
    assert_eq!(place(&at(("N", zero()), ("W", ten()))), Some((0.0, -10.0)));
    for (tag, value) in [
        (9, Value::Text("A")),
        (10, Value::Text("3")),
        (11, Value::Rational(vec![(12, 10)])),
        (8, Value::Text("05")),
    ] {
        let fixed = null_island.clone().gps(tag, value);
        assert_eq!(place(&fixed), Some((0.0, 0.0)), "{tag}");
    }
    for (tag, value) in [
        (11, Value::Rational(vec![(0, 0)])),
        (8, Value::Text("00")),
        (10, Value::Text("0")),
    ] {
        let unmeasured = null_island.clone().gps(tag, value);
        assert_eq!(place(&unmeasured), None, "{tag}");
    }
}

#[test]
fn a_void_fix_is_no_position() {
    for status in ["V", "v", "Void"] {
        let exif = Exif::paris().heading(90.0).gps(9, Value::Text(status));
        assert_eq!(place(&exif), None);
        assert_eq!(exif.read().heading.unwrap().degrees(), 90.0);
    }
    assert!(place(&Exif::paris().gps(9, Value::Text("A"))).is_some());
}

#[test]
fn what_cannot_be_a_position_is_none() {
    let paris = Exif::paris();
    for (tag, value) in [
        (2, Value::Rational(vec![(95, 1), (0, 1), (0, 1)])),
        (4, Value::Rational(vec![(181, 1)])),
        (2, Value::Rational(vec![(0, 0), (51, 1), (0, 1)])),
        (2, Value::Rational(vec![(48, 1), (51, 0), (0, 1)])),
        (2, Value::Double(vec![f64::NAN])),
        (2, Value::Double(vec![f64::INFINITY])),
        (2, Value::Rational(vec![])),
        (2, Value::Text("48")),
    ] {
        assert_eq!(place(&paris.clone().gps(tag, value)), None, "{tag}");
    }
}

#[test]
fn headings_of_every_type_are_read() {
    let heading = |value: Value| {
        let info = Exif::default().gps(17, value).read();
        info.heading.map(|heading| heading.degrees())
    };
    for (value, expected) in [
        (Value::Rational(vec![(2705, 10)]), Some(270.5)),
        (Value::SignedRational(vec![(2705, 10)]), Some(270.5)),
        (Value::SignedRational(vec![(-90, 1)]), Some(270.0)),
        (Value::Short(vec![270]), Some(270.0)),
        (Value::Long(vec![360]), Some(0.0)),
        (Value::Double(vec![270.5]), Some(270.5)),
        (Value::Float(vec![270.5]), Some(270.5)),
        (Value::Rational(vec![(1, 0)]), None),
        (Value::Rational(vec![(0, 0)]), None),
        (Value::Rational(vec![(361, 1)]), None),
        (Value::Double(vec![f64::NAN]), None),
        (Value::Text("270"), None),
    ] {
        assert_eq!(heading(value.clone()), expected, "{value:?}");
    }
}

#[test]
fn heights_are_read_with_their_references() {
    let here = || at(("N", thirds([48, 51, 30])), ("E", thirds([2, 17, 40])));
    let metres = |exif: Exif| exif.read().alt.map(|alt| alt.metres());
    let height = |text: (i32, i32)| Value::SignedRational(vec![text]);
    for (reference, value, expected) in [
        (None, (1155, 10), Some(115.5)),
        (None, (-7, 2), Some(-3.5)),
        (Some(0), (1155, 10), Some(115.5)),
        (Some(2), (1155, 10), Some(115.5)),
        (Some(1), (7, 2), Some(-3.5)),
        (Some(1), (-7, 2), Some(-3.5)),
        (Some(3), (7, 2), Some(-3.5)),
        (Some(0), (1, 0), None),
        (Some(0), (2_000_000, 1), None),
    ] {
        let mut exif = here().gps(6, height(value));
        if let Some(reference) = reference {
            exif = exif.gps(5, Value::Byte(vec![reference]));
        }
        assert_eq!(metres(exif), expected, "{reference:?} {value:?}");
    }
    let nowhere = Exif::default().gps(6, height((1155, 10)));
    assert_eq!(metres(nowhere), None, "a height without a position");
}
