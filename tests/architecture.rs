//! Imports point one way: `http -> pipeline -> stages -> {types, error, kernels}`.
//!
//! Reads every source file as Rust tokens (so comments and strings do not count, and macro bodies
//! do), collects which room names which other room and which outside crate, and compares that with
//! the table below. Code under `#[cfg(test)]` is left out: a test may borrow from anywhere.

use proc_macro2::{Delimiter, TokenStream, TokenTree};
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

const FOUNDATION: &[&str] = &["types", "error", "kernels"];
const STAGES: &[&str] = &["image", "extract", "search", "store", "rerank"];

/// What each room may import beyond itself; a room that is missing here fails the test.
fn allowed(room: &str) -> Option<BTreeSet<&'static str>> {
    let above: &[&str] = match room {
        "types" | "error" | "kernels" | "image" | "extract" | "search" | "store" | "rerank"
        | "ops" => &[],
        "synth" => &["image"],
        "draw" => &["image", "rerank"],
        "pipeline" => &["image", "extract", "search", "store", "rerank", "ops"],
        "http" => &[
            "image", "extract", "search", "store", "rerank", "ops", "pipeline",
        ],
        // The roof over every room's own settings: only the command line reads it.
        "config" => &[
            "image", "extract", "search", "store", "rerank", "ops", "pipeline", "http",
        ],
        "eval" => &[
            "image", "extract", "search", "store", "rerank", "ops", "pipeline", "draw", "synth",
        ],
        "train" => &[
            "image", "extract", "search", "store", "rerank", "ops", "pipeline", "draw", "synth",
            "eval",
        ],
        "bench" => &[
            "image", "extract", "search", "store", "rerank", "ops", "pipeline", "synth",
        ],
        "cli" => &[
            "image", "extract", "search", "store", "rerank", "config", "ops", "pipeline", "http",
            "eval", "train", "draw", "synth", "bench",
        ],
        _ => return None,
    };
    Some(FOUNDATION.iter().chain(above).copied().collect())
}

/// Outside crates that stay behind one door: crate, rooms that may name it.
const CRATE_HOMES: &[(&str, &[&str])] = &[
    ("axum", &["http"]),
    ("utoipa_axum", &["http"]),
    ("utoipa_swagger_ui", &["http"]),
    ("tower_http", &["http"]),
    ("rusqlite", &["store"]),
    ("candle_core", &["extract", "train", "bench"]),
    ("candle_nn", &["extract", "train"]),
    ("zune_jpeg", &["image"]),
    ("anyhow", &["cli", "main"]),
    ("tonic", &[]),
];

/// Macros that write to the terminal: library rooms log instead.
const TERMINAL_MACROS: &[&str] = &["println", "eprintln", "print", "eprint"];

/// What one source file names.
#[derive(Debug, Default, PartialEq)]
struct Names {
    /// Rooms of this crate (`crate::x`, also inside `use crate::{..}` and through `super`).
    rooms: BTreeSet<String>,
    /// First segments of all other paths, which is where outside crates show.
    heads: BTreeSet<String>,
    /// Macros called.
    macros: BTreeSet<String>,
    /// Whether the keyword `unsafe` is used as code.
    has_unsafe: bool,
    /// Modules declared as `#[cfg(test)] mod x;`: their files are test code.
    test_modules: BTreeSet<String>,
}

/// Reads the names of a source text. `depth` is how many modules deep the file lies below the crate
/// root, which is what tells where a chain of `super` ends.
fn names(source: &str, depth: usize) -> Names {
    let stream: TokenStream = source
        .parse()
        .expect("a source file is made of Rust tokens");
    let mut found = Names::default();
    walk(stream, depth, &mut found);
    found
}

