//! The book in docs/: every command of its pages is typed, what its screens show is awaited, its examples are checked, and what is made from
//! the program stands in it as the program has it.

mod made;
mod pages;
mod structure;
mod terminal;

use std::fs;
use std::path::{Path, PathBuf};

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn path_of(page: &str) -> PathBuf {
    root().join("docs").join(page)
}

fn text_of(page: &str) -> String {
    fs::read_to_string(path_of(page)).unwrap()
}

/// A fenced block of a page.
struct Block {
    /// The words behind the fence: the language, and for `sh` and `text` which terminal.
    info: Vec<String>,
    text: String,
    /// Where it begins, from 1.
    line: usize,
}

impl Block {
    fn is(&self, language: &str) -> bool {
        self.info.first().is_some_and(|word| word == language)
    }
}

/// The fenced blocks of a page, in their order.
fn blocks(page: &str) -> Vec<Block> {
    let mut found = Vec::new();
    let mut open: Option<Block> = None;
    for (k, line) in page.lines().enumerate() {
        match (line.strip_prefix("```"), &mut open) {
            (Some(_), Some(_)) => found.extend(open.take()),
            (Some(info), None) => {
                let info = info.split_whitespace().map(str::to_owned).collect();
                open = Some(Block { info, text: String::new(), line: k + 1 });
            }
            (None, Some(block)) => {
                block.text.push_str(line);
                block.text.push('\n');
            }
            (None, None) => {}
        }
    }
    assert!(open.is_none(), "a block without its end");
    found
}
