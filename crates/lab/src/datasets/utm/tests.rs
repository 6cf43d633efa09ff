use super::super::{DatasetKind, Truth, load as load_dataset};
use super::*;

fn write(root: &Path, names: &[&str]) {
    for name in names {
        let path = root.join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, b"x").unwrap();
    }
}

#[test]
fn radius_unreadable_names_and_same_names_in_two_folders() {
    let root = tempfile::tempdir().unwrap();
    write(
        root.path(),
        &[
            "images/test/database/2013/@0500000.00@4000000.00@17@T@@@p@00@@@@@@@.jpg",
            "images/test/database/2014/@0500000.00@4000000.00@17@T@@@p@00@@@@@@@.jpg",
            "images/test/database/@0500030.00@4000000.00@17@T@@@q@00@@@@@@@.jpg",
            "images/test/database/cover.jpg",
            "images/test/queries/@0500010.00@4000000.00@17@T@@@a@@@@@@@@.jpg",
            "images/test/queries/@0501000.00@4000000.00@17@T@@@b@@@@@@@@.jpg",
        ],
    );
    let dataset = load_dataset(
        DatasetKind::Pitts30k,
        root.path(),
        &DatasetOptions::default(),
    )
    .unwrap();
    assert_eq!((dataset.database.len(), dataset.queries.len()), (3, 2));
    assert_eq!(
        dataset.truth,
        [Truth::Positives(vec![0, 1, 2]), Truth::NoMatch]
    );
    assert_eq!(dataset.skipped.len(), 1);
    assert!(dataset.notes.is_empty());
}

#[test]
fn images_on_both_sides_of_a_zone_border_are_neighbours() {
    let root = tempfile::tempdir().unwrap();
    // 6 degrees east is the border of zones 31 and 32; the points lie 7 m apart across it.
    let name = |zone: UtmZone, lon: f64| {
        let point = zone.from_geo(placeformer_core::types::GeoPoint::new(48.0, lon).unwrap());
        format!(
            "@{:.2}@{:.2}@{}@U@@@@@@@@@@@.jpg",
            point.east, point.north, zone.number
        )
    };
    let west = name(
        UtmZone {
            number: 31,
            band: 'U',
        },
        5.99995,
    );
    let east = name(
        UtmZone {
            number: 32,
            band: 'U',
        },
        6.00005,
    );
    write(
        root.path(),
        &[
            &format!("images/test/database/{west}"),
            &format!("images/test/queries/{east}"),
        ],
    );
    let dataset = load_dataset(DatasetKind::Utm, root.path(), &DatasetOptions::default()).unwrap();
    assert_eq!(dataset.truth, [Truth::Positives(vec![0])]);
    assert_eq!(dataset.notes.len(), 1);
}

fn name_at(zone: UtmZone, lat: f64, lon: f64, north: f64) -> String {
    let point = zone.from_geo(placeformer_core::types::GeoPoint::new(lat, lon).unwrap());
    format!(
        "@{:.2}@{:.2}@{}@{}@@@@@@@@@@@.jpg",
        point.east,
        point.north + north,
        zone.number,
        zone.band
    )
}

