//! Uncertainty of the pose, its weak directions, and the uncertainty of each deviation.

use std::collections::HashMap;

use nalgebra::{DMatrix, Matrix6, Vector6};
use rayon::prelude::*;

use crate::geometry::{Point, Pose, Vector};
use crate::surface::Nominal;
use crate::surface::simd::{F64x4, LANES, Real};

use super::correspond::{Correspondence, FinalProjectionX4, ProjectionReporter};
use super::deviation::{Deviation, PointStatus};
use super::iterate::{Descent, Problem, free_projector};
use super::linearize::Scaling;
use super::options::{Method, RegistrationOptions};
use super::part::Part;
use super::solve::Spectrum;
use super::start::InitialPose;

/// Quality of a registration: figures, uncertainty of the pose, and warnings.
#[derive(Clone, Debug)]
pub struct RegistrationQuality {
    /// Number of points used: the inliers.
    pub inliers: usize,
    /// Sum of the squared deviations of the points used, in mm^2; eq. (7).
    pub objective_mm2: f64,
    /// Root mean square of the deviations of the points used, in millimetres.
    pub rms_mm: f64,
    /// Largest minus smallest deviation of the points used, in millimetres.
    pub pv_mm: f64,
    /// Standard deviation of the residuals in millimetres, corrected for the degrees of freedom.
    pub residual_sigma_mm: f64,
    /// Covariance of the pose: of the twist [v; omega] in the model frame that, applied to the true pose from the
    /// right, gives the estimated pose. Units: mm^2, mm rad, rad^2. Directions that are undetermined or locked have no
    /// variance here.
    ///
    /// Equation: s^2 (A^T A)^-1 with s^2 the residual variance (GUM, F.1; Golub and Van Loan, 5.5).
    pub covariance: Matrix6<f64>,
    /// Largest singular value of A divided by the smallest of the determined directions, with lengths in units of the
    /// cloud's rms size; 1 if no direction is determined.
    pub condition: f64,
    /// Directions that the surface does not determine, and directions with a larger uncertainty than a single point.
    pub weak_directions: Vec<WeakDirection>,
    /// Share of the nominal surface that is covered by inliers, from 0 to 1.
    pub coverage: f64,
    /// Other poses that fit about as well, each with its rms in millimetres over a sample of some hundred points.
    pub alternatives: Vec<(Pose, f64)>,
    /// Warnings that a person must read before trusting the pose; empty if there are none.
    pub warnings: Vec<String>,
    /// Number of steps of the iteration, including those that were undone.
    pub iterations: usize,
    /// True if the last descent converged. A registration that does not converge is an error.
    pub converged: bool,
}

/// Direction in which the pose is poorly determined.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct WeakDirection {
    /// Description, for example "x and y position repeats only to 3.4 mm".
    #[serde(rename = "words")]
    pub description: String,
    /// True if the surface does not determine the direction at all. The pose then stays at its start value in this
    /// direction.
    #[serde(rename = "held")]
    pub is_undetermined: bool,
    /// Standard uncertainty of a shift, or of the rim under a rotation, in millimetres; `None` if the direction is
    /// undetermined.
    pub sigma_mm: Option<f64>,
}

