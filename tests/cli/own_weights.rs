//! A server of one's own weights and head, as `train` writes them, and where its settings come
//! from: the real binary.

use crate::common::noise;
use crate::common::program::{Server, offline, refused_by, words};
use crate::common::weights::made_up;
use placeformer_core::progress::Silent;
use placeformer_core::types::{GLOBAL_DIM, ImageSize};
use placeformer_models::open_extractor;
use placeformer_vision::extract::{
    Aggregate, Difference, ExtractConfig, Head, HeadChoice, Preset, VitWeights,
};
use std::path::PathBuf;
use std::process::Command;

/// A server on a free port, with its data in the folder `data`.
const SERVE: &str = "serve --listen 127.0.0.1:0 --data data";

/// A configuration that names the geometry, and neither weights nor head.
const SETTINGS: &str = r#"
[extract]
preset = "placeformer-vits16"
input_size = { width = 64, height = 48 }

[pipeline]
disk_reserve_bytes = 0

[store]
reserve_bytes = 1048576
"#;

/// The paper's geometry, of which no weights are published, with made-up values.
fn weights() -> VitWeights {
    let preset = Preset::PlaceformerVits16;
    made_up(preset, preset.geometry(), (14, 14), 7)
}

/// A folder with weights, a head that fits them, and a configuration that names only the geometry.
struct Own {
    folder: tempfile::TempDir,
    model: String,
}

impl Own {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let config = ExtractConfig {
            preset: Preset::PlaceformerVits16,
            // Small, so that an unoptimised build answers soon.
            input_size: Some(ImageSize {
                width: 64,
                height: 48,
            }),
            weights: Some(folder.path().join("weights.safetensors")),
            head: HeadChoice::None,
            ..Default::default()
        };
        weights().save(config.weights.as_ref().unwrap()).unwrap();
        let without_head = open_extractor(&config, &Silent).unwrap();
        let weight = (0..GLOBAL_DIM * 384)
            .map(|i| ((i * 37 % 101) as f32 - 50.0) / 100.0)
            .collect();
        let bias = vec![0.0; GLOBAL_DIM];
        let head = Head::new(
            Aggregate::Mean,
            weight,
            bias,
            without_head.backbone(),
            Default::default(),
        )
        .unwrap();
        let head_path = folder.path().join("head.safetensors");
        head.save(&head_path).unwrap();
        let config = ExtractConfig {
            head: HeadChoice::File(head_path),
            ..config
        };
        let with_head = open_extractor(&config, &Silent).unwrap();
        std::fs::write(folder.path().join("placeformer.toml"), SETTINGS).unwrap();
        Self {
            model: with_head.model_id().to_string(),
            folder,
        }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn command(&self, arguments: &[&str]) -> Command {
        let mut command = offline(self.folder.path(), arguments);
        command.arg("--config").arg(self.path("placeformer.toml"));
        command
    }
}

fn picture(seed: u64) -> Vec<u8> {
    noise::png(seed, 64, 48)
}

#[test]
fn weights_and_head_of_ones_own_are_served_and_imported_with() {
    let own = Own::new();
    let photos = own.path("photos");
    std::fs::create_dir(&photos).unwrap();
    for seed in 0..2 {
        std::fs::write(photos.join(format!("{seed}.png")), picture(seed)).unwrap();
    }
    let flags = words("--weights weights.safetensors --head head.safetensors --precision f32");
    let import = [words("import photos --map m --data data"), flags.clone()].concat();
    let imported = own.command(&import).output().unwrap();
    assert!(
        imported.status.success(),
        "{}",
        String::from_utf8_lossy(&imported.stderr)
    );
    let serve = [words(SERVE), flags].concat();
    let server = Server::start(own.command(&serve));
    assert_eq!(server.get("/info")["model"], own.model.as_str());
    assert_eq!(
        server
            .post("/references?map=m&external_id=new", picture(2))
            .0,
        201
    );
    for (seed, name) in [(0, "0.png"), (1, "1.png"), (2, "new")] {
        let (status, answer) = server.post("/query?map=m&top_k=1", picture(seed));
        assert_eq!(
            (status, &answer["results"][0]["external_id"]),
            (200, &name.into()),
            "{answer}"
        );
    }
}

