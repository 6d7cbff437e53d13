//! Along the tracks, point by point: as far from each to the next as the chord error allows.

use super::tilt::{Sag, Stand};
use super::tracks::Span;
use super::{Pattern, ToolPath};
use crate::geometry::Point;

/// Share of the chord error that a step aims at: the deviation is looked at in the middle of a step, and the largest is near it.
const AIM: f64 = 0.8;
/// A step is never shorter than this share of the longest one.
const SHORTEST: f64 = 1e-5;
/// Height above the beginning of a track down to which the wheel comes down rapidly, in millimetres.
const APPROACH_MM: f64 = 1.0;
/// Share of the acceleration that a spiral takes up.
const ACCELERATION_SHARE: f64 = 0.8;

/// A move of the point that a program moves; in the model frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Move {
    /// Rapidly along z alone, in the air.
    RapidZ(f64),
    /// Rapidly in x and y, at the safe height.
    RapidXy([f64; 2]),
    /// Straight at a feed.
    Feed {
        /// Where to, in millimetres.
        at: Point,
        /// How fast.
        feed_mm_min: f64,
    },
    /// Rapidly in x and y, at the safe height, while the head turns.
    RapidTilted {
        /// Where to.
        to_mm: [f64; 2],
        /// How far the head is turned there, right-handed.
        tilt_rad: f64,
    },
    /// Straight at a feed while the head turns in proportion.
    FeedTilted {
        /// Where to, in millimetres; the slides', where the control does not keep the wheel's centre.
        at: Point,
        /// How far the head is turned there, right-handed.
        tilt_rad: f64,
        /// How fast the wheel's centre moves.
        feed_mm_min: f64,
        /// How far it goes, which is not how far the slides go.
        centre_mm: f64,
    },
}

/// The moves of a path. Each point costs two places of the surface; nothing is stored.
#[derive(Clone, Debug)]
pub struct Moves<'a> {
    path: &'a ToolPath,
    /// The next span, and where to stop.
    next: usize,
    end: usize,
    state: State,
    /// How the path bends and where its x and y are, at the last point given.
    pub(super) bend: f64,
    /// Whether the last point given is on the part or its overrun, and so not where the wheel comes down or lifts off.
    pub(super) on_span: bool,
    /// The middle of the step that led to the last point, on the path; none where that began a track, and over the place where a lead begins or ends.
    pub(super) middle: Option<Point>,
    /// How far the wheel's centre has gone to the last point given.
    centre_mm: f64,
}

#[derive(Clone, Copy, Debug)]
enum State {
    Above,
    Over(Walk),
    Down(Walk),
    Begin(Walk),
    Along(Walk),
    Ended,
}

/// The way along one span.
#[derive(Clone, Copy, Debug)]
struct Walk {
    span: Span,
    to: f64,
    t: f64,
    step: f64,
    at: Stand,
}

impl ToolPath {
    /// Returns the moves of the wheel's centre, from the first rapid one to the last.
    pub fn moves(&self) -> Moves<'_> {
        Moves::of(self, 0, self.tracks())
    }

    /// Returns the same moves track by track; each ends at the safe height.
    pub fn moves_by_track(&self) -> Vec<Moves<'_>> {
        (0..self.tracks()).map(|k| Moves::of(self, k, k + 1)).collect()
    }
}

impl<'a> Moves<'a> {
    /// The moves of some of the spans, which begin and end at the safe height.
    pub(super) fn of(path: &'a ToolPath, from: usize, to: usize) -> Self {
        let (state, bend, on_span, middle, centre_mm) = (State::Above, 0.0, false, None, 0.0);
        Self { path, next: from, end: to, state, bend, on_span, middle, centre_mm }
    }

    fn walk(&self, span: Span) -> Walk {
        let (from, to) = span.with_leads(self.path.options());
        let longest = self.path.options().longest_step_mm;
        let step = 0.25 * longest / span.speed_mm(from);
        Walk { span, to, t: from, step, at: self.path.stand(&span, from) }
    }

    /// A move in the model frame.
    #[inline]
    fn upright(&self, given: Move) -> Move {
        let upright = |z| self.path.upright(z);
        match given {
            Move::RapidZ(z) => Move::RapidZ(upright(z)),
            Move::Feed { at, feed_mm_min } => Move::Feed { at: Point::new(at.x, at.y, upright(at.z)), feed_mm_min },
            Move::RapidXy(_) | Move::RapidTilted { .. } | Move::FeedTilted { .. } => given,
        }
    }

