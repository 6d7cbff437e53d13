//! Clouds that are hardly wider than a line: a scan line, or a few rows.
//!
//! A line of points fits a curved surface in poses that are centimetres apart. The residual noise makes each of them
//! look exact, because a turn of the part about the line moves no point far. So a narrow cloud is refused, unless the
//! directions that it does not determine are locked: the rotation about the line, and the shift across it.
//!
//! There are two tests. Before the search for a pose: do the points follow each other like beads on a thread? After the
//! fit: how wide is the strip of contacts along the surface, in distances from point to point?

use nalgebra::{Matrix3, SymmetricEigen};
use regrind_figures::statistics::median;

use super::deviation::{Deviation, PointStatus};
use super::error::RegistrationError;
use super::options::{Coordinate, RegistrationOptions, Start};
use crate::geometry::{Point, Pose, Vector};

/// Minimum width of a cloud, in distances from point to point. A narrower cloud does not determine the pose across the
/// line.
const MIN_WIDTH_SPACINGS: f64 = 2.5;
/// Maximum ratio of the length of the path from point to point to the extent of the points, for points on a thread.
const MAX_PATH_RATIO: f64 = 2.0;
/// Maximum number of points that are examined.
const MAX_EXAMINED: usize = 600;
/// Width, as a share of the length, above which a cloud is not narrow, however few points it has.
const MIN_WIDE_RATIO: f64 = 0.2;

/// Rejects points that follow each other along one line, straight or bent. The check runs before any pose is tried.
///
/// A line does not determine two coordinates of the pose: the rotation about the line, and the shift across it. Such
/// points are accepted if `options` lock both coordinates.
///
/// # Errors
/// Returns [`RegistrationError::Narrow`] if the points follow a line and at least one of the two coordinates is not
/// locked.
pub(super) fn check_scan_line(measured: &[Point], options: &RegistrationOptions) -> Result<(), RegistrationError> {
    let few: Vec<Point> = measured.iter().step_by(measured.len().div_ceil(MAX_EXAMINED)).copied().collect();
    let Some(_) = ScanLine::detect(few) else { return Ok(()) };
    let Some(thread) = ScanLine::detect(measured.to_vec()) else { return Ok(()) };
    let model_from_cmm = match &options.start {
        Start::Pose(pose) => pose.inverse(),
        Start::Search => Pose::identity(),
    };
    let needed = undetermined_coordinates(model_from_cmm.transform_direction(&thread.axis), Vector::z());
    if are_locked(&needed, options) { Ok(()) } else { Err(narrow_error(thread.width_mm, thread.distance_mm, needed)) }
}

/// Points that follow each other along a line, straight or bent.
struct ScanLine {
    axis: Vector,
    width_mm: f64,
    distance_mm: f64,
}

impl ScanLine {
    /// Returns the line, straight or bent, along which the points follow each other: its direction, its width, and the
    /// mean distance from point to point in mm. Returns `None` if the points spread over an area, or if there are no
    /// points.
    ///
    /// The points are sorted along their longest principal axis, and joined to a path in this order. The points spread
    /// over an area in two cases:
    ///
    /// - The path is more than twice as long as the extent of the points along the axis, because it goes to and fro.
    /// - The width exceeds a fifth of this extent. The width is twice the median distance of a point from the straight
    ///   line through the points before and after it.
    fn detect(mut points: Vec<Point>) -> Option<Self> {
        let (middle, axes) = centroid_and_axes(points.iter().copied());
        let axis: Vector = axes.column(2).into();
        let at = |p: &Point| (p - middle).dot(&axis);
        points.sort_by(|a, b| at(a).total_cmp(&at(b)));
        let extent_mm = at(points.last()?) - at(points.first()?);
        let path_mm: f64 = points.windows(2).map(|two| (two[1] - two[0]).norm()).sum();
        if path_mm > MAX_PATH_RATIO * extent_mm {
            return None;
        }
        let beside = points.windows(3).map(|beads| {
            let chord = beads[2] - beads[0];
            chord.cross(&(beads[1] - beads[0])).norm() / chord.norm().max(f64::MIN_POSITIVE)
        });
        let width_mm = 2.0 * median(&mut beside.collect::<Vec<_>>()).unwrap_or(0.0);
        let distance_mm = path_mm / (points.len() - 1) as f64;
        (width_mm <= MIN_WIDE_RATIO * extent_mm).then_some(Self { axis, width_mm, distance_mm })
    }
}

