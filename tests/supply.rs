//! Checks of the supply chain. They compare the dependencies with deny.toml by the lock file and the manifests of the
//! crates: licences, bans and sources. This is the part of `cargo deny check licenses bans sources` that works without
//! cargo-deny. They also check the contents of the package that is handed out.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;
use std::process::Command;

use serde_json::Value;
use toml::Table;

fn table(file: &str) -> Table {
    fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join(file)).unwrap().parse().unwrap()
}

/// Returns the words of a list of texts, or of tables that name a crate.
fn words(list: &toml::Value) -> BTreeSet<&str> {
    list.as_array().unwrap().iter().map(|item| item.get("crate").unwrap_or(item).as_str().unwrap()).collect()
}

/// Returns the crates that a build for a platform uses with the features of this one, as their manifests list them.
fn packages(platform: &str) -> Vec<Value> {
    let output = Command::new(env!("CARGO"))
        .args(["metadata", "--format-version=1", "--offline", "--locked", "--filter-platform", platform])
        .args(cfg!(feature = "plant").then_some("--features=plant"))
        .args(cfg!(feature = "pdf").then_some("--features=pdf"))
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let found: Value = serde_json::from_slice(&output.stdout).unwrap();
    found["packages"].as_array().unwrap().clone()
}

/// Returns true if these licences satisfy an SPDX expression. `AND` binds closer than `OR`; an old `/` is `OR`.
fn is_allowed(expression: &str, may: &BTreeSet<&str>) -> bool {
    let spaced = expression.replace('(', " ( ").replace(')', " ) ").replace('/', " OR ");
    let mut words: Vec<&str> = spaced.split_whitespace().rev().collect();
    let allowed = any_of(&mut words, may);
    assert!(words.is_empty(), "{expression} is no SPDX expression");
    allowed
}

fn any_of(words: &mut Vec<&str>, may: &BTreeSet<&str>) -> bool {
    let mut allowed = all_of(words, may);
    while words.pop_if(|word| *word == "OR").is_some() {
        allowed |= all_of(words, may);
    }
    allowed
}

fn all_of(words: &mut Vec<&str>, may: &BTreeSet<&str>) -> bool {
    let mut allowed = one(words, may);
    while words.pop_if(|word| *word == "AND").is_some() {
        allowed &= one(words, may);
    }
    allowed
}

fn one(words: &mut Vec<&str>, may: &BTreeSet<&str>) -> bool {
    match words.pop() {
        Some("(") => {
            let allowed = any_of(words, may);
            assert_eq!(words.pop(), Some(")"));
            allowed
        }
        Some(name) => {
            // A licence with an exception is a different licence.
            let exception = words.pop_if(|word| *word == "WITH").and_then(|_| words.pop());
            exception.map_or(may.contains(name), |with| may.contains(format!("{name} WITH {with}").as_str()))
        }
        None => panic!("a licence is missing"),
    }
}

#[test]
fn licence_expressions_are_parsed() {
    let may = BTreeSet::from(["MIT", "Apache-2.0", "Unicode-3.0"]);
    for (expression, allowed) in [
        ("MIT", true),
        ("GPL-3.0-only", false),
        ("MIT OR GPL-3.0-only", true),
        ("Unlicense/MIT", true),
        ("MIT AND GPL-3.0-only OR Zlib", false),
        ("(MIT OR Apache-2.0) AND Unicode-3.0", true),
        ("(MIT OR Apache-2.0) AND OpenSSL", false),
        ("Apache-2.0 WITH LLVM-exception", false),
        ("Apache-2.0 WITH LLVM-exception OR Apache-2.0 OR MIT", true),
    ] {
        assert_eq!(is_allowed(expression, &may), allowed, "{expression}");
    }
}

#[test]
fn licences_allowed_for_linux() {
    every_licence_is_allowed(&format!("{}-unknown-linux-gnu", std::env::consts::ARCH));
}

