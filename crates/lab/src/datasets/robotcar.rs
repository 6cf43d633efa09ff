//! RobotCar Seasons v2: reference poses from the reconstruction, queries by condition and camera.
//!
//! `images/<condition>/<camera>/<timestamp>.jpg`; `3D-models/all-merged/all.nvm` holds the
//! reference poses (rotation world to camera, and the camera's centre); `robotcar_v2_train.txt`
//! names query images with a 4x4 camera-to-world matrix each; `robotcar_v2_test.txt` names those
//! whose poses are withheld. Metadata say `.png` where the images are `.jpg`.

use super::dataset::{Dataset, Item, Truth};
use super::error::DatasetError;
use super::kind::Split;
use super::layout::require;
use super::neighbours::NeighbourGrid;
use super::options::DatasetOptions;
use super::pose::Pose;
use nalgebra::{Matrix3, Quaternion, Rotation3, UnitQuaternion, Vector3};
use placeformer_core::geography::MetricPoint;
use std::collections::BTreeSet;
use std::path::Path;

const NAME: &str = "robotcar-seasons-v2";
const EXPECTED: &str =
    "images/<condition>/<camera>, 3D-models/all-merged/all.nvm and robotcar_v2_{train,test}.txt";

/// Reads the references seen by the queries' cameras, and the queries of one split.
pub(super) fn load(root: &Path, options: &DatasetOptions) -> Result<Dataset, DatasetError> {
    let images = require(NAME, root.join("images"), EXPECTED)?;
    let queries = match options.split.unwrap_or(Split::Train) {
        Split::Test => read_list(
            &require(NAME, root.join("robotcar_v2_test.txt"), EXPECTED)?,
            &images,
        )?,
        Split::Train | Split::Val => read_posed(
            &require(NAME, root.join("robotcar_v2_train.txt"), EXPECTED)?,
            &images,
        )?,
    };
    let cameras = queries.iter().filter_map(|query| camera_of(&query.name));
    let cameras: BTreeSet<String> = cameras.map(str::to_owned).collect();
    let nvm = require(NAME, root.join("3D-models/all-merged/all.nvm"), EXPECTED)?;
    let all = read_nvm(&nvm, &images)?;
    let of_all = all.len();
    let seen = |item: &Item| camera_of(&item.name).is_some_and(|camera| cameras.contains(camera));
    let database: Vec<Item> = all.into_iter().filter(seen).collect();
    let truth = truth_by_pose(&database, &queries, options.radius_m);
    let cameras: Vec<String> = cameras.into_iter().collect();
    let notes = vec![format!(
        "{} of {of_all} references are of the queries' cameras ({})",
        database.len(),
        cameras.join(", ")
    )];
    Ok(Dataset {
        name: NAME.into(),
        database,
        queries,
        truth,
        skipped: Vec::new(),
        notes,
    })
}

/// The camera of an image: the last folder of its name.
fn camera_of(name: &str) -> Option<&str> {
    name.split('/').nth_back(1)
}

/// Positives by the distance of camera centres in three dimensions; the grid finds those near in
/// the plane first.
fn truth_by_pose(database: &[Item], queries: &[Item], radius_m: f64) -> Vec<Truth> {
    let flat = |pose: &Pose| MetricPoint {
        east: pose.centre.x,
        north: pose.centre.y,
    };
    let posed = database
        .iter()
        .enumerate()
        .filter_map(|(index, item)| Some((index, flat(item.pose.as_ref()?))));
    let grid = NeighbourGrid::new(radius_m, posed);
    let near = |pose: &Pose, index: usize| {
        database[index]
            .pose
            .is_some_and(|other| pose.error(&other).0 <= radius_m)
    };
    let truth_of = |query: &Item| match query.pose {
        None => Truth::Unknown,
        Some(pose) => Truth::from_positives(
            grid.within(flat(&pose))
                .filter(|&index| near(&pose, index))
                .collect(),
        ),
    };
    queries.iter().map(truth_of).collect()
}

/// An item for an image named as the metadata name it.
fn item(images: &Path, name: &str, pose: Option<Pose>) -> Item {
    let name = name.trim_start_matches("./");
    let name = name
        .strip_suffix(".png")
        .map_or_else(|| name.to_owned(), |stem| format!("{stem}.jpg"));
    let group = name.split('/').next().map(str::to_owned);
    Item {
        pose,
        group,
        ..Item::new(name.clone(), images.join(&name))
    }
}

