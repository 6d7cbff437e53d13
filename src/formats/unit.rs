//! Unit of length of a table.

use std::fmt;
use std::str::FromStr;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A unit of length that tables are in.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub enum Unit {
    /// 1e-6 mm.
    #[serde(rename = "nm")]
    Nanometre,
    /// 1e-3 mm.
    #[serde(rename = "um")]
    Micrometre,
    /// 1 mm.
    #[default]
    #[serde(rename = "mm")]
    Millimetre,
    /// 10 mm.
    #[serde(rename = "cm")]
    Centimetre,
    /// 1000 mm.
    #[serde(rename = "m")]
    Metre,
    /// 25.4 mm.
    #[serde(rename = "inch")]
    Inch,
}

impl Unit {
    const ALL: [Self; 6] =
        [Self::Nanometre, Self::Micrometre, Self::Millimetre, Self::Centimetre, Self::Metre, Self::Inch];

    /// Returns the length of one unit, in millimetres.
    pub fn in_mm(self) -> f64 {
        match self {
            Self::Nanometre => 1e-6,
            Self::Micrometre => 1e-3,
            Self::Millimetre => 1.0,
            Self::Centimetre => 10.0,
            Self::Metre => 1000.0,
            Self::Inch => 25.4,
        }
    }

    /// Returns all words that name this unit, in lower case. The first one is the word used in settings files.
    pub(super) fn words(self) -> &'static [&'static str] {
        match self {
            Self::Nanometre => &["nm", "nanometre", "nanometres", "nanometer", "nanometers"],
            Self::Micrometre => &[
                "um",
                "\u{b5}m",
                "\u{3bc}m",
                "micron",
                "microns",
                "micrometre",
                "micrometres",
                "micrometer",
                "micrometers",
            ],
            Self::Millimetre => &["mm", "millimetre", "millimetres", "millimeter", "millimeters"],
            Self::Centimetre => &["cm", "centimetre", "centimetres", "centimeter", "centimeters"],
            Self::Metre => &["m", "metre", "metres", "meter", "meters"],
            Self::Inch => &["inch", "in", "inches", "zoll", "pouce", "pouces", "pulgadas"],
        }
    }

    /// Returns true if `word` names this unit. `word` must be in lower case.
    pub(super) fn is(self, word: &str) -> bool {
        self.words().contains(&word)
    }
}

impl FromStr for Unit {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let word = text.trim().to_lowercase();
        let all = || Self::ALL.map(|unit| unit.words()[0]).join(", ");
        Self::ALL
            .into_iter()
            .find(|unit| unit.is(&word))
            .ok_or_else(|| format!("expected one of {}, found `{text}`", all()))
    }
}

impl fmt::Display for Unit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.words()[0])
    }
}
