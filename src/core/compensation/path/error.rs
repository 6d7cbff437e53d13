//! Errors of a tool path.

use thiserror::Error;

/// Reason why no path can be laid, or why a path must not be sent to the machine. Each message gives the value, the
/// place, the limit and the remedy.
#[derive(Clone, Debug, Error, PartialEq)]
#[allow(missing_docs)]
#[non_exhaustive]
pub enum PathError {
    #[error(
        "no tool path can be made, because the nominal surface or its outline covers no area; check the surface and \
         the outline"
    )]
    Empty,
    #[error(
        "the nominal surface is not a height over x and y at x {x_mm:.3}, y {y_mm:.3} mm: it is steeper than 84° or \
         faces away from +z; turn the model frame so that z points away from the part"
    )]
    NotAHeight { x_mm: f64, y_mm: f64 },
    #[error("the correction is not a finite number at x {x_mm:.3}, y {y_mm:.3} mm; compute the correction again")]
    Correction { x_mm: f64, y_mm: f64 },
    #[error("{key} is {found}; it must be {allowed}")]
    Option { key: &'static str, found: f64, allowed: &'static str },
    #[error(
        "tracks every {track_mm} mm make {tracks:.0} tracks, more than {limit:.0}; choose a larger distance between \
         tracks"
    )]
    TooManyTracks { tracks: f64, track_mm: f64, limit: f64 },
    #[error(
        "the surface is concave with a radius of {hollow_mm:.3} mm at x {x_mm:.3}, y {y_mm:.3} mm, at \
         {direction_deg:.0}° from the track; the wheel has a radius of {wheel_mm:.3} mm in that direction and must \
         have less than {limit_mm:.3} mm; choose a smaller wheel"
    )]
    Hollow { x_mm: f64, y_mm: f64, direction_deg: f64, hollow_mm: f64, wheel_mm: f64, limit_mm: f64 },
    #[error(
        "the surface slopes by {slope_deg:.1}° at x {x_mm:.3}, y {y_mm:.3} mm, more than the {limit_deg:.1}° that \
         this wheel can grind; turn the part, or choose another wheel"
    )]
    Steep { x_mm: f64, y_mm: f64, slope_deg: f64, limit_deg: f64 },
    #[error(
        "the rim of the wheel cannot touch the surface at x {x_mm:.3}, y {y_mm:.3} mm: the normal there is within 2° \
         of the spindle; tilt the spindle further than the part slopes"
    )]
    CannotTouch { x_mm: f64, y_mm: f64 },
    #[error(
        "while the wheel touches x {x_mm:.3}, y {y_mm:.3} mm, it would cut {depth_um:.2} µm deep at x {at_x_mm:.3}, \
         y {at_y_mm:.3} mm; the limit is {limit_um} µm; choose a smaller wheel, or tilt its spindle",
        depth_um = 1e3 * depth_mm, limit_um = 1e3 * limit_mm
    )]
    Body { x_mm: f64, y_mm: f64, at_x_mm: f64, at_y_mm: f64, depth_mm: f64, limit_mm: f64 },
    #[error(
        "{refused}; with a tilt of {angle_deg}° (right-handed about the axis of {letter}) this wheel can grind the \
         whole part: write [grinding.tilt] with angle_deg = {angle_deg:?}"
    )]
    NeedsTilt { refused: Box<PathError>, letter: char, angle_deg: f64 },
    #[error(
        "grinding.tilt requires a rotary axis, and the grinder has none; remove it, or describe the axis: \
         [grinder.rotary] in the cell file"
    )]
    NoRotary,
    #[error(
        "grinding.tilt cannot tilt a wheel that comes from below; remove it, or turn the model so that the part is \
         ground from above"
    )]
    TiltBelow,
    #[error("a table of Z over X and Y cannot describe a tilted wheel; send the program instead of the table")]
    TableOfTilted,
    #[error(
        "the wheel would be tilted to {letter} {found_deg:.3}° at x {x_mm:.3}, y {y_mm:.3} mm, outside the \
         {min_deg}° to {max_deg}° of the axis (grinder.rotary); change grinding.tilt.angle_deg by {by_deg:.1}° or \
         more towards the range, or turn the part"
    )]
    Tilt { letter: char, found_deg: f64, x_mm: f64, y_mm: f64, min_deg: f64, max_deg: f64, by_deg: f64 },
    #[error(
        "the path turns {letter} at {found_deg_min:.1} °/min at x {x_mm:.3}, y {y_mm:.3} mm; the limit of the axis \
         is {limit_deg_min} °/min (grinder.rotary.max_rate_deg_min); lower the feed to {feed_mm_min:.1} mm/min, or \
         tilt the wheel by a constant angle"
    )]
    Rate { letter: char, found_deg_min: f64, x_mm: f64, y_mm: f64, limit_deg_min: f64, feed_mm_min: f64 },
    #[error(
        "the path reaches {axis} {found_mm:.3} mm, outside the travel of {min_mm} to {max_mm} mm; move the part \
         or its work offset, or shorten the overrun"
    )]
    Travel { axis: char, found_mm: f64, min_mm: f64, max_mm: f64 },
    #[error(
        "the path moves {axis} at {found_mm_s:.2} mm/s at x {x_mm:.3}, y {y_mm:.3} mm; the limit of the machine is \
         {limit_mm_s} mm/s; lower the feed to {feed_mm_min:.0} mm/min"
    )]
    Speed { axis: char, found_mm_s: f64, x_mm: f64, y_mm: f64, limit_mm_s: f64, feed_mm_min: f64 },
    #[error(
        "the bend of the path at x {x_mm:.3}, y {y_mm:.3} mm requires an acceleration of {found_mm_s2:.1} mm/s2 \
         across it; the limit of the machine is {limit_mm_s2} mm/s2; lower the feed to {feed_mm_min:.0} mm/min"
    )]
    Acceleration { x_mm: f64, y_mm: f64, found_mm_s2: f64, limit_mm_s2: f64, feed_mm_min: f64 },
    #[error(
        "the bend of the path changes at x {x_mm:.3}, y {y_mm:.3} mm and requires a jerk of {found_mm_s3:.0} mm/s3; \
         the limit of the machine is {limit_mm_s3} mm/s3; lower the feed to {feed_mm_min:.0} mm/min"
    )]
    Jerk { x_mm: f64, y_mm: f64, found_mm_s3: f64, limit_mm_s3: f64, feed_mm_min: f64 },
    #[error(
        "the wheel requires {found_mm:.2} mm to reach the feed, and has {limit_mm:.2} mm before the part; lengthen \
         the overrun, or lower the feed to {feed_mm_min:.0} mm/min"
    )]
    RunUp { found_mm: f64, limit_mm: f64, feed_mm_min: f64 },
    #[error("the path has {points} points, more than {limit}; allow a larger chord error or wider tracks")]
    TooManyPoints { points: u64, limit: u64 },
}

impl PathError {
    /// Returns true only for [`PathError::NotAHeight`]: the surface is too steep or faces away from +z, so this program
    /// cannot plan a path for it. A controller that plans its own path from the correction map may still grind the
    /// part. Returns false for all other errors.
    pub fn is_planning_failure(&self) -> bool {
        matches!(self, Self::NotAHeight { .. })
    }
}
