//! A server of one's own weights and head, as `train` writes them, and where its settings come
//! from: the real binary.

use placeformer_core::progress::Silent;
use placeformer_core::types::{GLOBAL_DIM, ImageSize};
use placeformer_models::open_extractor;
use placeformer_vision::extract::{
    Aggregate, BlockWeights, ExtractConfig, Head, HeadChoice, Linear, Norm, Preset, VitWeights,
};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

/// The paper's geometry, of which no weights are published, with made-up values.
fn weights() -> VitWeights {
    let preset = Preset::PlaceformerVits16;
    let (geometry, mut random) = (preset.geometry(), ChaCha8Rng::seed_from_u64(7));
    let (dim, mlp, patch) = (geometry.dim, geometry.mlp_dim, geometry.patch);
    let mut values = |count: usize| {
        (0..count)
            .map(|_| random.random_range(-0.05..0.05))
            .collect::<Vec<f32>>()
    };
    let norm = || Norm {
        weight: vec![1.0; dim],
        bias: vec![0.0; dim],
    };
    let mut linear = |from: usize, to: usize| Linear {
        weight: values(from * to),
        bias: vec![0.0; to],
    };
    let patch_embed = linear(3 * patch * patch, dim);
    let blocks = (0..geometry.depth)
        .map(|_| BlockWeights {
            norm1: norm(),
            qkv: linear(dim, 3 * dim),
            proj: linear(dim, dim),
            layer_scale1: None,
            norm2: norm(),
            fc1: linear(dim, mlp),
            fc2: linear(mlp, dim),
            layer_scale2: None,
        })
        .collect();
    let position_grid = (14, 14);
    VitWeights {
        preset,
        geometry,
        position_grid,
        patch_embed,
        cls_token: values(dim),
        positions: values((1 + position_grid.0 * position_grid.1) * dim),
        blocks,
        norm: norm(),
        unused_parameters: 0,
    }
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
        let with_head = open_extractor(
            &ExtractConfig {
                head: HeadChoice::File(head_path),
                ..config
            },
            &Silent,
        )
        .unwrap();
        let text = "[extract]\npreset = \"placeformer-vits16\"\ninput_size = { width = 64, height = 48 }\n\
                    [pipeline]\ndisk_reserve_bytes = 0\n[store]\nreserve_bytes = 1048576\n";
        std::fs::write(folder.path().join("placeformer.toml"), text).unwrap();
        Self {
            model: with_head.model_id().to_string(),
            folder,
        }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn command(&self, arguments: &[&str]) -> Command {
        let mut command = command(self.folder.path(), arguments);
        command.arg("--config").arg(self.path("placeformer.toml"));
        command
    }
}

/// The binary where nothing can be fetched and nothing is set but what a test sets.
fn command(folder: &Path, arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_placeformer"));
    for (name, _) in
        std::env::vars_os().filter(|(name, _)| name.to_string_lossy().starts_with("PLACEFORMER_"))
    {
        command.env_remove(name);
    }
    command
        .args(arguments)
        .env("PLACEFORMER_CACHE", folder.join("cache"))
        .env("HF_ENDPOINT", "http://127.0.0.1:9");
    command.current_dir(folder);
    command
}

/// A running server; killed when dropped.
struct Server {
    child: Child,
    url: String,
    http: reqwest::blocking::Client,
}

impl Server {
    fn start(mut command: Command) -> Self {
        let mut child = command
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
        let url =
            lines.find_map(|line| Some(line.unwrap().strip_prefix("listening on ")?.to_owned()));
        // Fails only if one is installed already, which is as good.
        let _ = rustls::crypto::ring::default_provider().install_default();
        let http = reqwest::blocking::Client::builder()
            .timeout(Duration::from_secs(60))
            .build()
            .unwrap();
        let server = Self {
            child,
            url: url.expect("the server did not start"),
            http,
        };
        let began = Instant::now();
        while server
            .http
            .get(format!("{}/readyz", server.url))
            .send()
            .is_ok_and(|answer| answer.status() != 200)
        {
            assert!(
                began.elapsed() < Duration::from_secs(120),
                "the server never became ready"
            );
            std::thread::sleep(Duration::from_millis(20));
        }
        server
    }

