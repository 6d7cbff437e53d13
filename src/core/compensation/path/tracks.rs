//! Tracks over x and y: a raster along x, or a spiral from the rim inwards. Tracks are cut where they leave the part.

use std::f64::consts::TAU;

use crate::geometry::Aperture;

use super::PathError;
use super::options::{PathOptions, TrackPattern};

/// Maximum number of tracks of a path.
const MAX_TRACKS: f64 = 1e6;
/// Number of intervals at whose ends a track is tested for being on the part. Shorter pieces of the track can be
/// missed.
const TESTS_PER_TRACK: usize = 720;

/// Track, or a piece of one, on a curve.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Span {
    curve: TrackCurve,
    /// Parameters of the curve at which the track enters and leaves the part with its overrun.
    pub(super) from: f64,
    pub(super) to: f64,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum TrackCurve {
    /// Line along x. The parameter is x, in mm.
    Line { y_mm: f64 },
    /// Spiral r = b |angle|. The parameter is the angle, in rad, which falls to 0 in the middle.
    Spiral { centre_mm: [f64; 2], rise_mm: f64 },
}

/// Tracks of a path, in the order of grinding.
#[derive(Clone, Debug)]
pub(super) struct Tracks {
    pub(super) spans: Vec<Span>,
    pub(super) track_mm: f64,
}

impl Span {
    /// Returns the place `[x, y]` on the track at the parameter `t`, in mm. On a line `t` is x in mm; on a spiral it is
    /// the angle in rad.
    #[inline]
    pub(super) fn place(&self, t: f64) -> [f64; 2] {
        match self.curve {
            TrackCurve::Line { y_mm } => [t, y_mm],
            TrackCurve::Spiral { centre_mm: [x, y], rise_mm } => {
                let (sine, cosine) = t.sin_cos();
                [x + rise_mm * t * cosine, y + rise_mm * t * sine]
            }
        }
    }

    /// Returns the arc length of the curve from the parameter 0 to the parameter `t`, projected onto the xy plane, in
    /// mm. The length is negative if `t` is negative.
    #[inline]
    fn arc_mm(&self, t: f64) -> f64 {
        match self.curve {
            TrackCurve::Line { .. } => t,
            TrackCurve::Spiral { rise_mm, .. } => 0.5 * rise_mm * (t * (1.0 + t * t).sqrt() + t.asinh()),
        }
    }

    /// Returns the derivative of the arc length of the track with respect to the curve parameter, at the parameter `t`.
    /// The arc length is projected onto the xy plane. The unit is mm per mm (1) on a straight track, and mm per rad on
    /// a spiral.
    #[inline]
    pub(super) fn length_per_parameter_mm(&self, t: f64) -> f64 {
        match self.curve {
            TrackCurve::Line { .. } => 1.0,
            TrackCurve::Spiral { rise_mm, .. } => rise_mm * (1.0 + t * t).sqrt(),
        }
    }

    /// Returns the length of the track between the curve parameters `from` and `to`, projected onto the xy plane, in
    /// mm. The length is never negative.
    pub(super) fn length_mm(&self, from: f64, to: f64) -> f64 {
        (self.arc_mm(to) - self.arc_mm(from)).abs()
    }

    /// Returns the curve parameter of the point that is `by_mm` further along the track than the point with the
    /// parameter `t`. The parameter is x in mm on a straight track, and the angle in rad on a spiral.
    ///
    /// `by_mm` is an arc length in mm, projected onto the xy plane. It is positive in the direction of increasing
    /// parameter and can be negative. On a spiral, Newton's method solves for the parameter.
    fn parameter_beyond(&self, t: f64, by_mm: f64) -> f64 {
        match self.curve {
            TrackCurve::Line { .. } => t + by_mm,
            TrackCurve::Spiral { .. } => {
                let wanted = self.arc_mm(t) + by_mm;
                let mut at = t + by_mm / self.length_per_parameter_mm(t);
                for _ in 0..60 {
                    let step = (self.arc_mm(at) - wanted) / self.length_per_parameter_mm(at);
                    at -= step;
                    if step.abs() < 1e-12 * (1.0 + at.abs()) {
                        break;
                    }
                }
                at
            }
        }
    }

    /// Returns two curve parameters of the track: the start of the lead-in and the end of the lead-out. The parameter
    /// is x in mm on a straight track, and the angle in rad on a spiral. In the lead-in the wheel comes down onto the
    /// surface, and in the lead-out it lifts off.
    pub(super) fn with_leads(&self, options: &PathOptions) -> (f64, f64) {
        let ahead = (self.to - self.from).signum() * options.lead_mm;
        (self.parameter_beyond(self.from, -ahead), self.parameter_beyond(self.to, ahead))
    }
}

