//! Tests of the links between the pages.

use std::fs;
use std::path::PathBuf;

use super::pages::TYPED;
use super::{blocks, path_of, root, text_of};

/// Returns the links of a page to other places of this repository.
fn links(text: &str) -> Vec<String> {
    let mut found = Vec::new();
    let mut in_block = false;
    for line in text.lines() {
        in_block ^= line.starts_with("```");
        let rest = line.split("](").skip(1).filter_map(|rest| rest.split(')').next());
        found.extend(rest.filter(|to| !in_block && !to.contains("://")).map(str::to_owned));
    }
    found
}

/// Returns the anchor of a heading.
fn anchor(heading: &str) -> String {
    let kept = |c: &char| c.is_alphanumeric() || matches!(c, ' ' | '-' | '_');
    heading.trim().to_lowercase().chars().filter(kept).map(|c| if c == ' ' { '-' } else { c }).collect()
}

fn anchors(text: &str) -> Vec<String> {
    let mut in_block = false;
    let mut found = Vec::new();
    for line in text.lines() {
        in_block ^= line.starts_with("```");
        if !in_block && line.starts_with('#') {
            found.push(anchor(line.trim_start_matches('#')));
        }
    }
    found
}

/// Returns the pages that the summary lists.
fn listed() -> Vec<String> {
    links(&text_of("SUMMARY.md"))
}

#[test]
fn summary_lists_every_page() {
    let listed = listed();
    for page in fs::read_dir(root().join("docs")).unwrap().map(|entry| entry.unwrap().path()) {
        let name = page.file_name().unwrap().to_string_lossy().into_owned();
        let is_page = name.ends_with(".md") && name != "SUMMARY.md";
        assert!(!is_page || listed.contains(&name), "docs/SUMMARY.md does not list {name}");
    }
    assert!(listed.iter().all(|page| path_of(page).is_file()), "{listed:?}");
    assert!(TYPED.iter().all(|page| listed.iter().any(|name| name == page)));
}

#[test]
fn page_links_resolve() {
    for page in listed() {
        let text = text_of(&page);
        for link in links(&text) {
            let (file, place) = link.split_once('#').unwrap_or((&link, ""));
            let target: PathBuf = if file.is_empty() { path_of(&page) } else { path_of(&page).with_file_name(file) };
            assert!(target.exists(), "{page}: {link}");
            let is_page = target.extension().is_some_and(|ending| ending == "md");
            let there = place.is_empty()
                || !is_page
                || anchors(&fs::read_to_string(&target).unwrap()).contains(&place.to_owned());
            assert!(there, "{page}: {link}");
        }
    }
}

#[test]
fn few_blocks_are_untyped() {
    let mut untyped = 0;
    for page in TYPED {
        for block in blocks(&text_of(page)) {
            let known = ["sh", "text", "toml", "console", "csv", "json"];
            let plain = block.info.is_empty();
            assert!(plain || known.iter().any(|word| block.is(word)), "{page}:{}: {:?}", block.line, block.info);
            // A formula is not a command.
            assert!(!plain || !block.text.contains("regrind "), "{page}:{}", block.line);
            untyped += usize::from(block.is("console"));
        }
    }
    assert!(untyped <= 6, "{untyped} blocks are not typed");
}

#[test]
fn source_paths_in_pages_exist() {
    for page in TYPED {
        let text = text_of(page);
        for word in
            text.split('`').skip(1).step_by(2).filter(|word| word.starts_with("src/") || word.starts_with("sim/"))
        {
            assert!(root().join(word).exists(), "{page}: {word}");
        }
    }
}
