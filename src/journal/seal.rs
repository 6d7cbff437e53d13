//! A seal: the head of the journal at some record, signed by the key that the run names.

use serde::{Deserialize, Serialize};
use serde_json::json;

use super::canonical::canonical_json;
use super::key::{AuditKey, PublicKey};

/// Records from one seal to the next, and from one anchor to the next where nothing is signed.
pub const SEALED_EVERY: u64 = 256;

/// What separates this signature from every other use of the key.
const DOMAIN: &str = "regrind journal seal 1\n";

/// The payload of a record of kind `seal`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Seal {
    /// The number of records before it.
    pub(super) records: u64,
    /// The hash of the last of them.
    pub(super) head: String,
    /// Who signed.
    pub(super) key: String,
    /// The signature.
    pub(super) signature: String,
}

impl Seal {
    pub(super) fn new(key: &AuditKey, run: &str, records: u64, head: &str) -> Self {
        let signature = key.sign(&message(run, records, head));
        Self { records, head: head.to_owned(), key: key.public().to_string(), signature }
    }
}

/// Returns what is signed: it names the run, so that a seal cannot be carried over into another.
fn message(run: &str, records: u64, head: &str) -> Vec<u8> {
    let text = canonical_json(&json!({ "head": head, "records": records, "run": run }));
    [DOMAIN, &text].concat().into_bytes()
}

/// Returns whether a key has signed the head of a run.
pub(super) fn is_signed(key: &PublicKey, run: &str, records: u64, head: &str, signature: &str) -> bool {
    key.has_signed(&message(run, records, head), signature)
}