    fn get(&self, path: &str) -> serde_json::Value {
        self.http
            .get(format!("{}{path}", self.url))
            .send()
            .unwrap()
            .json()
            .unwrap()
    }

    fn post(&self, path: &str, body: Vec<u8>) -> (u16, serde_json::Value) {
        let request = self
            .http
            .post(format!("{}{path}", self.url))
            .header("content-type", "image/png")
            .body(body);
        let answer = request.send().unwrap();
        (answer.status().as_u16(), answer.json().unwrap())
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        // It may have died by itself, which the test has then told.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn picture(seed: u64) -> Vec<u8> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let pixels = image::RgbImage::from_fn(64, 48, |_, _| image::Rgb(random.random()));
    let mut bytes = std::io::Cursor::new(Vec::new());
    pixels
        .write_to(&mut bytes, image::ImageFormat::Png)
        .unwrap();
    bytes.into_inner()
}

#[test]
fn weights_and_head_of_ones_own_are_served_and_imported_with() {
    let own = Own::new();
    let photos = own.path("photos");
    std::fs::create_dir(&photos).unwrap();
    for seed in 0..2 {
        std::fs::write(photos.join(format!("{seed}.png")), picture(seed)).unwrap();
    }
    let flags = [
        "--weights",
        "weights.safetensors",
        "--head",
        "head.safetensors",
        "--precision",
        "f32",
    ];
    let import = [
        &["import", "photos", "--map", "m", "--data", "data"],
        &flags[..],
    ]
    .concat();
    let imported = own.command(&import).output().unwrap();
    assert!(
        imported.status.success(),
        "{}",
        String::from_utf8_lossy(&imported.stderr)
    );
    let serve = ["serve", "--listen", "127.0.0.1:0", "--data", "data"];
    let server = Server::start(own.command(&[&serve, &flags[..]].concat()));
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
fn the_variable_that_other_commands_read_counts_for_the_server_too() {
    let own = Own::new();
    let mut command = own.command(&[
        "serve",
        "--listen",
        "127.0.0.1:0",
        "--data",
        "data",
        "--head",
        "head.safetensors",
    ]);
    command.env("PLACEFORMER_WEIGHTS", own.path("weights.safetensors"));
    assert_eq!(
        Server::start(command).get("/info")["model"],
        own.model.as_str()
    );
}

fn refusal(output: &Output) -> String {
    assert!(!output.status.success());
    String::from_utf8_lossy(&output.stderr).into_owned()
}

#[test]
fn a_server_that_could_not_search_does_not_start_and_says_what_to_set() {
    let own = Own::new();
    let serve = ["serve", "--listen", "127.0.0.1:0", "--data", "data"];
    for (flags, parts) in [
        (&["--head", "none"][..], &["extract.head", "head fit"][..]),
        (
            &[],
            &["no weights are published", "--weights", "extract.weights"],
        ),
        (
            &["--weights", "weights.safetensors"],
            &["no head is built in", "--head", "extract.head"],
        ),
        (
            &["--weights", "missing.safetensors"],
            &["missing.safetensors"],
        ),
    ] {
        let error = refusal(&own.command(&[&serve, flags].concat()).output().unwrap());
        assert!(
            parts.iter().all(|part| error.contains(part)),
            "{flags:?}: {error}"
        );
    }
}

#[test]
fn nothing_is_fetched_where_that_is_forbidden() {
    let folder = tempfile::tempdir().unwrap();
    let error = refusal(
        &command(folder.path(), &["model", "pull"])
            .env("PLACEFORMER_OFFLINE", "1")
            .output()
            .unwrap(),
    );
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
    let arguments = [
        "serve",
        "--print-config",
        "--config",
        "placeformer.toml",
        "--log",
        "error",
    ];
    let mut printing = command(folder.path(), &arguments);
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
    let again = command(
        folder.path(),
        &["serve", "--print-config", "--config", "printed.toml"],
    )
    .output()
    .unwrap();
    assert_eq!(String::from_utf8(again.stdout).unwrap(), printed);
    let mut misspelt = command(folder.path(), &["serve", "--print-config"]);
    let error = refusal(
        &misspelt
            .env("PLACEFORMER_HTTP_MAX_PAGE", "1")
            .output()
            .unwrap(),
    );
    assert!(error.contains("PLACEFORMER_HTTP__MAX_PAGE"), "{error}");
}
