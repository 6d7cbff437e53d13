//! Selection of one surface of a file that has several: faces of a CAD model, or surfaces of a lens.

use std::convert::Infallible;
use std::fmt;
use std::str::FromStr;

use super::analytic::Sampling;
use super::parametric::FaceFrame;
use crate::geometry::Aperture;

/// Choice of a surface.
#[derive(Clone, Debug, Eq, PartialEq)]
pub enum SurfaceChoice {
    /// The face with the largest area.
    Largest,
    /// The face with this number, counted from 1, or the surface of a lens with its number in the file.
    Number(usize),
    /// A number that was written as a word: that of a surface, if it is not the name of another one.
    NumberOrName(usize),
    /// The only one with this name.
    Name(String),
}

impl FromStr for SurfaceChoice {
    type Err = Infallible;

    /// Parses `largest`, a number, a name, or `number:` or `name:` and one of them.
    fn from_str(text: &str) -> Result<Self, Self::Err> {
        if text == "largest" {
            return Ok(Self::Largest);
        }
        if let Some(name) = text.strip_prefix("name:") {
            return Ok(Self::Name(name.to_owned()));
        }
        if let Some(Ok(number)) = text.strip_prefix("number:").map(str::parse) {
            return Ok(Self::Number(number));
        }
        Ok(text.parse().map_or_else(|_| Self::Name(text.to_owned()), Self::NumberOrName))
    }
}

impl fmt::Display for SurfaceChoice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Largest => f.write_str("largest"),
            Self::Number(number) | Self::NumberOrName(number) => write!(f, "{number}"),
            Self::Name(name) => f.write_str(name),
        }
    }
}

/// The surface of a file that is the nominal surface, and how it is taken.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SurfaceSelection {
    /// The surface. Default: the largest face, or the only curved surface of a lens.
    pub choice: Option<SurfaceChoice>,
    /// Frame in which a face becomes the nominal surface.
    pub frame: FaceFrame,
    /// Outline of the part, instead of that of the file.
    pub aperture: Option<Aperture>,
    /// How exactly the surface is sampled. Default: to 0.1 nm.
    pub sampling: Option<Sampling>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn choice_is_parsed_and_shown() {
        for (text, choice) in [
            ("largest", SurfaceChoice::Largest),
            ("12", SurfaceChoice::NumberOrName(12)),
            ("OPTIC", SurfaceChoice::Name("OPTIC".into())),
            ("-1", SurfaceChoice::Name("-1".into())),
        ] {
            assert_eq!(text.parse(), Ok(choice.clone()));
            assert_eq!(choice.to_string(), text);
        }
        for (text, choice) in [
            ("number:12", SurfaceChoice::Number(12)),
            ("name:12", SurfaceChoice::Name("12".into())),
            ("number:a", SurfaceChoice::Name("number:a".into())),
        ] {
            assert_eq!(text.parse(), Ok(choice));
        }
    }
}
