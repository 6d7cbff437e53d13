//! Grinding of a part: its pass, its tracks and its programs.

use super::error::SetupError;
use crate::compensation::Correction;
use crate::compensation::path::{
    Contact as PathContact, HeightField, MachineLimits, PathError, PathOptions, RotaryAxis, RotationAxis, Scallops,
    TargetSurface, TiltMode, TrackSpacing, Wheel as PathWheel,
};
use crate::config::{CellConfig, RotaryLetter};
use crate::device::Pass;
use crate::drive::Programs;
use crate::geometry::{Aperture, Grid, Vector};
use crate::recipe::{Micrometres, Recipe, SpindleAxis, Tilt, TiltKind, WheelDimensions};
use crate::surface::{Nominal, Side};

/// Maximum rms and height of the scallops, as a share of the RMS limit and of the PV limit, if the scallops determine
/// the track distance. A larger share causes a warning. A fifth of an RMS adds 2 % in quadrature; a fifth of a PV adds
/// a fifth.
pub const MAX_SCALLOP_SHARE: f64 = 0.2;

pub(super) fn pass(recipe: &Recipe, nominal: &Nominal, part_identity: [u8; 32], track_spacing_mm: f64) -> Pass {
    let [low, high] = match nominal.outline() {
        Some(outline) => outline.bounds(),
        None => nominal.points().fold([[f64::INFINITY; 2], [f64::NEG_INFINITY; 2]], |[low, high], p| {
            [[low[0].min(p.x), low[1].min(p.y)], [high[0].max(p.x), high[1].max(p.y)]]
        }),
    };
    Pass {
        spark_out_passes: recipe.grinding.spark_out_passes,
        wheel_radius_mm: recipe.grinding.wheel.radius_mm(),
        feed_mm_min: recipe.grinding.feed_mm_min,
        track_spacing_mm,
        level_mm: recipe.grinding.allowance_um.mm(),
        depth_of_cut_mm: recipe.compensation.depth_of_cut_um.mm(),
        x_mm: [low[0], high[0]],
        y_mm: [low[1], high[1]],
        part_identity,
    }
}

/// Surface under the paths, and outline of the part.
pub(super) type SurfaceAndOutline = (HeightField, Aperture);

pub(super) fn surface_and_outline(recipe: &Recipe, nominal: &Nominal) -> Result<SurfaceAndOutline, PathError> {
    let (field, outline) = Programs::surface_and_outline(nominal)?;
    // The surface as seen from the side of the wheel.
    Ok((if is_from_below(recipe) { field.mirrored() } else { field }, outline))
}

/// Returns true if the recipe sets the side of -z as the measured side. The part is then ground from this side too.
fn is_from_below(recipe: &Recipe) -> bool {
    recipe.measure.side.side() == Some(Side::Opposite)
}

