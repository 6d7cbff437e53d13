//! Moves along the tracks, point by point. Each step is as long as the chord error allows.

use super::tilt::{StepDeviation, WheelPosition};
use super::tracks::Span;
use super::{ToolPath, TrackPattern};
use crate::geometry::Point;

/// Target of a step's deviation, as a share of the chord error. The deviation is evaluated in the middle of a step;
/// its maximum is near the middle and can be a little larger.
const AIM: f64 = 0.8;
/// Limit below which a step is not shortened further, as a share of the longest step.
const MIN_STEP_SHARE: f64 = 1e-5;
/// Height above the start of a track at which the rapid move down ends, in millimetres.
const APPROACH_MM: f64 = 1.0;
/// Share of the acceleration limit that a spiral uses.
const ACCELERATION_SHARE: f64 = 0.8;

/// Move of the programmed point, in the model frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Move {
    /// Rapid move along z alone, in the air, to this height in millimetres.
    RapidZ(f64),
    /// Rapid move in x and y, at the safe height, to this place in millimetres.
    RapidXy([f64; 2]),
    /// Straight move at a feed.
    Feed {
        /// End point, in millimetres.
        to: Point,
        /// Feed of the wheel's centre.
        feed_mm_min: f64,
    },
    /// Rapid move in x and y, at the safe height, while the head rotates.
    RapidTilted {
        /// End place in x and y.
        to_mm: [f64; 2],
        /// Tilt of the head at the end, right-handed, in rad.
        tilt_rad: f64,
    },
    /// Straight move at a feed while the head rotates in proportion.
    FeedTilted {
        /// End point, in millimetres: of the wheel's centre if the control compensates the pivot, otherwise of the
        /// slides.
        to: Point,
        /// Tilt of the head at the end, right-handed, in rad.
        tilt_rad: f64,
        /// Feed of the wheel's centre.
        feed_mm_min: f64,
        /// Distance that the wheel's centre moves. The slides move a different distance.
        centre_mm: f64,
    },
}

/// Iterator over the moves of a path. Each point needs at least two evaluations of the surface. No moves are stored.
#[derive(Clone, Debug)]
pub struct Moves<'a> {
    path: &'a ToolPath,
    /// Index of the next span, and index at which to stop.
    next: usize,
    end: usize,
    state: State,
    /// Curvature of the path at the last point returned, in 1/mm.
    pub(super) curvature_per_mm: f64,
    /// True if the step to the last point returned is on the part or its overrun. False in a lead-in or lead-out.
    pub(super) on_span: bool,
    /// Point of the path in the middle of the step to the last point. `None` for the first point of a track, and for a
    /// step across the place where a lead and the span meet.
    pub(super) middle: Option<Point>,
    /// Distance that the wheel's centre moved to the last point returned, in mm.
    centre_mm: f64,
}

#[derive(Clone, Copy, Debug)]
enum State {
    Above,
    Over(SpanWalk),
    Down(SpanWalk),
    Begin(SpanWalk),
    Along(SpanWalk),
    Ended,
}

/// State of the walk along one span.
#[derive(Clone, Copy, Debug)]
struct SpanWalk {
    span: Span,
    to: f64,
    t: f64,
    step: f64,
    at: WheelPosition,
}

impl ToolPath {
    /// Returns an iterator over all moves of the path. The first and the last move are rapid moves to the safe height.
    pub fn moves(&self) -> Moves<'_> {
        Moves::new(self, 0, self.track_count())
    }

    /// Returns one iterator over moves for each track. The moves of a track end with a rapid move to the safe height.
    pub fn moves_by_track(&self) -> Vec<Moves<'_>> {
        (0..self.track_count()).map(|k| Moves::new(self, k, k + 1)).collect()
    }
}

impl<'a> Moves<'a> {
    /// Returns an iterator over the moves of the tracks with the indices `from..to`. The moves end at the safe height.
    pub(super) fn new(path: &'a ToolPath, from: usize, to: usize) -> Self {
        let (state, bend, on_span, middle, centre_mm) = (State::Above, 0.0, false, None, 0.0);
        Self { path, next: from, end: to, state, curvature_per_mm: bend, on_span, middle, centre_mm }
    }

    fn walk(&self, span: Span) -> SpanWalk {
        let (from, to) = span.with_leads(self.path.options());
        let longest = self.path.options().max_step_mm;
        let step = 0.25 * longest / span.length_per_parameter_mm(from);
        SpanWalk { span, to, t: from, step, at: self.path.wheel_position(&span, from) }
    }

    /// Converts the move `given` into the model frame. If the wheel grinds the part from below (from -z), the path is
    /// planned mirrored in z, so the z of the move changes its sign. If the wheel grinds from above, the move is
    /// unchanged.
    #[inline]
    fn to_model_frame(&self, given: Move) -> Move {
        let upright = |z| self.path.flipped_height_mm(z);
        match given {
            Move::RapidZ(z) => Move::RapidZ(upright(z)),
            Move::Feed { to: at, feed_mm_min } => Move::Feed { to: Point::new(at.x, at.y, upright(at.z)), feed_mm_min },
            Move::RapidXy(_) | Move::RapidTilted { .. } | Move::FeedTilted { .. } => given,
        }
    }

