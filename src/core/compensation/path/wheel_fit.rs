//! Checks before a path is laid: the wheel fits the surface at the contact, and its body does not touch the part
//! elsewhere.

use rayon::prelude::*;

use super::groove::wheel_curvatures;
use super::groove::{groove, relative_to_middle};
use super::options::{PathOptions, TrackSpacing};
use super::target_surface::SurfaceCurvature;
use super::{PathError, TargetSurface};
use crate::geometry::{Aperture, Point};

/// Number of places along each axis at which the fit of the wheel to the surface is checked.
pub(super) const PLACES: usize = 101;
/// Number of contacts along each axis (`BODIES`), and of surface points along each axis (`GROUND`), at which the body
/// of the wheel is checked against the part.
const BODIES: usize = 24;
const GROUND: usize = 48;
/// Minimum ratio of the wheel's curvature to the curvature of a hollow. With a closer fit a small error of either
/// makes the contact a line.
const MARGIN: f64 = 1.05;
/// Maximum depth to which the body of a wheel may cut the part away from the contact, in millimetres. It allows for
/// the limited smoothness of the surface.
const MAX_BODY_DEPTH_MM: f64 = 1e-4;
/// Maximum slope that a wheel can grind. On steeper slopes the machine's spindle is in the way.
const MAX_SLOPE_RAD: f64 = 1.2;
/// Checks that the wheel fits the surface `wanted` on a grid of places over the part and along its border. Returns the
/// distance between tracks, projected onto the xy plane, in mm.
///
/// If the options give this distance, it is returned. If they give a maximum scallop height instead, the result is the
/// largest distance at which no scallop (ridge between tracks) is higher, up to the limit in the options.
///
/// # Errors
/// Returns an error if the wheel does not fit at one of the places. If a hollow is too narrow at every failing place,
/// the error describes the place that requires the smallest wheel. Returns [`PathError::Empty`] if there is no place on
/// the part.
pub(super) fn track_mm(wanted: &TargetSurface, outline: &Aperture, options: &PathOptions) -> Result<f64, PathError> {
    let places = places(outline, PLACES);
    let one = |place: &[f64; 2]| fit_at(&wanted.curvature_at(*place), *place, outline, options);
    let distances: Vec<Result<f64, PathError>> = places.par_iter().map(one).collect();
    let narrowest = distances.into_iter().reduce(narrower).unwrap_or(Err(PathError::Empty))?;
    match options.spacing {
        TrackSpacing::Distance(mm) => Ok(mm),
        TrackSpacing::Scallop { max_track_mm: widest_mm, .. } => Ok(narrowest.min(widest_mm)),
    }
}

/// Returns false if the wheel does not fit the surface `wanted` at one of a few places of the part. This quick test
/// finds most wheels that do not fit; a wheel that passes it is not yet proven to fit.
pub(super) fn may_fit(wanted: &TargetSurface, outline: &Aperture, options: &PathOptions) -> bool {
    const FEW: usize = 21;
    places(outline, FEW).iter().all(|place| fit_at(&wanted.curvature_at(*place), *place, outline, options).is_ok())
}

/// Combines the results of [`fit_at`] at two places. Each result is the largest allowed distance between tracks in mm
/// (infinity if there is no limit), or the error that the wheel does not fit.
///
/// Returns the smaller distance if no result is an error. Returns the error if only one result is an error.
///
/// If both are [`PathError::Hollow`], returns the error that requires the smaller wheel, because this wheel fits at
/// both places. If both are errors and at least one is another error, returns `a`, so that the same path always gives
/// the same message.
fn narrower(a: Result<f64, PathError>, b: Result<f64, PathError>) -> Result<f64, PathError> {
    let room = |e: &PathError| match e {
        PathError::Hollow { limit_mm, wheel_mm, .. } => Some(limit_mm / wheel_mm),
        _ => None,
    };
    match (a, b) {
        (Ok(a), Ok(b)) => Ok(a.min(b)),
        (Err(a), Err(b)) => Err(if room(&a).zip(room(&b)).is_some_and(|(a, b)| b < a) { b } else { a }),
        (Err(e), Ok(_)) | (Ok(_), Err(e)) => Err(e),
    }
}

/// Returns test places `[x, y]` on the part, in mm. They are the points of a `count` x `count` grid over the bounding
/// box that lie on the part, followed by 4 x `count` points on the border of the part.
fn places(outline: &Aperture, count: usize) -> Vec<[f64; 2]> {
    let mut places = on_grid(outline, count);
    places.extend(outline.outline_mm(4 * count));
    places
}

