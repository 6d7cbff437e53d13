//! Nominal part to register to, and the checks of the input before any computation.

use rayon::prelude::*;

use crate::geometry::{Point, find_far_off};
use crate::surface::{Lookup, Nominal, OffsetSurface, Side};

use super::correspond::{ResidualModel, centroid_and_size};
use super::error::RegistrationError;
use super::iterate::Problem;
use super::options::{Method, RegistrationOptions, Start};
use super::robust_loss::{Loss, ScaledLoss};

/// Nominal surface to register to, with the sizes to which the limits refer.
pub(super) struct Part<'a> {
    pub(super) nominal: &'a Nominal,
    /// Radius of the offset surface in mm: that of the probe, or 0 if the points are registered to the nominal surface
    /// itself.
    pub(super) offset_mm: f64,
    /// Length subtracted from each distance, in mm.
    pub(super) subtract_mm: f64,
    /// Centroid of the measured cloud.
    pub(super) centroid: Point,
    /// Rms size of the measured cloud, in mm.
    pub(super) size_mm: f64,
    /// Minimum singular value of a direction that the surface determines, as a share of the root of the sum of all
    /// squared singular values.
    pub(super) min_singular_share: f64,
}

impl<'a> Part<'a> {
    /// Checks the input before any pose is tried. Returns the nominal surface together with the offset in mm (the probe
    /// radius, or 0), and with the centroid and the rms size of the measured points.
    ///
    /// # Errors
    /// Returns an error in these cases:
    ///
    /// - All coordinates are locked, but `options` contain no start pose.
    /// - The points are not finite or repeated, or fewer than the number of free coordinates plus one.
    /// - The points lie on one line, or their rms size does not agree with the rms size of the nominal surface. This is
    ///   not checked if all coordinates are locked.
    /// - The probe radius is not positive, or is at least half of the rms size of the nominal surface. This is not
    ///   checked for contact points (points on the part instead of probe centres), because they need no radius.
    pub(super) fn new(
        nominal: &'a Nominal,
        measured: &[Point],
        options: &RegistrationOptions,
    ) -> Result<Self, RegistrationError> {
        // A fully locked pose is given; only the deviations from it are wanted.
        let is_held = options.locked == [true; 6];
        if is_held && options.start == Start::Search {
            return Err(RegistrationError::Undetermined);
        }
        // One more than the free directions. With fewer, nothing shows how well the pose fits.
        let least = 7 - options.locked.iter().filter(|locked| **locked).count();
        if measured.len() < least {
            return Err(RegistrationError::TooFewPoints { points: measured.len(), min_points: least });
        }
        if let Some(index) = measured.par_iter().position_first(|p| !(p.x + p.y + p.z).is_finite()) {
            return Err(RegistrationError::NotFinite { index });
        }
        if !is_held && crate::surface::is_line(measured) {
            return Err(RegistrationError::Collinear { points: measured.len() });
        }
        check_repeats(measured)?;
        let (middle, size_mm) = centroid_and_size(measured);
        let nominal_mm = nominal.size_mm();
        // A fully locked pose needs only one point, and one point has no size.
        let size_mm = if is_held { size_mm.max(1e-3 * nominal_mm) } else { size_mm };
        if !is_held {
            check_sizes(size_mm, nominal_mm).map_err(|error| explain_by_far_point(nominal, measured, error))?;
        }
        let radius_mm = options.probe_radius_mm;
        let limit_mm = 0.5 * nominal_mm;
        if options.method != Method::Contact && !(radius_mm > 0.0 && radius_mm < limit_mm) {
            return Err(RegistrationError::ProbeRadius { radius_mm, limit_mm });
        }
        let (offset_mm, subtract_mm) = match options.method {
            Method::Offset => (radius_mm, 0.0),
            Method::Contact => (0.0, 0.0),
            Method::SubtractRadius => (0.0, radius_mm),
        };
        let min_share = 1e-6_f64.max(3.0 * nominal.normal_error_rad());
        Ok(Self { nominal, offset_mm, subtract_mm, centroid: middle, size_mm, min_singular_share: min_share })
    }