/// Returns the distance between the tracks of the wheel in mm, and the scallops (the ridges between the tracks) at this
/// distance. `ground` is the surface to grind with the outline of the part, or the reason why no path can be planned.
///
/// The distance depends on the keys of the recipe:
///
/// - Only `track_mm`: the distance is `track_mm`.
/// - Only `scallop_nm` (the maximum height of the scallops): the distance is the largest one that respects this height.
/// - Both: the distance is the largest one that respects `scallop_nm`, and at most `track_mm`.
/// - Neither: the distance follows from the tolerances of the recipe, see [`track_for_tolerance_mm`].
///
/// Without `track_mm`, the distance is also at most the radius of the wheel, and at most half of the shorter side of
/// the part. If `ground` is an error and the recipe states `track_mm`, the distance is `track_mm` and the scallops are
/// `None`.
///
/// # Errors
/// Returns an error if no path can be planned and the recipe does not state `track_mm`, or if the target surface cannot
/// be computed.
pub(super) fn track_distance(
    recipe: &Recipe,
    cell: &CellConfig,
    nominal: &Nominal,
    ground: &Result<SurfaceAndOutline, PathError>,
) -> Result<(f64, Option<Scallops>), SetupError> {
    let grinding = &recipe.grinding;
    let (field, outline) = match (ground, grinding.track_mm) {
        (Ok(ground), _) => ground,
        (Err(_), Some(track_mm)) => return Ok((track_mm, None)),
        (Err(source), None) => {
            return Err(SetupError::Tracks { recipe: recipe.path().to_owned(), source: source.clone() });
        }
    };
    let [low, high] = outline.bounds();
    let size_mm = [high[0] - low[0], high[1] - low[1]];
    let none = Correction::zero(Grid { columns: 2, rows: 2, first_mm: low, spacing_mm: size_mm }, 0.0);
    let unknown = |source| SetupError::Tracks { recipe: recipe.path().to_owned(), source };
    let wanted = TargetSurface::new(field.clone(), &none, 1.0).map_err(unknown)?;
    let options =
        with_tilt(recipe, cell, PathOptions::new(path_wheel(&grinding.wheel, nominal), 1.0, grinding.feed_mm_min));
    let wheel_at = |contact: &PathContact| options.wheel_at(contact);
    let unit = Scallops::compute(&wanted, outline, wheel_at, grinding.pattern, 1.0);
    // Tracks must overlap, and there must be more than one.
    let widest_mm = grinding.wheel.radius_mm().min(0.5 * size_mm[0].min(size_mm[1]));
    let track_mm = match (grinding.track_mm, grinding.scallop_nm) {
        (Some(track_mm), None) => track_mm,
        (max_mm, Some(nm)) => unit.max_track_mm(1e-6 * nm, f64::INFINITY).min(max_mm.unwrap_or(widest_mm)),
        (None, None) => track_for_tolerance_mm(recipe, &unit).min(widest_mm),
    };
    Ok((track_mm, Some(unit.with_track_mm(track_mm))))
}

/// Returns the maximum distance between tracks in mm at which the scallops (the ridges between the tracks) are small
/// enough for the limits of the recipe. The height of the scallops may be at most [`MAX_SCALLOP_SHARE`] times the PV
/// limit. Their rms may be at most [`MAX_SCALLOP_SHARE`] times the RMS limit. `scallops` gives height and rms for one
/// distance. For other distances, height and rms are proportional to the square of the distance. The result is rounded
/// down to two significant digits. The result is infinite if the recipe states neither limit, or if the wheel leaves no
/// scallops.
pub fn track_for_tolerance_mm(recipe: &Recipe, scallops: &Scallops) -> f64 {
    let share = |limit: Option<Micrometres>| limit.map_or(f64::INFINITY, |um| MAX_SCALLOP_SHARE * um.mm());
    let max_mm = scallops.max_track_mm(share(recipe.acceptance.pv_um), share(recipe.acceptance.rms_um));
    if !max_mm.is_finite() {
        return max_mm;
    }
    let per_mm = 10f64.powf(1.0 - max_mm.log10().floor());
    (max_mm * per_mm).floor() / per_mm
}

