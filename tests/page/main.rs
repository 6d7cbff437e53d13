//! The page of a cell: who has access, what it shows, and the effects of its orders.
//!
//! Every run here is the program itself with its simulated machines, and every page is the program that serves it.
//! Tests that need a browser look for Debian package chromium. Signals and file modes are Unix only.
#![cfg(unix)]

regrind_testcell::program!();

mod api;
mod foreign_clients;
mod in_a_browser;
mod speed;
mod strangers;
mod users;
mod views;
mod workbench;

use std::path::{Path, PathBuf};

use program::{Running, regrind, small_recipe};
use regrind_testcell::http::Visitor;

/// Line of a recipe after which a test inserts the speed of its machines.
const SPEED: &str = "[simulation]\nseed = 1";

/// Cell at work, and its page.
struct CellPage {
    run: Running,
    page: Running,
    /// Address that opens the page, with its key.
    url: String,
    folder: PathBuf,
    /// Name of the run.
    id: String,
}

impl CellPage {
    /// Begins a run whose machines are `speed` times as fast as real ones.
    fn begin(home: &Path, speed: f64) -> Self {
        Self::start(home, &small_recipe(home, speed))
    }

    fn start(home: &Path, recipe: &Path) -> Self {
        Self::start_in(home, &recipe.display().to_string(), "sim")
    }

    /// Begins a run in the cell of a file.
    fn start_in(home: &Path, recipe: &str, cell: &str) -> Self {
        let arguments = ["run", recipe, "--cell", cell, "--part", "SN-0042", "--operator", "A. Smith"];
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

/// Serves the page of the runs below a folder. Returns the address that opens it.
fn serve(home: &Path) -> (Running, String) {
    serve_with(home, &["--listen", "127.0.0.1:0"])
}

fn serve_with(home: &Path, arguments: &[&str]) -> (Running, String) {
    std::fs::create_dir_all(home.join("runs")).unwrap();
    let mut page = Running::new(regrind(&[&["serve", "--runs", "runs"], arguments].concat(), home));
    let line = page.line("address of the page", |line| line.starts_with("page "));
    let url = line.trim_start_matches("page").trim().to_owned();
    (page, url)
}
