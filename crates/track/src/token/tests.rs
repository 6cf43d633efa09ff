//! Tokens survive their text, and nothing else is one.

use super::*;
use proptest::prelude::*;

fn key(byte: u8) -> TrackKey {
    TrackKey::new(&[byte; 32])
}

fn at(seconds: i64) -> Timestamp {
    Timestamp::from_unix_micros(seconds * 1_000_000).unwrap()
}

fn track(places: usize) -> Track {
    let share = 0.75 / places.max(1) as f64;
    let place = |i: usize| Believed {
        id: ReferenceId::from_bytes((i as u128).to_be_bytes()),
        // A number that survives being halved in length.
        probability: f64::from(share as f32),
    };
    Track {
        map: "harbour".parse().unwrap(),
        model: ModelId::new("dinov2-vits14:747267a07f39:b8:448x336:t1:k400-200-50:h0a81be38658c"),
        issued_at: at(1_700_000_000),
        captured_at: at(1_700_000_001),
        by_client_clock: true,
        frames: 17,
        elsewhere: 0.25,
        places: (0..places).map(place).collect(),
    }
}

#[test]
fn a_track_survives_its_token() {
    for places in [0, 1, 7, 200, MOST_PLACES] {
        let track = track(places);
        let token = track.seal(&key(1));
        assert!(token.len() <= LONGEST_TOKEN, "{}", token.len());
        assert!(
            token
                .bytes()
                .all(|b| b.is_ascii_alphanumeric() || b == b'-' || b == b'_')
        );
        assert_eq!(Track::open(&token, &key(1)).unwrap(), track);
    }
}

#[test]
fn the_longest_names_leave_room_and_what_has_none_is_elsewhere() {
    let mut long = track(5000);
    long.map = "m".repeat(64).parse().unwrap();
    long.model = ModelId::new("x".repeat(10_000));
    let token = long.seal(&key(1));
    assert!(token.len() <= LONGEST_TOKEN, "{}", token.len());
    let read = Track::open(&token, &key(1)).unwrap();
    assert!(read.places.len() >= 200 && read.places.len() <= MOST_PLACES);
    let kept: f64 = read.places.iter().map(|place| place.probability).sum();
    assert!((kept + read.elsewhere - 1.0).abs() < 1e-6);
    let lifetime = Duration::from_secs(1);
    read.check(&long.map, &long.model, at(1_700_000_000), lifetime)
        .unwrap();
}

#[test]
fn a_token_cut_anywhere_is_malformed() {
    let token = track(3).seal(&key(1));
    for end in 0..token.len() {
        let cut = Track::open(&token[..end], &key(1));
        assert!(
            matches!(cut, Err(TokenError::Malformed(_))),
            "{end}: {cut:?}"
        );
    }
    let longer = Track::open(&format!("{token}AAAA"), &key(1));
    assert!(
        matches!(longer, Err(TokenError::Malformed(_))),
        "{longer:?}"
    );
}

#[test]
fn every_changed_byte_and_every_other_key_is_noticed() {
    let token = track(3).seal(&key(1));
    assert_eq!(Track::open(&token, &key(2)), Err(TokenError::Forged));
    let bytes = URL_SAFE_NO_PAD.decode(&token).unwrap();
    for i in 0..bytes.len() {
        let mut changed = bytes.clone();
        changed[i] ^= 1;
        let opened = Track::open(&URL_SAFE_NO_PAD.encode(&changed), &key(1));
        let expected_malformed = i < HEAD_BYTES;
        match opened {
            Err(TokenError::Malformed(_)) => assert!(expected_malformed, "byte {i}"),
            Err(TokenError::Forged) => assert!(!expected_malformed, "byte {i}"),
            other => panic!("byte {i}: {other:?}"),
        }
    }
}

#[test]
fn tracks_of_other_maps_models_and_times_are_told_apart() {
    let track = track(1);
    let lifetime = Duration::from_secs(600);
    let check = |map: &str, model: &str, seconds: i64| {
        let map = map.parse().unwrap();
        track.check(&map, &ModelId::new(model), at(seconds), lifetime)
    };
    let model = track.model.as_str();
    assert_eq!(check("harbour", model, 1_700_000_600), Ok(()));
    assert_eq!(
        check("harbour", model, 1_699_999_000),
        Ok(()),
        "a clock behind"
    );
    let expired = check("harbour", model, 1_700_000_601).unwrap_err();
    assert_eq!(expired.code(), ErrorCode::TrackExpired);
    let other = check("town", model, 1_700_000_000).unwrap_err();
    assert_eq!(other.code(), ErrorCode::TrackOtherMap);
    let other = check("harbour", "another", 1_700_000_000).unwrap_err();
    assert_eq!(other.code(), ErrorCode::TrackOtherModel);
}

proptest! {
    #[test]
    fn no_text_makes_the_reader_panic(text in ".{0,200}", bytes in prop::collection::vec(any::<u8>(), 0..300)) {
        let _ = Track::open(&text, &key(1));
        let _ = Track::open(&URL_SAFE_NO_PAD.encode(&bytes), &key(1));
        // Behind the tag as well.
        let _ = Track::parse(&bytes);
    }
}