/// Returns the points `[x, y]`, in mm, of a `count` x `count` grid that lie on the part. The grid covers the bounding
/// box of `outline`. `count` must be at least 2.
pub(super) fn on_grid(outline: &Aperture, count: usize) -> Vec<[f64; 2]> {
    let [low, high] = outline.bounds();
    let at = |k: usize, i: usize| low[k] + (high[k] - low[k]) * i as f64 / (count - 1) as f64;
    let grid = (0..count * count).map(|n| [at(0, n % count), at(1, n / count)]);
    grid.filter(|[x, y]| outline.contains(*x, *y)).collect()
}

/// Checks at one place of the part that the wheel fits the surface: slope, contact and radius of hollows. `bend` holds
/// normal and curvatures of the surface at `place`, `[x, y]` in mm.
///
/// Returns the distance between tracks, projected onto the xy plane, in mm, at which the scallops (ridges between
/// tracks) reach the maximum height in the options. Returns infinity if the options give the distance between tracks
/// instead of a height.
///
/// # Errors
/// Returns an error if the surface is not finite or too steep, if the rim cannot touch, or if a hollow is too narrow
/// for the wheel.
fn fit_at(
    bend: &SurfaceCurvature,
    place: [f64; 2],
    outline: &Aperture,
    options: &PathOptions,
) -> Result<f64, PathError> {
    let [x_mm, y_mm] = place;
    let normal = &bend.contact.normal;
    let finite = (bend.second_form_per_mm.iter().sum::<f64>() + bend.contact.point.z).is_finite();
    if !finite {
        return Err(PathError::NotAHeight { x_mm, y_mm });
    }
    let slope = normal.dot(&options.head_at(&bend.contact)).clamp(-1.0, 1.0).acos();
    if slope > MAX_SLOPE_RAD {
        let (slope_deg, limit_deg) = (slope.to_degrees(), MAX_SLOPE_RAD.to_degrees());
        return Err(PathError::Steep { x_mm, y_mm, slope_deg, limit_deg });
    }
    let wheel = options.wheel_at(&bend.contact);
    if wheel.centre(&bend.contact).is_none() {
        return Err(PathError::CannotTouch { x_mm, y_mm });
    }
    let curved = wheel_curvatures(bend, &wheel);
    let [a, b, c] = std::array::from_fn(|k| curved[k] - MARGIN * bend.second_form_per_mm[k]);
    // The gap opens in every direction if trace and determinant of this form are both positive.
    if !(a + c > 0.0 && a * c - b * b > 0.0) {
        return Err(hollow(bend, &curved, place));
    }
    let TrackSpacing::Scallop { max_height_mm: height, .. } = options.spacing else { return Ok(f64::INFINITY) };
    let groove = groove(bend, relative_to_middle(outline, place), &wheel, options.pattern);
    Ok((8.0 * height / groove.curvature_per_mm).sqrt() / groove.stretch)
}

/// Returns the error for a hollow of the surface that is too narrow for the wheel. The error names the tangent
/// direction in which the wheel has the least clearance.
///
/// `bend` holds the curvatures of the surface at `[x_mm, y_mm]`. `wheel` holds the second fundamental form of the wheel
/// at this contact, in 1/mm, from [`wheel_curvatures`].
fn hollow(bend: &SurfaceCurvature, wheel: &[f64; 3], [x_mm, y_mm]: [f64; 2]) -> PathError {
    let in_direction = |q: &[f64; 3], angle: f64| {
        let (s, c) = angle.sin_cos();
        q[0] * c * c + 2.0 * q[1] * s * c + q[2] * s * s
    };
    let gap = |angle: f64| in_direction(wheel, angle) - MARGIN * in_direction(&bend.second_form_per_mm, angle);
    let angles = (0..180).map(|d| f64::from(d).to_radians());
    let worst = angles.min_by(|a, b| gap(*a).total_cmp(&gap(*b))).unwrap_or(0.0);
    let hollow_mm = 1.0 / in_direction(&bend.second_form_per_mm, worst);
    PathError::Hollow {
        x_mm,
        y_mm,
        direction_deg: worst.to_degrees(),
        hollow_mm,
        wheel_mm: 1.0 / in_direction(wheel, worst),
        limit_mm: hollow_mm / MARGIN,
    }
}