impl Tracks {
    /// Computes the tracks, raster or spiral, over the outline of the part. `track_mm` is the distance between tracks
    /// in the xy plane, in millimetres. On a raster it is the maximum: the distance is reduced so that a track runs
    /// along each edge.
    ///
    /// # Errors
    /// Returns [`PathError::TooManyTracks`] if the size of the part requires 1e6 tracks or more, or is not a number.
    /// Returns [`PathError::Empty`] if no track is on the part.
    pub(super) fn lay(outline: &Aperture, options: &PathOptions, track_mm: f64) -> Result<Self, PathError> {
        let [low, high] = outline.bounds();
        let size = [high[0] - low[0], high[1] - low[1]];
        let turns = size[1].max(size[0]) / track_mm;
        if turns.is_nan() || turns >= MAX_TRACKS {
            return Err(PathError::TooManyTracks { tracks: turns, track_mm, limit: MAX_TRACKS });
        }
        let tracks = match options.pattern {
            TrackPattern::Raster => raster(outline, options.overrun_mm, track_mm, options.one_way),
            TrackPattern::Spiral => spiral(outline, options.overrun_mm, track_mm),
        };
        if tracks.spans.is_empty() { Err(PathError::Empty) } else { Ok(tracks) }
    }

    /// Returns the distance, in millimetres, by which the wheel is lifted off the surface at the curve parameter `t` of
    /// the track `span`. Returns 0 between the two ends of the track.
    ///
    /// In the leads the distance is s^2 / (2 rho). s is the length from the nearer end of the track to the point at
    /// `t`, projected onto the xy plane. rho is the lead radius of the options.
    #[inline]
    pub(super) fn lift_mm(&self, span: &Span, t: f64, options: &PathOptions) -> f64 {
        let ahead = (span.to - span.from).signum();
        let beyond = if (t - span.from) * ahead < 0.0 {
            span.length_mm(t, span.from)
        } else if (t - span.to) * ahead > 0.0 {
            span.length_mm(t, span.to)
        } else {
            return 0.0;
        };
        beyond * beyond / (2.0 * options.lead_radius_mm)
    }
}

fn raster(outline: &Aperture, overrun_mm: f64, track_mm: f64, one_way: bool) -> Tracks {
    let [[x0, y0], [x1, y1]] = outline.bounds();
    // Equal steps from border to border, so that a track runs along each edge. The factor keeps rounding from adding a
    // step.
    let steps = ((y1 - y0) / track_mm * (1.0 - 1e-9)).ceil().max(1.0);
    let step_mm = (y1 - y0) / steps;
    let mut spans = Vec::new();
    let mut backwards = false;
    for k in 0..=steps as usize {
        let line = Span { curve: TrackCurve::Line { y_mm: y0 + k as f64 * step_mm }, from: 0.0, to: 0.0 };
        let mut pieces = on_part(&line, outline, overrun_mm, x0 - overrun_mm, x1 + overrun_mm);
        if backwards {
            pieces.reverse();
            pieces.iter_mut().for_each(|p| std::mem::swap(&mut p.from, &mut p.to));
        }
        backwards = !backwards && !one_way;
        spans.extend(pieces);
    }
    Tracks { spans, track_mm: step_mm }
}

fn spiral(outline: &Aperture, overrun_mm: f64, track_mm: f64) -> Tracks {
    let [[x0, y0], [x1, y1]] = outline.bounds();
    let centre_mm = [0.5 * (x0 + x1), 0.5 * (y0 + y1)];
    let rim = outline.outline_mm(TESTS_PER_TRACK).into_iter().map(|[x, y]| (x - centre_mm[0]).hypot(y - centre_mm[1]));
    let rim_mm = rim.fold(0.0, f64::max);
    let rise_mm = track_mm / TAU;
    let curve = TrackCurve::Spiral { centre_mm, rise_mm };
    // Start one full turn beyond the rim; `on_part` keeps the pieces within the overrun.
    let outermost = rim_mm / rise_mm + TAU;
    let turns = (outermost / TAU).ceil() as usize;
    let mut spans: Vec<Span> = Vec::new();
    for turn in (0..turns).rev() {
        let (least, most) = (TAU * turn as f64, (TAU * (turn + 1) as f64).min(outermost));
        let whole = Span { curve, from: 0.0, to: 0.0 };
        for piece in on_part(&whole, outline, overrun_mm, least, most).into_iter().rev() {
            match spans.last_mut() {
                Some(last) if (last.to - piece.to).abs() < 1e-9 => last.to = piece.from,
                _ => spans.push(Span { curve, from: piece.to, to: piece.from }),
            }
        }
    }
    Tracks { spans, track_mm }
}

