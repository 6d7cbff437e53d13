//! File that other users can read.

/// Permission by which users other than the owner can read a file, and the command that removes it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct OpenToOthers {
    /// Name of the permission.
    pub how: String,
    /// Command that removes the permission.
    pub remedy: String,
}