/// Returns the quality of the pose in `descent`, the result of the last minimisation: figures, covariance, weak
/// directions, other poses and warnings. `correspondences` contains the distance of each point. `initial` contains the
/// result of the search for the start pose. `iterations` is the number of steps, including steps that were undone.
///
/// Sets the coverage to 0. The caller computes the coverage later.
pub(crate) fn assess_quality(
    problem: &Problem,
    descent: &Descent,
    correspondences: &[Correspondence],
    initial: &InitialPose,
    iterations: usize,
) -> RegistrationQuality {
    let DistanceSummary { used: n, squares_mm2: objective_mm2, low_mm, high_mm } =
        DistanceSummary::summarize(correspondences);
    let free = free_projector(&problem.locked, &descent.scaling);
    let spectrum = Spectrum::new(&(free * descent.sums.gram() * free));
    let rank = descent.rank;
    // The weights of a robust loss exclude the contribution of outliers.
    let residual2 = descent.sums.objective_mm2 / n.saturating_sub(rank).max(1) as f64;
    let scaled = scaled_covariance(&spectrum, rank, residual2);
    let to_twist = descent.scaling.to_twist();
    let locked = problem.locked.iter().filter(|l| **l).count();
    let held = spectrum.directions.columns(rank, 6 - rank).into_owned();
    let mut weak_directions =
        undetermined_directions(&(free * held), 6 - rank - locked.min(6 - rank), &descent.scaling);
    weak_directions.extend(uncertain_directions(
        &scaled,
        residual2.sqrt(),
        &descent.scaling,
        !weak_directions.is_empty(),
    ));
    // If a direction is undetermined, the surface fits in any pose along it. That is reported already.
    let all_seen = rank + locked >= 6;
    let alternatives: Vec<(Pose, f64)> =
        initial.alternatives.iter().filter(|_| all_seen).map(|c| (c.cmm_from_model, c.rms_mm)).collect();
    RegistrationQuality {
        inliers: n,
        objective_mm2,
        rms_mm: (objective_mm2 / n as f64).sqrt(),
        pv_mm: high_mm - low_mm,
        residual_sigma_mm: residual2.sqrt(),
        covariance: without_locked(to_twist * scaled * to_twist.transpose(), &problem.locked),
        condition: rank.checked_sub(1).map_or(1.0, |last| (spectrum.squares[0] / spectrum.squares[last]).sqrt()),
        weak_directions,
        coverage: 0.0,
        warnings: warnings(problem, initial, &alternatives, (objective_mm2 / n as f64).sqrt()),
        alternatives,
        iterations,
        converged: descent.converged,
    }
}

/// Sums and extremes of the distances of the points used.
#[derive(Clone, Copy)]
struct DistanceSummary {
    used: usize,
    squares_mm2: f64,
    low_mm: f64,
    high_mm: f64,
}

impl DistanceSummary {
    const NONE: Self = Self { used: 0, squares_mm2: 0.0, low_mm: f64::INFINITY, high_mm: f64::NEG_INFINITY };

    /// Returns the number, the sum of squares (mm^2), the minimum and the maximum (mm) of the distances of the points
    /// in the fit. If no point is in the fit, the minimum is +infinity and the maximum is -infinity.
    fn summarize(correspondences: &[Correspondence]) -> Self {
        let add = |sum: Self, d: f64| Self {
            used: sum.used + 1,
            squares_mm2: sum.squares_mm2 + d * d,
            low_mm: sum.low_mm.min(d),
            high_mm: sum.high_mm.max(d),
        };
        let part = |c: &[Correspondence]| c.iter().filter(|t| t.in_fit).map(|t| t.distance_mm).fold(Self::NONE, add);
        // Chunks are added in order, so the bits are the same on any number of threads.
        let parts: Vec<Self> = correspondences.par_chunks(1 << 14).map(part).collect();
        parts.iter().fold(Self::NONE, |a, b| Self {
            used: a.used + b.used,
            squares_mm2: a.squares_mm2 + b.squares_mm2,
            low_mm: a.low_mm.min(b.low_mm),
            high_mm: a.high_mm.max(b.high_mm),
        })
    }
}

