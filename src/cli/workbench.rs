//! Programs of the workbench of the page: this program itself, as a child with the lowest priority.

use std::io;
use std::path::{Path, PathBuf};
use std::process::Command;

use regrind::formats::{RecipeFolder, SimulationFolder};
use regrind::recipe;
use regrind_page::{RecipePrograms, Workbench};
use serde_json::Value;

use super::failure::Failure;

/// Folder of the recipes if the command names none. It need not exist.
const DEFAULT_FOLDER: &str = "recipes";

/// Text with which a new recipe begins: the tables that every recipe has.
const SKELETON: &str = "\
# Ctrl-Space shows the keys that fit; an incomplete recipe shows what is missing.

[part]
name = \"\"

[nominal]

[measure]

[acceptance]

[compensation]

[grinding]
";

/// Programs for recipes in a cell.
struct ChildPrograms {
    program: PathBuf,
    cell: PathBuf,
}

/// Returns the workbench for the recipes in `folder`, or in the default folder if it exists. `cell` is the cell for which
/// runs are planned.
///
/// # Errors
/// The given folder does not exist, or the path of this program is unknown.
pub(super) fn workbench(folder: Option<&Path>, cell: &Path) -> Result<Option<Workbench>, Failure> {
    let path = folder.unwrap_or(Path::new(DEFAULT_FOLDER));
    if !path.is_dir() {
        return match folder {
            None => Ok(None),
            Some(path) => Err(Failure::NoRecipesFolder { path: path.to_owned() }),
        };
    }
    SimulationFolder::delete_abandoned();
    let absolute = |path: &Path| std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
    let program = std::env::current_exe().map_err(|source: io::Error| Failure::Terminal(source))?;
    let programs = ChildPrograms { program, cell: cell.to_owned() };
    Ok(Some(Workbench::new(RecipeFolder::at(absolute(path)), Box::new(programs))))
}

impl ChildPrograms {
    fn command(&self, name: &str, recipe: &Path) -> Command {
        let mut command = Command::new(&self.program);
        command.arg(name).arg(recipe);
        command
    }
}

impl RecipePrograms for ChildPrograms {
    fn draft(&self, recipe: &Path) -> Command {
        let mut command = self.command("draft", recipe);
        command.arg("--cell").arg(&self.cell);
        command
    }

    fn simulation(&self, recipe: &Path, draft: &Path, runs: &Path, seed: u64) -> Command {
        let mut command = self.command("run", recipe);
        command.arg("--draft").arg(draft).arg("--runs").arg(runs).args(["--seed", &seed.to_string()]);
        command
    }

    fn schema(&self) -> &Value {
        recipe::json_schema()
    }

    fn skeleton(&self) -> &str {
        SKELETON
    }
}