    /// Goes on by as much as the chord error allows.
    #[inline]
    fn along(&mut self, mut walk: Walk) -> Walk {
        let path = self.path;
        let options = path.options();
        let (span, left) = (walk.span, walk.to - walk.t);
        let longest = options.longest_step_mm.min(path.grain_mm()) / span.speed_mm(walk.t);
        let mut step = walk.step.min(longest);
        loop {
            // A rest shorter than half a step joins the last one; two even ones are better than a long and a tiny one.
            let whole = step >= left.abs();
            let t = if whole {
                walk.to
            } else if 2.0 * step > left.abs() {
                walk.t + 0.5 * left
            } else {
                walk.t + step * left.signum()
            };
            let taken = (t - walk.t).abs();
            let at = path.stand(&span, t);
            let middle = path.stand(&span, 0.5 * (walk.t + t));
            let Sag { sag, chord, bent } = options.sag_mm(&walk.at, &middle, &at);
            let share = sag / (AIM * options.chord_error_mm);
            if share > 1.0 && taken > SHORTEST * longest {
                step = taken * (0.95 / share.sqrt()).max(0.2);
                continue;
            }
            self.bend = 8.0 * bent / (chord * chord).max(f64::MIN_POSITIVE);
            self.centre_mm = chord;
            let next = taken * (0.95 / share.max(1e-6).sqrt()).clamp(0.5, 2.0);
            let (low, high) = (span.from.min(span.to), span.from.max(span.to));
            self.on_span = low <= walk.t.min(t) && walk.t.max(t) <= high;
            // Where the lead meets the span the path bends anew, and its middle says little of such a step.
            let over_an_end = [low, high].iter().any(|end| walk.t.min(t) < *end && *end < walk.t.max(t));
            self.middle = (!over_an_end).then(|| Point::new(middle.at.x, middle.at.y, path.upright(middle.at.z)));
            walk = Walk { t, at, step: next, ..walk };
            return walk;
        }
    }

    /// The move to a point.
    #[inline]
    fn feed(&self, stand: &Stand) -> Move {
        let (at, feed_mm_min) = (stand.at, self.feed_mm_min());
        match self.path.options().lean {
            None => Move::Feed { at, feed_mm_min },
            Some(_) => Move::FeedTilted { at, tilt_rad: stand.written_rad, feed_mm_min, centre_mm: self.centre_mm },
        }
    }

    /// The rapid move over the first point of a track.
    fn over(&self, walk: &Walk) -> Move {
        let to_mm = [walk.at.at.x, walk.at.at.y];
        match self.path.options().lean {
            None => Move::RapidXy(to_mm),
            Some(_) => Move::RapidTilted { to_mm, tilt_rad: walk.at.written_rad },
        }
    }

    /// The feed at the last point: on a spiral as low as the acceleration asks for, to two digits so that it seldom changes.
    fn feed_mm_min(&self) -> f64 {
        let options = self.path.options();
        let (Pattern::Spiral, Some(limit)) = (options.pattern, options.spiral_acceleration_mm_s2) else {
            return options.feed_mm_min;
        };
        let most = 60.0 * (ACCELERATION_SHARE * limit / self.bend.max(1e-12)).sqrt();
        if most >= options.feed_mm_min {
            return options.feed_mm_min;
        }
        let unit = 10f64.powf(most.log10().floor() - 1.0);
        (most / unit).floor() * unit
    }
}

impl Iterator for Moves<'_> {
    type Item = Move;

    // Not inlined: a call is nothing beside a step along the path, and who writes the moves would compile all of this.
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
                // The wheel may be anywhere before the first move of all.
                if first { (State::Over(walk), Move::RapidZ(safe)) } else { (State::Down(walk), self.over(&walk)) }
            }
            State::Above => (State::Ended, Move::RapidZ(safe)),
            State::Over(walk) => (State::Down(walk), self.over(&walk)),
            State::Down(walk) => (State::Begin(walk), Move::RapidZ((walk.at.at.z + APPROACH_MM).min(safe))),
            State::Begin(walk) => {
                (self.bend, self.on_span, self.middle) = (0.0, false, None);
                self.centre_mm = APPROACH_MM.min(safe - walk.at.at.z);
                (State::Along(walk), self.feed(&walk.at))
            }
            State::Ended => return None,
        };
        let ended = matches!(state, State::Ended);
        self.state = state;
        // The last retreat has been given with the last track.
        if ended { None } else { Some(self.upright(given)) }
    }
}