/// Returns warnings, one text each, about doubts that the numbers of the quality do not show. It warns in three cases:
/// the side of the probe is assumed; `alternatives`, other poses that fit about as well, is not empty; or `rms_mm`
/// exceeds half of the relief (rms distance of the nominal points from their best-fit plane).
fn warnings(problem: &Problem, initial: &InitialPose, alternatives: &[(Pose, f64)], rms_mm: f64) -> Vec<String> {
    let mut warnings = Vec::new();
    if !initial.side_known {
        warnings.push(
            "the shape does not determine the side of the probe; the side of the normals is assumed: set `side`"
                .to_string(),
        );
    }
    if !alternatives.is_empty() {
        warnings.push(format!(
            "{} other {} as well: the part is symmetric, or too little of it was measured; give a start pose",
            alternatives.len(),
            if alternatives.len() == 1 { "pose fits about" } else { "poses fit about" },
        ));
    }
    let relief_mm = problem.surface.nominal().relief_mm();
    if rms_mm > 0.5 * relief_mm {
        warnings.push(format!(
            "the deviations, {} rms, exceed half of the distances of the part from a plane, {} rms: the shape does not \
             confirm the pose; check it against the fixture",
            format_length(rms_mm),
            format_length(relief_mm),
        ));
    }
    warnings
}

/// Returns the covariance with 0 in the rows and columns of the locked coordinates, where rounding leaves more.
fn without_locked(mut covariance: Matrix6<f64>, locked: &[bool; 6]) -> Matrix6<f64> {
    for k in (0..6).filter(|k| locked[*k]) {
        covariance.row_mut(k).fill(0.0);
        covariance.column_mut(k).fill(0.0);
    }
    covariance
}

/// Returns the covariance of the pose, `variance` (A^T A)^-1, in scaled coordinates (translation in units of the rms
/// size of the points, rotation about their centroid in radians). A is the Jacobian of the distances, and `variance` is
/// the residual variance in mm^2.
///
/// `spectrum` contains the singular values and directions of A. Includes only the first `rank` directions, which the
/// surface determines.
fn scaled_covariance(spectrum: &Spectrum, rank: usize, variance: f64) -> Matrix6<f64> {
    (0..rank)
        .map(|k| {
            let v = spectrum.directions.column(k);
            v * v.transpose() * (variance / spectrum.squares[k])
        })
        .sum()
}

/// Describes the motions of the part that change no distance: shifts along a direction, and rotations about an axis.
/// Returns an empty list if `count` is 0. Otherwise the list contains:
///
/// - one entry that names the directions of all shifts, if there are shifts;
/// - one entry for each rotation axis, or a single entry if every rotation about one point changes no distance.
///
/// The columns of `basis` are motions in scaled coordinates (translation in units of the rms size of the points,
/// rotation about their centroid in radians). They span a space of `count` dimensions. `scaling` contains the centroid
/// and the rms size.
fn undetermined_directions(basis: &nalgebra::Matrix6xX<f64>, count: usize, scaling: &Scaling) -> Vec<WeakDirection> {
    if count == 0 {
        return Vec::new();
    }
    // The projection removed the locked directions. The rest spans the undetermined ones.
    let svd = DMatrix::from_column_slice(6, basis.ncols(), basis.as_slice()).svd(true, false);
    let span = svd.u.expect("asked for").columns(0, count).into_owned();
    let omega = span.rows(3, 3).into_owned();
    let turn = omega.svd(false, true);
    let v_t = turn.v_t.expect("asked for");
    let combined = |k: usize| -> Vector6<f64> {
        let c = &span * v_t.row(k).transpose();
        Vector6::from_iterator(c.iter().copied())
    };
    let turns = turn.singular_values.iter().filter(|s| **s > 1e-3).count();
    let rotations: Vec<Vector6<f64>> = (0..turns).map(combined).collect();
    // Orthonormal complement for the shifts, because v_t can have fewer rows than the span has columns.
    let shifts = pure_shifts(&span, &rotations);
    let mut words = Vec::new();
    if !shifts.is_empty() {
        let names: Vec<String> = shifts.iter().map(|s| direction_name(&Vector::new(s[0], s[1], s[2]))).collect();
        words.push(format!("shift along {}", names.join(" and along ")));
    }
    if rotations.len() == 3 {
        let c = common_centre(&rotations, scaling);
        words.push(format!("every rotation about ({:.3}, {:.3}, {:.3}) mm", c.x, c.y, c.z));
    } else {
        words.extend(rotations.iter().map(|r| axis_name(r, scaling)));
    }
    words
        .into_iter()
        .map(|w| WeakDirection {
            description: format!("{w}: not determined by the shape; the pose keeps its start value"),
            is_undetermined: true,
            sigma_mm: None,
        })
        .collect()
}

