//! What `eval`, `import` and `match` say to wrong arguments, before any model is loaded; and `eval`
//! from photos to figures, files and pages, on a small drawn town.
#![cfg(feature = "lab")]

use crate::common::program::{
    self, SIZE, has_model, offline, prints, refused_by, succeeds, town, words,
};
use placeformer_core::types::Calibration;
use serde_json::Value;
use std::path::Path;

/// What the program says to arguments that it refuses before it needs a model.
#[track_caller]
fn refusal(arguments: &[&str], folder: &Path) -> String {
    refused_by(&mut offline(folder, arguments))
}

#[test]
fn eval_needs_one_whole_description_of_the_data() {
    let folder = tempfile::tempdir().unwrap();
    for (arguments, part) in [
        ("eval", "--dataset"),
        ("eval --dataset pitts30k", "--root"),
        ("eval --database a --queries b", "--ground-truth"),
        ("eval --dataset pitts300k --root x", "pitts30k"),
        ("eval --dataset utm --root /nowhere", "@utm_east@utm_north@"),
        ("eval --dataset utm --root /nowhere --radius=-1", "radius"),
        (
            "eval --dataset msls-val --root /nowhere",
            "train_val/<city>",
        ),
        (
            "eval --dataset utm --root /nowhere --scales 4",
            "not a scale",
        ),
    ] {
        let error = refusal(&words(arguments), folder.path());
        assert!(error.contains(part), "{arguments}: {error}");
    }
}

#[test]
fn eval_calibrate_takes_the_same_data_and_its_own_options() {
    let folder = tempfile::tempdir().unwrap();
    for (arguments, part) in [
        ("eval calibrate", "--dataset"),
        ("eval calibrate --dataset pitts30k", "--root"),
        (
            "eval calibrate --dataset utm --root /nowhere",
            "@utm_east@utm_north@",
        ),
        (
            "eval calibrate --dataset utm --root /nowhere --target-precision 1.5",
            "0.99",
        ),
        (
            "eval calibrate --dataset utm --root /nowhere --candidates 0",
            "--candidates",
        ),
        (
            "eval calibrate --dataset utm --root /nowhere --leave-out no",
            "never",
        ),
        (
            "eval calibrate --dataset utm --root /nowhere --no-rerank",
            "--no-rerank",
        ),
        (
            "eval calibrate --dataset utm --root /nowhere --score best",
            "learned",
        ),
        (
            "eval calibrate --dataset utm --root /nowhere --quarters middle",
            "east-quarter",
        ),
        (
            "eval calibrate --dataset utm --root /nowhere --out x.json \
             --quarters east-quarter,west-quarter",
            "one calibration",
        ),
        ("eval --dataset utm --root /nowhere calibrate", "calibrate"),
    ] {
        let error = refusal(&words(arguments), folder.path());
        assert!(error.contains(part), "{arguments}: {error}");
    }
}

#[test]
fn eval_calibrate_says_where_unknown_places_come_from() {
    let folder = tempfile::tempdir().unwrap();
    let output = offline(folder.path(), &["eval", "calibrate", "--help"])
        .output()
        .unwrap();
    let help = String::from_utf8_lossy(&output.stdout);
    let flowing = help.split_whitespace().collect::<Vec<_>>().join(" ");
    assert!(
        output.status.success() && flowing.contains("its own place left out of the database"),
        "{help}"
    );
}

#[test]
fn eval_names_images_the_ground_truth_invents() {
    let folder = tempfile::tempdir().unwrap();
    for name in ["database/a.jpg", "queries/q.jpg"] {
        let path = folder.path().join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, b"x").unwrap();
    }
    std::fs::write(
        folder.path().join("ground_truth.csv"),
        "query,reference\nq.jpg,missing.jpg\n",
    )
    .unwrap();
    let root = folder.path().to_str().unwrap();
    let error = refusal(&["eval", "--dataset", "csv", "--root", root], folder.path());
    assert!(error.contains("missing.jpg"), "{error}");
}

#[test]
fn import_needs_a_target_photos_and_a_reachable_server() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path().to_str().unwrap();
    assert!(refusal(&["import", root, "--map", "m"], folder.path()).contains("--server"));
    let mut nowhere = words("import --map m --server http://127.0.0.1:9 --attempts 1");
    nowhere.push(root);
    assert!(refusal(&nowhere, folder.path()).contains("holds no JPEG"));
    std::fs::write(folder.path().join("a.jpg"), b"x").unwrap();
    assert!(refusal(&nowhere, folder.path()).contains("127.0.0.1:9"));
    let mut bad_map = words("import --server http://127.0.0.1:9 --map");
    bad_map.extend(["a b", root]);
    assert!(refusal(&bad_map, folder.path()).contains("1 to 64"));
}