#[test]
#[ignore = "needs the crates of Windows: cargo fetch --target x86_64-pc-windows-gnu"]
fn licences_allowed_for_windows() {
    every_licence_is_allowed("x86_64-pc-windows-gnu");
}

fn every_licence_is_allowed(platform: &str) {
    let deny = table("deny.toml");
    let may = words(&deny["licenses"]["allow"]);
    let exceptions = deny["licenses"]["exceptions"].as_array().unwrap();
    let (packages, mut used) = (packages(platform), 0);
    assert!(packages.len() > 50);
    for package in &packages {
        let name = package["name"].as_str().unwrap();
        let licence = package["license"].as_str().unwrap_or_else(|| panic!("{name} names no licence"));
        let exception = exceptions.iter().find(|e| e["crate"].as_str() == Some(name));
        used += usize::from(exception.is_some());
        let may = exception.map_or_else(|| may.clone(), |e| words(&e["allow"]).union(&may).copied().collect());
        assert!(is_allowed(licence, &may), "{name} comes under {licence}, which deny.toml does not allow");
    }
    // Most of them belong to the plant feature. A build without it has not downloaded its crates.
    if cfg!(feature = "plant") {
        assert_eq!(used, exceptions.len(), "an exception that nobody needs");
    }
}

#[test]
fn no_banned_crate_and_one_registry() {
    let (deny, lock) = (table("deny.toml"), table("Cargo.lock"));
    let banned = words(&deny["bans"]["deny"]);
    // One registry, or a mirror of it, and no repository.
    let mut registries = BTreeSet::new();
    for package in lock["package"].as_array().unwrap() {
        let name = package["name"].as_str().unwrap();
        assert!(!banned.contains(name), "{name} is banned by deny.toml");
        match package.get("source").and_then(toml::Value::as_str) {
            Some(source) => {
                assert!(source.starts_with("registry+"), "{name} comes from {source}");
                registries.insert(source.to_owned());
            }
            None => assert!(name.starts_with("regrind"), "{name} comes from a folder"),
        }
    }
    assert_eq!(registries.len(), 1, "{registries:?}");
}

/// Returns true if a path matches a pattern with at most one `*`, which matches anything but a slash.
fn is_meant(path: &str, pattern: &str) -> bool {
    let Some((head, tail)) = pattern.split_once('*') else { return path == pattern };
    let middle = path.strip_prefix(head).and_then(|rest| rest.strip_suffix(tail));
    middle.is_some_and(|middle| !middle.contains('/'))
}

/// Returns the files below a folder of the sources, as paths relative to it.
fn files_below(folder: &str) -> Vec<String> {
    let entries = fs::read_dir(Path::new(env!("CARGO_MANIFEST_DIR")).join(folder)).unwrap().map(|entry| entry.unwrap());
    let below = entries.flat_map(|entry| {
        let path = format!("{folder}/{}", entry.file_name().into_string().unwrap());
        if entry.path().is_dir() { files_below(&path) } else { vec![path] }
    });
    below.collect()
}

#[test]
fn package_contains_shipped_files() {
    let manifest = table("Cargo.toml");
    let assets = manifest["package"]["metadata"]["deb"]["assets"].as_array().unwrap();
    let assets: Vec<[&str; 2]> = assets.iter().map(|asset| [0, 2].map(|k| asset[k].as_str().unwrap())).collect();
    for file in files_below("config").into_iter().chain(files_below("recipes")) {
        let found = assets.iter().find(|[pattern, _]| is_meant(&file, pattern));
        let Some([_, mode]) = found else { panic!("{file} is not in the package: add it to the assets in Cargo.toml") };
        let text = fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join(&file)).unwrap();
        assert_eq!(*mode == "755", text.starts_with("#!"), "{file} has the mode {mode} in the package");
    }
    assert!(is_meant("a/b.toml", "a/*.toml") && !is_meant("a/c/b.toml", "a/*.toml") && !is_meant("a/b", "a/*.toml"));
}