/// Returns an orthonormal basis of the shifts without rotation in the space `span`: all motions in this space that are
/// perpendicular to `rotations`. The columns of `span` and the vectors are motions in scaled coordinates (translation
/// in units of the rms size of the points, rotation about their centroid in radians).
fn pure_shifts(span: &DMatrix<f64>, rotations: &[Vector6<f64>]) -> Vec<Vector6<f64>> {
    let mut basis: Vec<Vector6<f64>> = rotations.to_vec();
    let mut found = Vec::new();
    for column in span.column_iter() {
        let mut rest = Vector6::from_iterator(column.iter().copied());
        for _ in 0..2 {
            for b in &basis {
                rest -= b * b.dot(&rest);
            }
        }
        if rest.norm() > 1e-3 && basis.len() < span.ncols() {
            let unit = rest.normalize();
            basis.push(unit);
            found.push(unit);
        }
    }
    found
}

/// Returns the point in the model frame, in mm, that three `rotations` about independent axes leave fixed. Each
/// rotation is a motion in scaled coordinates (translation in units of the rms size of the points, rotation about their
/// centroid in radians). `scaling` contains the centroid and the rms size. The point is a least-squares solution.
fn common_centre(rotations: &[Vector6<f64>], scaling: &Scaling) -> Point {
    let (mut gram, mut right) = (nalgebra::Matrix3::zeros(), Vector::zeros());
    for r in rotations {
        let (v, omega) = shift_and_rotation(r, scaling);
        // v + omega x q = 0.
        let hat = omega.cross_matrix();
        gram += hat.transpose() * hat;
        right -= hat.transpose() * v;
    }
    scaling.centre + gram.lu().solve(&right).unwrap_or_default()
}

/// Splits the motion `scaled` into the translation of the centroid in mm and the rotation in radians. The first three
/// components of `scaled` are the translation in units of the rms size in `scaling`, the last three the rotation.
fn shift_and_rotation(scaled: &Vector6<f64>, scaling: &Scaling) -> (Vector, Vector) {
    let v: Vector = scaled.fixed_rows::<3>(0) * scaling.size_mm;
    (v, scaled.fixed_rows::<3>(3).into())
}

/// Returns a text that describes the axis of a rotation: its direction, and a point on the axis in mm in the model
/// frame. `rotation` is a motion in scaled coordinates: translation in units of the rms size in `scaling`, and rotation
/// about the centroid in radians.
fn axis_name(rotation: &Vector6<f64>, scaling: &Scaling) -> String {
    let (v, omega) = shift_and_rotation(rotation, scaling);
    let through = scaling.centre + omega.cross(&v) / omega.norm_squared();
    let name = direction_name(&omega.normalize());
    format!("rotation about {name} through ({:.3}, {:.3}, {:.3}) mm", through.x, through.y, through.z)
}

/// Returns "x", "y" or "z" for a vector along an axis, and otherwise the components of its unit vector. The sign makes
/// the largest component positive.
fn direction_name(v: &Vector) -> String {
    for (k, name) in ["x", "y", "z"].into_iter().enumerate() {
        if v[k].abs() > 0.9999 * v.norm() {
            return name.into();
        }
    }
    let u = v.normalize() * if v[v.iamax()] < 0.0 { -1.0 } else { 1.0 };
    format!("({:.3}, {:.3}, {:.3})", u.x, u.y, u.z)
}

