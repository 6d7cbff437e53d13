//! Folders: the folder of the run, which holds the program of a pass, and the folder that this computer and the
//! controller both see.

use std::io;
use std::path::{Path, PathBuf};

use regrind_formats::result::read_bytes;
use regrind_formats::run_files::{CycleFolder, tool_path_file};
use regrind_formats::write_atomic;

use super::program::{FramedProgram, PROGRAM, ProgramInputs, ProgramRecord, RECORD, name_begins};

/// Maximum size of a record in bytes; a longer file is not a record.
const MAX_RECORD_BYTES: u64 = 1 << 16;

/// Source and destination folders of programs.
#[derive(Clone, Debug)]
pub(super) struct Folders {
    /// Folder of the run.
    pub(super) run: PathBuf,
    /// Folder of programs, as this computer sees it.
    pub(super) local: PathBuf,
    /// Folder of programs, as the controller sees it.
    pub(super) remote: String,
    /// True if file operations run on the caller's thread; false if they run on a thread for blocking work.
    pub(super) single_threaded: bool,
}

impl Folders {
    /// Reads the program of the newest cycle in the folder of the run, and adds the lines that log its begin and its
    /// end. `map` is the SHA-256 identity of the correction map for which the program must be made. `rounds` is the
    /// number of times that the controller runs the pass.
    ///
    /// # Errors
    /// Returns the reason as text if no cycle has a program, if the newest program is for another map, or if the
    /// program must not be run.
    pub(super) fn newest(&self, map: &[u8; 32], rounds: u32) -> Result<FramedProgram, String> {
        let cycles = std::fs::read_dir(&self.run).map_err(|error| path_error(&self.run, &error))?;
        let name = tool_path_file(PROGRAM);
        let cycle = |folder: &Path| CycleFolder::cycle_of(folder.file_name()?.to_str()?);
        let cycles = cycles.flatten().filter_map(|entry| Some((cycle(&entry.path())?, entry.path().join(&name))));
        let newest = cycles.filter(|(_, file)| file.is_file()).max_by_key(|(cycle, _)| *cycle);
        let (cycle, file) = newest.ok_or_else(|| {
            format!("the run folder {} has no file {name}: see the journal for the reason", self.run.display())
        })?;
        self.framed(cycle, &file, map, rounds)
    }

    fn framed(&self, cycle: u32, file: &Path, map: &[u8; 32], rounds: u32) -> Result<FramedProgram, String> {
        let pass = read_bytes(file).map_err(|error| error.to_string())?;
        let run = self.run.file_name().unwrap_or_default().to_string_lossy();
        let order = ProgramInputs { run: &run, cycle, pass: &pass, map, rounds, folder: &self.remote };
        FramedProgram::frame(order).map_err(|reason| format!("{}: {reason}", file.display()))
    }

    /// Writes `program` into the folder of programs, which this computer and the controller both see. Then reads the
    /// file back and compares the content. Writes nothing if the folder already contains the same program.
    ///
    /// # Errors
    /// Returns the reason as text if the file cannot be written, or if its content differs afterwards.
    pub(super) fn put(&self, program: &FramedProgram) -> Result<(), String> {
        let file = self.local.join(&program.name).with_extension(PROGRAM);
        let lies_there = |file: &Path| std::fs::read(file).is_ok_and(|text| text == program.text);
        if lies_there(&file) {
            return Ok(());
        }
        write_atomic(&file, &program.text).map_err(|error| error.to_string())?;
        match lies_there(&file) {
            true => Ok(()),
            false => Err(format!(
                "the file {} differs from the data that Regrind wrote: check the disk, and whether another program writes into this folder",
                file.display()
            )),
        }
    }

    /// Returns the content of the log file that the program `name` wrote, or `None` if there is no such file.
    pub(super) fn record(&self, name: &str) -> Result<Option<ProgramRecord>, String> {
        let file = self.local.join(name).with_extension(RECORD);
        let read = std::fs::metadata(&file).and_then(|about| match about.len() <= MAX_RECORD_BYTES {
            true => std::fs::read(&file),
            false => Err(io::ErrorKind::FileTooLarge.into()),
        });
        match read {
            Ok(bytes) => Ok(Some(ProgramRecord::read(&String::from_utf8_lossy(&bytes)))),
            Err(error) if error.kind() == io::ErrorKind::NotFound && self.local.is_dir() => Ok(None),
            Err(error) => Err(path_error(&file, &error)),
        }
    }

    /// Finds the program that an earlier process prepared for cycle `cycle` of this run. `token` is the random number
    /// of that preparation. Returns the program whose log file contains `token`. Returns `None` if no log file contains
    /// it, or if the program file is not valid.
    ///
    /// # Errors
    /// Returns the reason as text if the folder or a file cannot be read.
    pub(super) fn prepared(&self, cycle: u32, token: u32) -> Result<Option<FramedProgram>, String> {
        let run = self.run.file_name().unwrap_or_default().to_string_lossy();
        let begins = name_begins(&run, cycle);
        for entry in std::fs::read_dir(&self.local).map_err(|error| path_error(&self.local, &error))?.flatten() {
            let file = entry.path();
            let name = file.file_stem().and_then(|name| name.to_str()).filter(|name| name.starts_with(&begins));
            let Some(name) = name.filter(|_| file.extension().is_some_and(|e| e == RECORD)) else { continue };
            if self.record(name)?.is_some_and(|record| record.token == Some(token)) {
                let file = file.with_extension(PROGRAM);
                let text = std::fs::read(&file).map_err(|error| path_error(&file, &error))?;
                return Ok(FramedProgram::read(name, cycle, text));
            }
        }
        Ok(None)
    }
}

fn path_error(path: &Path, error: &io::Error) -> String {
    format!("{}: {error}", path.display())
}
