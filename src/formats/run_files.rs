//! Names of the files in the folder of a run. The journal itself names its files.

use std::ffi::OsStr;
use std::fmt;
use std::fs;
use std::path::{Path, PathBuf};

/// Defines files, each with its name.
macro_rules! named_files {
    ($(#[$about:meta])* $files:ident { $($(#[$doc:meta])* $file:ident = $name:literal,)+ }) => {
        $(#[$about])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub enum $files {
            $($(#[$doc])* $file,)+
        }

        impl $files {
            #[cfg(test)]
            const ALL: &[Self] = &[$(Self::$file),+];

            /// Returns the name of this file, without its folder.
            pub const fn name(self) -> &'static str {
                match self {
                    $(Self::$file => $name,)+
                }
            }

            /// Returns the file with this name. `name` is without a folder. Returns `None` if no file has this name.
            pub fn from_name(name: &str) -> Option<Self> {
                match name {
                    $($name => Some(Self::$file),)+
                    _ => None,
                }
            }
        }
    };
}

named_files! {
    /// File at the top of the folder of a run.
    RunFile {
        /// Recipe with which the run began.
        Recipe = "recipe.toml",
        /// Cell file with which the run began.
        Cell = "cell.toml",
        /// Knowledge of an earlier run with which the run began.
        LearnedFrom = "learned_from.json",
        /// Knowledge of the grinder from this run.
        Learned = "learned.json",
        /// Ending of the run, and the figures of its cycles.
        Result = "result.json",
        /// Report of the run.
        Report = "report.html",
        /// Report of the run as PDF/A.
        PdfReport = "report.pdf",
        /// Label of the part.
        Label = "label.svg",
        /// Results of the run as QIF 3.0.
        QifResults = "results.qif",
        /// Results of the run as Q-DAS ASCII.
        DfqResults = "results.dfq",
        /// Unix socket for the orders to a running cell.
        ControlSocket = "control.sock",
    }
}

named_files! {
    /// File in the folder of a cycle. Some files have a variable part in their names: see [`tool_path_file`],
    /// [`plan_file`], [`hits_file`] and [`machine_result_file`].
    CycleFile {
        /// Measured points on the part.
        Measured = "measured.csv",
        /// Conditions of the measurement.
        Conditions = "measured.json",
        /// Measured points on the reference sphere.
        ReferenceSphere = "reference_sphere.csv",
        /// Touched targets of an adaptive measurement.
        Touches = "touches.json",
        /// Number of rounds in which outliers were touched again.
        RepeatedTouches = "touched_again.json",
        /// Registration of the measured points.
        Registration = "registration.json",
        /// Deviations of the measured points.
        Deviations = "deviations.csv",
        /// Uncertainties of the deviations.
        DeviationUncertainty = "deviation_uncertainty.csv",
        /// Measured points, coloured by their deviations.
        ColouredDeviations = "deviations.ply",
        /// Model of the error: its form, noise and uncertainty.
        Model = "model.json",
        /// Form at each measured point.
        Form = "form.csv",
        /// Figures of the form.
        Figures = "figures.json",
        /// Estimated errors of the machine parameters.
        Parameters = "parameters.json",
        /// Error map as a table.
        ErrorMap = "error_map.csv",
        /// Error map as X3P, which contains the time of writing.
        ErrorMapX3p = "error_map.x3p",
        /// Picture of the error map, with axes.
        ErrorMapSvg = "error_map.svg",
        /// Picture of the error map, one pixel for each pixel of its raster.
        ErrorMapPng = "error_map.png",
        /// Correction of the next pass.
        Correction = "correction.csv",
        /// Offset of axis Z at each node of the correction of the next pass.
        AxisTable = "toolpath_z.csv",
        /// Judgement of the cycle.
        Judgement = "result.json",
    }
}

/// Folder for files of a cycle. Its text is the path relative to the folder of the run. Each attempt of a computation
/// and each batch of touches has a folder of its own, so that recorded files are never overwritten.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[allow(missing_docs)]
pub enum CycleFolder {
    /// Folder of an attempt, counted from 1. The first attempt uses the folder of the cycle itself.
    Attempt { cycle: u32, attempt: u32 },
    /// Folder for the results after a batch of an adaptive measurement, counted from 1.
    Batch { cycle: u32, batch: u32 },
}

impl CycleFolder {
    /// Returns the folder of a cycle, which is also that of the first attempt.
    pub const fn new(cycle: u32) -> Self {
        Self::Attempt { cycle, attempt: 1 }
    }

    /// Returns the number of the cycle to whose folder `path` belongs. `path` is relative to the folder of the run.
    /// Returns `None` for a path outside the folders of cycles.
    pub fn cycle_of(path: &str) -> Option<u32> {
        path.split('/').next()?.strip_prefix("cycle-")?.parse().ok()
    }
}

impl fmt::Display for CycleFolder {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Attempt { cycle, attempt: 0 | 1 } => write!(f, "cycle-{cycle}"),
            Self::Attempt { cycle, attempt } => write!(f, "cycle-{cycle}/attempt-{attempt}"),
            Self::Batch { cycle, batch } => write!(f, "cycle-{cycle}/batch-{batch}"),
        }
    }
}

