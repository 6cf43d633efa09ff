//! What `eval`, `import` and `match` say to wrong arguments, before any model is loaded.

use std::path::Path;
use std::process::{Command, Output};

fn placeformer(arguments: &[&str], folder: &Path) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_placeformer"));
    // An empty cache and no network address: whatever gets as far as the model fails for that reason instead.
    command.args(arguments).env("PLACEFORMER_CACHE", folder.join("cache")).env("HF_ENDPOINT", "http://127.0.0.1:9");
    command.env_remove("PLACEFORMER_WEIGHTS").env_remove("PLACEFORMER_CONFIG").env("PATH", "");
    command.output().expect("the binary was built")
}

fn refusal(arguments: &[&str], folder: &Path) -> String {
    let output = placeformer(arguments, folder);
    assert!(!output.status.success(), "{arguments:?} succeeded");
    String::from_utf8_lossy(&output.stderr).into_owned()
}

#[test]
fn eval_needs_one_whole_description_of_the_data() {
    let folder = tempfile::tempdir().unwrap();
    for (arguments, part) in [
        (&["eval"][..], "--dataset"),
        (&["eval", "--dataset", "pitts30k"], "--root"),
        (&["eval", "--database", "a", "--queries", "b"], "--ground-truth"),
        (&["eval", "--dataset", "pitts300k", "--root", "x"], "pitts30k"),
        (&["eval", "--dataset", "utm", "--root", "/nowhere"], "@utm_east@utm_north@"),
        (&["eval", "--dataset", "utm", "--root", "/nowhere", "--radius=-1"], "radius"),
        (&["eval", "--dataset", "msls-val", "--root", "/nowhere"], "train_val/<city>"),
        (&["eval", "--dataset", "utm", "--root", "/nowhere", "--scales", "4"], "not a scale"),
    ] {
        let error = refusal(arguments, folder.path());
        assert!(error.contains(part), "{arguments:?}: {error}");
    }
}

#[test]
fn eval_calibrate_takes_the_same_data_and_its_own_options() {
    let folder = tempfile::tempdir().unwrap();
    for (arguments, part) in [
        (&["eval", "calibrate"][..], "--dataset"),
        (&["eval", "calibrate", "--dataset", "pitts30k"], "--root"),
        (&["eval", "calibrate", "--dataset", "utm", "--root", "/nowhere"], "@utm_east@utm_north@"),
        (&["eval", "calibrate", "--dataset", "utm", "--root", "/nowhere", "--target-precision", "1.5"], "0.99"),
        (&["eval", "calibrate", "--dataset", "utm", "--root", "/nowhere", "--candidates", "0"], "--candidates"),
        (&["eval", "calibrate", "--dataset", "utm", "--root", "/nowhere", "--leave-out", "no"], "never"),
        (&["eval", "calibrate", "--dataset", "utm", "--root", "/nowhere", "--no-rerank"], "--no-rerank"),
        (&["eval", "--dataset", "utm", "--root", "/nowhere", "calibrate"], "calibrate"),
    ] {
        let error = refusal(arguments, folder.path());
        assert!(error.contains(part), "{arguments:?}: {error}");
    }
}

#[test]
fn eval_calibrate_says_where_unknown_places_come_from() {
    let folder = tempfile::tempdir().unwrap();
    let output = placeformer(&["eval", "calibrate", "--help"], folder.path());
    let help = String::from_utf8_lossy(&output.stdout);
    let flowing = help.split_whitespace().collect::<Vec<_>>().join(" ");
    assert!(output.status.success() && flowing.contains("its own place left out of the database"), "{help}");
}

#[test]
fn eval_names_images_the_ground_truth_invents() {
    let folder = tempfile::tempdir().unwrap();
    for name in ["database/a.jpg", "queries/q.jpg"] {
        let path = folder.path().join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, b"x").unwrap();
    }
    std::fs::write(folder.path().join("ground_truth.csv"), "query,reference\nq.jpg,missing.jpg\n").unwrap();
    let root = folder.path().to_str().unwrap();
    let error = refusal(&["eval", "--dataset", "csv", "--root", root], folder.path());
    assert!(error.contains("missing.jpg"), "{error}");
}

#[test]
fn import_needs_a_target_photos_and_a_reachable_server() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path().to_str().unwrap();
    assert!(refusal(&["import", root, "--map", "m"], folder.path()).contains("--server"));
    let nowhere = ["import", root, "--map", "m", "--server", "http://127.0.0.1:9", "--attempts", "1"];
    assert!(refusal(&nowhere, folder.path()).contains("holds no JPEG"));
    std::fs::write(folder.path().join("a.jpg"), b"x").unwrap();
    assert!(refusal(&nowhere, folder.path()).contains("127.0.0.1:9"));
    let bad_map = ["import", root, "--map", "a b", "--server", "http://127.0.0.1:9"];
    assert!(refusal(&bad_map, folder.path()).contains("1 to 64"));
}

#[test]
fn match_refuses_a_picture_it_cannot_write_before_loading_the_model() {
    let folder = tempfile::tempdir().unwrap();
    let error = refusal(&["match", "a.jpg", "b.jpg", "--out", "match.gif"], folder.path());
    assert!(error.contains(".png"), "{error}");
}
