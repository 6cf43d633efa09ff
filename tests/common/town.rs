//! The program on a small drawn town, as a user would run it.
#![allow(dead_code, reason = "each test file uses its own part")]

use placeformer_models::model_path;
use placeformer_vision::extract::Preset;
use std::path::Path;
use std::process::{Command, Output};

/// Small images: what is tested is the way from flags to files, not recall.
pub const SIZE: &str = "84x84";
/// The same, as a setting.
pub const SERVED_SIZE: &str = "{width=84,height=84}";

/// Whether the model is there; a run without it must say so.
pub fn has_model() -> bool {
    let path = model_path(Preset::Dinov2Vits14).unwrap();
    if !path.exists() && std::env::var("PLACEFORMER_TEST_NO_MODEL").is_ok_and(|value| value == "1")
    {
        println!(
            "skipped: no model at {} and PLACEFORMER_TEST_NO_MODEL=1",
            path.display()
        );
        return false;
    }
    assert!(
        path.exists(),
        "no model at {}: run `placeformer model pull dinov2-vits14` first",
        path.display()
    );
    true
}

/// The program in `folder`, whatever the environment of the tests says.
pub fn command(folder: &Path, arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_placeformer"));
    command
        .args(arguments)
        .current_dir(folder)
        .env_remove("PLACEFORMER_WEIGHTS")
        .env_remove("PLACEFORMER_CONFIG");
    command.env("PLACEFORMER_EXTRACT__INPUT_SIZE", SERVED_SIZE);
    command
}

pub fn placeformer(folder: &Path, arguments: &[&str]) -> Output {
    command(folder, arguments)
        .output()
        .expect("the binary was built")
}

/// What it prints when it succeeds, to the user and about its progress.
#[track_caller]
pub fn prints(folder: &Path, arguments: &[&str]) -> (String, String) {
    let output = placeformer(folder, arguments);
    let error = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.success(), "{arguments:?}: {error}");
    (String::from_utf8(output.stdout).unwrap(), error)
}

#[track_caller]
pub fn succeeds(folder: &Path, arguments: &[&str]) -> String {
    prints(folder, arguments).0
}

#[track_caller]
pub fn refusal(folder: &Path, arguments: &[&str]) -> String {
    let output = placeformer(folder, arguments);
    assert!(!output.status.success(), "{arguments:?} succeeded");
    String::from_utf8(output.stderr).unwrap()
}

/// So many places along a street, some references and a query each, and queries from elsewhere.
pub fn town(places: &str, views: &str) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    succeeds(
        folder.path(),
        &[
            "synth", "--out", "town", "--places", places, "--views", views, "--size", "96x72",
        ],
    );
    folder
}