fn walk(stream: TokenStream, depth: usize, found: &mut Names) {
    let tokens: Vec<TokenTree> = stream.into_iter().collect();
    let mut at = 0;
    let mut inline_module = false;
    while at < tokens.len() {
        if is_test_attribute(&tokens[at..]) {
            at = skip_item(&tokens, at + 2, found);
            continue;
        }
        match &tokens[at] {
            TokenTree::Group(group) => {
                // Only a module's braces move the end of a `super` chain.
                walk(group.stream(), depth + usize::from(inline_module), found);
                inline_module = false;
            }
            TokenTree::Ident(ident) => {
                let word = ident.to_string();
                inline_module = (word == "mod" && !follows_path(&tokens, at))
                    || (inline_module && word != "mod");
                found.has_unsafe |= word == "unsafe" && !in_attribute(&tokens, at);
                if is_punct(tokens.get(at + 1), '!') && !is_punct(tokens.get(at + 2), '=') {
                    found.macros.insert(word.clone());
                }
                if path_continues(&tokens, at) && !follows_path(&tokens, at) {
                    at = record_path(&tokens, at, &word, depth, found);
                    continue;
                }
                // `use axum;` and `extern crate axum;` name a crate without a `::`.
                if at > 0
                    && matches!(&tokens[at - 1], TokenTree::Ident(i) if *i == "use" || *i == "crate")
                {
                    found.heads.insert(word);
                }
            }
            TokenTree::Punct(punct) => inline_module &= punct.as_char() != ';',
            TokenTree::Literal(_) => {}
        }
        at += 1;
    }
}

/// Records the path that starts at `at`; returns where to read on.
fn record_path(
    tokens: &[TokenTree],
    at: usize,
    head: &str,
    depth: usize,
    found: &mut Names,
) -> usize {
    let mut next = at + 3;
    let at_root = match head {
        "crate" => true,
        "super" => {
            let mut climbed = 1;
            while matches!(tokens.get(next), Some(TokenTree::Ident(i)) if *i == "super")
                && path_continues(tokens, next)
            {
                climbed += 1;
                next += 3;
            }
            climbed == depth
        }
        "self" => depth == 0,
        _ => {
            found.heads.insert(head.to_owned());
            false
        }
    };
    if at_root {
        match tokens.get(next) {
            Some(TokenTree::Ident(room)) => {
                found.rooms.insert(room.to_string());
            }
            Some(TokenTree::Group(group)) if group.delimiter() == Delimiter::Brace => {
                let members: Vec<TokenTree> = group.stream().into_iter().collect();
                for member in members.split(|token| is_punct(Some(token), ',')) {
                    if let Some(TokenTree::Ident(room)) = member.first() {
                        found.rooms.insert(room.to_string());
                    }
                }
            }
            _ => {}
        }
    }
    // Back to the first token behind the `::`, so that groups and generic arguments are read as
    // well.
    next
}

/// Whether tokens start with `#[cfg(test)]` or `#[test]`.
fn is_test_attribute(tokens: &[TokenTree]) -> bool {
    let Some(TokenTree::Group(group)) = tokens.get(1) else {
        return false;
    };
    if !is_punct(tokens.first(), '#') || group.delimiter() != Delimiter::Bracket {
        return false;
    }
    let text: String = group.stream().to_string().split_whitespace().collect();
    text == "cfg(test)" || text == "test" || text.starts_with("cfg(all(test,")
}

/// The index behind the item that starts at `at`: it ends with `;` or with its braces.
fn skip_item(tokens: &[TokenTree], mut at: usize, found: &mut Names) -> usize {
    while at < tokens.len() {
        match &tokens[at] {
            TokenTree::Punct(punct) if punct.as_char() == ';' => return at + 1,
            TokenTree::Group(group) if group.delimiter() == Delimiter::Brace => {
                // `use a::{b, c};` goes on behind its braces.
                return if is_punct(tokens.get(at + 1), ';') {
                    at + 2
                } else {
                    at + 1
                };
            }
            TokenTree::Ident(ident) if *ident == "mod" => {
                if let (Some(TokenTree::Ident(name)), true) =
                    (tokens.get(at + 1), is_punct(tokens.get(at + 2), ';'))
                {
                    found.test_modules.insert(name.to_string());
                }
            }
            _ => {}
        }
        at += 1;
    }
    at
}