/// Returns the settings that all grinding programs of a part have in common, such as path options, machine limits and
/// program dialect. `ground` is the surface to grind, as a height over x and y, with the outline of the part.
/// `track_mm` is the distance between the tracks. `part_identity` is the SHA-256 that identifies the nominal surface.
pub(super) fn programs(
    recipe: &Recipe,
    cell: &CellConfig,
    nominal: &Nominal,
    part_identity: [u8; 32],
    (ground, track_mm): (SurfaceAndOutline, f64),
) -> Programs {
    let (grinding, limits) = (&recipe.grinding, &cell.grinder.limits);
    let plain = PathOptions::new(path_wheel(&grinding.wheel, nominal), track_mm, grinding.feed_mm_min);
    let plain = with_tilt(recipe, cell, plain);
    // The wheel reaches its feed before it touches the part.
    let machine = MachineLimits {
        travel_mm: limits.travel.map(|travel| [travel.min_mm, travel.max_mm]),
        speed_mm_s: limits.max_speed_mm_s,
        acceleration_mm_s2: limits.max_acceleration_mm_s2,
        jerk_mm_s3: limits.max_jerk_mm_s3,
    };
    let run_up_mm = 1.1 * machine.run_up_mm(grinding.feed_mm_min);
    let options = PathOptions {
        from_below: is_from_below(recipe),
        pattern: grinding.pattern,
        one_way: grinding.one_way,
        spacing: match grinding.scallop_nm {
            // A correction can bend the surface a little more than the nominal surface is bent.
            Some(nm) => TrackSpacing::Scallop { max_height_mm: 1e-6 * nm, max_track_mm: track_mm },
            None => TrackSpacing::Distance(track_mm),
        },
        chord_error_mm: grinding.chord_error_um.mm(),
        overrun_mm: grinding.overrun_mm,
        lead_mm: plain.lead_mm.max(run_up_mm - grinding.overrun_mm),
        safe_height_mm: grinding.safe_height_mm,
        spiral_acceleration_mm_s2: limits.max_acceleration_mm_s2,
        ..plain
    };
    Programs {
        part: recipe.part.name.clone(),
        part_identity,
        surface_and_outline: ground,
        options,
        limits: machine,
        mode: grinding.path_mode,
        path_tolerance_mm: grinding.path_tolerance_um.mm(),
        controller_tolerance_mm: cell.grinder.program.controller_tolerance_mm,
        arcs_within_mm: cell.grinder.program.arcs_within_mm,
        dialect: cell.grinder.program.dialect.clone(),
        folder: cell.grinder.program.folder.clone(),
        spark_out_passes: grinding.spark_out_passes,
        simulation: cell.simulated,
    }
}

/// Returns a copy of the path options `plain` with the rotary axis of the grinder from the cell file and the tilt of
/// the wheel from the recipe. Each of the two options is `None` if its file does not state it.
fn with_tilt(recipe: &Recipe, cell: &CellConfig, plain: PathOptions) -> PathOptions {
    let step_rad = 10f64.powi(-i32::from(cell.grinder.program.dialect.numbers.angle_decimals)).to_radians();
    let rotary = cell.grinder.rotary.map(|head| {
        let (letter, about) = match head.letter {
            RotaryLetter::A => ('A', RotationAxis::X),
            RotaryLetter::B => ('B', RotationAxis::Y),
        };
        RotaryAxis {
            letter,
            axis: about,
            reversed: head.reversed,
            range_rad: head.range_deg.map(f64::to_radians),
            rate_rad_s: head.max_rate_deg_min.to_radians() / 60.0,
            step_rad,
            pivot_mm: head.pivot_mm.map(Vector::from),
        }
    });
    let lean = recipe.grinding.tilt.map(|Tilt { lean, angle_deg }| match (lean, angle_deg.to_radians()) {
        (TiltKind::Constant, angle_rad) => TiltMode::Constant { angle_rad },
        (TiltKind::Following, lead_rad) => TiltMode::Following { lead_rad },
    });
    PathOptions { rotary, tilt: lean, ..plain }
}

/// Converts the wheel of a recipe into the wheel for path planning. If the recipe states no tilt for a cup wheel, the
/// tilt is the largest slope of the part plus 0.0873 rad (about 5°).
fn path_wheel(wheel: &WheelDimensions, nominal: &Nominal) -> PathWheel {
    const CUP_TILT_MARGIN_RAD: f64 = 0.0873;
    match *wheel {
        WheelDimensions::Sphere { radius_mm } => PathWheel::Sphere { radius_mm },
        WheelDimensions::Torus { radius_mm, minor_radius_mm, spindle } => PathWheel::Torus {
            ring_mm: radius_mm - minor_radius_mm,
            tube_mm: minor_radius_mm,
            spindle: match spindle {
                SpindleAxis::X => Vector::x(),
                SpindleAxis::Y => Vector::y(),
            },
        },
        WheelDimensions::Cup { radius_mm, minor_radius_mm, tilt_deg } => {
            let sloped = || nominal.max_slope_rad() + CUP_TILT_MARGIN_RAD;
            PathWheel::tilted_cup(radius_mm, minor_radius_mm, tilt_deg.map_or_else(sloped, f64::to_radians))
        }
    }
}
