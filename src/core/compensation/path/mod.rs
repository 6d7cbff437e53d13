//! From the surface wanted to the way of the wheel: tracks over the part, the wheel's centre along them, and what must hold
//! before a program is made of it.
//!
//! ```text
//!  Nominal --height_of--> Field --+
//!                                 +-- Wanted (points, normals of the corrected surface) --ToolPath--> Moves --> a program
//!  Correction --spline--> Field --+                 Wheel (where its centre must be)  --/      \--> Summary, checked against limits
//! ```
//!
//! Pure. Frame: everything is in the model frame {M}, z away from the part. Units: mm, s, rad; feeds are mm/min. A path is never
//! held in memory: it is a list of tracks and an iterator over their points.

mod axis_table;
mod check;
mod error;
mod field;
mod nominal;
mod tracks;
mod walk;
mod wanted;
mod wheel;

pub use axis_table::axis_offsets;
pub use check::{Limits, Peak, Summary};
pub use error::PathError;
pub use field::{Field, Jet};
pub use nominal::height_of;
pub use tracks::{Pattern, TrackSpacing};
pub use walk::{Move, Moves};
pub use wanted::{Bend, Contact, Wanted, displaced, spline_of};
pub use wheel::Wheel;

use crate::geometry::{Aperture, Point};
use tracks::{Span, Tracks};

/// How a path is laid.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PathOptions {
    /// The wheel.
    pub wheel: Wheel,
    /// How the tracks run.
    pub pattern: Pattern,
    /// How far apart they are.
    pub spacing: TrackSpacing,
    /// How far the straight lines between points may be from the path of the wheel's centre, in millimetres.
    pub chord_error_mm: f64,
    /// Longest distance of two points, over x and y, in millimetres.
    pub longest_step_mm: f64,
    /// How far tracks go on beyond the edge of the part, on the tangent of the surface, in millimetres.
    pub overrun_mm: f64,
    /// How long the wheel takes, beyond that, to come down and to lift off, over x and y, in millimetres.
    pub lead_mm: f64,
    /// Radius of the curve on which it comes down and lifts off, in millimetres.
    pub lead_radius_mm: f64,
    /// How far above the highest point of the path the wheel travels, in millimetres.
    pub safe_height_mm: f64,
    /// Feed of the wheel's centre along the path.
    pub feed_mm_min: f64,
    /// On a spiral the feed is lowered towards the middle so that this acceleration is kept, in mm/s2.
    pub spiral_acceleration_mm_s2: Option<f64>,
}

impl PathOptions {
    /// Options with a chord error of 0.1 um and room for an ordinary machine.
    pub fn new(wheel: Wheel, track_mm: f64, feed_mm_min: f64) -> Self {
        Self {
            wheel,
            pattern: Pattern::Raster { one_way: false },
            spacing: TrackSpacing::Distance(track_mm),
            chord_error_mm: 1e-4,
            longest_step_mm: 1.0,
            overrun_mm: 2.0,
            lead_mm: 2.0,
            lead_radius_mm: 5.0,
            safe_height_mm: 10.0,
            feed_mm_min,
            spiral_acceleration_mm_s2: None,
        }
    }
}

/// Tracks on which the highest place is looked for.
const SOME_TRACKS: usize = 200;

/// The way of a wheel over a part, point by point when it is asked for.
#[derive(Clone, Debug)]
pub struct ToolPath {
    wanted: Wanted,
    outline: Aperture,
    options: PathOptions,
    tracks: Tracks,
    safe_z_mm: f64,
    grain_mm: f64,
}

impl ToolPath {
    /// Lays tracks over a part.
    ///
    /// Checked are the options, and whether the wheel fits the surface: its slope, its hollows in every direction, and whether the body
    /// of the wheel touches the part elsewhere. Travel, speed and acceleration are checked by [`Summary::check`].
    ///
    /// # Errors
    /// Options that make no path, and a wheel that does not fit, each with place, value, limit and remedy.
    pub fn new(wanted: Wanted, outline: Aperture, options: PathOptions) -> Result<Self, PathError> {
        check::options(&options)?;
        let track_mm = check::fit(&wanted, &outline, &options)?;
        let tracks = Tracks::lay(&outline, &options, track_mm)?;
        let grain_mm = wanted.grain_mm();
        let mut path = Self { wanted, outline, options, tracks, safe_z_mm: f64::INFINITY, grain_mm };
        path.safe_z_mm = path.highest_mm()? + options.safe_height_mm;
        check::body(&path)?;
        Ok(path)
    }

    /// Returns the moves of the wheel's centre, from the first rapid one to the last.
    pub fn moves(&self) -> Moves<'_> {
        Moves::new(self)
    }

    /// Returns the same moves track by track; each ends at the safe height.
    pub fn moves_by_track(&self) -> Vec<Moves<'_>> {
        (0..self.tracks()).map(|k| Moves::of(self, k, k + 1)).collect()
    }

    /// Returns the distance of the tracks over x and y, in millimetres.
    pub fn track_mm(&self) -> f64 {
        self.tracks.track_mm
    }

    /// Returns the number of tracks, or of pieces of them where they leave the part.
    pub fn tracks(&self) -> usize {
        self.tracks.spans.len()
    }

    /// Returns the height at which the wheel travels, in millimetres.
    pub fn safe_z_mm(&self) -> f64 {
        self.safe_z_mm
    }

    /// Nothing of the surface is finer than this, in millimetres.
    fn grain_mm(&self) -> f64 {
        self.grain_mm
    }

    /// Returns how the path was laid.
    pub fn options(&self) -> &PathOptions {
        &self.options
    }

    /// Returns the surface that it leaves.
    pub fn wanted(&self) -> &Wanted {
        &self.wanted
    }

    /// Returns the outline of the part.
    pub fn outline(&self) -> &Aperture {
        &self.outline
    }

    /// Returns where the wheel's centre is at a place of a track; NaN where a rim cannot touch, which [`ToolPath::new`] has refused.
    #[inline]
    fn centre(&self, span: &Span, t: f64) -> Point {
        let contact = self.wanted.at(span.place(t));
        let lifted = self.tracks.lift_mm(span, t, &self.options);
        match self.options.wheel.centre(&contact) {
            Some(centre) if lifted > 0.0 => centre + contact.normal * lifted,
            Some(centre) => centre,
            None => Point::new(f64::NAN, f64::NAN, f64::NAN),
        }
    }

    /// The highest place of the centre, looked for a millimetre apart on some of the tracks: the height of travel has room above it.
    fn highest_mm(&self) -> Result<f64, PathError> {
        use rayon::prelude::*;
        let highest = |span: &Span| {
            let (from, to) = span.with_leads(&self.options);
            let count = (span.length_mm(from, to).ceil() as usize).clamp(8, 20_000);
            (0..=count)
                .map(|k| from + (to - from) * k as f64 / count as f64)
                .map(|t| (self.centre(span, t).z, t))
                .try_fold(
                    f64::NEG_INFINITY,
                    |most, (z, t)| if z.is_finite() { Ok(most.max(z)) } else { Err(span.place(t)) },
                )
        };
        let spans = &self.tracks.spans;
        let some = spans.len().div_ceil(SOME_TRACKS).max(1);
        let chosen = spans.par_iter().step_by(some).chain(spans.par_iter().rev().take(1));
        let heights: Vec<Result<f64, [f64; 2]>> = chosen.map(highest).collect();
        heights
            .into_iter()
            .try_fold(f64::NEG_INFINITY, |most, one| one.map(|z| most.max(z)))
            .map_err(|[x_mm, y_mm]| PathError::CannotTouch { x_mm, y_mm })
    }
}
