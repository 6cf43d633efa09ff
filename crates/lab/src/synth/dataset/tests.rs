use super::*;
use placeformer_core::progress::{Silent, Step};
use placeformer_vision::image::{ImageConfig, decode};
use std::collections::{HashMap, HashSet};
use std::sync::Mutex;

/// The last state of the only task.
#[derive(Default)]
struct Counter(Mutex<Option<(u64, Option<u64>)>>);

impl Progress for Counter {
    fn update(&self, step: Step<'_>) {
        *self.0.lock().unwrap() = Some((step.done, step.total));
    }

    fn end(&self, _task: &str) {}
}

fn options() -> TownOptions {
    let size = ImageSize {
        width: 48,
        height: 36,
    };
    TownOptions {
        places: 2,
        views: 1,
        seed: 4,
        size,
        conditions: vec![Condition::Dusk, Condition::Overcast],
    }
}

fn rows(path: &Path) -> Vec<csv::StringRecord> {
    csv::Reader::from_path(path)
        .unwrap()
        .records()
        .map(Result::unwrap)
        .collect()
}

#[test]
fn a_data_set_is_whole_consistent_and_the_same_twice() {
    let folders = [tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap()];
    let counter = Counter::default();
    let summaries = folders
        .each_ref()
        .map(|folder| write_town(folder.path(), &options(), &counter).unwrap());
    assert_eq!(*counter.0.lock().unwrap(), Some((5, Some(5))));
    assert_eq!(
        summaries[0],
        TownSummary {
            references: 2,
            queries: 3,
            unmatched: 1
        }
    );
    let folder = folders[0].path();
    let positions = rows(&folder.join("positions.csv"));
    assert_eq!(positions.len(), 5);
    let mut places = HashMap::new();
    for row in &positions {
        let bytes = fs::read(folder.join(&row[0])).unwrap();
        assert_eq!(bytes, fs::read(folders[1].path().join(&row[0])).unwrap());
        assert_eq!(
            decode(&bytes, &ImageConfig::default()).unwrap().size,
            options().size
        );
        let place = GeoPoint::new(row[1].parse().unwrap(), row[2].parse().unwrap()).unwrap();
        assert!(OffsetDateTime::parse(&row[4], &Rfc3339).is_ok());
        places.insert(row[0].split_once('/').unwrap().1.to_owned(), place);
    }
    let truth = rows(&folder.join("ground_truth.csv"));
    let queries: HashSet<_> = truth.iter().map(|row| row[0].to_owned()).collect();
    assert_eq!(queries.len(), 3);
    for row in truth.iter().filter(|row| !row[1].is_empty()) {
        assert!(places[&row[0]].distance_m(places[&row[1]]) <= MATCH_RADIUS_M);
    }
    for row in truth.iter().filter(|row| row[1].is_empty()) {
        let far = positions
            .iter()
            .filter(|position| position[0].starts_with("database/"));
        let query = places[&row[0]];
        let name = |position: &csv::StringRecord| position[0].split_once('/').unwrap().1.to_owned();
        assert!(
            far.map(|position| places[&name(position)].distance_m(query))
                .all(|metres| metres > 100.0)
        );
    }
}

#[test]
fn names_carry_the_position_in_utm() {
    let world = StreetWorld::new(4);
    let shot = references(world, &options()).remove(0);
    let fields: Vec<&str> = shot.name.split('@').collect();
    let number = |i: usize| fields[i].parse::<f64>().unwrap();
    assert_eq!(
        (fields.len(), fields[3], fields[4], fields[15]),
        (16, "32", "U", ".jpg")
    );
    let (lat, lon) = utm::wsg84_utm_to_lat_lon(number(1), number(2), 32, 'U').unwrap();
    assert!(GeoPoint::new(lat, lon).unwrap().distance_m(shot.location) < 0.1);
    assert!((number(9) - shot.heading.degrees()).abs() <= 0.05);
}

#[test]
fn nothing_is_written_into_a_folder_with_images_or_without_a_place() {
    let folder = tempfile::tempdir().unwrap();
    fs::create_dir_all(folder.path().join("database")).unwrap();
    fs::write(folder.path().join("database/mine.jpg"), b"keep").unwrap();
    assert!(matches!(
        write_town(folder.path(), &options(), &Silent),
        Err(SynthError::NotEmpty(_))
    ));
    let empty = TownOptions {
        places: 0,
        ..options()
    };
    assert!(matches!(
        write_town(folder.path(), &empty, &Silent),
        Err(SynthError::Nothing(_))
    ));
}