/// The lines of a text file that are not empty, with their 1-based numbers; Windows line ends do
/// not matter.
fn lines(text: &str) -> impl Iterator<Item = (u64, &str)> {
    (1..)
        .zip(text.lines().map(str::trim))
        .filter(|(_, line)| !line.is_empty())
}

fn read_text(path: &Path) -> Result<String, DatasetError> {
    std::fs::read_to_string(path).map_err(DatasetError::io(path))
}

/// An error that names a line of a file.
fn wrong(path: &Path, line: u64, reason: impl Into<String>) -> DatasetError {
    DatasetError::Record {
        path: path.to_owned(),
        line,
        reason: reason.into(),
    }
}

/// All `fields` as finite numbers.
fn numbers<'a>(
    path: &Path,
    line: u64,
    fields: impl Iterator<Item = &'a str>,
) -> Result<Vec<f64>, DatasetError> {
    let parse = |field: &str| match field.parse::<f64>() {
        Ok(value) if value.is_finite() => Ok(value),
        _ => Err(wrong(path, line, format!("{field:?} is not a number"))),
    };
    fields.map(parse).collect()
}

/// Names of images, one a line.
fn read_list(path: &Path, images: &Path) -> Result<Vec<Item>, DatasetError> {
    let text = read_text(path)?;
    Ok(lines(&text)
        .filter_map(|(_, line)| line.split_whitespace().next())
        .map(|name| item(images, name, None))
        .collect())
}

/// `name` and 16 numbers, the rows of a camera-to-world matrix.
fn read_posed(path: &Path, images: &Path) -> Result<Vec<Item>, DatasetError> {
    let text = read_text(path)?;
    let mut items = Vec::new();
    for (line, content) in lines(&text) {
        let mut fields = content.split_whitespace();
        let name = fields.next().unwrap_or_default();
        let matrix = numbers(path, line, fields)?;
        if matrix.len() != 16 {
            return Err(wrong(
                path,
                line,
                format!("{} numbers instead of the 16 of a 4x4 matrix", matrix.len()),
            ));
        }
        let row = |r: usize| [matrix[4 * r], matrix[4 * r + 1], matrix[4 * r + 2]];
        let rotation = Matrix3::from_row_slice(&[row(0), row(1), row(2)].concat());
        if (rotation * rotation.transpose() - Matrix3::identity()).norm() > 1e-2
            || rotation.determinant() < 0.0
        {
            return Err(wrong(
                path,
                line,
                "the upper left of the matrix is not a rotation",
            ));
        }
        let to_world =
            UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rotation));
        let centre = Vector3::new(matrix[3], matrix[7], matrix[11]);
        let pose = Pose {
            rotation: to_world.inverse(),
            centre,
        };
        items.push(item(images, name, Some(pose)));
    }
    Ok(items)
}

/// The cameras of an NVM model: a count, then `name focal qw qx qy qz cx cy cz distortion 0` each.
fn read_nvm(path: &Path, images: &Path) -> Result<Vec<Item>, DatasetError> {
    let text = read_text(path)?;
    let mut lines = lines(&text);
    match lines.next() {
        Some((_, header)) if header.starts_with("NVM_V3") => {}
        _ => return Err(wrong(path, 1, "this is not an NVM_V3 file")),
    }
    let (line, count) = lines
        .next()
        .ok_or_else(|| wrong(path, 2, "the number of cameras is missing"))?;
    let count: usize = count
        .parse()
        .map_err(|_| wrong(path, line, format!("{count:?} is not a number of cameras")))?;
    let mut items = Vec::new();
    for (line, content) in lines.take(count) {
        let mut fields = content.split_whitespace();
        let name = fields.next().unwrap_or_default();
        let values = numbers(path, line, fields)?;
        let &[_, w, x, y, z, cx, cy, cz, ..] = values.as_slice() else {
            return Err(wrong(
                path,
                line,
                "a camera needs a name, a focal length, a quaternion and a centre",
            ));
        };
        let rotation = UnitQuaternion::try_new(Quaternion::new(w, x, y, z), 1e-9)
            .ok_or_else(|| wrong(path, line, "the quaternion is zero"))?;
        let centre = Vector3::new(cx, cy, cz);
        items.push(item(images, name, Some(Pose { rotation, centre })));
    }
    if items.len() == count {
        Ok(items)
    } else {
        Err(wrong(
            path,
            line,
            format!("{count} cameras announced, {} found", items.len()),
        ))
    }
}