/// Returns the highest cycle number N for which the run folder contains a file or folder named `cycle-N`. Returns 0 if
/// there is none, or if the folder cannot be read.
pub fn newest_cycle(run: &Path) -> u32 {
    let names = fs::read_dir(run).into_iter().flatten().flatten().map(|entry| entry.file_name());
    names.filter_map(|name| CycleFolder::cycle_of(name.to_str()?)).max().unwrap_or(0)
}

/// Returns the name of the program of a pass in the folder of a cycle. The dialect of the controller defines
/// `extension`.
pub fn tool_path_file(extension: &str) -> String {
    format!("{TOOL_PATH}.{extension}")
}

/// Returns true if `name` is a name that [`tool_path_file`] gives, with any extension.
pub fn is_tool_path_file(name: &str) -> bool {
    name.strip_prefix(TOOL_PATH).is_some_and(|rest| rest.starts_with('.'))
}

/// Returns the path of the program for the pass of the cycle `cycle` in the run folder `run`. The cycle before wrote it.
/// Returns `None` if there is no program.
pub fn program_for_pass(run: &Path, cycle: u32) -> Option<PathBuf> {
    let folder = run.join(CycleFolder::new(cycle.saturating_sub(1)).to_string());
    let files = fs::read_dir(folder).ok()?.flatten().map(|entry| entry.path());
    let is_program = |name: Option<&OsStr>| name.and_then(OsStr::to_str).is_some_and(is_tool_path_file);
    files.filter(|file| file.is_file() && is_program(file.file_name())).min()
}

/// Returns the name of the list of targets for a person or a machine that touches them. `earlier_batches` is the number
/// of batches of touches before it in the same measurement.
pub fn plan_file(earlier_batches: u32) -> String {
    batch_file("plan", earlier_batches, "csv")
}

/// Returns the name of the file with the lines that a machine sent. `earlier_batches` is the number of batches of
/// touches before it in the same measurement.
pub fn hits_file(earlier_batches: u32) -> String {
    batch_file("hits", earlier_batches, "jsonl")
}

/// Returns the name under which the file of a machine's result is stored. `earlier_batches` is the number of batches of
/// touches before it in the same measurement, and `extension` that of the machine's file.
pub fn machine_result_file(earlier_batches: u32, extension: &str) -> String {
    batch_file(MACHINE_RESULT, earlier_batches, extension)
}

/// Returns true if `name` is a name that [`machine_result_file`] gives, for any batch and with any extension.
pub fn is_machine_result_file(name: &str) -> bool {
    name.strip_prefix(MACHINE_RESULT).is_some_and(|rest| rest.starts_with(['.', '-']))
}

