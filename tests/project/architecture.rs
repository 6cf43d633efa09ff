//! The rules about imports that Cargo cannot enforce, because they hold inside one package.
//!
//! Between the crates of the workspace the dependencies of each `Cargo.toml` decide who may use
//! whom, and the lint `unsafe_code` keeps `unsafe` inside `crates/kernels`.

use crate::rust_source::{Names, SourceFile, names, read_crate};
use std::path::{Path, PathBuf};

/// Modules of the service. Each may import those before it and none after it.
const SERVICE_LAYERS: &[&str] = &["ops", "pipeline", "http", "config", "server", "cli"];

/// Modules of `crates/vision` that never import each other: the pipeline composes them.
const STAGES: &[&str] = &["image", "extract", "search", "rerank"];

/// Crates that only some modules of a package may name: package, crate, modules.
const CRATE_OWNERS: &[(&str, &str, &[&str])] = &[
    (SERVICE, "axum", &["http"]),
    (SERVICE, "tower_http", &["http"]),
    (SERVICE, "utoipa_axum", &["http"]),
    (SERVICE, "utoipa_swagger_ui", &["http"]),
    (SERVICE, "anyhow", &["cli", "main"]),
    ("vision", "candle_core", &["extract"]),
    ("vision", "candle_nn", &["extract"]),
    ("vision", "jpeg_decoder", &["image"]),
    ("vision", "zune_jpeg", &["image"]),
];

/// Macros that write to the terminal. A library logs instead.
const TERMINAL_MACROS: &[&str] = &["println", "eprintln", "print", "eprint", "dbg"];

/// The root package's name in [`CRATE_OWNERS`]; the others go by their folder below `crates/`.
const SERVICE: &str = "placeformer";

fn workspace() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// Every package of the workspace with its folder, the service first.
fn packages() -> Vec<(String, PathBuf)> {
    let folder = workspace().join("crates");
    let entries = std::fs::read_dir(&folder).expect("the crates are readable");
    let mut packages: Vec<(String, PathBuf)> = entries
        .map(|entry| entry.unwrap())
        .map(|entry| (entry.file_name().into_string().unwrap(), entry.path()))
        .collect();
    packages.sort();
    packages.insert(0, (SERVICE.to_owned(), workspace().to_path_buf()));
    packages
}

/// Every broken rule of one source file, in words.
fn violations(package: &str, module: &str, names: &Names) -> Vec<String> {
    let mut broken = broken_imports(package, module, names);
    broken.extend(broken_owners(package, module, names));
    broken.extend(broken_macros(package, module, names));
    broken
}

fn broken_imports(package: &str, module: &str, names: &Names) -> Vec<String> {
    let is_root = module == "lib" || module == "main";
    let others = names.modules.iter().filter(|other| *other != module);
    let forbidden = |message: String| format!("`{module}` must not import {message}");
    match package {
        SERVICE if is_root => Vec::new(),
        SERVICE => {
            let Some(layer) = SERVICE_LAYERS.iter().position(|layer| *layer == module) else {
                return vec![format!("`{module}` has no place among the layers")];
            };
            others
                .filter(|other| SERVICE_LAYERS[layer..].contains(&other.as_str()))
                .map(|other| forbidden(format!("`{other}`, a layer above it")))
                .collect()
        }
        "vision" if !is_root => others
            .filter(|other| STAGES.contains(&other.as_str()))
            .map(|other| forbidden(format!("the stage `{other}`")))
            .collect(),
        _ => Vec::new(),
    }
}

fn broken_owners(package: &str, module: &str, names: &Names) -> Vec<String> {
    CRATE_OWNERS
        .iter()
        .filter(|(within, outside, owners)| {
            *within == package && names.path_heads.contains(*outside) && !owners.contains(&module)
        })
        .map(|(_, outside, owners)| format!("`{outside}` may be named in {owners:?} only"))
        .collect()
}

fn broken_macros(package: &str, module: &str, names: &Names) -> Vec<String> {
    let writes_to_user = package == SERVICE && (module == "cli" || module == "main");
    let (forbidden, instead) = if writes_to_user {
        (
            TERMINAL_MACROS,
            "it panics on a closed pipe; use say! or note!",
        )
    } else {
        (TERMINAL_MACROS, "a library logs; use tracing")
    };
    forbidden
        .iter()
        .filter(|name| names.macros.contains(**name))
        .map(|name| format!("`{name}!`: {instead}"))
        .collect()
}

