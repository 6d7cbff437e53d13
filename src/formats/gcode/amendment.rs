//! Correction of a base program: what it consists of.

use regrind_core::compensation::path::{HeightField, TargetSurface, ball_displacement};
use regrind_core::geometry::{Point, Vector};

use super::dialect::Dialect;
use super::map::ProgramMap;
use super::read::Refusal;

/// Settings for the correction of a program.
#[derive(Debug)]
pub struct Amendment<'a> {
    /// Displacement of the surface along its normal over x and y in the program's frame, in millimetres; positive away
    /// from the part.
    pub shift: &'a HeightField,
    /// Nominal surface, for a ball that grinds it; `None` to move the program's points along z.
    pub along_normals: Option<AlongNormals<'a>>,
    /// Maximum distance between the new program and the corrected path, in millimetres.
    pub tolerance_mm: f64,
    /// Map from which the shift was computed.
    pub map: &'a ProgramMap,
    /// Factor by which the map was multiplied.
    pub gain: f64,
    /// Form of the program; `None` for that of LinuxCNC.
    pub dialect: Option<&'a Dialect>,
    /// Maximum displacement of a point, in millimetres; a larger one is rejected.
    pub max_shift_mm: f64,
}

/// Returns the displacement, in millimetres, that the map gives to `at`, a position in the base program. Without a
/// nominal surface in `amendment`, the displacement is along z. Otherwise it moves the centre of the grinding ball so
/// that the ground surface shifts along its normals.
///
/// # Errors
/// A position with no nominal surface under it.
pub(super) fn displacement(amendment: &Amendment, at: &Point) -> Result<Vector, Refusal> {
    let shift = amendment.shift;
    let Some(along) = &amendment.along_normals else { return Ok(Vector::z() * shift.at([at.x, at.y]).value) };
    let centre = at + Vector::z() * along.centre_above_mm;
    ball_displacement(along.nominal, shift, &centre).ok_or_else(|| {
        let found = format!("no place of the nominal surface is under x {:.3}, y {:.3}, z {:.3} mm", at.x, at.y, at.z);
        let remedy = "above a concave part, begin the move at feed closer to the part, because its normals cross high \
                      above it (approach by G0); otherwise check that the program is in the frame of the \
                      nominal surface, and that its programmed point is the stated one";
        (found, remedy)
    })
}

/// The nominal surface under a program, for corrections along its normals.
#[derive(Clone, Copy, Debug)]
pub struct AlongNormals<'a> {
    /// The nominal surface, without a correction.
    pub nominal: &'a TargetSurface,
    /// Height of the ball's centre above the program's point: 0 if the program moves the centre, the radius if it moves
    /// the tip.
    pub centre_above_mm: f64,
}
