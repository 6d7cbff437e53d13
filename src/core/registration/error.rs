//! Errors of a registration.

use thiserror::Error;

use super::options::Coordinate;
use crate::surface::SurfaceError;

/// Reason why a registration fails.
#[derive(Clone, Debug, Error, PartialEq)]
#[allow(missing_docs)]
#[non_exhaustive]
pub enum RegistrationError {
    #[error(transparent)]
    Surface(#[from] SurfaceError),
    #[error(
        "the probe radius is {radius_mm} mm; it must be above 0 and below {limit_mm:.3} mm, half the size of the \
         part; for contact points (radius 0) register with the method `contact`"
    )]
    ProbeRadius { radius_mm: f64, limit_mm: f64 },
    #[error(
        "there are {points} measured points; at least {min_points} are required, one more than the pose has free \
         directions; measure more, or lock the directions that the fixture holds"
    )]
    TooFewPoints { points: usize, min_points: usize },
    #[error(
        "the measured points lie on or near one line: {width_mm:.3} mm wide, with {distance_mm:.3} mm from point to \
         point; they do not determine the rotation of the part about that line, nor its position across it; measure \
         a strip at least {min_width_mm:.3} mm wide, or give a start pose and lock {} and {}",
        to_lock[0].name(), to_lock[1].name()
    )]
    Narrow { width_mm: f64, distance_mm: f64, min_width_mm: f64, to_lock: [Coordinate; 2] },
    #[error("measured point {} has a coordinate that is not a finite number; remove or correct the point", index + 1)]
    NotFinite { index: usize },
    #[error(
        "measured point {} at ({:.6}, {:.6}, {:.6}) mm lies {distance_mm:.6} mm from the middle of the others, too \
         far to lie on the part; remove it or correct it", index + 1, at[0], at[1], at[2]
    )]
    FarOff { index: usize, at: [f64; 3], distance_mm: f64 },
    #[error(
        "the nominal point at ({:.6}, {:.6}, {:.6}) mm lies {distance_mm:.6} mm from the middle of the other points, \
         too far to belong to the part; remove or correct this point",
        at[0], at[1], at[2]
    )]
    NominalFarOff { at: [f64; 3], distance_mm: f64 },
    #[error("all {points} measured points lie on one line; measure points off the line")]
    Collinear { points: usize },
    #[error(
        "{doubled} of {points} examined points repeat another point exactly, limit 1 %; check whether a file was \
         joined to itself, and remove the repeats"
    )]
    Repeated { doubled: usize, points: usize },
    #[error(
        "the measured cloud is {ratio:.4} times the size of the nominal surface ({measured_mm:.4} mm against {nominal_mm:.4} \
         mm); {remedy}"
    )]
    Size { ratio: f64, measured_mm: f64, nominal_mm: f64, remedy: &'static str },
    #[error(
        "only {used} of {points} measured points lie on the part; check that the cloud belongs to the part, and \
         check the start pose"
    )]
    TooFewUsed { used: usize, points: usize },
    #[error(
        "the fit does not converge within {iterations} iterations; its sum of squared distances is still \
         {objective_mm2:.3e} mm^2; check that the cloud belongs to the part, and give a start pose"
    )]
    NotConverged { iterations: usize, objective_mm2: f64 },
    #[error("the measured points do not fit the nominal surface: rms {rms_mm:.4} mm, limit {limit_mm:.4} mm; {remedy}")]
    DoesNotFit { rms_mm: f64, limit_mm: f64, remedy: String },
    #[error(
        "the measured cloud is a mirror image of the part: as measured it fits to {rms_mm:.4} mm rms, mirrored to \
         {mirrored_rms_mm:.4} mm; one axis of the CMM file is reversed: correct it"
    )]
    Mirrored { rms_mm: f64, mirrored_rms_mm: f64 },
    #[error(
        "the probe lies on the other side of the nominal surface: rms {other_rms_mm:.4} mm there, {rms_mm:.4} mm on \
         the given side; reverse the normals, or give the other side"
    )]
    WrongSide { rms_mm: f64, other_rms_mm: f64 },
    #[error(
        "the points and the surface determine no free direction of the pose; give a start pose, \
         measure more of the surface, or unlock a direction"
    )]
    Undetermined,
}