const TOOL_PATH: &str = "toolpath";
const MACHINE_RESULT: &str = "result";

fn batch_file(stem: &str, earlier_batches: u32, extension: &str) -> String {
    match earlier_batches {
        0 => format!("{stem}.{extension}"),
        earlier => format!("{stem}-{}.{extension}", earlier + 1),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn run_file_names() {
        let names: Vec<&str> = RunFile::ALL.iter().map(|file| file.name()).collect();
        assert_eq!(
            names.join(" "),
            "recipe.toml cell.toml learned_from.json learned.json result.json report.html report.pdf label.svg results.qif results.dfq control.sock"
        );
        let names: Vec<&str> = CycleFile::ALL.iter().map(|file| file.name()).collect();
        assert_eq!(
            names.join(" "),
            "measured.csv measured.json reference_sphere.csv touches.json touched_again.json registration.json deviations.csv \
             deviation_uncertainty.csv deviations.ply model.json form.csv figures.json parameters.json error_map.csv error_map.x3p \
             error_map.svg error_map.png correction.csv toolpath_z.csv result.json"
        );
        assert!(CycleFile::ALL.iter().all(|file| CycleFile::from_name(file.name()) == Some(*file)));
        assert_eq!(CycleFile::from_name("correction.json"), None);
        assert_eq!([plan_file(0), plan_file(1)], ["plan.csv", "plan-2.csv"]);
        assert_eq!([hits_file(0), hits_file(2)], ["hits.jsonl", "hits-3.jsonl"]);
        assert_eq!([machine_result_file(0, "txt"), machine_result_file(1, "csv")], ["result.txt", "result-2.csv"]);
        assert_eq!(tool_path_file("ngc"), "toolpath.ngc");
        let are = |is: fn(&str) -> bool, names: [&str; 3]| names.map(is);
        assert_eq!(are(is_machine_result_file, ["result.txt", "result-2.csv", "results.csv"]), [true, true, false]);
        assert_eq!(are(is_tool_path_file, ["toolpath.ngc", "toolpath.h", "toolpath_z.csv"]), [true, true, false]);
    }

    #[test]
    fn cycle_folder_names() {
        let folders = [
            (CycleFolder::new(2), "cycle-2"),
            (CycleFolder::Attempt { cycle: 2, attempt: 3 }, "cycle-2/attempt-3"),
            (CycleFolder::Batch { cycle: 12, batch: 1 }, "cycle-12/batch-1"),
        ];
        for (folder, path) in folders {
            assert_eq!(folder.to_string(), path);
            let (CycleFolder::Attempt { cycle, .. } | CycleFolder::Batch { cycle, .. }) = folder;
            assert_eq!(CycleFolder::cycle_of(&format!("{path}/measured.csv")), Some(cycle));
        }
        assert_eq!(["recipe.toml", "cycle-x/a", "a/cycle-1"].map(CycleFolder::cycle_of), [None; 3]);
    }

    #[test]
    fn program_for_pass_from_cycle_before() {
        let home = tempfile::tempdir().unwrap();
        assert_eq!(program_for_pass(home.path(), 1), None);
        fs::create_dir(home.path().join("cycle-1")).unwrap();
        for name in ["toolpath_z.csv", "toolpath.ngc", "correction.csv"] {
            fs::write(home.path().join("cycle-1").join(name), "").unwrap();
        }
        assert_eq!(program_for_pass(home.path(), 2), Some(home.path().join("cycle-1/toolpath.ngc")));
        assert_eq!(program_for_pass(home.path(), 3), None);
    }

    #[test]
    fn newest_cycle_by_number() {
        let home = tempfile::tempdir().unwrap();
        assert_eq!(newest_cycle(home.path()), 0);
        for name in ["cycle-2", "cycle-10", "cycle-x", "other-30"] {
            fs::create_dir(home.path().join(name)).unwrap();
        }
        assert_eq!(newest_cycle(home.path()), 10);
    }
}
