//! Why a surface could not be defined or sampled.

use thiserror::Error;

use crate::geometry::ApertureError;

/// Why a nominal surface given by a formula could not be defined or sampled.
///
/// A key is written as the path in the definition, such as `surface.radius_mm`; lines and columns count from 1.
#[derive(Clone, Debug, Error, PartialEq)]
#[allow(missing_docs)]
#[non_exhaustive]
pub enum DefinitionError {
    /// The text is no TOML, or a key is missing, unknown or of the wrong type.
    #[error("line {line}, column {column}: {message}")]
    Toml { line: usize, column: usize, message: String },
    /// An error of value, with the place where the value stands.
    #[error("line {line}, column {column}: {source}")]
    Located { line: usize, column: usize, source: Box<DefinitionError> },
    /// A number lies outside what the formula can take; value and limit are in the unit that the key ends with.
    #[error("`{key}` is {value}; it must be {limit}; {remedy}")]
    OutOfRange { key: String, value: f64, limit: &'static str, remedy: &'static str },
    /// A coefficient's key is no power or index of this formula.
    #[error("`{key}` names no term; {expected}")]
    Term { key: String, expected: &'static str },
    /// Two coefficients are given for one term.
    #[error("`{key}` is given twice; add the two coefficients, or remove one")]
    RepeatedTerm { key: String },
    /// A section is cut from another section.
    #[error(
        "`{key}` is itself an off-axis section; give the whole surface as the parent, and one distance and azimuth"
    )]
    NestedSection { key: String },
    /// The formula is not defined, or infinitely steep, at the centre of an off-axis section, in the parent's frame.
    #[error(
        "the parent surface is not defined at the section's centre ({x_mm} mm, {y_mm} mm); `surface.distance_mm` must be \
         less than the parent's radial extent"
    )]
    SectionOffParent { x_mm: f64, y_mm: f64 },
    /// In the parent's frame, the aperture misses the section.
    #[error(
        "the aperture does not contain the section's centre ({x_mm} mm, {y_mm} mm); with `frame = \"parent\"` the \
         aperture is in the parent's frame: write `centre_mm = [{x_mm}, {y_mm}]`, or choose the frame \"shifted\" or \
         \"tilted\""
    )]
    SectionOutsideAperture { x_mm: f64, y_mm: f64 },
    /// The outline is none.
    #[error("in [aperture]: {0}")]
    Aperture(#[from] ApertureError),
    /// The aperture reaches beyond the disc on which the polynomials are meant.
    #[error(
        "the aperture reaches {reach_mm} mm from the axis, beyond `surface.normalisation_radius_mm`, which is \
         {limit_mm} mm; the polynomials are not valid there: make the aperture smaller, or fit the coefficients to a \
         larger radius"
    )]
    BeyondNormalisation { reach_mm: f64, limit_mm: f64 },
    /// The formula has no value somewhere in the aperture.
    #[error(
        "the surface is not defined, or is infinitely steep, at ({x_mm} mm, {y_mm} mm) in the aperture; make the aperture \
         smaller, or check the radii and conic constants"
    )]
    NotDefined { x_mm: f64, y_mm: f64 },
    /// Both ways of choosing the spacing are given, or none.
    #[error("[sampling] requires either `spacing_mm` or `accuracy_nm`, and has {count} of them; keep one")]
    Sampling { count: usize },
    /// The sampling would be too large.
    #[error(
        "a spacing of {spacing_mm} mm makes {nodes:.3e} nodes; at most {limit:.0e} are allowed: choose a coarser spacing, or \
         a less strict `accuracy_nm`"
    )]
    TooManyNodes { spacing_mm: f64, nodes: f64, limit: f64 },
    /// The sampling would take too long.
    #[error(
        "{nodes:.3e} nodes of a formula and an outline of {terms} terms are {work:.1e} steps; at most {limit:.0e} are \
         allowed: choose a coarser spacing, fewer terms or fewer corners"
    )]
    TooMuchWork { nodes: f64, terms: usize, work: f64, limit: f64 },
    /// No spacing is fine enough; reached is twice the largest error found at the finest spacing tried.
    #[error(
        "the accuracy of {accuracy_nm} nm cannot be reached: at a spacing of {spacing_mm} mm the error is still \
         {reached_nm} nm; raise `accuracy_nm`, or keep the aperture away from places where the surface becomes \
         infinitely steep or has a kink"
    )]
    AccuracyOutOfReach { accuracy_nm: f64, reached_nm: f64, spacing_mm: f64 },
}

impl DefinitionError {
    /// A number outside its limits.
    pub(super) fn out_of_range(key: &str, value: f64, limit: &'static str, remedy: &'static str) -> Self {
        Self::OutOfRange { key: key.to_owned(), value, limit, remedy }
    }

    /// Puts the name of the enclosing table before the key.
    pub(super) fn in_table(mut self, table: &str) -> Self {
        match &mut self {
            Self::OutOfRange { key, .. }
            | Self::Term { key, .. }
            | Self::RepeatedTerm { key }
            | Self::NestedSection { key } => *key = format!("{table}.{key}"),
            _ => {}
        }
        self
    }

    /// Returns the path of the key the error is about, such as `surface.radius_mm`; none for text that is no TOML.
    pub fn key(&self) -> Option<String> {
        match self {
            Self::OutOfRange { key, .. }
            | Self::Term { key, .. }
            | Self::RepeatedTerm { key }
            | Self::NestedSection { key } => Some(key.clone()),
            Self::Aperture(error) => Some(format!("aperture.{}", error.key())),
            Self::Located { source, .. } => source.key(),
            Self::SectionOffParent { .. } => Some("surface.distance_mm".to_owned()),
            Self::BeyondNormalisation { .. } => Some("surface.normalisation_radius_mm".to_owned()),
            Self::SectionOutsideAperture { .. } | Self::NotDefined { .. } => Some("aperture".to_owned()),
            Self::Sampling { .. } => Some("sampling".to_owned()),
            Self::TooManyNodes { .. } | Self::TooMuchWork { .. } | Self::AccuracyOutOfReach { .. } => {
                Some("sampling".to_owned())
            }
            Self::Toml { .. } => None,
        }
    }
}

/// Checks a number that must be finite.
pub(super) fn check_finite(key: &str, value: f64) -> Result<f64, DefinitionError> {
    if value.is_finite() {
        return Ok(value);
    }
    Err(DefinitionError::out_of_range(key, value, "a finite number", "write a number, or remove the key"))
}

/// Checks a radius of curvature, which may be infinite, and returns its curvature.
pub(super) fn checked_curvature(key: &str, radius_mm: f64) -> Result<f64, DefinitionError> {
    if radius_mm.abs() >= 1e-6 {
        return Ok(1.0 / radius_mm);
    }
    let limit = "at least 1e-6 mm in magnitude, positive with the centre of curvature at +z";
    Err(DefinitionError::out_of_range(key, radius_mm, limit, "for no curvature write inf"))
}

/// Checks a length that must be positive.
pub(super) fn check_positive(key: &str, length_mm: f64) -> Result<f64, DefinitionError> {
    if length_mm > 0.0 && length_mm <= 1e6 {
        return Ok(length_mm);
    }
    Err(DefinitionError::out_of_range(key, length_mm, "greater than 0 and at most 1e6 mm", "write it in mm"))
}