#[test]
fn far_zones_keep_their_metres_and_never_meet() {
    let root = tempfile::tempdir().unwrap();
    let copenhagen = UtmZone {
        number: 33,
        band: 'U',
    };
    let francisco = UtmZone {
        number: 10,
        band: 'S',
    };
    let names = [
        format!(
            "images/val/database/{}",
            name_at(copenhagen, 55.67, 12.57, 0.0)
        ),
        format!(
            "images/val/database/{}",
            name_at(francisco, 37.77, -122.42, 0.0)
        ),
        format!(
            "images/val/queries/{}",
            name_at(copenhagen, 55.67, 12.57, 20.0)
        ),
        format!(
            "images/val/queries/{}",
            name_at(francisco, 37.77, -122.42, 20.0)
        ),
        // Copenhagen's coordinates under San Francisco's number.
        format!(
            "images/val/queries/{}",
            name_at(copenhagen, 55.67, 12.57, 0.0).replace("@33@U", "@10@S")
        ),
    ];
    write(root.path(), &names.each_ref().map(String::as_str));
    let options = DatasetOptions {
        split: Some(Split::Val),
        ..Default::default()
    };
    let dataset = load_dataset(DatasetKind::MslsVal, root.path(), &options).unwrap();
    for (query, truth) in dataset.queries.iter().zip(&dataset.truth) {
        let expected: Vec<usize> = (0..2)
            .filter(|&index| {
                let a = dataset.database[index].position.unwrap();
                let b = query.position.unwrap();
                let same = dataset.database[index].group == query.group;
                same && (a.east - b.east).hypot(a.north - b.north) < 25.0
            })
            .collect();
        assert_eq!(*truth, Truth::from_positives(expected), "{}", query.name);
    }
    assert_eq!(
        dataset
            .truth
            .iter()
            .filter(|truth| !truth.positives().is_empty())
            .count(),
        2
    );
    let groups: std::collections::BTreeSet<_> =
        dataset.queries.iter().map(|q| q.group.as_deref()).collect();
    assert_eq!(
        groups.into_iter().collect::<Vec<_>>(),
        [Some("zone 10 north"), Some("zone 33 north")]
    );
}

#[test]
fn splits_are_found_without_an_images_folder_and_missing_view_angles_are_counted() {
    let root = tempfile::tempdir().unwrap();
    let at = |heading: &str| format!("@0500000.00@4000000.00@17@T@@@@@{heading}@@@@@@.jpg");
    write(
        root.path(),
        &[
            &format!("val/database/{}", at("010")),
            &format!("val/queries/{}", at("020")),
            &format!("val/queries/{}", at("")),
            &format!("train/database/{}", at("200")),
            &format!("train/queries/{}", at("020")),
        ],
    );
    let load = |split| {
        let options = DatasetOptions {
            split: Some(split),
            ..Default::default()
        };
        load_dataset(DatasetKind::MslsVal, root.path(), &options).unwrap()
    };
    let val = load(Split::Val);
    assert_eq!(
        val.truth,
        [Truth::Positives(vec![0]), Truth::Positives(vec![0])]
    );
    assert!(
        val.notes
            .iter()
            .any(|note| note.contains("1 images have no view angle")),
        "{:?}",
        val.notes
    );
    let train = load(Split::Train);
    assert_eq!(train.truth, [Truth::NoMatch]);
    assert!(
        !train
            .notes
            .iter()
            .any(|note| note.contains("no view angle")),
        "{:?}",
        train.notes
    );
}

#[test]
fn names_without_a_zone_belong_to_the_only_plane_or_to_none() {
    let root = tempfile::tempdir().unwrap();
    let bare = "images/test/queries/@500000@4000000@.jpg";
    write(
        root.path(),
        &["images/test/database/@500000@4000000@17@T@.jpg", bare],
    );
    let load = || load_dataset(DatasetKind::Utm, root.path(), &DatasetOptions::default()).unwrap();
    assert_eq!(load().truth, [Truth::Positives(vec![0])]);
    write(
        root.path(),
        &["images/test/database/@500000@4000000@40@T@.jpg"],
    );
    let apart = load();
    assert_eq!(apart.truth, [Truth::NoMatch]);
    assert!(
        apart
            .notes
            .iter()
            .any(|note| note.starts_with("1 images name no zone")),
        "{:?}",
        apart.notes
    );
}

#[test]
fn a_wrong_root_says_what_is_expected() {
    let root = tempfile::tempdir().unwrap();
    let error = load_dataset(
        DatasetKind::Tokyo247,
        root.path(),
        &DatasetOptions::default(),
    )
    .unwrap_err();
    assert!(
        error.to_string().contains("images/{train,val,test}"),
        "{error}"
    );
}
