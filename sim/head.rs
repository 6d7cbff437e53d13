//! Head that turns the wheel about one axis: position of the wheel's centre from the positions of the slides and the
//! scale of the axis.
//!
//! ```text
//!  pivot = slides + v          v: from the wheel's centre to the pivot with the head upright
//!  centre = pivot - R v        R: the turn, about x for an A, about y for a B
//! ```
//!
//! A control that keeps the wheel's centre computes the same with its own parameters: the centre is then where the
//! program says.

use crate::Vec3;
use crate::motion::Waypoint;

/// Rotary head.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Head {
    /// Letter of its axis in programs.
    pub letter: char,
    /// True if its scale counts left-handed.
    pub left_handed: bool,
    /// Lower and upper limit of the angle on its scale.
    pub range_deg: [f64; 2],
    /// Vector from the wheel's centre to the pivot with the head upright, if the control moves only the slides.
    pub pivot_mm: Option<Vec3>,
}

impl Head {
    /// Returns the centre of the wheel in mm after the head has turned about its pivot. `slides_mm` is the position of
    /// the linear slides; with the head upright, this is the centre of the wheel. `scale_deg` is the angle in degrees
    /// on the scale of the head.
    ///
    /// The field `pivot_mm` of the head is the vector from the wheel's centre to the pivot with the head upright. If
    /// `pivot_mm` is `None`, the control itself compensates the rotation, and the centre is at `slides_mm`.
    pub fn centre_mm(&self, slides_mm: Vec3, scale_deg: f64) -> Vec3 {
        let Some([u, v, w]) = self.pivot_mm else { return slides_mm };
        let angle = if self.left_handed { -scale_deg } else { scale_deg }.to_radians();
        let (s, c) = (angle.sin(), angle.cos());
        let arm =
            if self.letter == 'A' { [u, c * v - s * w, s * v + c * w] } else { [c * u + s * w, v, c * w - s * u] };
        let pivot = [slides_mm[0] + u, slides_mm[1] + v, slides_mm[2] + w];
        std::array::from_fn(|k| pivot[k] - arm[k])
    }

    /// Returns the centre of the wheel in mm during the move from `from` to `to`. `share` is the completed fraction of
    /// the move, from 0 to 1. The slides follow the line or arc of the move. The angle of the head changes linearly
    /// with `share`.
    pub fn centre_on_move_mm(&self, from: &Waypoint, to: &Waypoint, share: f64) -> Vec3 {
        let slides = to.position_at(from.at_mm, share);
        let ends = from.rotary_deg.or(to.rotary_deg).zip(to.rotary_deg);
        ends.map_or(slides, |(a, b)| self.centre_mm(slides, a + share * (b - a)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn head_centre_matches_hand_calculation() {
        let head = |letter, left_handed| Head {
            letter,
            left_handed,
            range_deg: [-90.0, 90.0],
            pivot_mm: Some([0.0, 0.0, 200.0]),
        };
        let close = |a: Vec3, b: Vec3| assert!((0..3).all(|k| (a[k] - b[k]).abs() < 1e-9), "{a:?} {b:?}");
        // The pivot stays. The wheel below it swings to -x when B turns right-handed, and to +y when A does.
        close(head('B', false).centre_mm([0.0; 3], 90.0), [-200.0, 0.0, 200.0]);
        close(head('A', false).centre_mm([0.0; 3], 90.0), [0.0, 200.0, 200.0]);
        close(head('B', true).centre_mm([1.0, 2.0, 3.0], -90.0), [-199.0, 2.0, 203.0]);
        close(head('B', false).centre_mm([1.0, 2.0, 3.0], 0.0), [1.0, 2.0, 3.0]);
    }
}