#[test]
fn match_refuses_a_picture_it_cannot_write_before_loading_the_model() {
    let folder = tempfile::tempdir().unwrap();
    let error = refusal(
        &["match", "a.jpg", "b.jpg", "--out", "match.gif"],
        folder.path(),
    );
    assert!(error.contains(".png"), "{error}");
}

/// `eval` on the town, with everything kept below `folder`.
fn eval<'a>(more: &[&'a str]) -> Vec<&'a str> {
    let mut arguments = words("eval --dataset csv --root town --cache cache --input-size");
    arguments.push(SIZE);
    arguments.extend(more);
    arguments
}

fn keys(value: &Value) -> Vec<&str> {
    value
        .as_object()
        .expect("an object")
        .keys()
        .map(String::as_str)
        .collect()
}

/// Queries that are mapped, each with the reference that shows its place.
fn pairs(folder: &Path) -> Vec<(String, String)> {
    let text = std::fs::read_to_string(folder.join("town/ground_truth.csv")).unwrap();
    let rows = text.lines().skip(1).filter_map(|row| row.split_once(','));
    rows.filter(|row| !row.1.is_empty())
        .map(|(query, reference)| (query.to_owned(), reference.to_owned()))
        .collect()
}

#[test]
fn a_run_measures_resumes_and_survives_lost_images() {
    if !has_model() {
        return;
    }
    let town = town("8", "2");
    let folder = town.path();
    let (text, said) = prints(folder, &eval(&["--json", "out.json"]));
    assert!(
        text.contains("R@1") && !said.contains("described 0 images"),
        "{text}{said}"
    );
    let json: Value =
        serde_json::from_slice(&std::fs::read(folder.join("out.json")).unwrap()).unwrap();
    let queries = std::fs::read_dir(folder.join("town/queries"))
        .unwrap()
        .count();
    assert_eq!(json["queries"], queries);
    for stage in ["global", "reranked"] {
        let recall = &json["recall"][stage];
        let mut depths: Vec<u32> = keys(recall)
            .iter()
            .map(|key| key.parse().unwrap())
            .collect();
        depths.sort_unstable();
        assert_eq!(depths, [1, 5, 10, 20]);
        let at = |k: &str| recall[k].as_f64().unwrap();
        assert!(
            at("1") <= at("5") && at("5") <= at("10") && at("20") == 100.0,
            "{recall}"
        );
    }
    assert!(
        ["extract", "search", "rerank"]
            .iter()
            .all(|stage| json["seconds"][stage].as_f64().unwrap() > 0.0)
    );
    assert!(json["bytes_per_reference"].as_f64().unwrap() > 1000.0);
    assert_eq!(json["config"]["candidates"], 100);

    // One query has a second right answer and loses the first; another loses its only one.
    let [first, second, third, ..] = &pairs(folder)[..] else {
        panic!("the town is too small")
    };
    let path = folder.join("town/ground_truth.csv");
    let more = format!(
        "{}{},{}\n",
        std::fs::read_to_string(&path).unwrap(),
        first.0,
        second.1
    );
    std::fs::write(&path, more).unwrap();
    assert!(
        first.1 < second.1,
        "the first in the database is the one that goes"
    );
    let lost = [&first.1, &third.1];
    lost.iter()
        .for_each(|name| std::fs::write(folder.join("town/database").join(name), b"torn").unwrap());
    let kept = format!("a right answer<br><span class=\"soft\">{}</span>", second.1);
    let (text, said) = prints(folder, &eval(&["--html", "out.html", "--pictures", "16"]));
    assert!(said.contains("described 0 images"), "{said}");
    assert!(text.contains("2 images could not be read"), "{text}");
    let page = std::fs::read_to_string(folder.join("out.html")).unwrap();
    assert!(page.contains("src=\"data:image/jpeg;base64,") && !page.contains("src=\"http"));
    assert_eq!(page.matches("no right answer could be read").count(), 1);
    // The photo that is left is shown for its own query and for the one that lost its first.
    assert_eq!(page.matches(&kept).count(), 2, "{kept}");
}

