//! Reads which modules, outside crates and macros a Rust source file names.
//!
//! A file is read as tokens, so that comments and strings do not count and the bodies of macros do.
//! Code under `#[cfg(test)]` is left out, because a test may borrow from anywhere.

use proc_macro2::{Delimiter, Group, TokenStream, TokenTree};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// What one source file names.
#[derive(Debug, Default)]
pub struct Names {
    /// Top-level modules of its own crate: `crate::x`, `use crate::{x, y}`, or through `super`.
    pub modules: BTreeSet<String>,
    /// First segments of all other paths, among which are all outside crates.
    pub path_heads: BTreeSet<String>,
    /// Macros that are called.
    pub macros: BTreeSet<String>,
    /// Modules declared as `#[cfg(test)] mod x;`, whose files are test code.
    test_modules: BTreeSet<String>,
}

/// One source file that is not test code.
pub struct SourceFile {
    /// Its path below the source folder.
    pub path: PathBuf,
    /// The top-level module it belongs to; `lib` or `main` for the roots.
    pub module: String,
    /// What it names.
    pub names: Names,
}

/// Every source file below `folder`, the `src` of a crate, except for test code.
pub fn read_crate(folder: &Path) -> Vec<SourceFile> {
    let mut paths = Vec::new();
    list_sources(folder, &mut paths);
    assert!(!paths.is_empty(), "no sources in {}", folder.display());

    let files: Vec<SourceFile> = paths.iter().map(|path| read_file(folder, path)).collect();
    let tests: BTreeSet<PathBuf> = files.iter().flat_map(test_files_of).collect();
    files
        .into_iter()
        .filter(|file| !tests.iter().any(|test| file.path.starts_with(test)))
        .collect()
}

fn list_sources(folder: &Path, into: &mut Vec<PathBuf>) {
    let entries = std::fs::read_dir(folder).expect("a source folder is readable");
    let mut paths: Vec<PathBuf> = entries.map(|entry| entry.unwrap().path()).collect();
    paths.sort();
    for path in paths {
        if path.is_dir() {
            list_sources(&path, into);
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            into.push(path);
        }
    }
}

fn read_file(root: &Path, path: &Path) -> SourceFile {
    let relative = path.strip_prefix(root).expect("the file is below the root");
    let (module, depth) = place(relative);
    let text = std::fs::read_to_string(path).expect("a source file is text");
    SourceFile {
        path: relative.to_path_buf(),
        module,
        names: names(&text, depth),
    }
}

/// The top-level module of a file, and how many modules deep its code lies below the crate's root.
fn place(relative: &Path) -> (String, usize) {
    let stem = relative.with_extension("");
    let parts: Vec<String> = stem
        .components()
        .map(|part| part.as_os_str().to_string_lossy().into_owned())
        .collect();
    let module = parts[0].clone();
    let is_root = module == "lib" || module == "main";
    let is_folder_module = parts.last().is_some_and(|last| last == "mod");
    let depth = match (is_root, is_folder_module) {
        (true, _) => 0,
        (false, true) => parts.len() - 1,
        (false, false) => parts.len(),
    };
    (module, depth)
}

/// The files and folders of the modules that `file` declares as test code.
fn test_files_of(file: &SourceFile) -> Vec<PathBuf> {
    let stem = file.path.file_stem().expect("a source file has a name");
    let folder = if stem == "mod" || stem == "lib" || stem == "main" {
        file.path.parent().unwrap_or(Path::new("")).to_path_buf()
    } else {
        file.path.with_extension("")
    };
    let declared = file.names.test_modules.iter();
    declared
        .flat_map(|name| [folder.join(format!("{name}.rs")), folder.join(name)])
        .collect()
}

/// Reads a source text whose code lies `depth` modules below the crate's root. The depth tells
/// whether a chain of `super` ends at the root.
pub fn names(source: &str, depth: usize) -> Names {
    let stream: TokenStream = source
        .parse()
        .expect("a source file is made of Rust tokens");
    let mut found = Names::default();
    read_tokens(stream, depth, &mut found);
    found
}

fn read_tokens(stream: TokenStream, depth: usize, found: &mut Names) {
    let tokens: Vec<TokenTree> = stream.into_iter().collect();
    // Whether the next braces are those of `mod name { .. }`, in which `super` is one level deeper.
    let mut opens_module = false;
    let mut at = 0;
    while at < tokens.len() {
        if is_test_attribute(&tokens[at..]) {
            at = skip_item(&tokens, at + 2, found);
            continue;
        }
        match &tokens[at] {
            TokenTree::Group(group) => {
                read_tokens(group.stream(), depth + usize::from(opens_module), found);
                opens_module = false;
            }
            TokenTree::Ident(ident) if *ident == "mod" => opens_module = true,
            TokenTree::Ident(ident) => {
                let word = ident.to_string();
                if is_punct(tokens.get(at + 1), '!') && !is_punct(tokens.get(at + 2), '=') {
                    found.macros.insert(word.clone());
                }
                if is_path_start(&tokens, at) {
                    at = read_path(&tokens, at, depth, found);
                    continue;
                }
                // `use axum;` and `extern crate axum;` name a crate without a `::`.
                if at > 0
                    && (is_ident(&tokens[at - 1], "use") || is_ident(&tokens[at - 1], "crate"))
                {
                    found.path_heads.insert(word);
                }
            }
            TokenTree::Punct(punct) => opens_module &= punct.as_char() != ';',
            TokenTree::Literal(_) => {}
        }
        at += 1;
    }
}