    /// Advances `walk`, the current position on a track, by one step. The step is as long as three limits allow: the
    /// chord error (the distance between the straight step and the curved path), the maximum step of the options, and
    /// the node spacing of the target surface.
    ///
    /// Returns the new position, together with the length of the step to try next.
    #[inline]
    fn along(&mut self, mut walk: SpanWalk) -> SpanWalk {
        let path = self.path;
        let options = path.options();
        let (span, left) = (walk.span, walk.to - walk.t);
        let longest = options.max_step_mm.min(path.min_node_spacing_mm()) / span.length_per_parameter_mm(walk.t);
        let mut step = walk.step.min(longest);
        loop {
            // If less than two steps remain, divide the rest into two equal steps: a long and a tiny step are worse.
            let whole = step >= left.abs();
            let t = if whole {
                walk.to
            } else if 2.0 * step > left.abs() {
                walk.t + 0.5 * left
            } else {
                walk.t + step * left.signum()
            };
            let taken = (t - walk.t).abs();
            let at = path.wheel_position(&span, t);
            let middle = path.wheel_position(&span, 0.5 * (walk.t + t));
            let StepDeviation { sag_mm: sag, chord_mm: chord, slide_sag_mm: bent } =
                options.step_deviation(&walk.at, &middle, &at);
            let share = sag / (AIM * options.chord_error_mm);
            if share > 1.0 && taken > MIN_STEP_SHARE * longest {
                step = taken * (0.95 / share.sqrt()).max(0.2);
                continue;
            }
            self.curvature_per_mm = 8.0 * bent / (chord * chord).max(f64::MIN_POSITIVE);
            self.centre_mm = chord;
            let next = taken * (0.95 / share.max(1e-6).sqrt()).clamp(0.5, 2.0);
            let (low, high) = (span.from.min(span.to), span.from.max(span.to));
            self.on_span = low <= walk.t.min(t) && walk.t.max(t) <= high;
            // The curvature jumps where a lead meets the span. The middle does not represent a step across that place.
            let over_an_end = [low, high].iter().any(|end| walk.t.min(t) < *end && *end < walk.t.max(t));
            self.middle = (!over_an_end).then(|| {
                Point::new(
                    middle.programmed_point.x,
                    middle.programmed_point.y,
                    path.flipped_height_mm(middle.programmed_point.z),
                )
            });
            walk = SpanWalk { t, at, step: next, ..walk };
            return walk;
        }
    }

    /// Returns the move at feed to the position `stand` of the wheel; with a tilt if the head rotates.
    #[inline]
    fn feed(&self, stand: &WheelPosition) -> Move {
        let (at, feed_mm_min) = (stand.programmed_point, self.feed_mm_min());
        match self.path.options().tilt {
            None => Move::Feed { to: at, feed_mm_min },
            Some(_) => {
                Move::FeedTilted { to: at, tilt_rad: stand.programmed_tilt_rad, feed_mm_min, centre_mm: self.centre_mm }
            }
        }
    }

    /// Returns the rapid move in x and y, at the safe height, that ends above the current point of `walk`: the start of
    /// the next track. The move includes the tilt angle if the path tilts the wheel.
    fn over(&self, walk: &SpanWalk) -> Move {
        let to_mm = [walk.at.programmed_point.x, walk.at.programmed_point.y];
        match self.path.options().tilt {
            None => Move::RapidXy(to_mm),
            Some(_) => Move::RapidTilted { to_mm, tilt_rad: walk.at.programmed_tilt_rad },
        }
    }

    /// Returns the feed for the current point of the path, in mm/min.
    ///
    /// This is the feed of the options, except on a spiral with an acceleration limit a. There the feed is at most (0.8
    /// a / k)^(1/2), where k is the curvature of the path. A reduced feed is rounded down to two significant digits, so
    /// that the feed seldom changes.
    fn feed_mm_min(&self) -> f64 {
        let options = self.path.options();
        let (TrackPattern::Spiral, Some(limit)) = (options.pattern, options.spiral_acceleration_mm_s2) else {
            return options.feed_mm_min;
        };
        let most = 60.0 * (ACCELERATION_SHARE * limit / self.curvature_per_mm.max(1e-12)).sqrt();
        if most >= options.feed_mm_min {
            return options.feed_mm_min;
        }
        let unit = 10f64.powf(most.log10().floor() - 1.0);
        (most / unit).floor() * unit
    }
}

impl Iterator for Moves<'_> {
    type Item = Move;

    // Not inlined: the cost of a call is small compared with a step, and every user of the moves would otherwise
    // compile all of this.
    fn next(&mut self) -> Option<Move> {
        let safe = self.path.travel_mm();
        let (state, given) = match self.state {
            State::Along(walk) if walk.t != walk.to => {
                let walk = self.along(walk);
                (State::Along(walk), self.feed(&walk.at))
            }
            State::Along(_) => (State::Above, Move::RapidZ(safe)),
            State::Above if self.next < self.end => {
                let walk = self.walk(self.path.tracks.spans[self.next]);
                let first = self.next == 0;
                self.next += 1;
                // Before the first move of the path the wheel can be anywhere.
                if first { (State::Over(walk), Move::RapidZ(safe)) } else { (State::Down(walk), self.over(&walk)) }
            }
            State::Above => (State::Ended, Move::RapidZ(safe)),
            State::Over(walk) => (State::Down(walk), self.over(&walk)),
            State::Down(walk) => {
                (State::Begin(walk), Move::RapidZ((walk.at.programmed_point.z + APPROACH_MM).min(safe)))
            }
            State::Begin(walk) => {
                (self.curvature_per_mm, self.on_span, self.middle) = (0.0, false, None);
                self.centre_mm = APPROACH_MM.min(safe - walk.at.programmed_point.z);
                (State::Along(walk), self.feed(&walk.at))
            }
            State::Ended => return None,
        };
        let ended = matches!(state, State::Ended);
        self.state = state;
        // The last track already returned the last retreat.
        if ended { None } else { Some(self.to_model_frame(given)) }
    }
}