#[cfg(test)]
mod tests {
    use super::super::{DatasetKind, load as load_dataset};
    use super::*;

    fn sample(nvm_cameras: &str, count: usize) -> tempfile::TempDir {
        let root = tempfile::tempdir().unwrap();
        let write = |name: &str, text: &str| {
            let path = root.path().join(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, text).unwrap();
        };
        std::fs::create_dir_all(root.path().join("images")).unwrap();
        write(
            "3D-models/all-merged/all.nvm",
            &format!("NVM_V3 \r\n\r\n{count}\r\n{nvm_cameras}0\r\n"),
        );
        // A quarter turn about z, 3 m from the first reference; one far away.
        write(
            "robotcar_v2_train.txt",
            "dawn/rear/11.png 0 -1 0 3 1 0 0 0 0 0 1 0 0 0 0 1\r\n\r\nnight/rear/12.jpg 1 0 0 900 0 1 0 0 0 0 1 0 0 0 0 1\r\n",
        );
        write(
            "robotcar_v2_test.txt",
            "rain/rear/21.jpg\nsnow/rear/22.jpg\n",
        );
        root
    }

    const CAMERAS: &str = "./overcast-reference/rear/1.png 400 1 0 0 0 0 0 0 0 0\n\
        overcast-reference/left/2.png 400 1 0 0 0 0 0 0 0 0\n\
        overcast-reference/rear/3.png 400 0.7071067811865476 0 0 -0.7071067811865476 3 0 30 0 0\n";

    #[test]
    fn poses_are_read_in_both_conventions() {
        let root = sample(CAMERAS, 3);
        let dataset = load_dataset(
            DatasetKind::RobotcarSeasonsV2,
            root.path(),
            &DatasetOptions::default(),
        )
        .unwrap();
        let names: Vec<_> = dataset
            .database
            .iter()
            .map(|item| item.name.as_str())
            .collect();
        // Only the queries' camera; .png became .jpg.
        assert_eq!(
            names,
            [
                "overcast-reference/rear/1.jpg",
                "overcast-reference/rear/3.jpg"
            ]
        );
        let query = dataset.queries[0].pose.unwrap();
        let (metres, degrees) = query.error(&dataset.database[0].pose.unwrap());
        assert!(
            (metres - 3.0).abs() < 1e-9 && (degrees - 90.0).abs() < 1e-6,
            "{metres} {degrees}"
        );
        // Camera-to-world turned by +90 degrees about z is world-to-camera turned by -90: the third
        // reference.
        let (metres, degrees) = query.error(&dataset.database[1].pose.unwrap());
        assert!(
            (metres - 30.0).abs() < 1e-9 && degrees < 1e-6,
            "{metres} {degrees}"
        );
        // 30 m up is beyond the radius though right above on the plan.
        assert_eq!(dataset.truth, [Truth::Positives(vec![0]), Truth::NoMatch]);
        assert_eq!(dataset.queries[1].group.as_deref(), Some("night"));
    }

    #[test]
    fn the_test_split_has_no_poses() {
        let root = sample(CAMERAS, 3);
        let options = DatasetOptions {
            split: Some(Split::Test),
            ..Default::default()
        };
        let dataset = load_dataset(DatasetKind::RobotcarSeasonsV2, root.path(), &options).unwrap();
        assert_eq!(dataset.truth, [Truth::Unknown, Truth::Unknown]);
    }

    #[test]
    fn damaged_metadata_are_named_with_their_line() {
        let load = |root: &tempfile::TempDir| {
            load_dataset(
                DatasetKind::RobotcarSeasonsV2,
                root.path(),
                &DatasetOptions::default(),
            )
            .unwrap_err()
            .to_string()
        };
        assert!(load(&sample(CAMERAS, 4)).contains("line 7: a camera needs"));
        assert!(load(&sample("", 0)).contains("no usable database image"));
        assert!(
            load(&sample("a/rear/1.png 400 0 0 0 0 0 0 0 0 0\n", 1))
                .contains("line 4: the quaternion is zero")
        );
        let root = sample(CAMERAS, 3);
        std::fs::write(
            root.path().join("robotcar_v2_train.txt"),
            "a/rear/1.png 1 2 3\n",
        )
        .unwrap();
        assert!(load(&root).contains("line 1: 3 numbers"));
    }
}
