//! Kind of file that has a JSON schema.

use serde_json::Value;

/// Kind of file: its name on the command line, its description, and its JSON schema.
pub(super) type FileKind = (&'static str, &'static str, fn() -> &'static Value);
