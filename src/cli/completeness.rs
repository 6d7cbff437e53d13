//! Completeness of the record of a run: its end, and the signature of the end.

use regrind::journal::{PublicKey, Verified};

/// Returns true if a verified journal is complete: the run has its end record, and the end is signed if the run has a
/// key. Returns false if the run is still active and its end is therefore missing or not signed yet. `keys` are the
/// public keys that the user trusts. The slice can be empty.
///
/// Returns an error, with a text that names the fault, in three cases:
///
/// - The end of the run is not signed, although the run has a key. If `keys` is empty, this is no error while the run
///   is still active.
/// - The anchor file is missing. This file states the number of records. Without it, records can be removed from the
///   end and nobody can detect this.
/// - The run was interrupted and has no end.
pub(super) fn is_whole(verified: &Verified, keys: &[PublicKey]) -> Result<bool, &'static str> {
    match verified {
        // With a key, an end that this key has not signed is not trusted, even if a process holds the lock.
        verified if verified.lacks_last_seal() && (!verified.under_way || !keys.is_empty()) => Err(
            "the end of the record is not signed, although the run has a key: the records after the last signature may come from a person without the key",
        ),
        Verified { anchored: 0, .. } => {
            Err("journal.anchor is missing: it is unknown whether the end of the record was cut off")
        }
        Verified { closed: false, under_way: false, .. } => Err(
            "the run was interrupted: its program no longer runs, and the record stops before the end of the run; later events are unknown",
        ),
        verified => Ok(verified.closed && !verified.lacks_last_seal()),
    }
}
