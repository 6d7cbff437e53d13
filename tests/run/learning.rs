//! Learning from part to part: the repeatable error that one run estimated is the start of the next run, or the next
//! run reports why not.

use std::fs;
use std::path::{Path, PathBuf};

use serde_json::Value;

use crate::program::{replaced, root, run, run_folders};

/// A folder of runs, and a recipe with learning.
struct Shop {
    home: tempfile::TempDir,
    recipe: String,
}

impl Shop {
    fn new() -> Self {
        let recipe = fs::read_to_string(root().join("recipes/shallow-wave.toml")).unwrap();
        let recipe = replaced(&recipe, "columns = 50\nrows = 40", "columns = 25\nrows = 20");
        let recipe = replaced(&recipe, "cutoff_mm = 5.0", "cutoff_mm = 11.0\nlearn = true");
        let recipe = replaced(&recipe, "max_cycles = 5", "max_cycles = 2");
        Self { home: tempfile::tempdir().unwrap(), recipe }
    }

    /// Runs or plans a recipe. Returns the exit code and all output.
    fn give(&self, command: &str, recipe: &str) -> (i32, String) {
        fs::write(self.home.path().join("wave.toml"), recipe).unwrap();
        let cell = root().join("config/sim.toml");
        let (code, out, err) = run(&[command, "wave.toml", "--cell", cell.to_str().unwrap()], self.home.path());
        (code, format!("{out}\n{err}"))
    }

    /// Runs a recipe to its end. Returns its folder and all output.
    fn ran(&self, recipe: &str) -> (PathBuf, String) {
        let before = self.folders();
        let (code, said) = self.give("run", recipe);
        assert!(matches!(code, 0 | 1), "{said}");
        let mut new = self.folders();
        new.retain(|folder| !before.contains(folder));
        (new.pop().expect("a run has a folder"), said)
    }

    fn folders(&self) -> Vec<PathBuf> {
        run_folders(&self.home.path().join("runs"))
    }
}

/// Returns the measured RMS of the part after the first pass, in mm.
fn first_rms_mm(run: &Path) -> f64 {
    let document: Value = serde_json::from_slice(&fs::read(run.join("cycle-1/registration.json")).unwrap()).unwrap();
    document["rms_mm"].as_f64().expect("registration.json tells rms_mm")
}

#[test]
fn next_part_starts_from_learned_error() {
    let shop = Shop::new();
    let (first, said) = shop.ran(&shop.recipe);
    assert!(said.contains("begins without knowledge"), "{said}");
    let name = first.file_name().unwrap().to_str().unwrap().to_owned();

    let (second, said) = shop.ran(&shop.recipe);
    assert!(said.lines().any(|line| line.contains("begins with ") && line.contains(&name)), "{said}");
    let [before, after] = [&first, &second].map(|run| first_rms_mm(run));
    assert!(after < 0.5 * before, "the first pass left {before} mm, and that of the next part {after} mm");
    // The record contains the initial state, and the correction of the first pass.
    let recorded = |folder: &Path| run(&["audit", "export", folder.to_str().unwrap()], shop.home.path()).1;
    for name in ["correction.csv", "toolpath.ngc", "toolpath_z.csv"] {
        for (run, cycle, there) in [(&first, 0, false), (&first, 1, true), (&second, 0, true)] {
            let name = format!("cycle-{cycle}/{name}");
            assert_eq!(run.join(&name).is_file(), there, "{name} of {run:?}");
            assert_eq!(recorded(run).contains(&name), there, "{name} in the record of {run:?}");
        }
    }
    assert_eq!(fs::read(first.join("learned.json")).unwrap(), fs::read(second.join("learned_from.json")).unwrap());
    let (code, _, errors) = run(&["audit", "verify", second.to_str().unwrap()], shop.home.path());
    assert_eq!(code, 0, "{errors}");

    // A plan does not know which run it will start from.
    let is_learning = |recipe: &str| shop.give("plan", recipe).1.lines().any(|line| line.starts_with("learn "));
    assert!(is_learning(&shop.recipe));
    assert!(!is_learning(&replaced(&shop.recipe, "learn = true", "learn = false")));

    // Another rule for the gain makes the learned state incompatible.
    let (_, said) = shop.ran(&replaced(&shop.recipe, "learn = true", "learn = true\ngain = 0.8"));
    assert!(said.contains("begins without knowledge"), "{said}");
}

#[test]
fn unusable_learned_error_refused() {
    let shop = Shop::new();
    let (first, _) = shop.ran(&shop.recipe);
    let refused = |recipe: &str, words: &[&str]| {
        let runs = shop.folders().len();
        let (code, said) = shop.give("run", recipe);
        assert_eq!(code, 2, "{said}");
        assert!(words.iter().all(|word| said.contains(word)), "{said}");
        assert_eq!(shop.folders().len(), runs, "a refused run leaves no folder");
    };
    let small = replaced(&shop.recipe, "max_correction_um = 60.0", "max_correction_um = 0.5");
    refused(&small, &["the recipe allows 0.50 µm", "raise max_correction_um", "learn = false"]);
    let measured_first = replaced(&shop.recipe, "max_cycles = 2", "max_cycles = 2\nbegin_with = \"measure\"");
    refused(&measured_first, &["compensation.learn", "remove `learn`"]);
    // A damaged file is reported, and blocks nothing.
    fs::write(first.join("learned.json"), "{").unwrap();
    let (_, said) = shop.ran(&shop.recipe);
    assert!(
        said.contains("ignored:") && said.contains("learned.json") && said.contains("begins without knowledge"),
        "{said}"
    );
}
