//! Where a machine stands in a cell file, for messages about it.

/// Where a machine stands in a cell file.
#[derive(Clone, Copy, Debug)]
pub struct Place<'a> {
    /// Its table: `cmm` or `grinder`.
    pub table: &'a str,
    /// Whether the cell is simulated, where the file says it.
    pub simulated: Option<bool>,
}

impl Place<'_> {
    /// Returns a key of the machine's table as messages call it.
    pub fn key(&self, rest: &str) -> String {
        format!("{}.{rest}", self.table)
    }
}
