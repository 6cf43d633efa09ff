//! From photos to places with the real model: a town is imported into a server and recognised
//! again.
#![cfg(feature = "lab")]

use crate::common::program::{Server, command, has_model, succeeds};
use serde_json::Value;
use std::path::Path;

/// Half the default: the smallest size at which streets are told apart.
const RECOGNISABLE_SIZE: &str = "{width=224,height=168}";

/// Query and reference, one pair a row; the reference is empty where the place is not mapped.
fn pairs(folder: &Path) -> Vec<(String, String)> {
    let text = std::fs::read_to_string(folder.join("town/ground_truth.csv")).unwrap();
    let rows = text.lines().skip(1).filter_map(|row| row.split_once(','));
    rows.map(|(query, reference)| (query.to_owned(), reference.to_owned()))
        .collect()
}

#[test]
fn a_town_is_imported_and_recognised() {
    if !has_model() {
        return;
    }
    let town = tempfile::tempdir().unwrap();
    let folder = town.path();
    // A town that the built-in head has not seen.
    let drawn = [
        "synth", "--out", "town", "--places", "8", "--views", "1", "--seed", "7", "--size",
        "320x240",
    ];
    succeeds(folder, &drawn);
    let arguments = ["serve", "--listen", "127.0.0.1:0", "--data", "store"];
    let mut serve = command(folder, &arguments);
    serve.env("PLACEFORMER_EXTRACT__INPUT_SIZE", RECOGNISABLE_SIZE);
    let server = Server::start(serve);
    succeeds(folder, &["healthcheck", "--server", &server.url]);
    let target = ["--map", "town", "--server", &server.url];
    succeeds(
        folder,
        &[&["import", "town/database"][..], &target].concat(),
    );
    let pairs = pairs(folder);
    let mut queries: Vec<&str> = pairs
        .iter()
        .filter(|(_, reference)| !reference.is_empty())
        .map(|pair| pair.0.as_str())
        .collect();
    queries.dedup();
    assert!(queries.len() >= 8, "{queries:?}");
    let first_is_right = |query: &&&str| {
        let photo = format!("town/queries/{query}");
        let answer = succeeds(
            folder,
            &[&["query", &photo, "--json"][..], &target].concat(),
        );
        let answer: Value = serde_json::from_str(&answer).unwrap();
        assert_eq!(
            (&answer["reranked"], &answer["results"][0]["rank"]),
            (&Value::Bool(true), &1.into()),
            "{answer}"
        );
        let name = answer["results"][0]["external_id"].as_str().unwrap();
        pairs
            .iter()
            .any(|(asked, reference)| asked == **query && reference == name)
    };
    let right = queries.iter().filter(first_is_right).count();
    assert!(
        2 * right > queries.len(),
        "{right} of {} queries are right",
        queries.len()
    );
}

#[test]
fn the_demo_runs_to_its_report() {
    if !has_model() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let arguments = [
        "demo",
        "--places",
        "4",
        "--views",
        "1",
        "--pictures",
        "1",
        "--out",
        "shown",
    ];
    let said = succeeds(folder.path(), &arguments);
    let page = std::fs::read_to_string(folder.path().join("shown/index.html")).unwrap();
    assert!(
        page.contains("<html") && page.contains("data:image/") && said.contains("index.html"),
        "{said}"
    );
    assert!(folder.path().join("shown/match-1.png").exists());
    // Pictures lead, and places have names that a person would give them.
    assert!(page.find("data:image/") < page.find("<table"));
    assert!(page.contains("Query of place ") && page.contains("<svg"));
    assert!(
        !page.contains("@359"),
        "names of files are no names for a person"
    );
}