/// Checks that the body of the wheel does not cut into the part away from the contact point. Contacts all over the part
/// are tested. For each contact, all sampled surface points within the largest radius of the wheel are tested. A cut of
/// up to 0.1 µm is allowed.
///
/// Another check compares the curvatures of wheel and surface, and shows only that the wheel fits near the contact.
/// This check finds collisions of other areas: the far side of a cup, the flank of a disc, or the opposite wall of a
/// valley.
///
/// # Errors
/// Returns [`PathError::CannotTouch`] if the wheel cannot touch the surface at one of the contacts. Returns
/// [`PathError::Body`] for the deepest cut if a cut is deeper than 0.1 µm.
pub(super) fn check_body(wanted: &TargetSurface, outline: &Aperture, options: &PathOptions) -> Result<(), PathError> {
    let ground: Vec<([f64; 2], Point)> =
        places(outline, GROUND).into_par_iter().map(|at| (at, wanted.at(at).point)).collect();
    let reach = options.wheel.reach_mm() + MAX_BODY_DEPTH_MM;
    let one = |place: &[f64; 2]| {
        let [x_mm, y_mm] = *place;
        let contact = wanted.at(*place);
        let wheel = options.wheel_at(&contact);
        let centre = wheel.centre(&contact).ok_or(PathError::CannotTouch { x_mm, y_mm })?;
        let (mut depth_mm, mut deepest_at) = (MAX_BODY_DEPTH_MM, None);
        for (at, point) in &ground {
            let from = point - centre;
            if from.norm_squared() > reach * reach {
                continue;
            }
            let depth = -wheel.distance_mm(&from);
            if depth > depth_mm {
                (depth_mm, deepest_at) = (depth, Some(*at));
            }
        }
        deepest_at.map_or(Ok(()), |[at_x_mm, at_y_mm]| {
            Err(PathError::Body { x_mm, y_mm, at_x_mm, at_y_mm, depth_mm, limit_mm: MAX_BODY_DEPTH_MM })
        })
    };
    let cuts: Vec<Result<(), PathError>> = places(outline, BODIES).par_iter().map(one).collect();
    let depth = |e: &PathError| if let PathError::Body { depth_mm, .. } = e { *depth_mm } else { f64::INFINITY };
    let deeper = |a: PathError, b: PathError| if depth(&b) > depth(&a) { b } else { a };
    cuts.into_iter().filter_map(Result::err).reduce(deeper).map_or(Ok(()), Err)
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::compensation::Correction;
    use crate::compensation::path::Wheel;
    use crate::compensation::path::{HeightField, ToolPath};
    use crate::geometry::{Grid, Vector};

    pub(in super::super) const PART: Aperture =
        Aperture::Rectangle { centre_mm: [0.0, 0.0], width_mm: 16.0, height_mm: 12.0 };

    /// Returns the surface z = a x^2 + b y^2 without a correction.
    pub(in super::super) fn quadric(a: f64, b: f64) -> TargetSurface {
        surface(|[x, y]| (a * x * x + b * y * y, [2.0 * a * x, 2.0 * b * y]))
    }

    /// Returns a target surface without a correction, for x and y from -10 mm to 10 mm. `height` returns the height z
    /// in mm, and the slopes along x and y, at a place `[x, y]`.
    pub(in super::super) fn surface(height: impl Fn([f64; 2]) -> (f64, [f64; 2])) -> TargetSurface {
        let on = Grid { columns: 81, rows: 81, first_mm: [-10.0, -10.0], spacing_mm: [0.25, 0.25] };
        let places = (0..on.len()).map(|k| on.place_mm(k));
        let (z, slopes): (Vec<f64>, Vec<[f64; 2]>) = places.map(height).unzip();
        let grid = Grid { columns: 2, rows: 2, first_mm: [-8.0, -6.0], spacing_mm: [16.0, 12.0] };
        let none = Correction { grid, values_mm: vec![0.0; 4], cycle: 1, level_mm: 0.0, parameters: None };
        TargetSurface::new(HeightField::hermite(on, &z, &slopes), &none, 5.0).unwrap()
    }

    pub(in super::super) fn ball(radius_mm: f64) -> PathOptions {
        PathOptions::new(Wheel::Sphere { radius_mm }, 0.5, 600.0)
    }

    pub(in super::super) fn path(wanted: TargetSurface, options: PathOptions) -> Result<ToolPath, PathError> {
        ToolPath::new(wanted, PART, options)
    }

    #[test]
    fn wheel_fit_refuses_tight_hollow() {
        // Hollow across the tracks with a radius of 20 mm; a dome along them.
        let hollow = || quadric(-0.01, 0.025);
        assert!(path(hollow(), ball(18.0)).is_ok());
        let refused = path(hollow(), ball(20.5)).unwrap_err();
        let PathError::Hollow { direction_deg, hollow_mm, wheel_mm, .. } = refused else { panic!("{refused}") };
        assert!((direction_deg - 90.0).abs() < 5.0 && (hollow_mm - 20.0).abs() < 0.01 && wheel_mm == 20.5, "{refused}");
        // The error names the narrowest place, in any order of the threads.
        for _ in 0..20 {
            assert_eq!(path(hollow(), ball(20.5)).unwrap_err().to_string(), refused.to_string());
        }
        // A disc that rolls along the track is narrow across it. Turned by 90° it does not fit.
        let disc = |spindle| PathOptions { wheel: Wheel::Torus { ring_mm: 40.0, tube_mm: 5.0, spindle }, ..ball(1.0) };
        assert!(path(hollow(), disc(Vector::y())).is_ok());
        assert!(matches!(path(hollow(), disc(Vector::x())), Err(PathError::Hollow { .. })));
        assert!(path(quadric(0.0, 0.0), ball(1000.0)).is_ok());
    }

    #[test]
    fn wheel_fit_refuses_steep_slopes_and_rims() {
        assert!(matches!(path(quadric(0.2, 0.0), ball(1.0)), Err(PathError::Steep { .. })));
        // Along x the normal approaches the direction of the spindle.
        let along = Wheel::Torus { ring_mm: 3.0, tube_mm: 0.5, spindle: Vector::new(0.6, 0.0, 0.8) };
        assert!(matches!(
            path(quadric(-0.05, 0.0), PathOptions { wheel: along, ..ball(1.0) }),
            Err(PathError::CannotTouch { .. })
        ));
        // A cup that is tilted less than the slope of the dome would have to touch with the other side of its ring.
        let cup = PathOptions { wheel: Wheel::tilted_cup(6.0, 1.0, 0.15), ..ball(1.0) };
        assert!(matches!(path(quadric(-0.0125, -0.001), cup), Err(PathError::CannotTouch { .. })));
        assert!(path(quadric(-0.002, -0.001), cup).is_ok());
    }

    #[test]
    fn wheel_body_collision_is_refused() {
        // A disc tilted by 37° reaches up over the part towards -x. There it meets a wall of 50°, although its rim
        // still fits at the bottom of the wall.
        let wall = |steepest: f64| {
            surface(move |[x, _]| {
                let (into, width) = ((-2.0 - x).max(0.0), 0.8 * steepest / 1.2);
                let slope = steepest * (into / width).min(1.0);
                (if into < width { 0.5 * slope * into } else { steepest * (into - 0.5 * width) }, [-slope, 0.0])
            })
        };
        let leaning = Wheel::Torus { ring_mm: 3.0, tube_mm: 0.4, spindle: Vector::new(0.6, 0.0, 0.8) };
        let options = PathOptions { wheel: leaning, overrun_mm: 0.0, lead_mm: 0.0, ..ball(1.0) };
        assert!(path(wall(0.4), options).is_ok());
        let refused = path(wall(1.2), options).unwrap_err();
        let PathError::Body { x_mm, at_x_mm, depth_mm, limit_mm, .. } = refused else { panic!("{refused}") };
        // On the wall the wheel touches with the side that is high over the flat. The error gives the deepest cut; a
        // rim cuts no deeper than its tube radius.
        assert!(x_mm < -2.0 && (at_x_mm - x_mm).abs() > 1.0 && limit_mm == MAX_BODY_DEPTH_MM, "{refused}");
        assert!(depth_mm > 0.1 && depth_mm <= 0.4, "{refused}");
    }

    #[test]
    fn path_options_refused_by_key() {
        for (options, key) in [
            (PathOptions { chord_error_mm: 0.0, ..ball(5.0) }, "chord error (mm)"),
            (PathOptions { feed_mm_min: f64::NAN, ..ball(5.0) }, "feed (mm/min)"),
            (PathOptions { overrun_mm: -1.0, ..ball(5.0) }, "overrun (mm)"),
            (ball(-5.0), "wheel radius (mm)"),
        ] {
            assert!(matches!(path(quadric(0.0, 0.0), options), Err(PathError::Option { key: k, .. }) if k == key));
        }
    }

    #[test]
    fn track_spacing_from_scallop_height() {
        let spacing = TrackSpacing::Scallop { max_height_mm: 1e-4, max_track_mm: 5.0 };
        let flat = path(quadric(0.0, 0.0), PathOptions { spacing, ..ball(10.0) }).unwrap();
        // h = s^2 / (8 R). Tracks are equally spaced between the borders, so they are a little closer.
        let most = (8.0f64 * 10.0 * 1e-4).sqrt();
        assert!(flat.track_mm() <= most && flat.track_mm() > 0.98 * most, "{}", flat.track_mm());
        // In a hollow with a radius of 20 mm the ridges are half as high.
        let hollow = path(quadric(0.0, 0.025), PathOptions { spacing, ..ball(10.0) }).unwrap();
        assert!(hollow.track_mm() > 1.2 * most);
    }
}
