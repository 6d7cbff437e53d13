//! Tests of the page docs/extending.md: it makes a protocol, and its files and changed lines fit the sources.

use std::fs;
use std::path::Path;
use std::process::Command;

use super::{Block, blocks, root, text_of};

/// Returns the blocks of the page.
fn page() -> Vec<Block> {
    blocks(&text_of("extending.md"))
}

/// Makes the change of a block in the folder `sources`: a new file, or lines that are added to a file. Returns the path
/// of the file, or `None` if the block changes no file.
fn make(block: &Block, sources: &Path) -> Option<String> {
    let [language, path] = &block.info[..] else { return None };
    let target = sources.join(path);
    if language != "diff" {
        assert!(!target.exists(), "{path} exists already");
        fs::create_dir_all(target.parent().unwrap()).unwrap();
        fs::write(target, &block.text).unwrap();
        return Some(path.clone());
    }
    let lines = |is_kept: fn(&str) -> bool| -> String {
        block.text.lines().filter(|line| is_kept(line)).map(|line| format!("{}\n", &line[1..])).collect()
    };
    let (before, after) = (lines(|line| !line.starts_with('+')), lines(|_| true));
    let text = fs::read_to_string(&target).unwrap();
    assert_eq!(text.matches(&before).count(), 1, "{path}, line {} of the page: {before}", block.line);
    fs::write(target, text.replace(&before, &after)).unwrap();
    Some(path.clone())
}

fn copy(from: &Path, to: &Path) {
    fs::create_dir_all(to).unwrap();
    for entry in fs::read_dir(from).unwrap().map(Result::unwrap) {
        let (name, target) = (entry.file_name(), to.join(entry.file_name()));
        match entry.file_type().unwrap().is_dir() {
            true if name == "target" || name == ".git" => {}
            true => copy(&entry.path(), &target),
            false => drop(fs::copy(entry.path(), target).unwrap()),
        }
    }
}

#[test]
fn added_protocol_fits_sources() {
    let copied = tempfile::tempdir().unwrap();
    for folder in ["src/device", "sim", "config", "docs"] {
        copy(&root().join(folder), &copied.path().join(folder));
    }
    let made: Vec<String> = page().iter().filter_map(|block| make(block, copied.path())).collect();
    for folder in ["src/device/plain_touch/", "sim/plain_touch/", "config/", "docs/"] {
        assert!(made.iter().any(|path| path.starts_with(folder)), "{folder}: {made:?}");
    }
    // The comments of a module list its files.
    let listed = fs::read_to_string(copied.path().join("src/device/plain_touch/mod.rs")).unwrap();
    for path in made.iter().filter_map(|path| path.strip_prefix("src/device/plain_touch/")) {
        let name = path.trim_end_matches(".rs");
        assert!(name == "mod" || listed.contains(&format!("mod {name};")), "{name}");
    }
}

#[test]
#[ignore = "builds the program once more: some minutes"]
fn added_protocol_makes_a_part() {
    // The same folder each time, so that the results of the last build are replaced.
    let home = Path::new(env!("CARGO_TARGET_TMPDIR")).join("extending");
    let sources = home.join("sources");
    let _ = fs::remove_dir_all(&sources);
    copy(root(), &sources);
    for block in &page() {
        make(block, &sources);
    }
    let typed = page().into_iter().filter(|block| block.is("sh")).map(|block| block.text).collect::<String>();
    assert!(typed.contains("regrind-device") && typed.contains("cargo run -- run"), "{typed}");
    let done = Command::new("sh")
        .args(["-e", "-x", "-c", &typed])
        .current_dir(&sources)
        .env("CARGO_TARGET_DIR", home.join("built"))
        .env("REGRIND_KEY", "")
        .output()
        .unwrap();
    let output = String::from_utf8_lossy(&done.stdout);
    println!("{output}\n{}", String::from_utf8_lossy(&done.stderr));
    assert!(done.status.success(), "{}", done.status);
    assert!(output.contains("ACCEPTED"));
    let schema = fs::read_to_string(sources.join("docs/cell.schema.json")).unwrap();
    assert!(schema.contains("plain-touch"));
}