/// Describes the directions of the pose that the points determine poorly: shifts along the axes of the model frame, and
/// rotations about these axes through the centroid of the points.
///
/// The uncertainty of a rotation is given in mm, as the motion of a point at the rim of the part. The rim is taken at
/// the rms size of the points from the centroid. A direction is listed if its standard uncertainty exceeds `sigma_mm`,
/// the standard deviation of one point. Shifts whose uncertainties differ by less than a factor of two share one entry;
/// the same holds for rotations.
///
/// `scaled` is the covariance of the pose in scaled coordinates (translation in units of the rms size of the points,
/// rotation in radians). Returns an empty list if `some_held` is true. This flag means that the surface does not
/// determine some direction at all.
fn uncertain_directions(
    scaled: &Matrix6<f64>,
    sigma_mm: f64,
    scaling: &Scaling,
    some_held: bool,
) -> Vec<WeakDirection> {
    let at_rim: [f64; 6] = std::array::from_fn(|k| scaled[(k, k)].sqrt() * scaling.size_mm);
    let weak = |k: &usize| at_rim[*k] > sigma_mm && !some_held;
    let mut found = Vec::new();
    for (first, kind) in [(0, "shift"), (3, "rotation")] {
        let mut rest: Vec<usize> = (first..first + 3).filter(weak).collect();
        // Those within a factor of two are named together.
        while let Some(&worst) = rest.iter().max_by(|a, b| at_rim[**a].total_cmp(&at_rim[**b])) {
            let (group, others): (Vec<usize>, Vec<usize>) =
                rest.iter().partition(|k| at_rim[**k] * 2.0 > at_rim[worst]);
            let names: Vec<&str> = group.iter().map(|k| ["x", "y", "z"][k % 3]).collect();
            let names = names.join(" and ");
            let words = if kind == "shift" {
                format!("{names} position repeats only to {}", format_length(at_rim[worst]))
            } else {
                let angle = at_rim[worst] / scaling.size_mm;
                format!(
                    "rotation about {names} repeats only to {:.2} mrad, {} at the rim",
                    1e3 * angle,
                    format_length(at_rim[worst])
                )
            };
            found.push(WeakDirection { description: words, is_undetermined: false, sigma_mm: Some(at_rim[worst]) });
            rest = others;
        }
    }
    found
}

/// Formats a length that is given in mm, with two or three digits. The text is in mm from 0.1 mm, and in µm below.
pub(super) fn format_length(mm: f64) -> String {
    match mm {
        l if l >= 10.0 => format!("{l:.0} mm"),
        l if l >= 1.0 => format!("{l:.1} mm"),
        l if l >= 0.1 => format!("{l:.2} mm"),
        l if l >= 0.01 => format!("{:.0} µm", 1e3 * l),
        l if l >= 1e-3 => format!("{:.1} µm", 1e3 * l),
        l => format!("{:.2} µm", 1e3 * l),
    }
}

/// Returns the share of the nominal surface that inliers cover, from 0 to 1. Tests some thousand places spread over the
/// surface. Uses at most 50,000 of the `deviations`.
///
/// - About 6800 inliers or more: divides space into cubes with an edge of a fifteenth of the rms size of the surface. A
///   place is covered if its cube contains an inlier. The cubes are small enough to show a missing corner.
/// - Fewer inliers: a place is covered if the nearest inlier is within a limit. The limit is 1.1 times the point
///   spacing that the same number of inliers would have if they were spread evenly over the surface. So inliers spread
///   evenly over the surface cover all of it. Inliers along a line cover only a strip.
pub(crate) fn coverage(nominal: &Nominal, deviations: &[Deviation]) -> f64 {
    const MAX_POINTS: usize = 50_000;
    // A disc and a rectangle have an area of about 2.5^2 times the square of their rms size.
    const SIDE: f64 = 2.5;
    const WITHIN: f64 = 1.1;
    let size = nominal.size_mm();
    let stride = deviations.len().div_ceil(MAX_POINTS);
    let used: Vec<&Deviation> = deviations.iter().step_by(stride).filter(|d| d.status == PointStatus::Inlier).collect();
    let edge = size / 15.0;
    let within = WITHIN * SIDE * size / (used.len() as f64).sqrt();
    if within > 0.5 * edge {
        return covered_within(within, &nominal.sample(4_000), &used);
    }
    let sample = nominal.sample(20_000);
    let mut cells = CoverageCells::new(&sample, edge);
    for deviation in used {
        cells.mark(&deviation.point);
    }
    sample.iter().filter(|p| cells.is_marked(p)).count() as f64 / sample.len() as f64
}

