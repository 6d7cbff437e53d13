//! Seal: signature of the head of the journal at one record, made with the key that the run names.

use serde::{Deserialize, Serialize};
use serde_json::json;

use super::canonical::canonical_json;
use super::key::{AuditKey, PublicKey};

/// Number of records from one seal to the next. In an unsigned journal, number of records from one anchor to the next.
pub const SEALED_EVERY: u64 = 256;

/// Domain separator: keeps this signature distinct from every other use of the key.
const DOMAIN: &str = "regrind journal seal 1\n";

/// Payload of a record of kind `seal`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Seal {
    /// Number of records before the seal.
    pub records: u64,
    /// Hash of the last of these records.
    pub head: String,
    /// Public key of the signer, 64 hexadecimal digits.
    pub key: String,
    /// Signature, 128 hexadecimal digits.
    pub signature: String,
}

impl Seal {
    pub(super) fn new(key: &AuditKey, run: &str, records: u64, head: &str) -> Self {
        let signature = key.sign(&message(run, records, head));
        Self { records, head: head.to_owned(), key: key.public().to_string(), signature }
    }
}

/// Returns the message whose signature is a seal (the signed record that protects all records before it). The message
/// contains the name of the run, the number of records, and `head`, the hash of the last record. Because the message
/// contains the name of the run, a seal is not valid in another run.
fn message(run: &str, records: u64, head: &str) -> Vec<u8> {
    let text = canonical_json(&json!({ "head": head, "records": records, "run": run }));
    [DOMAIN, &text].concat().into_bytes()
}

/// Returns true if `signature` is a valid seal (signature of the journal at one record), made with `key`. The seal must
/// be for the run named `run`, for the number of records `records`, and for `head`, the hash of the last of these
/// records.
pub(super) fn is_signed(key: &PublicKey, run: &str, records: u64, head: &str, signature: &str) -> bool {
    key.has_signed(&message(run, records, head), signature)
}
