use super::super::{DatasetKind, load};
use super::*;

/// (key, easting, northing or none for no postprocessed row, angle, panorama).
type Photo = (&'static str, Option<(f64, f64)>, &'static str, &'static str);

fn write_side(folder: &Path, photos: &[Photo], line_end: &str) {
    std::fs::create_dir_all(folder.join("images")).unwrap();
    let mut raw = format!(",key,lon,lat,ca,captured_at,pano{line_end}");
    let mut post = format!(
        ",key,easting,northing,night,control_panel,view_direction,unique_cluster{line_end}"
    );
    let mut subtask = format!(",key,all,s2w,w2s,o2n,n2o,d2n,n2d{line_end}");
    for (i, (key, position, angle, pano)) in photos.iter().enumerate() {
        std::fs::write(folder.join("images").join(format!("{key}.jpg")), b"x").unwrap();
        raw += &format!("{i},{key},12.5,55.6,{angle},2019-01-01,{pano}{line_end}");
        if let Some((east, north)) = position {
            post += &format!("{i},{key},{east},{north},False,False,Forward,0{line_end}");
        }
        subtask += &format!(
            "{i},{key},True,{},False,False,False,False,False{line_end}",
            i % 2 == 0
        );
    }
    std::fs::write(folder.join("raw.csv"), raw).unwrap();
    std::fs::write(folder.join("postprocessed.csv"), post).unwrap();
    std::fs::write(
        folder.join("subtask_index.csv"),
        subtask.replace("true", "True").replace("false", "False"),
    )
    .unwrap();
    std::fs::write(
        folder.join("seq_info.csv"),
        format!(",key,sequence_key,frame_number{line_end}"),
    )
    .unwrap();
}

fn sample() -> tempfile::TempDir {
    let root = tempfile::tempdir().unwrap();
    let city = |name: &str| root.path().join("train_val").join(name);
    let database: [Photo; 6] = [
        ("d0", Some((0.0, 0.0)), "10", "False"),
        ("d1", Some((5.0, 0.0)), "60", "False"),
        ("d2", Some((6.0, 0.0)), "10", "True"),
        ("d3", None, "10", "False"),
        ("d4", Some((7.0, 0.0)), "", "False"),
        ("d5", Some((900.0, 0.0)), "10", "False"),
    ];
    let queries: [Photo; 3] = [
        ("q0", Some((1.0, 1.0)), "350", "False"),
        ("q1", Some((500.0, 1.0)), "0", "False"),
        ("q2", Some((1.0, 1.0)), "0", "True"),
    ];
    write_side(&city("cph").join("database"), &database, "\r\n");
    write_side(&city("cph").join("query"), &queries, "\r\n");
    // The other city has the same coordinates: never a positive.
    write_side(
        &city("sf").join("database"),
        &[("d0", Some((0.0, 0.0)), "0", "False")],
        "\n",
    );
    write_side(
        &city("sf").join("query"),
        &[("q9", Some((1000.0, 0.0)), "0", "False")],
        "\n",
    );
    root
}

#[test]
fn distance_angle_panoramas_and_missing_rows() {
    let root = sample();
    let dataset = load(
        DatasetKind::MslsVal,
        root.path(),
        &DatasetOptions::default(),
    )
    .unwrap();
    let names: Vec<_> = dataset
        .database
        .iter()
        .map(|item| item.name.as_str())
        .collect();
    let expected = [
        "cph/database/d0",
        "cph/database/d1",
        "cph/database/d4",
        "cph/database/d5",
        "sf/database/d0",
    ];
    assert_eq!(names, expected);
    // q0 looks 20 degrees from d0, 70 from d1; d4 has no angle.
    assert_eq!(
        dataset.truth,
        [Truth::Positives(vec![0, 2]), Truth::NoMatch, Truth::NoMatch]
    );
    let reasons: Vec<_> = dataset
        .skipped
        .iter()
        .map(|skipped| (skipped.name.as_str(), skipped.reason.as_str()))
        .collect();
    assert!(
        reasons.contains(&("cph/database/d3", "no row in postprocessed.csv")),
        "{reasons:?}"
    );
    assert!(
        reasons.contains(&("cph/database/d2", "panorama"))
            && reasons.contains(&("cph/query/q2", "panorama"))
    );
    assert_eq!(dataset.notes.len(), 2);
}

#[test]
fn the_angle_rule_can_be_lifted_and_a_subtask_chosen() {
    let root = sample();
    let options = DatasetOptions {
        max_angle_deg: Some(180.0),
        ..Default::default()
    };
    let dataset = load(DatasetKind::MslsVal, root.path(), &options).unwrap();
    assert_eq!(dataset.truth[0], Truth::Positives(vec![0, 1, 2]));
    let options = DatasetOptions {
        subtask: "s2w".into(),
        cities: vec!["cph".into()],
        ..Default::default()
    };
    let dataset = load(DatasetKind::MslsVal, root.path(), &options).unwrap();
    assert_eq!((dataset.database.len(), dataset.queries.len()), (2, 1));
    let options = DatasetOptions {
        subtask: "dawn".into(),
        ..Default::default()
    };
    assert!(
        load(DatasetKind::MslsVal, root.path(), &options)
            .unwrap_err()
            .to_string()
            .contains("dawn")
    );
}

#[test]
fn a_subtask_chooses_validation_images_but_never_training_images() {
    let root = sample();
    let index = root.path().join("train_val/cph/query/subtask_index.csv");
    let load = |split| {
        let cities = vec!["cph".into()];
        let options = DatasetOptions {
            subtask: "s2w".into(),
            cities,
            split: Some(split),
            ..Default::default()
        };
        load(DatasetKind::MslsVal, root.path(), &options)
    };
    assert_eq!(load(Split::Val).unwrap().queries.len(), 1);
    let training = load(Split::Train).unwrap();
    assert_eq!((training.database.len(), training.queries.len()), (4, 2));
    assert!(
        training.notes.iter().any(|note| note.contains("s2w")),
        "{:?}",
        training.notes
    );
    std::fs::remove_file(&index).unwrap();
    assert_eq!(load(Split::Train).unwrap(), training);
    assert!(
        load(Split::Val)
            .unwrap_err()
            .to_string()
            .contains("subtask_index.csv")
    );
}

#[test]
fn rows_are_joined_by_key_and_second_rows_are_reported() {
    let root = sample();
    let folder = root.path().join("train_val/cph/database");
    // Another order than postprocessed.csv; d0 twice with another angle, d1 not at all.
    let raw = ",key,lon,lat,ca,captured_at,pano\n0,d5,1,1,10,x,False\n1,d4,1,1,,x,False\n2,d0,1,1,10,x,False\n\
               3,d0,1,1,200,x,False\n4,d2,1,1,10,x,True\n";
    std::fs::write(folder.join("raw.csv"), raw).unwrap();
    // d0 a second time, far away.
    let path = folder.join("postprocessed.csv");
    let rows = std::fs::read_to_string(&path).unwrap() + "9,d0,5000,0,False,False,Forward,0\r\n";
    std::fs::write(&path, rows).unwrap();
    let options = DatasetOptions {
        cities: vec!["cph".into()],
        ..Default::default()
    };
    let dataset = load(DatasetKind::MslsVal, root.path(), &options).unwrap();
    let known: Vec<_> = dataset
        .database
        .iter()
        .map(|item| {
            (
                item.name.as_str(),
                item.position.unwrap().east,
                item.heading,
            )
        })
        .collect();
    let expected = [
        ("cph/database/d0", 0.0, Some(10.0)),
        ("cph/database/d4", 7.0, None),
        ("cph/database/d5", 900.0, Some(10.0)),
    ];
    assert_eq!(known, expected);
    let mut reasons: Vec<_> = dataset
        .skipped
        .iter()
        .filter_map(|skipped| {
            Some((
                skipped.name.strip_prefix("cph/database/")?,
                skipped.reason.as_str(),
            ))
        })
        .collect();
    reasons.sort_unstable();
    let expected = [
        ("d0", "a second row with this key in postprocessed.csv"),
        ("d0", "a second row with this key in raw.csv"),
        ("d1", "no row in raw.csv"),
        ("d2", "panorama"),
        ("d3", "no row in postprocessed.csv"),
    ];
    assert_eq!(reasons, expected);
}

#[test]
fn the_test_cities_have_no_answers_and_duplicate_keys_are_reported() {
    let root = tempfile::tempdir().unwrap();
    for city in TEST_CITIES {
        for (side, keys) in [("database", vec!["a", "b", "b"]), ("query", vec!["q"])] {
            let folder = root.path().join("test").join(city).join(side);
            std::fs::create_dir_all(folder.join("images")).unwrap();
            let rows: String = keys
                .iter()
                .enumerate()
                .map(|(i, key)| format!("{i},{key},True,False\n"))
                .collect();
            std::fs::write(
                folder.join("subtask_index.csv"),
                format!(",key,all,s2w\n{rows}"),
            )
            .unwrap();
        }
    }
    let dataset = load(
        DatasetKind::MslsTest,
        root.path(),
        &DatasetOptions::default(),
    )
    .unwrap();
    assert_eq!(
        (
            dataset.database.len(),
            dataset.queries.len(),
            dataset.skipped.len()
        ),
        (12, 6, 6)
    );
    assert!(dataset.truth.iter().all(|truth| *truth == Truth::Unknown));
    assert!(
        dataset.database[0]
            .path
            .ends_with("test/miami/database/images/a.jpg")
    );
}

#[test]
fn the_downloaders_form_is_read_too() {
    let root = tempfile::tempdir().unwrap();
    for name in [
        "database/@0@0@@@@@a@@010@@@@@@.jpg",
        "database/@1@0@@@@@b@@090@@@@@@.jpg",
        "queries/@2@0@@@@@c@@000@@@@@@.jpg",
    ] {
        let path = root.path().join("images/val").join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, b"x").unwrap();
    }
    let dataset = load(
        DatasetKind::MslsVal,
        root.path(),
        &DatasetOptions::default(),
    )
    .unwrap();
    assert_eq!(dataset.truth, [Truth::Positives(vec![0])]);
}
