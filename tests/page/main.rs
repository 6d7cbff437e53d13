//! The page of a cell: who is let in, what it shows, and what comes of its orders.
//!
//! Every run here is the program itself with its simulated machines, every page the program that serves it. What needs a browser asks
//! for one: Debian package chromium. Signals and modes are Unix's.
#![cfg(unix)]

#[path = "../common/keep.rs"]
mod keep;
#[path = "../common/program.rs"]
mod program;

mod browser;
mod http;
mod in_a_browser;
mod strangers;
mod users;
mod views;

use std::path::{Path, PathBuf};

use http::Visitor;
use program::{Running, regrind, small_recipe};

/// The line of a recipe behind which the speed of its machines may stand.
const SPEED: &str = "[simulation]\nseed = 1";

/// A cell that is at work, and its page.
struct Shown {
    run: Running,
    page: Running,
    /// The address that opens the page, with its key.
    url: String,
    folder: PathBuf,
    /// The name of the run.
    id: String,
}

impl Shown {
    /// Begins a run whose machines are so many times as fast as real ones.
    fn begin(home: &Path, speed: f64) -> Self {
        Self::of(home, &small_recipe(home, speed))
    }

    fn of(home: &Path, recipe: &Path) -> Self {
        let recipe = recipe.display().to_string();
        let arguments = ["run", &recipe, "--cell", "sim", "--part", "SN-0042", "--operator", "A. Smith"];
        let mut run = Running::new(regrind(&arguments, home));
        let folder = run.folder(home);
        let (page, url) = serve(home);
        let id = folder.file_name().unwrap().to_string_lossy().into_owned();
        Self { run, page, url, folder, id }
    }

    /// Opens the page with its key, as a browser does.
    fn visitor(&self) -> Visitor {
        Visitor::with_key(&self.url)
    }
}

/// Serves the page of the runs below a folder; returns the address that opens it.
fn serve(home: &Path) -> (Running, String) {
    serve_with(home, &["--listen", "127.0.0.1:0"])
}

fn serve_with(home: &Path, arguments: &[&str]) -> (Running, String) {
    let mut page = Running::new(regrind(&[&["serve", "--runs", "runs"], arguments].concat(), home));
    let line = page.line("address of the page", |line| line.starts_with("page "));
    let url = line.trim_start_matches("page").trim().to_owned();
    (page, url)
}
