//! Columns of the fit: effects on the deviations of a unit of each parameter, of each motion and of the machine's
//! slides.

use super::kinds::{ParameterKind, SurfacePoint, WheelTerm};
use crate::geometry::bounds;

/// Minimum share of a column that is orthogonal to the columns before it. A column with a smaller share counts as a
/// combination of them and is left out.
const MIN_INDEPENDENT_SHARE: f64 = 1e-7;

/// Effect of one unit of a parameter, motion or slide at every point.
pub(super) struct Column<K> {
    pub(super) kind: K,
    pub(super) values: Vec<f64>,
}

pub(super) const MOTIONS: [&str; 6] = [
    "a shift of the part along x",
    "a shift of the part along y",
    "a shift of the part along z",
    "a tilt of the part about x",
    "a tilt of the part about y",
    "a turn of the part about z",
];
const SLIDES: [&str; 4] = [
    "a simple bend of a slide along x",
    "an S-shaped bend of a slide along x",
    "a simple bend of a slide along y",
    "an S-shaped bend of a slide along y",
];

/// Extent of the part in x and y: its middle and half its size.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Extent {
    middle_mm: [f64; 2],
    half_mm: [f64; 2],
}

impl Extent {
    /// Returns the extent (bounding box) of the places `[x, y]`.
    pub fn from_places(places_mm: impl Iterator<Item = [f64; 2]>) -> Self {
        let [low, high] = bounds(places_mm);
        let of = |sign: f64| std::array::from_fn(|k| 0.5 * (high[k] + sign * low[k]));
        Self { middle_mm: of(1.0), half_mm: of(-1.0) }
    }

    /// Returns the length of the longer side, along x or along y, in millimetres.
    pub(super) fn size_mm(&self) -> f64 {
        2.0 * self.half_mm[0].max(self.half_mm[1])
    }

    /// Returns the position of a point within the extent along x and along y, scaled so that the borders are -1 and 1.
    fn relative_position(&self, contact: &SurfacePoint) -> [f64; 2] {
        [0, 1].map(|k| (contact.point[k] - self.middle_mm[k]) / self.half_mm[k].max(f64::MIN_POSITIVE))
    }
}

/// Returns the change of the deviation at the point `contact` per unit of a motion of the part. `motion` selects the
/// motion. 0 to 2 are shifts along x, y, z; the result is in mm per mm. 3 to 5 are rotations about x, y, z through the
/// origin of the model frame; the result is in mm per radian.
pub(super) fn motion_effect(contact: &SurfacePoint, motion: usize) -> f64 {
    match motion {
        0..3 => contact.normal[motion],
        _ => contact.point.coords.cross(&contact.normal)[motion - 3],
    }
}

pub(super) fn motions(contacts: &[SurfacePoint], free: [bool; 6]) -> Vec<Column<&'static str>> {
    let of = |k: usize| Column { kind: MOTIONS[k], values: contacts.iter().map(|c| motion_effect(c, k)).collect() };
    (0..6).filter(|&k| free[k]).map(of).collect()
}

/// Returns the effects of bent guideways (slides) of the machine on the deviations at the points `contacts`. There are
/// four columns: a simple and an S-shaped bend, each along x and along y. Each column has one value for each point: the
/// change of the deviation per unit of height of the bend.
///
/// The height of the guideway follows the second (simple) or third (S-shaped) Legendre polynomial of the position.
/// `extent` is the extent of the part; its borders are the positions -1 and 1.
pub(super) fn slides(contacts: &[SurfacePoint], extent: &Extent) -> Vec<Column<&'static str>> {
    let of =
        |k: usize| Column { kind: SLIDES[k], values: contacts.iter().map(|c| slide_effect(c, extent, k)).collect() };
    (0..SLIDES.len()).map(of).collect()
}

pub(super) fn slide_effect(contact: &SurfacePoint, extent: &Extent, k: usize) -> f64 {
    let t = extent.relative_position(contact)[k / 2];
    contact.normal.z * if k.is_multiple_of(2) { 1.5 * t * t - 0.5 } else { 2.5 * t * t * t - 1.5 * t }
}

impl ParameterKind {
    /// Returns the change of the deviation at the point `contact`, in millimetres, per unit of this parameter
    /// (millimetre or radian). `term` selects the formula for the effect of the wheel radius.
    ///
    /// For wear, returns 0, because the effect of wear depends on the progress along the path and not on the place.
    pub(super) fn effect(self, contact: &SurfacePoint, term: WheelTerm) -> f64 {
        let n = contact.normal;
        match self {
            Self::WheelRadius => match term {
                WheelTerm::InHeight => 1.0 - 1.0 / n.z,
                WheelTerm::AlongNormal => n.z - 1.0,
            },
            // p nz = -nx
            Self::SettingX => -n.x,
            Self::SettingY => -n.y,
            Self::SettingZ => n.z,
            Self::TiltX => -motion_effect(contact, 3),
            Self::TiltY => -motion_effect(contact, 4),
            Self::Wear => 0.0,
        }
    }
}

pub(super) fn candidates(
    contacts: &[SurfacePoint],
    progress: Option<&[f64]>,
    term: WheelTerm,
    extent: &Extent,
) -> Vec<Column<ParameterKind>> {
    let along_y = || contacts.iter().map(|c| 0.5 * (1.0 + extent.relative_position(c)[1])).collect();
    let of = |kind: ParameterKind| match kind {
        ParameterKind::Wear => progress.map_or_else(along_y, <[f64]>::to_vec),
        _ => contacts.iter().map(|c| kind.effect(c, term)).collect(),
    };
    ParameterKind::ALL.into_iter().map(|kind| Column { kind, values: of(kind) }).collect()
}

/// Orthonormal columns.
pub(super) struct OrthonormalBasis {
    pub(super) columns: Vec<Vec<f64>>,
}

pub(super) fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(x, y)| x * y).sum()
}

impl OrthonormalBasis {
    /// Builds an orthonormal basis from vectors of the same length (`columns`). The method is Gram-Schmidt, applied
    /// twice for accuracy. A vector that is a linear combination of the vectors before it adds nothing to the basis.
    pub(super) fn new<'a>(columns: impl Iterator<Item = &'a Vec<f64>>) -> Self {
        let mut basis = Self { columns: Vec::new() };
        for column in columns {
            let size = dot(column, column).sqrt();
            let mut own = basis.orthogonal_part(column);
            let left = dot(&own, &own).sqrt();
            if left > MIN_INDEPENDENT_SHARE * size {
                own.iter_mut().for_each(|v| *v /= left);
                basis.columns.push(own);
            }
        }
        basis
    }

    /// Returns `column` minus its projection onto the basis.
    pub(super) fn orthogonal_part(&self, column: &[f64]) -> Vec<f64> {
        let mut own = column.to_vec();
        for _ in 0..2 {
            for unit in &self.columns {
                let share = dot(unit, &own);
                own.iter_mut().zip(unit).for_each(|(v, u)| *v -= share * u);
            }
        }
        own
    }
}
