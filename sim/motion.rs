//! Motion of a wheel: points with their feeds, joined by lines and arcs.

use crate::vector::distance;

/// Arc, the same for every control: about a centre in a plane of two axes, while the third axis moves in proportion to
/// the angle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CircularArc {
    /// The two axes of the plane, and the axis normal to it.
    axes: [usize; 3],
    centre_mm: [f64; 2],
    /// Angle of the arc; positive is counter-clockwise, from the first axis to the second.
    sweep_rad: f64,
}

impl CircularArc {
    /// Computes the circular arc from the first position to the second, both in mm. `axes` are three axis indices, from
    /// 0 to 2: the first two axes span the plane of the arc, and the third axis is normal to the plane. `centre_mm` is
    /// the centre of the arc, in mm along the first two axes. If `clockwise` is true, the arc turns from the second
    /// axis towards the first.
    ///
    /// `takes_mm` is a tolerance of the control: the maximum difference, in mm, between the radius at the start and the
    /// radius at the end.
    ///
    /// # Errors
    /// Returns an error if the two radii differ by more than `takes_mm`, if the radius at the start is 0, or if the arc
    /// has no length. A full circle is refused too, because its two ends are the same point.
    pub fn new(
        axes: [usize; 3],
        [from, to]: [[f64; 3]; 2],
        centre_mm: [f64; 2],
        clockwise: bool,
        takes_mm: f64,
    ) -> Result<Self, String> {
        let arm = |at: [f64; 3]| [0, 1].map(|k| at[axes[k]] - centre_mm[k]);
        let (begin, end) = (arm(from), arm(to));
        let [r, q] = [begin, end].map(|[u, v]| u.hypot(v));
        // NaN is refused too.
        if !((r - q).abs() <= takes_mm && r > 0.0) {
            return Err(format!("the radius is {r} mm where the arc begins and {q} mm where it ends"));
        }
        let counter = (end[1].atan2(end[0]) - begin[1].atan2(begin[0])).rem_euclid(std::f64::consts::TAU);
        let sweep_rad = if clockwise { counter - std::f64::consts::TAU } else { counter };
        if counter == 0.0 {
            return Err("the arc ends where it begins".into());
        }
        Ok(Self { axes, centre_mm, sweep_rad })
    }

    /// Returns the position in mm on the arc from `from` to `to`, after the fraction `share` (0 to 1) of the angle of
    /// the arc. Along the axis normal to the plane of the arc, the position changes linearly with `share`.
    fn position_at(&self, from: [f64; 3], to: [f64; 3], share: f64) -> [f64; 3] {
        let [a, b, c] = self.axes;
        let (u, v) = (from[a] - self.centre_mm[0], from[b] - self.centre_mm[1]);
        let (sine, cosine) = (share * self.sweep_rad).sin_cos();
        let mut at = from;
        at[a] = self.centre_mm[0] + u * cosine - v * sine;
        at[b] = self.centre_mm[1] + u * sine + v * cosine;
        at[c] = from[c] + share * (to[c] - from[c]);
        at
    }

    fn radius_mm(&self, from: [f64; 3]) -> f64 {
        (from[self.axes[0]] - self.centre_mm[0]).hypot(from[self.axes[1]] - self.centre_mm[1])
    }

    /// Returns the number of chords (straight lines between points of the arc) that replace the arc. `from` is the
    /// start of the arc in mm. `within_mm` is the maximum deviation of a chord from the arc, in mm. The number is
    /// limited to 1 000 000.
    fn chords(&self, from: [f64; 3], within_mm: f64) -> usize {
        let each = (8.0 * within_mm / self.radius_mm(from)).sqrt();
        (self.sweep_rad.abs() / each).ceil().clamp(1.0, 1e6) as usize
    }
}

/// End of a move.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Waypoint {
    /// Position in mm; NaN along an axis that has not been programmed yet.
    pub at_mm: [f64; 3],
    /// Angle in degrees, on the scale of the rotary axis; `None` if none has been programmed yet.
    pub rotary_deg: Option<f64>,
    /// Feed in mm/min; `None` for a rapid move. For a move with a programmed time, the speed of the slides.
    pub feed_mm_min: Option<f64>,
    /// Time of the move in minutes, if it is programmed.
    pub minutes: Option<f64>,
    /// Arc of the move; `None` for a straight move.
    pub arc: Option<CircularArc>,
}

impl Waypoint {
    /// Returns the position on the move after the fraction `share` of its length, from 0 to 1. The move begins at
    /// `from_mm`.
    pub fn position_at(&self, from_mm: [f64; 3], share: f64) -> [f64; 3] {
        match &self.arc {
            Some(turn) => turn.position_at(from_mm, self.at_mm, share),
            None => std::array::from_fn(|k| from_mm[k] + share * (self.at_mm[k] - from_mm[k])),
        }
    }

    /// Returns the length of the move that begins at `from_mm`, in mm.
    pub fn length_mm(&self, from_mm: [f64; 3]) -> f64 {
        match &self.arc {
            Some(turn) => {
                let across = turn.axes[2];
                (turn.radius_mm(from_mm) * turn.sweep_rad).hypot(self.at_mm[across] - from_mm[across])
            }
            None => distance(from_mm, self.at_mm),
        }
    }

    /// Replaces this move by straight moves, and returns the end points of these straight moves in mm. The move begins
    /// at `from_mm`. The straight moves deviate from this move by at most `within_mm`, in mm. For a move that is
    /// already straight, returns only its end point.
    pub fn in_chords(&self, from_mm: [f64; 3], within_mm: f64) -> Vec<[f64; 3]> {
        let count = self.arc.as_ref().map_or(1, |turn| turn.chords(from_mm, within_mm));
        let inner = (1..count).map(|k| self.position_at(from_mm, k as f64 / count as f64));
        inner.chain([self.at_mm]).collect()
    }
}
