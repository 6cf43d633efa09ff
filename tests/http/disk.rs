//! The disk full, and the disk wrong.

use crate::process::Server;
use crate::small_disk::SmallDisk;
use crate::support::{App, FakeSource, SIZE, picture};
use placeformer::pipeline::DescriptorSource;
use placeformer_store::codec;
use placeformer_vision::image::{ImageConfig, load_tensor};
use serde_json::json;
use std::path::Path;
use std::time::{Duration, Instant};

#[test]
fn a_disk_that_fills_refuses_images_while_queries_and_deletions_go_on() {
    let Some(disk) = SmallDisk::mount() else {
        return;
    };
    let server = Server::start(disk.path(), None);
    let add = |seed: u64| server.post("/references?map=m", picture(seed)).unwrap();
    let refused = |(status, answer): (u16, serde_json::Value)| {
        assert_eq!(
            (status, answer["code"].as_str()),
            (507, Some("disk_full")),
            "{answer}"
        );
    };
    let mut ids = Vec::new();
    let first_refusal = loop {
        match add(ids.len() as u64) {
            (201, answer) => ids.push(answer["id"].as_str().unwrap().to_owned()),
            refusal => break refusal,
        }
    };
    refused(first_refusal);
    assert!(ids.len() > 30, "only {} references fit", ids.len());
    let filler = disk.fill();
    refused(add(1_000_000));
    // A balancer that asks for this goes on sending queries and deletions.
    assert_eq!(server.get("/readyz?for=query").unwrap().0, 200);
    let began = Instant::now();
    while !server
        .text("/metrics")
        .contains("\nplaceformer_disk_free_bytes 0\n")
    {
        assert!(
            began.elapsed() < Duration::from_secs(30),
            "the metrics never say that nothing is free"
        );
        std::thread::sleep(Duration::from_millis(100));
    }
    for (seed, id) in ids.iter().enumerate().step_by(7) {
        let (status, answer) = server
            .post("/query?map=m&top_k=1", picture(seed as u64))
            .unwrap();
        assert_eq!(
            (status, &answer["results"][0]["reference_id"]),
            (200, &json!(id)),
            "{answer}"
        );
    }
    for id in ids.iter().take(5) {
        assert_eq!(server.delete(&format!("/references/{id}")).unwrap().0, 204);
    }
    let (_, page) = server.get("/references?limit=1000").unwrap();
    assert_eq!(page["references"].as_array().unwrap().len(), ids.len() - 5);
    std::fs::remove_file(filler).unwrap();
    let (status, answer) = server.delete("/maps/m").unwrap();
    assert_eq!(
        (status, &answer["references_deleted"]),
        (200, &json!(ids.len() - 5)),
        "{answer}"
    );
    // The server looks at the disk every other second, and frees the map's room in the background.
    let began = Instant::now();
    while add(1_000_001).0 != 201 {
        assert!(
            began.elapsed() < Duration::from_secs(30),
            "room was made, and the server does not use it"
        );
        std::thread::sleep(Duration::from_millis(100));
    }
    server.kill();
}

/// Flips one bit of the only place where the closed database holds `bytes`.
fn flip(directory: &Path, bytes: &[u8]) {
    let path = directory.join("placeformer.db");
    let mut content = std::fs::read(&path).unwrap();
    let places: Vec<usize> = content
        .windows(bytes.len())
        .enumerate()
        .filter(|(_, window)| *window == bytes)
        .map(|(at, _)| at)
        .collect();
    assert_eq!(
        places.len(),
        1,
        "the bytes to damage are not there exactly once"
    );
    content[places[0] + bytes.len() / 2] ^= 0x10;
    std::fs::write(path, content).unwrap();
}

/// Damages the key patches of `picture(seed)` in the closed database.
pub fn damage_patches(directory: &Path, seed: u64) {
    let image = load_tensor(&picture(seed), &ImageConfig::default(), SIZE).unwrap();
    let victim = FakeSource::new("fake-1")
        .describe(&[image])
        .unwrap()
        .remove(0);
    let blob = codec::encode(&victim.patches).unwrap();
    flip(directory, &blob[blob.len() / 2..][..40]);
}

#[tokio::test]
async fn damaged_patches_are_set_aside_reported_and_replaced() {
    let app = App::new();
    let mut ids = Vec::new();
    for seed in 0..5 {
        let answer = app
            .post_png(&format!("/references?map=m&external_id={seed}"), seed)
            .await;
        ids.push(answer.created()["id"].as_str().unwrap().to_owned());
    }
    let (directory, source) = (app.directory.clone(), app.source.clone());
    drop(app);
    damage_patches(directory.path(), 2);
    let app = App::open(directory, source, |_| {});
    let answer = app.post_png("/query?map=m", 2).await;
    let places: Vec<_> = answer.ok()["results"]
        .as_array()
        .unwrap()
        .iter()
        .map(|r| r["reference_id"].clone())
        .collect();
    assert_eq!(places.len(), 4);
    assert!(!places.contains(&ids[2].clone().into()), "{places:?}");
    assert!(
        app.get(&format!("/references/{}", ids[2]))
            .await
            .problem("corrupt_record")
            .contains(&ids[2])
    );
    let metrics = app.get("/metrics").await.text;
    assert!(
        metrics.contains("placeformer_corrupt_records_total 1"),
        "{metrics}"
    );
    assert!(
        metrics.contains("placeformer_quarantined_references 1"),
        "{metrics}"
    );
    // The same photo sent again takes its place.
    app.post_png("/references?map=m&external_id=2", 2)
        .await
        .created();
    let answer = app.post_png("/query?map=m&top_k=1", 2).await;
    assert_eq!(answer.ok()["results"][0]["external_id"], "2");
    assert!(
        app.get("/metrics")
            .await
            .text
            .contains("placeformer_quarantined_references 0")
    );
}
