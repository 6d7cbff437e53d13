//! Response of the part to its correction.

use serde::{Deserialize, Serialize};

/// Response of the part to the last map.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PartResponse {
    /// As expected.
    Expected,
    /// Unknown: the map was too small, or its effect too noisy.
    Unclear,
    /// In the opposite direction: the sign of the map is wrong.
    SignFlipped,
    /// As to a mirrored or turned map: the direction of an axis is wrong.
    Mirrored,
    /// No response.
    NoEffect,
    /// Twice the expected response: the map was applied two times.
    Doubled,
}
