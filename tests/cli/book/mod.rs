//! Tests of the book in docs/: every command of its pages runs, its screens are compared with the output, its examples
//! are checked, and its generated parts match the program.

mod extending;
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
    /// Words after the fence: the language, and for `sh` and `text` the terminal.
    info: Vec<String>,
    text: String,
    /// First line of the block, counted from 1.
    line: usize,
}

impl Block {
    fn is(&self, language: &str) -> bool {
        self.info.first().is_some_and(|word| word == language)
    }
}

/// Returns the fenced blocks of a page, in order.
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