/// Returns the pieces of `curve` that are on the part or at most `overrun_mm` outside its outline. Only the curve
/// parameters from `least` to `most` are searched. The pieces are in ascending order of the parameter. Pieces shorter
/// than 1/720 of this parameter range can be missed.
fn on_part(curve: &Span, outline: &Aperture, overrun_mm: f64, least: f64, most: f64) -> Vec<Span> {
    let inside = |t: f64| {
        let [x, y] = curve.place(t);
        outline.distance_mm(x, y) <= overrun_mm
    };
    let border = |mut a: f64, mut b: f64| {
        let at_a = inside(a);
        for _ in 0..60 {
            let middle = 0.5 * (a + b);
            *(if inside(middle) == at_a { &mut a } else { &mut b }) = middle;
        }
        if at_a { a } else { b }
    };
    let at = |k: usize| least + (most - least) * k as f64 / TESTS_PER_TRACK as f64;
    let mut pieces = Vec::new();
    let mut began = None;
    for k in 0..=TESTS_PER_TRACK {
        match (began, inside(at(k))) {
            (None, true) => began = Some(if k == 0 { at(0) } else { border(at(k - 1), at(k)) }),
            (Some(from), false) => {
                pieces.push(Span { from, to: border(at(k - 1), at(k)), ..*curve });
                began = None;
            }
            _ => {}
        }
    }
    if let Some(from) = began {
        pieces.push(Span { from, to: most, ..*curve });
    }
    pieces.retain(|p| p.to > p.from);
    pieces
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::compensation::path::Wheel;

    fn options() -> PathOptions {
        PathOptions::new(Wheel::Sphere { radius_mm: 10.0 }, 0.5, 600.0)
    }

    #[test]
    fn raster_alternates_edge_to_edge() {
        let part = Aperture::Rectangle { centre_mm: [1.0, 2.0], width_mm: 10.0, height_mm: 6.0 };
        let tracks = Tracks::lay(&part, &options(), 0.5).unwrap();
        assert_eq!((tracks.spans.len(), tracks.track_mm), (13, 0.5));
        let ends = |k: usize| [tracks.spans[k].place(tracks.spans[k].from), tracks.spans[k].place(tracks.spans[k].to)];
        assert!((ends(0)[0][0] + 6.0).abs() < 1e-9 && (ends(0)[1][0] - 8.0).abs() < 1e-9 && ends(0)[0][1] == -1.0);
        assert!((ends(1)[0][0] - 8.0).abs() < 1e-9 && (ends(12)[0][1] - 5.0).abs() < 1e-12);
        let one_way = raster(&part, 2.0, 0.5, true);
        assert!(one_way.spans.iter().all(|s| s.to > s.from));
        assert!(matches!(Tracks::lay(&part, &options(), 1e-9), Err(PathError::TooManyTracks { .. })));
    }

    #[test]
    fn raster_skips_annulus_hole() {
        let part = Aperture::Annulus { centre_mm: [0.0; 2], inner_radius_mm: 5.0, outer_radius_mm: 12.0 };
        let tracks = raster(&part, 1.0, 0.5, false);
        let middle: Vec<_> = tracks.spans.iter().filter(|s| s.place(0.0)[1].abs() < 1e-9).collect();
        assert_eq!(middle.len(), 2);
        assert!((middle[0].place(middle[0].to)[0].abs() - 4.0).abs() < 1e-9, "{middle:?}");
    }

    #[test]
    fn spiral_on_disc_is_one_span() {
        let part = Aperture::Circle { centre_mm: [3.0, 0.0], radius_mm: 8.0 };
        let tracks = spiral(&part, 2.0, 0.5);
        assert_eq!(tracks.spans.len(), 1);
        let span = tracks.spans[0];
        let r = |t: f64| (span.place(t)[0] - 3.0).hypot(span.place(t)[1]);
        assert!((r(span.from) - 8.5).abs() < 0.01 && r(span.to) == 0.0);
        assert!((r(span.from) - r(span.from - TAU) - 0.5).abs() < 1e-9);
        let (first, last) = span.with_leads(&options());
        assert!(
            (span.length_mm(first, span.from) - 2.0).abs() < 1e-9 && (span.length_mm(last, span.to) - 2.0).abs() < 1e-9
        );
        assert!((tracks.lift_mm(&span, last, &options()) - 0.4).abs() < 1e-9);
    }
}