/// Rejects a fit whose inliers form a narrow strip on the surface. A strip is narrow if it is less than 2.5 times as
/// wide as the distance between neighbouring points, and at most a fifth as wide as long. It is accepted if `options`
/// lock two coordinates of the pose: the rotation about the strip, and the shift across it.
///
/// # Errors
/// Returns [`RegistrationError::Narrow`] if the strip is narrow and at least one of the two coordinates is not locked.
pub(super) fn check_strip(deviations: &[Deviation], options: &RegistrationOptions) -> Result<(), RegistrationError> {
    let used = || deviations.iter().filter(|d| d.status == PointStatus::Inlier);
    let normal = used().map(|d| d.normal).sum::<Vector>();
    if normal.norm() == 0.0 {
        return Ok(());
    }
    let normal = normal.normalize();
    let flat = |d: &Deviation| d.point - normal * d.point.coords.dot(&normal);
    let (middle, axes) = centroid_and_axes(used().map(flat));
    let [across, along]: [Vector; 2] = [1, 2].map(|k| axes.column(k).into());
    let extent = |axis: &Vector| {
        // Extent of an evenly filled strip: sqrt(12) times its standard deviation.
        let (sum, n) = used().fold((0.0, 0.0), |(sum, n), d| (sum + (flat(d) - middle).dot(axis).powi(2), n + 1.0));
        (12.0 * sum / n).sqrt()
    };
    let (width_mm, length_mm) = (extent(&across), extent(&along));
    if width_mm > MIN_WIDE_RATIO * length_mm {
        return Ok(());
    }
    let contacts: Vec<Point> = used().map(|d| d.point).collect();
    let mut nearest: Vec<f64> = (0..contacts.len())
        .step_by(contacts.len().div_ceil(MAX_EXAMINED))
        .map(|k| {
            let others = contacts.iter().enumerate().filter(|(other, _)| *other != k);
            others.map(|(_, p)| (p - contacts[k]).norm_squared()).fold(f64::INFINITY, f64::min).sqrt()
        })
        .collect();
    // Rows can be nearer to each other than the points in a row.
    let distance_mm = median(&mut nearest).unwrap_or(0.0).max((width_mm * length_mm / contacts.len() as f64).sqrt());
    let needed = undetermined_coordinates(along, normal);
    if width_mm < MIN_WIDTH_SPACINGS * distance_mm && !are_locked(&needed, options) {
        return Err(narrow_error(width_mm, distance_mm, needed));
    }
    Ok(())
}

/// Returns the two coordinates of the pose that points along a line do not determine. The first is the shift along the
/// axis nearest to `normal` x `line`, the second is the rotation about the axis nearest to `line`. Both arguments are
/// unit vectors in the model frame: the direction of the line, and the normal of the surface.
fn undetermined_coordinates(line: Vector, normal: Vector) -> [Coordinate; 2] {
    const SHIFTS: [Coordinate; 3] = [Coordinate::X, Coordinate::Y, Coordinate::Z];
    const ROTATIONS: [Coordinate; 3] = [Coordinate::Rx, Coordinate::Ry, Coordinate::Rz];
    [SHIFTS[normal.cross(&line).iamax()], ROTATIONS[line.iamax()]]
}

/// Returns true if `options` lock both coordinates of `needed`.
fn are_locked(needed: &[Coordinate; 2], options: &RegistrationOptions) -> bool {
    let held = Coordinate::locked_flags(needed);
    held.iter().zip(&options.locked).all(|(needed, locked)| !needed || *locked)
}

/// Returns the error for a cloud that is only `width_mm` wide, with `distance_mm` from point to point. `hold` are the
/// two coordinates that must be locked to accept it.
fn narrow_error(width_mm: f64, distance_mm: f64, hold: [Coordinate; 2]) -> RegistrationError {
    RegistrationError::Narrow { width_mm, distance_mm, min_width_mm: MIN_WIDTH_SPACINGS * distance_mm, to_lock: hold }
}

/// Returns the centroid of the points, and their principal axes from the shortest to the longest, one per column.
fn centroid_and_axes(points: impl Iterator<Item = Point> + Clone) -> (Point, Matrix3<f64>) {
    let n = points.clone().count().max(1) as f64;
    let middle = Point::from(points.clone().map(|p| p.coords).sum::<Vector>() / n);
    let spread = points.map(|p| (p - middle) * (p - middle).transpose()).sum::<Matrix3<f64>>();
    let SymmetricEigen { eigenvalues, eigenvectors } = spread.symmetric_eigen();
    let mut order = [0, 1, 2];
    order.sort_by(|a, b| eigenvalues[*a].total_cmp(&eigenvalues[*b]));
    (middle, Matrix3::from_columns(&order.map(|k| eigenvectors.column(k).into_owned())))
}