fn is_punct(token: Option<&TokenTree>, wanted: char) -> bool {
    matches!(token, Some(TokenTree::Punct(punct)) if punct.as_char() == wanted)
}

fn path_continues(tokens: &[TokenTree], at: usize) -> bool {
    is_punct(tokens.get(at + 1), ':') && is_punct(tokens.get(at + 2), ':')
}

fn follows_path(tokens: &[TokenTree], at: usize) -> bool {
    // `::axum::x` (from the root of all crates) counts as the head of a path, `a::b` does not.
    let after_colons =
        at >= 2 && is_punct(tokens.get(at - 1), ':') && is_punct(tokens.get(at - 2), ':');
    let behind_name = at >= 3
        && (matches!(tokens[at - 3], TokenTree::Ident(_))
            && !matches!(&tokens[at - 3], TokenTree::Ident(i) if *i == "use")
            || is_punct(tokens.get(at - 3), '>'));
    after_colons && behind_name
}

/// `#[unsafe(...)]` and `#![deny(unsafe_code)]` are words about the keyword, not its use.
fn in_attribute(tokens: &[TokenTree], at: usize) -> bool {
    matches!(tokens.get(at + 1), Some(TokenTree::Group(group)) if group.delimiter() == Delimiter::Parenthesis)
}

/// The room of a file, and how many modules deep its code lies below the root.
fn place(relative: &Path) -> (String, usize) {
    let parts: Vec<String> = relative
        .with_extension("")
        .components()
        .map(|part| part.as_os_str().to_string_lossy().into_owned())
        .collect();
    let depth = if parts.last().is_some_and(|last| last == "mod") {
        parts.len() - 1
    } else {
        parts.len()
    };
    let is_root = parts[0] == "lib" || parts[0] == "main";
    (parts[0].clone(), if is_root { 0 } else { depth })
}

fn source_files(folder: &Path, into: &mut Vec<PathBuf>) {
    let mut entries: Vec<PathBuf> = std::fs::read_dir(folder)
        .expect("src is readable")
        .map(|entry| entry.expect("an entry").path())
        .collect();
    entries.sort();
    for path in entries {
        if path.is_dir() {
            source_files(&path, into);
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            into.push(path);
        }
    }
}

/// Every production file under `src`, with its room and what it names.
fn read_house() -> Vec<(PathBuf, String, Names)> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut files = Vec::new();
    source_files(&root, &mut files);
    let read: Vec<_> = files
        .into_iter()
        .map(|file| {
            let relative = file.strip_prefix(&root).expect("under src").to_path_buf();
            let (room, depth) = place(&relative);
            let text = std::fs::read_to_string(&file).expect("a source file is text");
            (relative, room, names(&text, depth))
        })
        .collect();
    let test_files: BTreeSet<PathBuf> = read
        .iter()
        .flat_map(|(file, _, found)| test_files_of(file, found))
        .collect();
    read.into_iter()
        .filter(|(file, ..)| !test_files.iter().any(|test| file.starts_with(test)))
        .collect()
}

/// The files and folders of modules that `file` declares as test code.
fn test_files_of(file: &Path, found: &Names) -> Vec<PathBuf> {
    let is_parent = file
        .file_stem()
        .is_some_and(|stem| stem == "mod" || stem == "lib" || stem == "main");
    let folder = if is_parent {
        file.parent().unwrap_or(Path::new("")).to_path_buf()
    } else {
        file.with_extension("")
    };
    found
        .test_modules
        .iter()
        .flat_map(|name| [folder.join(format!("{name}.rs")), folder.join(name)])
        .collect()
}