/// Returns the share of `places`, from 0 to 1, that have a contact point of `used` within the distance `within_mm`.
/// Returns 0 if `places` is empty.
fn covered_within(within_mm: f64, places: &[Point], used: &[&Deviation]) -> f64 {
    let cell = |p: &Point| [p.x, p.y, p.z].map(|c| (c / within_mm).floor() as i64);
    let mut points: HashMap<[i64; 3], Vec<Point>> = HashMap::new();
    for deviation in used {
        points.entry(cell(&deviation.point)).or_default().push(deviation.point);
    }
    let around = |p: &Point| {
        let at = cell(p);
        (0..27).map(move |k: i64| [at[0] + k % 3 - 1, at[1] + k / 3 % 3 - 1, at[2] + k / 9 - 1])
    };
    let near = |p: &&Point| {
        let near = around(p).filter_map(|cell| points.get(&cell)).flatten();
        near.into_iter().any(|other| (other - **p).norm_squared() <= within_mm * within_mm)
    };
    places.iter().filter(near).count() as f64 / places.len().max(1) as f64
}

/// Grid of cubes around some points, with a flag for each cube that contains a used point.
struct CoverageCells {
    low: [i32; 3],
    counts: [usize; 3],
    per_mm: f64,
    marked: Vec<bool>,
}

impl CoverageCells {
    /// Maximum number of cells along an axis. If a point far from all others extends the range further, the last cell
    /// covers the rest.
    const MAX_PER_AXIS: i64 = 256;

    /// Creates a grid of unmarked cubes with the edge `edge_mm` that covers the bounding box of `points`. The grid has
    /// at most 256 cubes along an axis.
    fn new(points: &[Point], edge_mm: f64) -> Self {
        let per_mm = 1.0 / edge_mm;
        let (mut low, mut high) = ([i32::MAX; 3], [i32::MIN; 3]);
        for p in points {
            let at = Self::cell(p, per_mm);
            for c in 0..3 {
                (low[c], high[c]) = (low[c].min(at[c]), high[c].max(at[c]));
            }
        }
        let count = |c: usize| (i64::from(high[c]) - i64::from(low[c]) + 1).clamp(1, Self::MAX_PER_AXIS) as usize;
        let counts = [count(0), count(1), count(2)];
        Self { low, counts, per_mm, marked: vec![false; counts.iter().product()] }
    }

    /// Returns the integer positions along x, y and z of the cube that contains the point `p`, counted from the origin
    /// of the coordinates. `per_mm` is the inverse of the edge of a cube, in 1/mm.
    fn cell(p: &Point, per_mm: f64) -> [i32; 3] {
        [p.x, p.y, p.z].map(|c| (c * per_mm).floor() as i32)
    }

    /// Returns the index of the cube that contains the point `p`, for the list of marks. Returns `None` if `p` lies
    /// outside the grid of cubes.
    ///
    /// There is one exception. The grid has at most 256 cubes along an axis. Along an axis with 256 cubes, a point
    /// beyond the far side of the last cube counts as inside this cube.
    fn index(&self, p: &Point) -> Option<usize> {
        let at = Self::cell(p, self.per_mm);
        let mut index = 0;
        for (c, at) in at.into_iter().enumerate() {
            let k = i64::from(at) - i64::from(self.low[c]);
            // The last cell covers everything beyond it only if the number of cells is at the limit.
            let k = if self.counts[c] == Self::MAX_PER_AXIS as usize { k.min(Self::MAX_PER_AXIS - 1) } else { k };
            if k < 0 || k >= self.counts[c] as i64 {
                return None;
            }
            index = index * self.counts[c] + k as usize;
        }
        Some(index)
    }

