//! Times of cameras and receivers, sound and not.

use super::writer::{Exif, Value};
use crate::image::exif::{
    DATE_TIME_DIGITIZED, OFFSET_TIME, OFFSET_TIME_DIGITIZED, SUBSEC_TIME, SUBSEC_TIME_ORIGINAL,
};
use placeformer_core::types::Timestamp;
use time::OffsetDateTime;
use time::macros::datetime;

fn time(exif: &Exif) -> Option<OffsetDateTime> {
    let info = exif.read();
    assert_eq!(
        info.captured_at.is_some(),
        info.sources.captured_at.is_some()
    );
    info.captured_at.map(Timestamp::instant)
}

fn local(text: &'static str) -> Exif {
    Exif::default().time(text)
}

#[test]
fn offsets_and_fractions_are_found_wherever_they_stand() {
    let at = datetime!(2026-03-01 12:30:05 UTC);
    let exact = datetime!(2026-03-01 12:30:05.847 UTC);
    for (exif, expected) in [
        (local("2026:03:01 14:30:05+02:00"), at),
        (local("2026:03:01 12:30:05Z"), at),
        (local("2026-03-01T14:30:05+0200"), at),
        (local("2026:03:01 14:30:05.847+02:00"), exact),
        (local("2026:03:01 14:30:05").offset("+02:00"), at),
        (
            local("2026:03:01 14:30:05").exif(OFFSET_TIME, Value::Text("+02:00")),
            at,
        ),
        (
            local("2026:03:01 14:30:05")
                .exif(OFFSET_TIME, Value::Text("+09:00"))
                .offset("+02:00"),
            at,
        ),
        (
            local("2026:03:01 14:30:05")
                .offset("   :  ")
                .exif(OFFSET_TIME, Value::Text("+02:00")),
            at,
        ),
        (
            local("2026:03:01 14:30:05")
                .offset("+02:00")
                .exif(SUBSEC_TIME_ORIGINAL, Value::Text("847")),
            exact,
        ),
        (
            local("2026:03:01 14:30:05")
                .offset("+02:00")
                .exif(SUBSEC_TIME, Value::Text("847 ")),
            exact,
        ),
        (
            local("0000:00:00 00:00:00")
                .exif(DATE_TIME_DIGITIZED, Value::Text("2026:03:01 14:30:05"))
                .exif(OFFSET_TIME_DIGITIZED, Value::Text("+02:00")),
            at,
        ),
    ] {
        assert_eq!(time(&exif), Some(expected), "{exif:?}");
        assert_eq!(exif.read().local_time, None);
    }
}

#[test]
fn without_an_offset_the_receiver_knows_better() {
    let without = local("2026:03:01 14:30:05");
    assert_eq!(time(&without), Some(datetime!(2026-03-01 14:30:05 UTC)));
    assert_eq!(
        without.read().local_time,
        Some(datetime!(2026-03-01 14:30:05))
    );
    let both = without.clone().gps_time("2026:03:01", [12, 30, 6]);
    assert_eq!(time(&both), Some(datetime!(2026-03-01 12:30:06 UTC)));
    assert_eq!(both.read().local_time, None);
    let offset = both.offset("+03:00");
    assert_eq!(time(&offset), Some(datetime!(2026-03-01 11:30:05 UTC)));
    let void = without
        .gps_time("2026:03:01", [12, 30, 6])
        .gps(9, Value::Text("V"));
    assert_eq!(time(&void), Some(datetime!(2026-03-01 14:30:05 UTC)));
    let fraction = vec![(12, 1), (30, 1), (6847, 1000)];
    let fraction = Exif::default()
        .gps_time("2026:03:01", [0, 0, 0])
        .gps(7, Value::Rational(fraction));
    assert_eq!(
        time(&fraction),
        Some(datetime!(2026-03-01 12:30:06.847 UTC))
    );
}

#[test]
fn a_receiver_without_a_date_loses_against_a_sound_clock() {
    let clock = datetime!(2026-03-01 14:30:05 UTC);
    for date in [
        "1970:01:01",
        "1980:01:06",
        "1980:01:07",
        // 1024 and 2048 weeks before.
        "2006:07:16",
        "1986:11:30",
        // 1024 weeks later.
        "2045:10:15",
        // The days on which the number of the week began again.
        "1999:08:22",
        "2019:04:07",
        "0000:00:00",
    ] {
        let exif = local("2026:03:01 14:30:05").gps_time(date, [12, 30, 6]);
        assert_eq!(time(&exif), Some(clock), "{date}");
    }
    // A receiver's own date is right where it is only the clock that is off.
    let exif = local("2025:12:24 14:30:05").gps_time("2026:03:01", [12, 30, 6]);
    assert_eq!(time(&exif), Some(datetime!(2026-03-01 12:30:06 UTC)));
    let exif = local("1970:01:01 00:00:00").gps_time("2026:03:01", [12, 30, 6]);
    assert_eq!(time(&exif), Some(datetime!(2026-03-01 12:30:06 UTC)));
    let exif = local("1970:01:01 00:00:00+00:00").gps_time("2026:03:01", [12, 30, 6]);
    assert_eq!(time(&exif), Some(datetime!(2026-03-01 12:30:06 UTC)));
    let epoch = Exif::default().gps_time("1980:01:06", [0, 0, 0]);
    assert_eq!(time(&epoch), None);
    // A print from before there were receivers.
    assert_eq!(time(&local("1962:07:01 12:00:00")).unwrap().year(), 1962);
}

#[test]
fn no_year_is_beyond_what_text_can_hold() {
    for exif in [
        local("9999:12:31 23:00:00").offset("-02:00"),
        local("0001:01:01 00:30:00").offset("+02:00"),
        local("0000:01:01 00:30:00"),
        Exif::default().gps_time("9999:12:31", [24, 0, 0]),
        Exif::default().gps_time("2026:03:01", [12, 60, 0]),
    ] {
        assert_eq!(time(&exif), None, "{exif:?}");
    }
    assert!(time(&local("9999:12:31 23:59:59")).is_some());
}