/// Every broken rule of one file, in words.
fn violations(file: &Path, room: &str, found: &Names, rooms: &BTreeSet<String>) -> Vec<String> {
    let mut broken = Vec::new();
    if room != "main" && room != "lib" {
        match allowed(room) {
            None => broken.push(format!(
                "{}: room `{room}` has no row in the table of imports",
                file.display()
            )),
            Some(allowed) => broken.extend(
                found
                    .rooms
                    .iter()
                    .filter(|other| {
                        rooms.contains(*other)
                            && *other != room
                            && !allowed.contains(other.as_str())
                    })
                    .map(|other| format!("{}: `{room}` must not import `{other}`", file.display())),
            ),
        }
    }
    for (outside, homes) in CRATE_HOMES {
        if found.heads.contains(*outside) && !homes.contains(&room) {
            broken.push(format!(
                "{}: `{outside}` belongs to {homes:?} alone",
                file.display()
            ));
        }
    }
    if found.has_unsafe && room != "kernels" {
        broken.push(format!(
            "{}: `unsafe` belongs to `kernels` alone",
            file.display()
        ));
    }
    if room != "cli" && room != "main" {
        let printing = TERMINAL_MACROS
            .iter()
            .filter(|name| found.macros.contains(**name));
        broken.extend(printing.map(|name| {
            format!(
                "{}: `{name}!` in a library room; use tracing",
                file.display()
            )
        }));
    } else {
        let panicking = ["println", "print"]
            .into_iter()
            .filter(|name| found.macros.contains(*name));
        broken.extend(panicking.map(|name| {
            format!(
                "{}: `{name}!` panics on a closed pipe; use say!",
                file.display()
            )
        }));
    }
    broken
}

#[test]
fn imports_point_one_way() {
    let house = read_house();
    let rooms: BTreeSet<String> = house.iter().map(|(_, room, _)| room.clone()).collect();
    assert!(
        STAGES
            .iter()
            .chain(FOUNDATION)
            .all(|room| rooms.contains(*room)),
        "a room is missing: {rooms:?}"
    );
    let broken: Vec<String> = house
        .iter()
        .flat_map(|(file, room, found)| violations(file, room, found, &rooms))
        .collect();
    assert!(broken.is_empty(), "\n{}\n", broken.join("\n"));
}

#[test]
fn rooms_have_no_cycle() {
    let house = read_house();
    let mut imports: BTreeMap<&str, BTreeSet<&str>> = BTreeMap::new();
    for (_, room, found) in house
        .iter()
        .filter(|(_, room, _)| room != "lib" && room != "main")
    {
        let others = found
            .rooms
            .iter()
            .map(String::as_str)
            .filter(|other| *other != room.as_str());
        imports.entry(room).or_default().extend(others);
    }
    // `types`, `error` and `kernels` are one floor: they may lean on each other.
    assert_eq!(cycle(&imports, FOUNDATION), None);
}

/// A room that can reach itself through others, if any. Rooms in `floor` are taken as one.
fn cycle<'a>(imports: &BTreeMap<&'a str, BTreeSet<&'a str>>, floor: &[&str]) -> Option<&'a str> {
    imports
        .keys()
        .copied()
        .filter(|room| !floor.contains(room))
        .find(|start| {
            let mut seen = BTreeSet::new();
            let mut open: Vec<&str> = imports[start].iter().copied().collect();
            while let Some(room) = open.pop() {
                if seen.insert(room) {
                    open.extend(imports.get(room).into_iter().flatten().copied());
                }
            }
            seen.contains(start)
        })
}

fn rooms_of(source: &str, depth: usize) -> Vec<String> {
    names(source, depth).rooms.into_iter().collect()
}

#[test]
fn the_reader_finds_imports_in_every_form() {
    assert_eq!(rooms_of("use crate::store::PlaceStore;", 1), ["store"]);
    assert_eq!(
        rooms_of("use crate::{http::app, types::{MapName, geo::Point}};", 1),
        ["http", "types"]
    );
    assert_eq!(
        rooms_of("fn f() -> crate::search::Hit { todo!() }", 1),
        ["search"]
    );
    assert_eq!(
        rooms_of("fn f() { vec![crate::rerank::score(1)]; }", 1),
        ["rerank"]
    );
    assert_eq!(rooms_of("use super::super::store::Codec;", 2), ["store"]);
    assert_eq!(
        rooms_of("mod inner { use super::super::store::Codec; }", 1),
        ["store"]
    );
    assert_eq!(rooms_of("use super::sibling::X;", 2), Vec::<String>::new());
    assert_eq!(rooms_of("use super::store::X;", 1), ["store"]);
}