    fn mark(&mut self, p: &Point) {
        if let Some(index) = self.index(p) {
            self.marked[index] = true;
        }
    }

    fn is_marked(&self, p: &Point) -> bool {
        self.index(p).is_some_and(|index| self.marked[index])
    }
}

/// Conversion of a projection to a reported deviation.
pub(crate) struct DeviationReporter<'a> {
    nominal: &'a Nominal,
    /// Covariance of the pose in scaled coordinates.
    scaled: Matrix6<f64>,
    variance_mm2: f64,
    subtract_mm: f64,
    contact_offset_mm: f64,
}

impl<'a> DeviationReporter<'a> {
    /// Prepares the conversion of projections to deviations. Takes the covariance of the pose and the residual variance
    /// from `verdict`, the quality of the registration. Takes the nominal surface from `part`, and the distance from
    /// the probe centre to the contact point from `options`. This distance is 0 for contact points, otherwise the probe
    /// radius.
    pub(crate) fn new(
        part: &Part<'a>,
        scaling: &Scaling,
        verdict: &RegistrationQuality,
        options: &RegistrationOptions,
    ) -> Self {
        let to_scaled = scaling.to_twist().try_inverse().unwrap_or_default();
        Self {
            nominal: part.nominal,
            scaled: to_scaled * verdict.covariance * to_scaled.transpose(),
            variance_mm2: verdict.residual_sigma_mm.powi(2),
            subtract_mm: part.subtract_mm,
            contact_offset_mm: if options.method == Method::Contact { 0.0 } else { options.probe_radius_mm },
        }
    }
}

impl ProjectionReporter for DeviationReporter<'_> {
    type Item = Deviation;

    const BLANK: Deviation = Deviation {
        point: Point::new(0.0, 0.0, 0.0),
        normal: Vector::new(0.0, 0.0, 0.0),
        deviation_mm: 0.0,
        uncertainty_mm: 0.0,
        status: PointStatus::Inlier,
        in_fit: true,
    };

    /// Returns the deviations of four points, one per SIMD lane, in mm, each with contact point, normal, standard
    /// uncertainty and status. `at` contains the projections of these points under the final pose, and
    /// `correspondences` tells which of them are in the fit. A contact point outside the outline of the nominal surface
    /// has the status `OffPart`.
    #[inline(always)]
    fn report_x4(&self, correspondences: [&Correspondence; LANES], at: &FinalProjectionX4) -> [Deviation; LANES] {
        let normal = &at.projections.normal;
        let back = F64x4::splat(self.contact_offset_mm);
        let contact =
            [at.centre[0] - normal[0] * back, at.centre[1] - normal[1] * back, at.centre[2] - normal[2] * back];
        let deviation = at.projections.distance_mm - F64x4::splat(self.subtract_mm);
        let mut variance = F64x4::splat(0.0);
        for i in 0..6 {
            let mut along = F64x4::splat(0.0);
            for j in 0..6 {
                along = along + F64x4::splat(self.scaled[(i, j)]) * at.row[j];
            }
            variance = variance + at.row[i] * along;
        }
        let mut deviations = [Self::BLANK; LANES];
        for (l, found) in deviations.iter_mut().enumerate() {
            let point = Point::new(contact[0].0[l], contact[1].0[l], contact[2].0[l]);
            let beyond_outline = match self.nominal.outline() {
                Some(outline) => !outline.contains(point.x, point.y),
                None => false,
            };
            *found = Deviation {
                point,
                normal: Vector::new(normal[0].0[l], normal[1].0[l], normal[2].0[l]),
                deviation_mm: deviation.0[l],
                uncertainty_mm: (self.variance_mm2 + variance.0[l].max(0.0)).sqrt(),
                status: if beyond_outline { PointStatus::OffPart } else { correspondences[l].status() },
                in_fit: correspondences[l].in_fit,
            };
        }
        deviations
    }
}
