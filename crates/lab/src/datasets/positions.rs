//! Positions beside images that have none in their names: `positions.csv` with `file`, `lat`,
//! `lon`, `heading`.
//!
//! The table `import` takes. `file` is the path below the table's folder, so that both sides of a
//! data set find their rows in one table. Positions become metres in the plane of their UTM zones;
//! regions far apart become groups, see `zones`.

use super::dataset::Item;
use super::error::DatasetError;
use super::table::{Column, Row, Table};
use super::zones::Zones;
use placeformer_core::folder::relative_name;
use placeformer_core::geography::UtmZone;
use placeformer_core::types::GeoPoint;
use std::collections::HashMap;
use std::path::Path;

/// Gives the items of `sides` the positions and headings that `folder/positions.csv` has for them,
/// if it is there.
pub(super) fn locate(folder: &Path, sides: [&mut [Item]; 2]) -> Result<(), DatasetError> {
    let path = folder.join("positions.csv");
    if !path.exists() {
        return Ok(());
    }
    let table = Table::read(&path)?;
    let (Some(lat), Some(lon)) = (table.optional_column("lat"), table.optional_column("lon"))
    else {
        return Ok(());
    };
    let file = table.column("file")?;
    let heading = table.optional_column("heading");
    let mut rows = HashMap::new();
    for row in table.rows() {
        let beyond =
            || row.error("beyond 80 degrees south or 84 north there is no UTM zone".into());
        let place = match point(row, lat, lon)? {
            None => None,
            Some(geo) => Some((UtmZone::of(geo).ok_or_else(beyond)?, geo)),
        };
        let heading = match heading.filter(|&column| !row.text(column).is_empty()) {
            Some(column) => Some(row.number(column)?),
            None => None,
        };
        rows.insert(row.text(file).replace('\\', "/"), (place, heading));
    }
    let zones = Zones::of(rows.values().filter_map(|(place, _)| Some((*place)?.0)));
    for item in sides.into_iter().flatten() {
        if let Some(&(place, heading)) = rows.get(&relative_name(folder, &item.path)) {
            item.position = place.and_then(|(zone, geo)| zones.locate(zone, geo));
            item.group = place.and_then(|(zone, _)| zones.group(zone));
            item.heading = heading;
        }
    }
    Ok(())
}

fn point(row: Row<'_>, lat: Column, lon: Column) -> Result<Option<GeoPoint>, DatasetError> {
    if row.text(lat).is_empty() && row.text(lon).is_empty() {
        return Ok(None);
    }
    let geo = GeoPoint::new(row.number(lat)?, row.number(lon)?);
    geo.map(Some).map_err(|error| row.error(error.to_string()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn located(csv: &str) -> Result<[Vec<Item>; 2], DatasetError> {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("positions.csv"), csv).unwrap();
        let item = |name: &str| Item::new(name, folder.path().join(name));
        let mut database = vec![item("database/a.jpg"), item("database/b.jpg")];
        let mut queries = vec![item("queries/a.jpg")];
        locate(folder.path(), [&mut database, &mut queries])?;
        Ok([database, queries])
    }

    #[test]
    fn both_sides_find_their_rows_in_metres() {
        let csv = "file,lat,lon,heading\ndatabase\\a.jpg,51.5,7.4,90\nqueries/a.jpg,51.5001,7.4,\ndatabase/b.jpg,,,10\n";
        let [database, queries] = located(csv).unwrap();
        let a = database[0].position.unwrap();
        let q = queries[0].position.unwrap();
        assert!(
            (q.north - a.north - 11.12).abs() < 0.1 && (q.east - a.east).abs() < 0.5,
            "{a:?} {q:?}"
        );
        assert_eq!(
            (
                database[0].heading,
                database[1].heading,
                database[1].position
            ),
            (Some(90.0), Some(10.0), None)
        );
    }

    #[test]
    fn far_regions_become_groups() {
        // San Francisco and Copenhagen; both sides of the latter 20 m apart.
        let csv = "file,lat,lon\ndatabase/a.jpg,37.77,-122.42\ndatabase/b.jpg,55.67,12.57\nqueries/a.jpg,55.67018,12.57\n";
        let [database, queries] = located(csv).unwrap();
        assert!(database[1].group == queries[0].group && database[0].group != queries[0].group);
        let b = database[1].position.unwrap();
        let q = queries[0].position.unwrap();
        assert!(
            ((b.east - q.east).hypot(b.north - q.north) - 20.0).abs() < 0.2,
            "{b:?} {q:?}"
        );
    }

    #[test]
    fn a_table_without_positions_is_passed_over_and_a_wrong_one_is_named_by_line() {
        assert_eq!(
            located("file,heading\ndatabase/a.jpg,5\n").unwrap()[0][0].position,
            None
        );
        for csv in [
            "file,lat,lon\ndatabase/a.jpg,north,5\n",
            "file,lat,lon\ndatabase/a.jpg,95,5\n",
        ] {
            assert!(
                located(csv).unwrap_err().to_string().contains("line 2"),
                "{csv}"
            );
        }
    }
}