#[test]
fn the_reader_ignores_words_and_tests() {
    assert_eq!(
        rooms_of(
            "//! See [`crate::http`].\n// crate::store::x\nconst S: &str = \"crate::store::x\";",
            1
        )
        .len(),
        0
    );
    let tested = "#[cfg(test)] mod tests { use crate::http::app; } fn f() { crate::image::g() }";
    assert_eq!(rooms_of(tested, 1), ["image"]);
    assert_eq!(
        rooms_of(
            "#[cfg(test)] use crate::{http::a, cli::b}; use crate::types::C;",
            1
        ),
        ["types"]
    );
    let declared = names("#[cfg(test)] mod cases; mod real;", 1);
    assert_eq!(
        test_files_of(Path::new("store/mod.rs"), &declared)[0],
        Path::new("store/cases.rs")
    );
    assert_eq!(
        test_files_of(Path::new("store/codec.rs"), &declared)[0],
        Path::new("store/codec/cases.rs")
    );
}

#[test]
fn every_rule_can_fail() {
    let rooms: BTreeSet<String> = ["store", "search", "http", "types", "pipeline", "kernels"]
        .map(str::to_owned)
        .into();
    let broken = |room: &str, source: &str| {
        violations(
            Path::new(&format!("{room}/mod.rs")),
            room,
            &names(source, 1),
            &rooms,
        )
        .join("; ")
    };
    assert!(
        broken("store", "use crate::search::MapIndex;")
            .contains("`store` must not import `search`")
    );
    assert!(
        broken("search", "use crate::pipeline::Service;").contains("must not import `pipeline`")
    );
    assert!(broken("types", "use crate::store::PlaceStore;").contains("must not import `store`"));
    assert!(broken("pipeline", "use crate::http::app;").contains("must not import `http`"));
    assert!(broken("pipeline", "fn f(r: axum::Router) {}").contains("`axum` belongs to"));
    assert!(
        broken("http", "use rusqlite::{Connection, params};").contains("`rusqlite` belongs to")
    );
    assert!(broken("http", "use ::rusqlite::Connection;").contains("`rusqlite` belongs to"));
    assert!(broken("http", "use tonic;").contains("`tonic` belongs to"));
    assert!(broken("store", "fn f() { unsafe { g() } }").contains("`unsafe` belongs to"));
    assert!(broken("store", "unsafe fn f() {}").contains("`unsafe` belongs to"));
    assert!(broken("store", "fn f() { println!(\"x\") }").contains("`println!`"));
    assert!(broken("cli", "fn f() { println!(\"x\") }").contains("closed pipe"));
    assert!(broken("attic", "").contains("no row in the table"));
    for (room, source) in [
        (
            "store",
            "use crate::types::MapName; use rusqlite::Connection; #[allow(unsafe_code)] fn f() { self::g(); }",
        ),
        (
            "http",
            "use crate::{pipeline::Service, store::MapInfo}; fn f() -> axum::Router { a.axum() }",
        ),
        ("kernels", "unsafe fn f() { unsafe { g() } }"),
    ] {
        assert_eq!(broken(room, source), "");
    }
    let ring = BTreeMap::from([
        ("a", ["b"].into()),
        ("b", ["c"].into()),
        ("c", ["a"].into()),
    ]);
    assert_eq!(cycle(&ring, &[]), Some("a"));
    assert_eq!(
        cycle(
            &BTreeMap::from([("a", ["b"].into()), ("b", ["c"].into())]),
            &[]
        ),
        None
    );
}