#[test]
fn a_difference_is_merged_and_part_of_the_model_and_refused_by_other_weights() {
    let own = Own::new();
    let mut trained = weights();
    trained.blocks[11].proj.bias[3] += 0.5;
    let difference = Difference::between(&weights(), &trained, Default::default()).unwrap();
    difference
        .save(&own.path("difference.safetensors"))
        .unwrap();
    let serve = [words(SERVE), words("--weights weights.safetensors")].concat();
    // The head is that of the weights without the difference.
    let with_difference = [serve.clone(), words("--difference difference.safetensors")].concat();
    let wrong_head = [with_difference.clone(), words("--head head.safetensors")].concat();
    let error = refused_by(&mut own.command(&wrong_head));
    let part = format!(":d{}", &difference.content_hash()[..12]);
    assert!(
        error.contains("was fitted for") && error.contains(&part),
        "{error}"
    );

    let head = Head::load(&own.path("head.safetensors")).unwrap();
    let hash = weights().content_hash();
    let bound = head
        .backbone()
        .replace(&hash[..12], &format!("{}{part}", &hash[..12]));
    let (weight, bias) = head.weights();
    let head = Head::new(
        Aggregate::Mean,
        weight.to_vec(),
        bias.to_vec(),
        bound.clone(),
        Default::default(),
    );
    head.unwrap().save(&own.path("bound.safetensors")).unwrap();
    let with_head = [with_difference, words("--head bound.safetensors")].concat();
    let server = Server::start(own.command(&with_head));
    let model = server.get("/info")["model"].to_string();
    assert!(model.contains(&bound) && model != own.model, "{model}");

    let other = made_up(
        Preset::PlaceformerVits16,
        Preset::PlaceformerVits16.geometry(),
        (14, 14),
        8,
    );
    let another = Difference::between(&other, &weights(), Default::default()).unwrap();
    another.save(&own.path("another.safetensors")).unwrap();
    let refused = [
        serve,
        words("--difference another.safetensors --head bound.safetensors"),
    ];
    let error = refused_by(&mut own.command(&refused.concat()));
    assert!(
        error.contains("belongs to weights") && error.contains(&hash),
        "{error}"
    );
}

#[test]
fn the_variable_that_other_commands_read_counts_for_the_server_too() {
    let own = Own::new();
    let serve = [words(SERVE), words("--head head.safetensors")].concat();
    let mut command = own.command(&serve);
    command.env("PLACEFORMER_WEIGHTS", own.path("weights.safetensors"));
    assert_eq!(
        Server::start(command).get("/info")["model"],
        own.model.as_str()
    );
}

#[test]
fn a_server_that_could_not_search_does_not_start_and_says_what_to_set() {
    let own = Own::new();
    for (flags, parts) in [
        ("--head none", &["extract.head", "head fit"][..]),
        (
            "",
            &["no weights are published", "--weights", "extract.weights"],
        ),
        (
            "--weights weights.safetensors",
            &["no head is built in", "--head", "extract.head"],
        ),
        ("--weights missing.safetensors", &["missing.safetensors"]),
    ] {
        let serve = [words(SERVE), words(flags)].concat();
        let error = refused_by(&mut own.command(&serve));
        assert!(
            parts.iter().all(|part| error.contains(part)),
            "{flags:?}: {error}"
        );
    }
}

#[test]
fn nothing_is_fetched_where_that_is_forbidden() {
    let folder = tempfile::tempdir().unwrap();
    let mut pulling = offline(folder.path(), &["model", "pull"]);
    let error = refused_by(pulling.env("PLACEFORMER_OFFLINE", "1"));
    assert!(
        error.contains("PLACEFORMER_OFFLINE") && !error.contains("Tried"),
        "{error}"
    );
}

#[test]
fn flags_win_over_variables_and_variables_over_the_file() {
    let folder = tempfile::tempdir().unwrap();
    let text = "[http]\nmax_page = 11\nmax_connections = 12\n[log]\nfilter = \"warn\"\n";
    std::fs::write(folder.path().join("placeformer.toml"), text).unwrap();
    let arguments = words("serve --print-config --config placeformer.toml --log error");
    let mut printing = offline(folder.path(), &arguments);
    printing
        .env("PLACEFORMER_HTTP__MAX_CONNECTIONS", "13")
        .env("PLACEFORMER_LOG__FILTER", "debug");
    let output = printing.output().unwrap();
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
    let printed = String::from_utf8(output.stdout).unwrap();
    let table: toml::Table = printed.parse().unwrap();
    assert_eq!(table["http"]["max_page"].as_integer(), Some(11));
    assert_eq!(table["http"]["max_connections"].as_integer(), Some(13));
    assert_eq!(table["log"]["filter"].as_str(), Some("error"));
    // What is printed is explained, and is a configuration that prints the same.
    assert!(
        printed.contains("# Most references in one page of a listing."),
        "{printed}"
    );
    std::fs::write(folder.path().join("printed.toml"), &printed).unwrap();
    let again = offline(
        folder.path(),
        &["serve", "--print-config", "--config", "printed.toml"],
    )
    .output()
    .unwrap();
    assert_eq!(String::from_utf8(again.stdout).unwrap(), printed);
    let mut misspelt = offline(folder.path(), &["serve", "--print-config"]);
    let error = refused_by(misspelt.env("PLACEFORMER_HTTP_MAX_PAGE", "1"));
    assert!(error.contains("PLACEFORMER_HTTP__MAX_PAGE"), "{error}");
}