#[test]
fn a_prediction_file_has_a_line_for_every_query() {
    if !has_model() {
        return;
    }
    let town = town("3", "1");
    let folder = town.path();
    for (side, from) in [("database", "town/database"), ("query", "town/queries")] {
        let target = folder.join("msls/test/miami").join(side);
        std::fs::create_dir_all(target.join("images")).unwrap();
        let mut index = ",key,all\n".to_owned();
        let mut names: Vec<_> = std::fs::read_dir(folder.join(from))
            .unwrap()
            .map(|e| e.unwrap().path())
            .collect();
        names.sort();
        for (row, path) in names.iter().enumerate() {
            std::fs::copy(path, target.join("images").join(format!("{side}{row}.jpg"))).unwrap();
            index += &format!("{row},{side}{row},True\n");
        }
        std::fs::write(target.join("subtask_index.csv"), index).unwrap();
    }
    std::fs::write(
        folder.join("msls/test/miami/query/images/query1.jpg"),
        b"torn",
    )
    .unwrap();
    let mut arguments = words(
        "eval --dataset msls-test --root msls --cities miami --cache c --predictions out.txt \
         --input-size",
    );
    arguments.push(SIZE);
    let (_, said) = prints(folder, &arguments);
    assert!(
        said.contains("1 of the queries could not be answered"),
        "{said}"
    );
    let text = std::fs::read_to_string(folder.join("out.txt")).unwrap();
    let lines: Vec<Vec<&str>> = text.lines().map(|line| line.split(' ').collect()).collect();
    let queries = std::fs::read_dir(folder.join("town/queries"))
        .unwrap()
        .count();
    let references = std::fs::read_dir(folder.join("town/database"))
        .unwrap()
        .count();
    let asked: Vec<String> = (0..queries).map(|row| format!("query{row}")).collect();
    assert_eq!(lines.iter().map(|line| line[0]).collect::<Vec<_>>(), asked);
    for line in &lines {
        let answers: std::collections::BTreeSet<_> = line[1..].iter().collect();
        assert_eq!(
            (line.len(), answers.len()),
            (1 + references, references),
            "{line:?}"
        );
        assert!(
            answers.iter().all(|key| key.starts_with("database")),
            "{line:?}"
        );
    }
}

#[test]
fn a_calibration_is_fitted_and_judged_elsewhere() {
    if !has_model() {
        return;
    }
    let town = town("8", "2");
    let folder = town.path();
    let mut calibrate = words(
        "eval calibrate --dataset csv --root town --cache cache --leave-out always \
         --target-precision 0.8 --out own.json --input-size",
    );
    calibrate.push(SIZE);
    let text = succeeds(folder, &calibrate);
    assert!(text.contains("re-ranked"), "{text}");
    let bytes = std::fs::read(folder.join("own.json")).unwrap();
    let calibration: Calibration = serde_json::from_slice(&bytes).unwrap();
    assert!(calibration.curve(true).right > 0 && calibration.curve(true).wrong > 0);
    // The same answers judge it: as many again cannot be right.
    let more =
        words("--leave-out --calibration own.json --json out.json --html out.html --pictures 0");
    let text = succeeds(folder, &eval(&more));
    assert!(text.contains("of the calibration given"), "{text}");
    let json: Value =
        serde_json::from_slice(&std::fs::read(folder.join("out.json")).unwrap()).unwrap();
    assert_eq!(json["queries_left_out"], json["queries_with_match"]);
    assert!(
        json["given_calibration"]["expected_calibration_error"]
            .as_f64()
            .unwrap()
            < 0.5,
        "{json}"
    );
    let page = std::fs::read_to_string(folder.join("out.html")).unwrap();
    assert!(page.contains("the one given, error"));
    // It holds for this re-ranking only.
    let error = program::refusal(
        folder,
        &eval(&["--calibration", "own.json", "--scales", "1"]),
    );
    assert!(error.contains("re-ranking"), "{error}");
}