    /// Returns the offset surface on the given side of the nominal surface. `options` select two things: the distance
    /// model (the distance from a flat or from a curved facet), and the rule that finds the facet for a point. The rule
    /// is the facet above or below the point along z for [`Method::SubtractRadius`], and otherwise the facet that
    /// contains the projection of the point.
    pub(super) fn surface(&self, options: &RegistrationOptions, side: Side) -> OffsetSurface<'a> {
        let lookup = if options.method == Method::SubtractRadius { Lookup::AlongZ } else { Lookup::ContainingFacet };
        OffsetSurface::new(self.nominal, self.offset_mm, side)
            .expect("the radius was checked")
            .with_distance_model(options.distance_model)
            .with_lookup(lookup)
    }

    /// Checks that the probe ball fits into all concave areas of the surface on the given side.
    ///
    /// # Errors
    /// Returns [`crate::surface::SurfaceError::OffsetFolds`] with the most concave place if the offset surface folds:
    /// there the probe radius is larger than the concave radius of curvature.
    pub(super) fn check_fold(&self, options: &RegistrationOptions, side: Side) -> Result<(), RegistrationError> {
        match self.surface(options, side).find_fold() {
            Some(fold) => Err(fold.into()),
            None => Ok(()),
        }
    }

    /// Returns the input and the stopping rules of the iteration for `measured` points on the given side. The loss is
    /// the square of the distance.
    pub(super) fn problem<'b>(&self, measured: &'b [Point], options: &RegistrationOptions, side: Side) -> Problem<'b>
    where
        'a: 'b,
    {
        Problem {
            surface: self.surface(options, side),
            residual: ResidualModel { subtract_mm: self.subtract_mm, loss: ScaledLoss::new(Loss::None, 1.0) },
            measured,
            centroid: self.centroid,
            size_mm: self.size_mm,
            locked: options.locked,
            min_singular_share: self.min_singular_share,
            tolerance: options.tolerance,
            ball_radius: options.ball_radius,
            max_iterations: options.max_iterations,
        }
    }

    /// Returns the largest accepted rms deviation in mm. This is `options.rms_limit_mm` if it is given; otherwise 0.2
    /// mm plus 1e-4 of the rms size of the measured points.
    pub(super) fn rms_limit_mm(&self, options: &RegistrationOptions) -> f64 {
        options.rms_limit_mm.unwrap_or(0.2 + 1e-4 * self.size_mm)
    }
}

/// Rejects measured points of which too many occur twice, with exactly equal coordinates. Examines all points, or about
/// 8000 of a larger number. A hash of the coordinates selects these points. So two equal points are either both
/// examined or both not.
///
/// # Errors
/// Returns [`RegistrationError::Repeated`] if more than 1 % of the examined points repeat another point.
fn check_repeats(measured: &[Point]) -> Result<(), RegistrationError> {
    const MAX_EXAMINED: usize = 8192;
    let mixed = |p: &Point| {
        let [x, y, z] = [p.x, p.y, p.z].map(|c| (c + 0.0).to_bits());
        let mixed = x.wrapping_mul(0x9E37_79B9_7F4A_7C15) ^ y.rotate_left(21).wrapping_mul(0xD6E8_FEB8_6659_FD93) ^ z;
        let mixed = (mixed ^ (mixed >> 32)).wrapping_mul(0xD6E8_FEB8_6659_FD93);
        mixed ^ (mixed >> 29)
    };
    let one_in = measured.len().div_ceil(MAX_EXAMINED) as u64;
    let mixed = |(k, p): (usize, &Point)| (mixed(p), k);
    let mut chosen: Vec<(u64, usize)> =
        measured.par_iter().enumerate().with_min_len(4096).map(mixed).filter(|(h, _)| h % one_in == 0).collect();
    chosen.sort_unstable();
    let doubled = chosen.windows(2).filter(|w| w[0].0 == w[1].0 && measured[w[0].1] == measured[w[1].1]).count();
    if doubled * 100 > chosen.len() {
        return Err(RegistrationError::Repeated { doubled, points: chosen.len() });
    }
    Ok(())
}

/// Explains `error`, which reports that the sizes of the measured points and of the nominal surface do not agree.
/// Searches for one measured point far from all other measured points, then for one nominal point far from all other
/// nominal points. Returns an error that names the first such point, or `error` unchanged if there is none.
fn explain_by_far_point(nominal: &Nominal, measured: &[Point], error: RegistrationError) -> RegistrationError {
    if let Some((index, distance_mm)) = find_far_off(measured) {
        return RegistrationError::FarOff { index, at: measured[index].into(), distance_mm };
    }
    let nominal: Vec<Point> = nominal.points().copied().collect();
    match find_far_off(&nominal) {
        Some((index, distance_mm)) => RegistrationError::NominalFarOff { at: nominal[index].into(), distance_mm },
        None => error,
    }
}

/// Compares the rms size of the measured points, `measured_mm`, with the rms size of the nominal points, `nominal_mm`.
///
/// # Errors
/// Returns [`RegistrationError::Size`] if the measured size is less than 0.06 times or more than 3 times the nominal
/// size, or if a size is 0 or not finite. The error contains a remedy that names the likely wrong unit.
fn check_sizes(measured_mm: f64, nominal_mm: f64) -> Result<(), RegistrationError> {
    let ratio = measured_mm / nominal_mm;
    let remedy = match ratio {
        r if !(r > 0.0 && r.is_finite()) => "both sizes must be above 0: check whether all points of a file are equal",
        r if r > 500.0 => {
            "check whether the nominal points are in metres or the measured points in micrometres; give both in \
             millimetres"
        }
        r if r > 15.0 => "check whether the nominal points are in inches or centimetres; give both in millimetres",
        r if r > 3.0 => "check that this is the nominal surface of this part, and that both are in millimetres",
        r if r < 0.002 => "check whether the measured points are in metres; give both in millimetres",
        r if r < 0.06 => {
            "check whether the measured points are in inches or centimetres, or cover only a small area of the \
             surface; give both in millimetres"
        }
        _ => return Ok(()),
    };
    Err(RegistrationError::Size { ratio, measured_mm, nominal_mm, remedy })
}
