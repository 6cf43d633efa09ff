//! Files that the public benchmarks accept, where the answers are withheld.

use super::error::EvalError;
use super::run::Answer;
use crate::datasets::{Dataset, Item};
use std::io::Write;
use std::path::Path;

/// Answers written per query: the challenge looks at no more.
const MSLS_ANSWERS: usize = 20;

/// The Mapillary challenge's file: one line per query, its key and the keys of its answers, best
/// first, separated by spaces. Sorted by re-ranking where that was done.
///
/// The official evaluation stops at a query without a line. So a query that could not be read gets
/// one too, in its place, with the first references of the database; how many there are is
/// returned.
///
/// # Errors
/// The file cannot be written.
pub fn write_msls(path: &Path, dataset: &Dataset, answers: &[Answer]) -> Result<usize, EvalError> {
    let mut ranked: Vec<Option<Vec<usize>>> = vec![None; dataset.queries.len()];
    for answer in answers {
        let mut found = best(answer);
        found.truncate(MSLS_ANSWERS);
        ranked[answer.query] = Some(found);
    }
    let count = ranked
        .iter()
        .flatten()
        .map(Vec::len)
        .max()
        .unwrap_or(MSLS_ANSWERS.min(dataset.database.len()));
    let unanswered = ranked.iter().filter(|found| found.is_none()).count();
    let line = |(query, found): (&Item, Option<Vec<usize>>)| {
        let found = found.unwrap_or_else(|| (0..count).collect());
        let keys = found.into_iter().map(|index| key(&dataset.database[index]));
        std::iter::once(key(query))
            .chain(keys)
            .collect::<Vec<_>>()
            .join(" ")
    };
    write_lines(path, dataset.queries.iter().zip(ranked).map(line))?;
    Ok(unanswered)
}

/// The visual localisation benchmark's file: `camera/timestamp.jpg qw qx qy qz tx ty tz` of the
/// world-to-camera transform, here that of the best match.
///
/// # Errors
/// The file cannot be written.
pub fn write_robotcar(path: &Path, dataset: &Dataset, answers: &[Answer]) -> Result<(), EvalError> {
    let line = |answer: &Answer| {
        let pose = best(answer)
            .first()
            .and_then(|&index| dataset.database[index].pose)?;
        let name = &dataset.queries[answer.query].name;
        // The benchmark wants the last two parts: conditions are not told apart.
        let cut = name.rmatch_indices('/').nth(1).map_or(0, |(at, _)| at + 1);
        let q = pose.rotation.quaternion();
        let t = pose.translation();
        Some(format!(
            "{} {} {} {} {} {} {} {}",
            &name[cut..],
            q.w,
            q.i,
            q.j,
            q.k,
            t.x,
            t.y,
            t.z
        ))
    };
    write_lines(path, answers.iter().filter_map(line))
}

fn best(answer: &Answer) -> Vec<usize> {
    if answer.reranked.is_empty() {
        answer.global_ranking()
    } else {
        answer.reranked_ranking()
    }
}

fn key(item: &Item) -> String {
    item.name
        .rsplit('/')
        .next()
        .unwrap_or(&item.name)
        .to_owned()
}

fn write_lines(path: &Path, lines: impl Iterator<Item = String>) -> Result<(), EvalError> {
    let file = std::fs::File::create(path).map_err(EvalError::io(path))?;
    let mut writer = std::io::BufWriter::new(file);
    for line in lines {
        writeln!(writer, "{line}").map_err(EvalError::io(path))?;
    }
    writer.flush().map_err(EvalError::io(path))
}

#[cfg(test)]
mod tests {
    use super::super::run::{Candidate, Neighbour};
    use super::*;
    use crate::datasets::{Pose, Truth};
    use nalgebra::{UnitQuaternion, Vector3};
    use placeformer_vision::rerank::PairScore;

    fn dataset(queries: &[&str], database: Vec<Item>) -> Dataset {
        let queries: Vec<Item> = queries.iter().map(|name| Item::new(*name, *name)).collect();
        let truth = vec![Truth::Unknown; queries.len()];
        Dataset {
            name: "d".into(),
            database,
            queries,
            truth,
            skipped: Vec::new(),
            notes: Vec::new(),
        }
    }

    fn answer(query: usize, global: &[usize], reranked: &[usize]) -> Answer {
        let candidate = |&index: &usize| {
            let distance = 0.0;
            Candidate::by_inliers(Neighbour { index, distance }, PairScore::default())
        };
        Answer {
            query,
            global: global
                .iter()
                .map(|&index| Neighbour {
                    index,
                    distance: 0.0,
                })
                .collect(),
            reranked: reranked.iter().map(candidate).collect(),
        }
    }

    #[test]
    fn msls_lines_hold_keys_best_first() {
        let database = (0..30)
            .map(|i| Item::new(format!("miami/database/k{i}"), "x"))
            .collect();
        let dataset = dataset(
            &["miami/query/q0", "miami/query/torn", "miami/query/q1"],
            database,
        );
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("msls.txt");
        let all: Vec<usize> = (0..30).collect();
        // Answers may come in any order; the file keeps the data set's.
        let unanswered = write_msls(
            &path,
            &dataset,
            &[answer(2, &all, &[]), answer(0, &[1, 2], &[2, 1])],
        )
        .unwrap();
        let text = std::fs::read_to_string(&path).unwrap();
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!((lines.len(), unanswered), (3, 1));
        assert_eq!(lines[0], "q0 k2 k1");
        assert_eq!(
            (lines[2].split(' ').count(), lines[2].ends_with(" k19")),
            (21, true)
        );
        // A query that was not answered has as many keys as the others.
        assert_eq!(lines[1].replacen("torn", "q1", 1), lines[2]);
    }

    #[test]
    fn robotcar_lines_hold_the_pose_of_the_best_match() {
        let rotation =
            UnitQuaternion::from_axis_angle(&Vector3::z_axis(), std::f64::consts::FRAC_PI_2);
        let pose = Pose {
            rotation,
            centre: Vector3::new(1.0, 0.0, 2.0),
        };
        let reference = Item {
            pose: Some(pose),
            ..Item::new("overcast-reference/rear/1.jpg", "x")
        };
        let dataset = dataset(&["night/rear/42.jpg"], vec![reference]);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("robotcar.txt");
        write_robotcar(&path, &dataset, &[answer(0, &[0], &[])]).unwrap();
        let text = std::fs::read_to_string(&path).unwrap();
        let fields: Vec<&str> = text.split_whitespace().collect();
        assert_eq!(fields[0], "rear/42.jpg");
        let numbers: Vec<f64> = fields[1..].iter().map(|f| f.parse().unwrap()).collect();
        let half = std::f64::consts::FRAC_1_SQRT_2;
        // A quarter turn takes the centre (1, 0, 2) to (0, 1, 2); the translation is its negative.
        for (number, expected) in numbers.iter().zip([half, 0.0, 0.0, half, 0.0, -1.0, -2.0]) {
            assert!((number - expected).abs() < 1e-12, "{text}");
        }
    }
}