#[test]
fn every_source_file_keeps_the_rules() {
    let mut broken = Vec::new();
    for (package, folder) in packages() {
        for SourceFile {
            path,
            module,
            names,
        } in read_crate(&folder.join("src"))
        {
            let of_file = violations(&package, &module, &names);
            broken.extend(
                of_file
                    .into_iter()
                    .map(|rule| format!("{package}, {}: {rule}", path.display())),
            );
        }
    }
    assert!(broken.is_empty(), "\n{}\n", broken.join("\n"));
}

#[test]
fn every_module_that_a_rule_names_exists() {
    let missing = |package: &str, modules: &[&str]| -> Vec<String> {
        let packages = packages();
        let (_, folder) = packages.iter().find(|(name, _)| name == package).unwrap();
        let source = folder.join("src");
        modules
            .iter()
            .filter(|module| !source.join(format!("{module}.rs")).exists())
            .filter(|module| !source.join(module).join("mod.rs").exists())
            .map(|module| format!("{package}: {module}"))
            .collect()
    };
    assert_eq!(missing(SERVICE, SERVICE_LAYERS), [""; 0]);
    assert_eq!(missing("vision", STAGES), [""; 0]);
    for (package, _, owners) in CRATE_OWNERS {
        assert_eq!(missing(package, owners), [""; 0]);
    }
}

/// A crate that forgot to inherit the workspace's lints could use `unsafe` freely.
#[test]
fn every_crate_but_the_kernels_inherits_the_lint_against_unsafe() {
    let manifest = |folder: &Path| -> toml::Table {
        let text = std::fs::read_to_string(folder.join("Cargo.toml")).unwrap();
        text.parse().expect("a manifest is TOML")
    };
    let lints = &manifest(workspace())["workspace"]["lints"];
    assert_eq!(lints["rust"]["unsafe_code"].as_str(), Some("deny"));
    let exempt: Vec<String> = packages()
        .into_iter()
        .filter(|(_, folder)| {
            let manifest = manifest(folder);
            let inherits = manifest
                .get("lints")
                .and_then(|lints| lints.get("workspace"));
            inherits.and_then(|inherits| inherits.as_bool()) != Some(true)
        })
        .map(|(package, _)| package)
        .collect();
    assert_eq!(exempt, ["kernels"]);
}

#[test]
fn every_rule_can_fail() {
    let broken = |package: &str, module: &str, source: &str| {
        violations(package, module, &names(source, 1)).join("; ")
    };
    for (package, module, source, expected) in [
        (
            SERVICE,
            "pipeline",
            "use crate::http::app;",
            "import `http`",
        ),
        (
            SERVICE,
            "ops",
            "use crate::pipeline::X;",
            "import `pipeline`",
        ),
        (
            SERVICE,
            "http",
            "use crate::config::Config;",
            "import `config`",
        ),
        (SERVICE, "config", "use super::cli::Cli;", "import `cli`"),
        (SERVICE, "attic", "", "no place among the layers"),
        (
            SERVICE,
            "pipeline",
            "fn f(r: axum::Router) {}",
            "`axum` may",
        ),
        (SERVICE, "server", "use ::axum::Router;", "`axum` may"),
        (SERVICE, "config", "use tower_http;", "`tower_http` may"),
        (SERVICE, "pipeline", "use anyhow::Context;", "`anyhow` may"),
        (SERVICE, "http", "fn f() { println!(\"x\") }", "use tracing"),
        (SERVICE, "cli", "fn f() { println!(\"x\") }", "closed pipe"),
        (
            SERVICE,
            "main",
            "fn f() { eprintln!(\"x\") }",
            "closed pipe",
        ),
        (
            "store",
            "codec",
            "fn f() { eprintln!(\"x\") }",
            "use tracing",
        ),
        (
            "vision",
            "search",
            "use crate::rerank::X;",
            "the stage `rerank`",
        ),
        (
            "vision",
            "helper",
            "use crate::image::X;",
            "the stage `image`",
        ),
        (
            "vision",
            "image",
            "use candle_core::Tensor;",
            "`candle_core` may",
        ),
    ] {
        let found = broken(package, module, source);
        assert!(found.contains(expected), "{package}, {module}: {found}");
    }
    for (package, module, source) in [
        (
            SERVICE,
            "http",
            "use crate::{pipeline::Service, ops::Metrics}; fn f() -> axum::Router { a.axum() }",
        ),
        (SERVICE, "cli", "fn f() { note!(\"x\"); self::g(); }"),
        (SERVICE, "lib", "pub use crate::cli::Cli;"),
        (
            "vision",
            "extract",
            "use crate::helper::X; use candle_core::Tensor;",
        ),
        (
            "store",
            "codec",
            "use crate::sqlite::X; use rusqlite::Connection;",
        ),
    ] {
        assert_eq!(broken(package, module, source), "");
    }
}
