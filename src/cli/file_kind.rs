//! Kind of file that has a JSON schema.

use serde_json::Value;

/// Kind of file: its name on the command line, its description, and its JSON schema.
pub(super) type FileKind = (&'static str, &'static str, fn() -> &'static Value);

/// Plant file without problems: its SHA-256 and notes for people.
pub(super) struct CheckedPlantFile {
    pub(super) sha256: [u8; 32],
    pub(super) notes: Vec<String>,
}
