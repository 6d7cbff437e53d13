//! Errors of the definition and the sampling of a surface.

use thiserror::Error;

use crate::geometry::ApertureError;

/// Reason why a nominal surface given by a formula cannot be defined or sampled.
///
/// A key is written as the path in the definition, such as `surface.radius_mm`; lines and columns count from 1.
#[derive(Clone, Debug, Error, PartialEq)]
#[allow(missing_docs)]
#[non_exhaustive]
pub enum DefinitionError {
    /// The text is not TOML, or a key is missing, unknown or of the wrong type.
    #[error("line {line}, column {column}: {message}")]
    Toml { line: usize, column: usize, message: String },
    /// Error about a value, with the place of the value in the text.
    #[error("line {line}, column {column}: {source}")]
    Located { line: usize, column: usize, source: Box<DefinitionError> },
    /// A number is outside its range. The value and the limit are in the unit at the end of the key.
    #[error("`{key}` is {value}; it must be {limit}; {remedy}")]
    OutOfRange { key: String, value: f64, limit: &'static str, remedy: &'static str },
    /// The key of a coefficient is not a power or index of this formula.
    #[error("`{key}` is not a term of this formula; {expected}")]
    Term { key: String, expected: &'static str },
    /// Two coefficients are given for one term.
    #[error("`{key}` is given twice; write the sum of the two coefficients once, or remove one coefficient")]
    RepeatedTerm { key: String },
    /// A section is cut from another section.
    #[error(
        "`{key}` is an off-axis section, but the parent of a section must be a whole surface; give the whole surface \
         as the parent, with one distance and one azimuth"
    )]
    NestedSection { key: String },
    /// The formula is not defined, or infinitely steep, at the centre of an off-axis section, in the parent's frame.
    #[error(
        "the parent surface is not defined at the section's centre ({x_mm} mm, {y_mm} mm); `surface.distance_mm` must be \
         less than the parent's radial extent"
    )]
    SectionOffParent { x_mm: f64, y_mm: f64 },
    /// The aperture does not contain the centre of the section, in the parent's frame.
    #[error(
        "the aperture does not contain the section's centre ({x_mm} mm, {y_mm} mm); with `frame = \"parent\"` the \
         aperture is in the parent's frame: write `centre_mm = [{x_mm}, {y_mm}]`, or choose the frame \"shifted\" or \
         \"tilted\""
    )]
    SectionOutsideAperture { x_mm: f64, y_mm: f64 },
    /// The outline of the aperture is not valid.
    #[error("in [aperture]: {0}")]
    Aperture(#[from] ApertureError),
    /// The aperture extends beyond the disc on which the polynomials are defined.
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
    /// Both keys that choose the spacing are given, or neither.
    #[error("[sampling] has {count} of the keys `spacing_mm` and `accuracy_nm`; give exactly one of them")]
    Sampling { count: usize },
    /// The sampling would have too many nodes.
    #[error(
        "a spacing of {spacing_mm} mm makes {nodes:.3e} nodes; at most {limit:.0e} are allowed: choose a coarser spacing, or \
         a less strict `accuracy_nm`"
    )]
    TooManyNodes { spacing_mm: f64, nodes: f64, limit: f64 },
    /// The sampling would take too long.
    #[error(
        "{nodes:.3e} nodes with {terms} terms of formula and outline need {work:.1e} steps; at most {limit:.0e} are \
         allowed: choose a coarser spacing, fewer terms or fewer corners"
    )]
    TooMuchWork { nodes: f64, terms: usize, work: f64, limit: f64 },
    /// No spacing gives the accuracy. `reached_nm` is twice the largest error found at the smallest spacing that was
    /// tried.
    #[error(
        "the accuracy of {accuracy_nm} nm cannot be reached: at a spacing of {spacing_mm} mm the error is still \
         {reached_nm} nm; raise `accuracy_nm`, or keep the aperture away from places where the surface becomes \
         infinitely steep or has a kink"
    )]
    AccuracyOutOfReach { accuracy_nm: f64, reached_nm: f64, spacing_mm: f64 },
}

impl DefinitionError {
    /// Creates the error for a value outside its range. `key` is the path of the key in the definition file. `limit` is
    /// a text with the valid range, and `remedy` is a text that says what to do.
    pub(super) fn out_of_range(key: &str, value: f64, limit: &'static str, remedy: &'static str) -> Self {
        Self::OutOfRange { key: key.to_owned(), value, limit, remedy }
    }

    /// Puts `table`, the name of the enclosing table, and a dot before the key of the error, so that `radius_mm`
    /// becomes `surface.radius_mm`. Returns errors that store no key unchanged.
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

    /// Returns the path of the key that the error is about, such as `surface.radius_mm`; `None` for an error about the
    /// TOML text itself.
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

/// Returns `value` unchanged if it is finite. `key` is the name of the key in the definition file.
///
/// # Errors
/// Returns an error that names `key` if the value is infinite or NaN.
pub(super) fn check_finite(key: &str, value: f64) -> Result<f64, DefinitionError> {
    if value.is_finite() {
        return Ok(value);
    }
    Err(DefinitionError::out_of_range(key, value, "a finite number", "write a number, or remove the key"))
}

/// Returns the curvature in 1/mm for the radius of curvature `radius_mm`. An infinite radius gives the curvature 0.
/// `key` is the name of the key in the definition file.
///
/// # Errors
/// Returns an error that names `key` if the radius is NaN or less than 1e-6 mm in magnitude.
pub(super) fn checked_curvature(key: &str, radius_mm: f64) -> Result<f64, DefinitionError> {
    if radius_mm.abs() >= 1e-6 {
        return Ok(1.0 / radius_mm);
    }
    let limit = "at least 1e-6 mm in magnitude, positive with the centre of curvature at +z";
    Err(DefinitionError::out_of_range(key, radius_mm, limit, "for no curvature write inf"))
}

/// Returns `length_mm` unchanged if it is positive and at most 1e6 mm. `key` is the name of the key in the definition
/// file.
///
/// # Errors
/// Returns an error that names `key` for any other length, and for NaN.
pub(super) fn check_positive(key: &str, length_mm: f64) -> Result<f64, DefinitionError> {
    if length_mm > 0.0 && length_mm <= 1e6 {
        return Ok(length_mm);
    }
    Err(DefinitionError::out_of_range(key, length_mm, "greater than 0 and at most 1e6 mm", "write it in mm"))
}