#[test]
fn a_score_is_learned_judged_and_used() {
    if !has_model() {
        return;
    }
    let town = town("8", "2");
    let folder = town.path();
    let learn = words(
        "calibrate --score learned --leave-out always --target-precision 0.8 --out own.json \
         --radius 2 --quarters east-quarter",
    );
    let mut arguments = eval(&[]);
    arguments.splice(1..1, learn);
    let text = succeeds(folder, &arguments);
    let rows = ["east-quarter held out", "paper ", "fused ", "learned "];
    assert!(rows.iter().all(|row| text.contains(row)), "{text}");
    let bytes = std::fs::read(folder.join("own.json")).unwrap();
    let calibration: Calibration = serde_json::from_slice(&bytes).unwrap();
    let score = calibration.learned_score().expect("a score was learned");
    assert!(score.terms().iter().any(|term| term.weight != 0.0));

    let learned = ["--score", "learned"];
    let error = program::refusal(folder, &eval(&learned));
    assert!(error.contains("--calibration"), "{error}");
    let with_own = [&learned[..], &["--calibration", "own.json"]].concat();
    let text = succeeds(folder, &eval(&with_own));
    assert!(text.contains("of the calibration given"), "{text}");
    // It was fitted on the features of these combinations only.
    let other_scales = [&with_own[..], &["--scales", "1"]].concat();
    let error = program::refusal(folder, &eval(&other_scales));
    assert!(error.contains("re-ranking"), "{error}");
    succeeds(folder, &eval(&["--score", "fused"]));
}

#[test]
fn the_ablation_marks_its_base_once_on_every_axis() {
    if !has_model() {
        return;
    }
    let town = town("2", "1");
    let folder = town.path();
    let text = succeeds(
        folder,
        &eval(&["--ablate", "--json", "out.json", "--no-rerank"]),
    );
    let json: Value =
        serde_json::from_slice(&std::fs::read(folder.join("out.json")).unwrap()).unwrap();
    let rows = json["ablation"].as_array().unwrap();
    let mut stars = std::collections::BTreeMap::new();
    for row in rows {
        let is_base = row["setting"].as_str().unwrap().ends_with('*');
        *stars.entry(row["axis"].as_str().unwrap()).or_insert(0) += usize::from(is_base);
    }
    assert_eq!(
        stars.into_iter().collect::<Vec<_>>(),
        [
            "backbone",
            "caps",
            "codec",
            "exit block",
            "input size",
            "scales",
            "score",
            "tau"
        ]
        .map(|axis| (axis, 1))
    );
    // The base is the base on whatever axis.
    let base: Vec<&Value> = rows
        .iter()
        .filter(|row| row["setting"].as_str().unwrap().ends_with('*'))
        .collect();
    assert!(
        base.iter().all(|row| row["recall"] == base[0]["recall"]),
        "{text}"
    );
    assert_eq!(
        text.lines()
            .filter(|line| line.starts_with("codec"))
            .count(),
        rows.iter().filter(|row| row["axis"] == "codec").count()
    );
}

#[test]
fn queries_are_followed_as_the_frames_of_a_drive() {
    if !has_model() {
        return;
    }
    let town = town("8", "2");
    let folder = town.path();
    let mut calibrate = words(
        "eval calibrate --dataset csv --root town --cache cache --leave-out always \
         --target-precision 0.8 --out own.json --input-size",
    );
    calibrate.push(SIZE);
    succeeds(folder, &calibrate);
    let more = words(
        "--sequences --spacing 30 --max-speed 40 --calibration own.json --json out.json \
         --html out.html --pictures 0",
    );
    let text = succeeds(folder, &eval(&more));
    assert!(
        text.contains("tracked") && text.contains("lost after"),
        "{text}"
    );
    let json: Value =
        serde_json::from_slice(&std::fs::read(folder.join("out.json")).unwrap()).unwrap();
    let recall = |by: &str| json["recall"][by]["1"].as_f64().unwrap();
    assert!(
        recall("tracked") > 0.0 && recall("reranked") > 0.0,
        "{}",
        json["recall"]
    );
    let sequences = &json["sequences"];
    for side in ["alone", "tracked"] {
        assert_eq!(sequences[side]["judged"], json["queries"], "{sequences}");
    }
    let found = &sequences["found_again"];
    let legs = found["frames"].as_array().unwrap().len() as u64 + found["never"].as_u64().unwrap();
    // Legs have equally many frames, so that few frames make fewer legs than the six asked for.
    let frames_of_a_leg = json["queries"].as_u64().unwrap().div_ceil(6);
    let expected = json["queries"].as_u64().unwrap().div_ceil(frames_of_a_leg) - 1;
    assert_eq!(legs, expected, "{sequences}");
    let page = std::fs::read_to_string(folder.join("out.html")).unwrap();
    assert!(page.contains("Reliability of tracks"));
    let mut without = words("eval --dataset csv --root town --max-speed 3 --input-size");
    without.push(SIZE);
    assert!(program::refusal(folder, &without).contains("--sequences"));
}