/// Records the path that starts at `at`. Returns the index behind its leading segments, from where
/// reading goes on, so that braces and generic arguments of the path are read as well.
fn read_path(tokens: &[TokenTree], at: usize, depth: usize, found: &mut Names) -> usize {
    let head = tokens[at].to_string();
    let mut next = at + 3;
    let reaches_root = match head.as_str() {
        "crate" => true,
        "self" => depth == 0,
        "super" => {
            let mut climbed = 1;
            while tokens
                .get(next)
                .is_some_and(|token| is_ident(token, "super"))
                && is_double_colon(tokens, next + 1)
            {
                climbed += 1;
                next += 3;
            }
            climbed == depth
        }
        _ => {
            found.path_heads.insert(head);
            false
        }
    };
    if reaches_root {
        match tokens.get(next) {
            Some(TokenTree::Ident(module)) => {
                found.modules.insert(module.to_string());
            }
            Some(TokenTree::Group(group)) => found.modules.extend(first_words(group)),
            _ => {}
        }
    }
    next
}

/// The first word of each member of `{a::b, c}`.
fn first_words(group: &Group) -> Vec<String> {
    if group.delimiter() != Delimiter::Brace {
        return Vec::new();
    }
    let members: Vec<TokenTree> = group.stream().into_iter().collect();
    members
        .split(|token| is_punct(Some(token), ','))
        .filter_map(|member| match member.first() {
            Some(TokenTree::Ident(word)) => Some(word.to_string()),
            _ => None,
        })
        .collect()
}

/// Whether the tokens start with `#[test]`, `#[cfg(test)]` or `#[cfg(all(test, ..))]`.
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

/// The index behind the item that starts at `at`, which ends with `;` or with its braces.
fn skip_item(tokens: &[TokenTree], mut at: usize, found: &mut Names) -> usize {
    while at < tokens.len() {
        match &tokens[at] {
            TokenTree::Punct(punct) if punct.as_char() == ';' => return at + 1,
            TokenTree::Group(group) if group.delimiter() == Delimiter::Brace => {
                // The braces of `use a::{b, c};` are followed by a semicolon.
                return at + 1 + usize::from(is_punct(tokens.get(at + 1), ';'));
            }
            TokenTree::Ident(ident) if *ident == "mod" => {
                if let Some(TokenTree::Ident(name)) = tokens.get(at + 1)
                    && is_punct(tokens.get(at + 2), ';')
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

/// Whether the word at `at` is followed by `::` and is the first segment of its path. In
/// `::axum::Router` that is `axum`.
fn is_path_start(tokens: &[TokenTree], at: usize) -> bool {
    if !is_double_colon(tokens, at + 1) {
        return false;
    }
    if at < 2 || !is_double_colon(tokens, at - 2) {
        return true;
    }
    let before = at.checked_sub(3).map(|before| &tokens[before]);
    let continues = match before {
        Some(TokenTree::Ident(word)) => *word != "use",
        before => is_punct(before, '>'),
    };
    !continues
}

fn is_double_colon(tokens: &[TokenTree], at: usize) -> bool {
    is_punct(tokens.get(at), ':') && is_punct(tokens.get(at + 1), ':')
}

fn is_punct(token: Option<&TokenTree>, wanted: char) -> bool {
    matches!(token, Some(TokenTree::Punct(punct)) if punct.as_char() == wanted)
}

fn is_ident(token: &TokenTree, wanted: &str) -> bool {
    matches!(token, TokenTree::Ident(ident) if *ident == wanted)
}

fn modules_in(source: &str, depth: usize) -> Vec<String> {
    names(source, depth).modules.into_iter().collect()
}

#[test]
fn imports_are_found_in_every_form() {
    assert_eq!(modules_in("use crate::store::PlaceStore;", 1), ["store"]);
    assert_eq!(
        modules_in("use crate::{http::app, types::{MapName, geo::Point}};", 1),
        ["http", "types"]
    );
    let in_signature = "fn f() -> crate::search::Hit { todo!() }";
    assert_eq!(modules_in(in_signature, 1), ["search"]);
    let in_macro = "fn f() { vec![crate::rerank::score(1)]; }";
    assert_eq!(modules_in(in_macro, 1), ["rerank"]);
    assert_eq!(modules_in("use super::super::store::Codec;", 2), ["store"]);
    let in_inner_module = "mod inner { use super::super::store::Codec; }";
    assert_eq!(modules_in(in_inner_module, 1), ["store"]);
    assert_eq!(modules_in("use super::store::X;", 1), ["store"]);
    assert_eq!(modules_in("use super::sibling::X;", 2), [""; 0]);
    assert_eq!(modules_in("use self::store::X;", 0), ["store"]);
}

#[test]
fn comments_strings_and_tests_do_not_count() {
    let words =
        "//! See [`crate::http`].\n// crate::store::x\nconst S: &str = \"crate::store::x\";";
    assert_eq!(modules_in(words, 1), [""; 0]);
    let tested = "#[cfg(test)] mod tests { use crate::http::app; } fn f() { crate::image::g() }";
    assert_eq!(modules_in(tested, 1), ["image"]);
    let imported = "#[cfg(test)] use crate::{http::a, cli::b}; use crate::types::C;";
    assert_eq!(modules_in(imported, 1), ["types"]);
}

#[test]
fn files_of_test_modules_are_known() {
    let declared_in = |path: &str| {
        test_files_of(&SourceFile {
            path: PathBuf::from(path),
            module: "store".to_owned(),
            names: names("#[cfg(test)] mod cases; mod real;", 1),
        })
    };
    let files = ["store/cases.rs", "store/cases"].map(PathBuf::from);
    assert_eq!(declared_in("store/mod.rs"), files);
    let files = ["store/codec/cases.rs", "store/codec/cases"].map(PathBuf::from);
    assert_eq!(declared_in("store/codec.rs"), files);
}
