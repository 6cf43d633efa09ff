//! Keeps the x86 code of the kernels in modules that other architectures do not compile.
//!
//! Vector code exists for x86-64 only. That the crate builds and works elsewhere must not depend on
//! somebody trying it, so this test reads the sources of `crates/kernels`. Intrinsics, assembly and target
//! features may occur only in files named after an instruction set, and every declaration or import
//! of such a module must be compiled for x86-64 only.

use std::path::{Path, PathBuf};

/// Modules that exist for x86-64 only.
const X86_MODULES: [&str; 3] = ["avx2", "avx512", "amx"];

/// What only those modules may contain.
const X86_CODE: [&str; 7] = [
    "core::arch",
    "std::arch",
    "_mm_",
    "_mm256_",
    "_mm512_",
    "asm!",
    "is_x86_feature_detected!",
];

/// The condition under which a module or import exists.
const CONDITION: &str = "#[cfg(target_arch = \"x86_64\")]";

#[test]
fn x86_code_is_only_in_modules_for_x86() {
    let mut checked = 0;
    for (path, source) in sources() {
        if is_x86_module(&path) {
            continue;
        }
        checked += 1;
        for (number, line) in code_lines(&source) {
            for word in X86_CODE.iter().chain(&["target_feature"]) {
                assert!(
                    !line.contains(word),
                    "{}:{number} contains `{word}` outside a module for x86",
                    path.display()
                );
            }
        }
    }
    assert!(checked > 20, "only {checked} portable files were found");
}

#[test]
fn modules_for_x86_are_compiled_for_x86_only() {
    let mut declarations = 0;
    for (path, source) in sources() {
        if is_x86_module(&path) {
            continue;
        }
        let lines: Vec<(usize, &str)> = code_lines(&source).collect();
        for (index, &(number, line)) in lines.iter().enumerate() {
            let item = line.trim();
            let names_module = X86_MODULES.iter().any(|module| has_word(item, module));
            if !names_module || !is_declaration(item) {
                continue;
            }
            declarations += 1;
            let before = index.checked_sub(1).map(|before| lines[before].1.trim());
            assert_eq!(
                before,
                Some(CONDITION),
                "{}:{number} names a module for x86 without its condition",
                path.display()
            );
        }
    }
    assert!(
        declarations > 20,
        "only {declarations} declarations were found"
    );
}

/// Every source file of the crate with its path.
fn sources() -> Vec<(PathBuf, String)> {
    let mut sources = Vec::new();
    let mut folders = vec![Path::new(env!("CARGO_MANIFEST_DIR")).join("crates/kernels/src")];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else {
                let source = std::fs::read_to_string(&path).unwrap();
                sources.push((path, source));
            }
        }
    }
    sources
}

/// Whether a file is named after an instruction set.
fn is_x86_module(path: &Path) -> bool {
    let name = path.file_stem().unwrap().to_str().unwrap();
    X86_MODULES.contains(&name)
}

/// The lines of a source file without comments, and their numbers from 1 on.
fn code_lines(source: &str) -> impl Iterator<Item = (usize, &str)> {
    let lines = source.lines().enumerate();
    lines
        .map(|(index, line)| (index + 1, line.split("//").next().unwrap()))
        .filter(|(_, line)| !line.trim().is_empty())
}

/// Whether a line declares a module or imports something, whatever its visibility.
fn is_declaration(line: &str) -> bool {
    let item = match line.strip_prefix("pub(") {
        Some(restricted) => restricted.split_once(')').unwrap().1,
        None => line.strip_prefix("pub ").unwrap_or(line),
    };
    let item = item.trim_start();
    item.starts_with("mod ") || item.starts_with("use ")
}

/// Whether `text` contains `word` with no letter, digit or underscore next to it.
fn has_word(text: &str, word: &str) -> bool {
    let is_part = |character: char| character.is_alphanumeric() || character == '_';
    text.split(|character| !is_part(character))
        .any(|part| part == word)
}
