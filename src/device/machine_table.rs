//! Position of a machine in a cell file, for messages about it.

/// Position of a machine in a cell file.
#[derive(Clone, Copy, Debug)]
pub struct MachineTable<'a> {
    /// Table of the machine: `cmm` or `grinder`.
    pub table: &'a str,
    /// True if the cell is simulated; `None` if the file does not say it.
    pub simulated: Option<bool>,
}

impl MachineTable<'_> {
    /// Returns the full path of a key in a cell file, for messages. `rest` is the path of the key within the table of
    /// the machine. Example: `cmm.wire.unit` for `wire.unit`.
    pub fn key(&self, rest: &str) -> String {
        format!("{}.{rest}", self.table)
    }
}
