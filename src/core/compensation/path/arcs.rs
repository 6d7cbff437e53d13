//! Arcs in place of straight lines: from each point of a track on, the longest arc that is within a tolerance of the path.
//!
//! ```text
//!  Moves --middle of each step--> window of points --longest--> Arc, or the lines as they were
//! ```
//!
//! An arc runs in a plane of two axes, and the third may move along evenly with its angle. It is judged as it will be written: both ends and the
//! centre in whole steps of the last digit, between them the path's own points and the middle of every step between those.

use std::collections::VecDeque;

use rayon::prelude::*;

use super::{Move, Moves, ToolPath};
use crate::geometry::{Point, Vector};

/// Points that one arc is looked for among.
const WINDOW: usize = 1024;
/// Largest half chord as a share of the centre's distance from it: a quarter of a turn, so that no control can take the longer way round.
const WIDEST: f64 = 1.0;
/// Largest way of the third axis as a share of the chord. Some controls have the feed in the plane, some along the whole way: 0.5 % apart at most.
const STEEPEST: f64 = 0.1;

/// The plane of arcs: its first and second axis, and the one across; turning from the first to the second is counter-clockwise.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Plane(pub [usize; 3]);

impl Plane {
    /// Of x and y.
    pub const XY: Self = Self([0, 1, 2]);
    /// Of z and x.
    pub const ZX: Self = Self([2, 0, 1]);
    /// Of y and z.
    pub const YZ: Self = Self([1, 2, 0]);
}

/// What arcs must keep to.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ArcOptions {
    /// How far they may be from the path of the wheel's centre, in millimetres.
    pub within_mm: f64,
    /// Steps of the last digit that is written in a millimetre.
    pub per_mm: f64,
    /// How much the radius at the end may differ from that at the beginning, in millimetres.
    pub radius_error_mm: f64,
    /// Largest coordinate of a centre, and its largest distance from the beginning, in millimetres.
    pub largest_mm: f64,
    /// Whether the third axis may move along.
    pub helix: bool,
    /// An arc stands for so many lines at least.
    pub least_lines: usize,
}

/// An arc at a feed, from where the move before it ended.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Arc {
    /// The plane that it turns in.
    pub plane: Plane,
    /// Whether it turns from the second axis of the plane to the first.
    pub clockwise: bool,
    /// Where to, in millimetres, in the model frame.
    pub to: Point,
    /// The centre along the two axes of the plane, in whole steps.
    pub centre_mm: [f64; 2],
    /// How fast.
    pub feed_mm_min: f64,
    /// How far it is from the path of the wheel's centre at most.
    pub deviation_mm: f64,
}

/// What a program says in one block, or in two that belong together.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Block {
    /// A move along a line.
    Straight(Move),
    /// An arc.
    Arc(Arc),
}

impl From<Move> for Block {
    fn from(one: Move) -> Self {
        Self::Straight(one)
    }
}

/// A path in arcs, beside the same path in lines.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ArcSummary {
    /// Moves, arcs and rapid ones included.
    pub moves: u64,
    /// Arcs.
    pub arcs: u64,
    /// Lines at feed that are left.
    pub lines: u64,
    /// How far an arc is from the path of the wheel's centre at most, in millimetres.
    pub deviation_mm: f64,
    /// Largest angle between the end of one move at feed and the beginning of the next: in arcs, and in lines.
    pub corner_rad: [f64; 2],
}

impl ToolPath {
    /// Returns the moves of the wheel's centre track by track, in arcs where points can be put together.
    ///
    /// Frame: model. Units: mm, mm/min.
    pub fn arcs_by_track(&self, options: &ArcOptions) -> Vec<Arcs<Sampled<'_>>> {
        self.moves_by_track().into_iter().map(|moves| Arcs::new(Sampled(moves), options)).collect()
    }

    /// Puts the whole path into arcs once, all tracks at the same time, and counts what comes of it.
    pub fn arc_summary(&self, options: &ArcOptions) -> ArcSummary {
        let one = |k: usize| {
            let mut one = ArcSummary::default();
            let moves = || Moves::of(self, k, k + 1);
            corners(Arcs::new(Sampled(moves()), options), |block, corner| one.take(block, corner));
            corners(moves().map(Block::from), |_, corner| one.corner_rad[1] = one.corner_rad[1].max(corner));
            one
        };
        (0..self.tracks()).into_par_iter().map(one).reduce(ArcSummary::default, ArcSummary::and)
    }
}

impl ArcSummary {
    fn take(&mut self, block: &Block, corner: f64) {
        self.moves += 1;
        self.corner_rad[0] = self.corner_rad[0].max(corner);
        match block {
            Block::Arc(arc) => {
                self.arcs += 1;
                self.deviation_mm = self.deviation_mm.max(arc.deviation_mm);
            }
            Block::Straight(Move::Feed { .. }) => self.lines += 1,
            Block::Straight(_) => {}
        }
    }

    fn and(self, other: Self) -> Self {
        Self {
            moves: self.moves + other.moves,
            arcs: self.arcs + other.arcs,
            lines: self.lines + other.lines,
            deviation_mm: self.deviation_mm.max(other.deviation_mm),
            corner_rad: [0, 1].map(|k| self.corner_rad[k].max(other.corner_rad[k])),
        }
    }
}

/// The moves of a path, each with the middle of its step; one that has none stays a line.
#[derive(Clone, Debug)]
pub struct Sampled<'a>(Moves<'a>);

impl Iterator for Sampled<'_> {
    type Item = (Move, Option<Point>);

    fn next(&mut self) -> Option<Self::Item> {
        let one = self.0.next()?;
        Some((one, self.0.middle))
    }
}

/// A point of the path, the middle of the step that led to it, and the feed.
#[derive(Clone, Copy, Debug)]
struct Sample {
    middle: Point,
    at: Point,
    feed_mm_min: f64,
}

/// The moves of a path, in arcs where points can be put together.
#[derive(Clone, Debug)]
pub struct Arcs<S> {
    source: S,
    options: ArcOptions,
    /// Where the last block ended.
    from: Point,
    window: VecDeque<Sample>,
    /// So many points of the window stay lines.
    lines: usize,
    /// What comes after the window.
    after: Option<Move>,
}

impl<S: Iterator<Item = (Move, Option<Point>)>> Arcs<S> {
    fn new(source: S, options: &ArcOptions) -> Self {
        let (from, window) = (Point::origin(), VecDeque::new());
        Self { source, options: *options, from, window, lines: 0, after: None }
    }

    fn fill(&mut self) {
        while self.window.len() < WINDOW && self.after.is_none() {
            match self.source.next() {
                Some((Move::Feed { at, feed_mm_min }, Some(middle))) => {
                    self.window.push_back(Sample { middle, at, feed_mm_min });
                }
                Some((other, _)) => self.after = Some(other),
                None => break,
            }
        }
    }

    /// The longest arc from here on with how many points it takes; none, with how many points stay lines.
    fn longest(&mut self) -> (usize, Option<Arc>) {
        let least = self.options.least_lines.max(2);
        let from = self.from;
        let window = self.window.make_contiguous();
        let feed = window[0].feed_mm_min;
        let most = window.iter().take_while(|sample| sample.feed_mm_min == feed).count();
        if most < least {
            return (most, None);
        }
        let fit = |count: usize| fit(from, &window[..count], &self.options);
        let mut found = match fit(least) {
            Fit::Not => return (1, None),
            found => (least, found),
        };
        let mut beyond = most + 1;
        while 2 * found.0 < beyond {
            match fit(2 * found.0) {
                Fit::Not => beyond = 2 * found.0,
                better => found = (2 * found.0, better),
            }
        }
        while beyond - found.0 > 1 {
            let count = usize::midpoint(found.0, beyond);
            match fit(count) {
                Fit::Not => beyond = count,
                better => found = (count, better),
            }
        }
        match found {
            (count, Fit::Arc(arc)) => (count, Some(arc)),
            (count, _) => (count, None),
        }
    }
}

impl<S: Iterator<Item = (Move, Option<Point>)>> Iterator for Arcs<S> {
    type Item = Block;

    fn next(&mut self) -> Option<Block> {
        self.fill();
        if self.window.is_empty() {
            let one = self.after.take()?;
            if let Move::Feed { at, .. } = one {
                self.from = at;
            }
            return Some(Block::Straight(one));
        }
        if self.lines == 0 {
            match self.longest() {
                (count, Some(arc)) => {
                    self.window.drain(..count);
                    self.from = arc.to;
                    return Some(Block::Arc(arc));
                }
                (count, None) => self.lines = count,
            }
        }
        self.lines -= 1;
        let Sample { at, feed_mm_min, .. } = self.window.pop_front()?;
        self.from = at;
        Some(Block::Straight(Move::Feed { at, feed_mm_min }))
    }
}

/// What some points in a row are.
enum Fit {
    /// An arc.
    Arc(Arc),
    /// As good as straight.
    Straight,
    /// Neither.
    Not,
}

/// Lays an arc from a point through some others, of which the last is its end.
fn fit(from: Point, samples: &[Sample], options: &ArcOptions) -> Fit {
    let Some(frame) = Chord::of(from, samples, options) else { return Fit::Not };
    let Some([low, high]) = frame.bends(samples, options.within_mm) else { return Fit::Not };
    if low <= 0.0 && 0.0 <= high {
        return if frame.is_level(samples, options.within_mm) { Fit::Straight } else { Fit::Not };
    }
    match frame.arc(from, samples, 0.5 * (low + high), options) {
        Some(arc) if arc.deviation_mm <= options.within_mm => Fit::Arc(arc),
        _ => Fit::Not,
    }
}

/// The chord of an arc, both ends as they are written.
struct Chord {
    plane: Plane,
    ends: [Point; 2],
    /// In the plane: the middle, the direction from the first end to the second, half of the length.
    middle: [f64; 2],
    along: [f64; 2],
    half: f64,
}

impl Chord {
    fn of(from: Point, samples: &[Sample], options: &ArcOptions) -> Option<Self> {
        let last = samples.last()?.at;
        let ends = [from, last].map(|p| p.map(|v| written(v, options)));
        // The plane is the one that the points turn in most: half-way they are farthest from their chord.
        let turn: Vector = (samples[(samples.len() - 1) / 2].at - ends[0]).cross(&(ends[1] - ends[0]));
        let plane = [Plane::XY, Plane::ZX, Plane::YZ].into_iter().max_by(|p, q| {
            let share = |plane: &Plane| turn[plane.0[2]].abs();
            share(p).total_cmp(&share(q))
        })?;
        let [a, b, c] = plane.0;
        let by = ends[1] - ends[0];
        let length = by[a].hypot(by[b]);
        let moves_along = if options.helix { STEEPEST * length } else { 0.0 };
        if by[c].abs() > moves_along || length < 2.0 / options.per_mm {
            return None;
        }
        let middle = [a, b].map(|k| 0.5 * (ends[0][k] + ends[1][k]));
        Some(Self { plane, ends, middle, along: [by[a] / length, by[b] / length], half: 0.5 * length })
    }

    /// A point along the chord and to the left of it, from its middle.
    fn beside(&self, p: &Point) -> [f64; 2] {
        let [a, b, _] = self.plane.0;
        let [x, y] = [p[a] - self.middle[0], p[b] - self.middle[1]];
        let [s, t] = self.along;
        [x * s + y * t, y * s - x * t]
    }

    /// The bends of arcs over the chord that are near enough to all points: 1 / t for a centre t to the left of the chord.
    ///
    /// A point (u, v) is off the circle about (0, t) through (+-h, 0) by d where u^2 + v^2 - h^2 - 2 v t = 2 d (t^2 + h^2)^(1/2) + d^2;
    /// multiplied by 1 / t that is linear in it, but for a factor (1 + h^2 / t^2)^(1/2) of d, which only allows more.
    fn bends(&self, samples: &[Sample], within_mm: f64) -> Option<[f64; 2]> {
        let widest = WIDEST / self.half;
        let [mut low, mut high] = [-widest, widest];
        for p in samples.iter().flat_map(|s| [&s.middle, &s.at]) {
            let [u, v] = self.beside(p);
            let w = u * u + v * v - self.half * self.half;
            if w.abs() < f64::EPSILON {
                continue;
            }
            let [p, q] = [(2.0 * (v - within_mm)) / w, (2.0 * (v + within_mm)) / w];
            // Points near the ends tell little: all of these hold where w is small enough.
            (low, high) = (low.max(p.min(q)), high.min(p.max(q)));
            if low > high {
                return None;
            }
        }
        Some([low, high])
    }

    /// Whether the third axis moves evenly along the chord.
    fn is_level(&self, samples: &[Sample], within_mm: f64) -> bool {
        let c = self.plane.0[2];
        let [first, last] = [self.ends[0][c], self.ends[1][c]];
        samples.iter().all(|sample| {
            let share = 0.5 * (1.0 + self.beside(&sample.at)[0] / self.half);
            (sample.at[c] - first - share * (last - first)).abs() <= within_mm
        })
    }

    /// The arc of a curvature as it is written, and how far it is from the points and what is between them.
    fn arc(&self, from: Point, samples: &[Sample], bend: f64, options: &ArcOptions) -> Option<Arc> {
        let [s, t] = self.along;
        let centre_mm = [self.middle[0] - t / bend, self.middle[1] + s / bend].map(|v| written(v, options));
        let circle = Circle::of(self, centre_mm);
        let [a, b, _] = self.plane.0;
        let from_start = [centre_mm[0] - self.ends[0][a], centre_mm[1] - self.ends[0][b]];
        let too_far = centre_mm.iter().chain(&from_start).any(|v| v.abs() > options.largest_mm);
        if too_far || circle.radius_error().abs() > options.radius_error_mm {
            return None;
        }
        let mut last = circle.off(&from)?;
        let [mut most, mut between] = [size(last), 0.0f64];
        for sample in samples {
            let (half_way, now) = (circle.off(&sample.middle)?, circle.off(&sample.at)?);
            most = most.max(size(half_way)).max(size(now));
            // Between a point and the middle the difference bends a quarter as much as between two points.
            let bend = [0, 1].map(|k| half_way[k] - 0.5 * (last[k] + now[k]));
            between = between.max(0.25 * size(bend));
            last = now;
        }
        // Controls differ in where they leave a difference of the radii.
        let deviation_mm = most + between + circle.radius_error().abs();
        let Sample { at: to, feed_mm_min, .. } = *samples.last()?;
        Some(Arc { plane: self.plane, clockwise: bend < 0.0, to, centre_mm, feed_mm_min, deviation_mm })
    }
}

/// The circle of an arc as a control goes along it: radius and third axis change evenly with the angle.
struct Circle {
    plane: Plane,
    centre_mm: [f64; 2],
    /// From the centre to the beginning, the radii at both ends, the sweep, and the third axis at both ends.
    arm: [f64; 2],
    radii: [f64; 2],
    sweep: f64,
    across: [f64; 2],
}

impl Circle {
    fn of(chord: &Chord, centre_mm: [f64; 2]) -> Self {
        let plane = chord.plane;
        let [a, b, c] = plane.0;
        let arm = |p: &Point| [p[a] - centre_mm[0], p[b] - centre_mm[1]];
        let [first, last] = [arm(&chord.ends[0]), arm(&chord.ends[1])];
        let radii = [first, last].map(|[x, y]| x.hypot(y));
        let across = [chord.ends[0][c], chord.ends[1][c]];
        Self { plane, centre_mm, arm: first, radii, sweep: angle(first, last), across }
    }

    fn radius_error(&self) -> f64 {
        self.radii[1] - self.radii[0]
    }

    /// How far a point is off, along the radius and across the plane; none where it is not between the ends.
    fn off(&self, p: &Point) -> Option<[f64; 2]> {
        let [a, b, c] = self.plane.0;
        let arm = [p[a] - self.centre_mm[0], p[b] - self.centre_mm[1]];
        let share = angle(self.arm, arm) / self.sweep;
        // Rounding moves an end by a step.
        let beyond = 0.01;
        if !(-beyond..=1.0 + beyond).contains(&share) {
            return None;
        }
        let radius = self.radii[0] + share * self.radius_error();
        let across = self.across[0] + share * (self.across[1] - self.across[0]);
        Some([arm[0].hypot(arm[1]) - radius, p[c] - across])
    }
}

/// The angle from one arm to another, counter-clockwise.
fn angle([x, y]: [f64; 2], [u, v]: [f64; 2]) -> f64 {
    (x * v - y * u).atan2(x * u + y * v)
}

fn size([x, y]: [f64; 2]) -> f64 {
    x.hypot(y)
}

/// A coordinate as it will be written.
fn written(value_mm: f64, options: &ArcOptions) -> f64 {
    (value_mm * options.per_mm).round() / options.per_mm
}

/// Tells every block with the angle between its beginning and the end of the one before; 0 where the wheel comes down or travels.
fn corners(blocks: impl Iterator<Item = Block>, mut tell: impl FnMut(&Block, f64)) {
    let (mut from, mut heading): (Option<Point>, Option<Vector>) = (None, None);
    for block in blocks {
        let (to, directions) = match (&block, from) {
            (Block::Straight(Move::Feed { at, .. }), from) => (Some(*at), from.map(|from| [at - from; 2])),
            (Block::Arc(arc), Some(from)) => (Some(arc.to), Some(arc.directions(from))),
            _ => (None, None),
        };
        let corner = heading.zip(directions).map_or(0.0, |(a, [b, _])| a.cross(&b).norm().atan2(a.dot(&b)));
        tell(&block, corner);
        (from, heading) = (to, directions.map(|[_, out]| out));
    }
}

impl Arc {
    /// The directions in which it begins and ends, of any length.
    fn directions(&self, from: Point) -> [Vector; 2] {
        let [a, b, c] = self.plane.0;
        let turn = if self.clockwise { -1.0 } else { 1.0 };
        let arm = |p: &Point| [p[a] - self.centre_mm[0], p[b] - self.centre_mm[1]];
        let sweep = angle(arm(&from), arm(&self.to)).abs();
        [&from, &self.to].map(|p| {
            let [x, y] = arm(p);
            let mut direction = Vector::zeros();
            (direction[a], direction[b]) = (-turn * y, turn * x);
            direction[c] = (self.to[c] - from[c]) / sweep.max(f64::MIN_POSITIVE);
            direction
        })
    }
}

#[cfg(test)]
mod tests {
    use super::super::fit::tests::{ball, path, quadric};
    use super::super::{PathOptions, Pattern};
    use super::*;

    const OPTIONS: ArcOptions = ArcOptions {
        within_mm: 1e-4,
        per_mm: 1e6,
        radius_error_mm: 2e-3,
        largest_mm: 1e6,
        helix: true,
        least_lines: 2,
    };

    /// A track along a curve over a parameter from 0 to 1, in equal steps.
    fn track(curve: impl Fn(f64) -> Point, steps: usize) -> impl Iterator<Item = (Move, Option<Point>)> {
        fed(curve, steps, |_| 600.0)
    }

    fn fed(
        curve: impl Fn(f64) -> Point,
        steps: usize,
        feed: impl Fn(usize) -> f64,
    ) -> impl Iterator<Item = (Move, Option<Point>)> {
        let of = |k: f64| k / steps as f64;
        let began = Move::Feed { at: curve(0.0), feed_mm_min: feed(0) };
        let along: Vec<_> = (1..=steps)
            .map(|k| (Move::Feed { at: curve(of(k as f64)), feed_mm_min: feed(k) }, Some(curve(of(k as f64 - 0.5)))))
            .collect();
        let ends = [(Move::RapidZ(10.0), None)];
        [(Move::RapidZ(9.0), None), (began, None)].into_iter().chain(along).chain(ends)
    }

    fn arcs_of(blocks: &[Block]) -> Vec<Arc> {
        blocks.iter().filter_map(|block| if let Block::Arc(arc) = block { Some(*arc) } else { None }).collect()
    }

    /// A quarter of a circle of 40 mm about (3, 7, -5) from +z towards +x, while y rises.
    fn quarter(y_mm: f64) -> impl Fn(f64) -> Point + Copy {
        move |t: f64| {
            let (s, c) = (0.4 * t).sin_cos();
            Point::new(3.0 + 40.0 * s, 7.0 + y_mm * t, -5.0 + 40.0 * c)
        }
    }

    #[test]
    fn a_planted_circle_is_one_arc_about_its_centre() {
        for y_mm in [0.0, 0.3] {
            let blocks: Vec<Block> = Arcs::new(track(quarter(y_mm), 300), &OPTIONS).collect();
            assert!(matches!(blocks[..2], [Block::Straight(Move::RapidZ(9.0)), Block::Straight(Move::Feed { .. })]));
            assert!(matches!(blocks[3..], [Block::Straight(Move::RapidZ(10.0))]), "{blocks:?}");
            let Block::Arc(arc) = blocks[2] else { panic!("{blocks:?}") };
            // From z towards x is counter-clockwise in the plane of z and x.
            assert!(arc.plane == Plane::ZX && !arc.clockwise && arc.to == quarter(y_mm)(1.0));
            // A sagitta of 0.8 mm tells the radius 25 times less well than its own middle.
            assert!((arc.centre_mm[0] + 5.0).abs() < 0.01 && (arc.centre_mm[1] - 3.0).abs() < 0.01, "{arc:?}");
            assert!(arc.deviation_mm < 1e-4);
            let flat = ArcOptions { helix: false, ..OPTIONS };
            let flat = arcs_of(&Arcs::new(track(quarter(y_mm), 300), &flat).collect::<Vec<_>>()).len();
            assert_eq!(flat, usize::from(y_mm == 0.0));
        }
    }

    #[test]
    fn a_mirror_turns_it_round_and_axes_can_be_exchanged() {
        let turned = |p: Point| [Point::new(-p.x, p.y, p.z), Point::new(p.y, p.z, p.x), Point::new(p.z, p.x, p.y)];
        let expected = [(Plane::ZX, true), (Plane::YZ, false), (Plane::XY, false)];
        for (k, (plane, clockwise)) in expected.into_iter().enumerate() {
            let curve = move |t| turned(quarter(0.0)(t))[k];
            let arcs = arcs_of(&Arcs::new(track(curve, 100), &OPTIONS).collect::<Vec<_>>());
            assert_eq!(arcs.iter().map(|a| (a.plane, a.clockwise)).collect::<Vec<_>>(), [(plane, clockwise)], "{k}");
        }
    }

    #[test]
    fn straight_runs_short_runs_and_points_that_stand_still_stay_lines() {
        let straight = |t: f64| Point::new(80.0 * t, 1.0, 0.2 - 3.0 * t);
        let still = |_: f64| Point::new(1.0, 1.0, 0.0);
        // One step, and a jump to and fro.
        let jump = |t: f64| Point::new((40.0 * t).fract(), 0.0, (97.0 * t).fract());
        let all: [(Vec<_>, usize); 4] = [
            (track(straight, 500).collect(), 500),
            (track(still, 20).collect(), 20),
            (track(quarter(0.0), 1).collect(), 1),
            (track(jump, 30).collect(), 30),
        ];
        for (moves, steps) in all {
            let blocks: Vec<Block> = Arcs::new(moves.clone().into_iter(), &OPTIONS).collect();
            let same: Vec<Block> = moves.into_iter().map(|(one, _)| Block::Straight(one)).collect();
            assert_eq!(blocks, same, "{steps}");
        }
    }

    #[test]
    fn no_arc_joins_feeds_that_differ_nor_two_curves() {
        let slower = |k: usize| if k > 120 { 300.0 } else { 600.0 };
        let arcs = arcs_of(&Arcs::new(fed(quarter(0.0), 300, slower), &OPTIONS).collect::<Vec<_>>());
        assert_eq!(arcs.iter().map(|a| a.feed_mm_min).collect::<Vec<_>>(), [600.0, 300.0]);
        assert_eq!(arcs[0].to, quarter(0.0)(0.4));
        // A line that goes on into a circle: the line stays one but for its last points.
        let joined = |t: f64| {
            let (s, c) = (t.max(0.0)).sin_cos();
            if t < 0.0 { Point::new(20.0 * t, 0.0, 20.0) } else { Point::new(20.0 * s, 0.0, 20.0 * c) }
        };
        let blocks: Vec<Block> = Arcs::new(track(|t| joined(t - 0.5), 200), &OPTIONS).collect();
        let arcs = arcs_of(&blocks);
        assert!(arcs.len() <= 2 && blocks.len() > 95 && blocks.len() < 110, "{} {}", arcs.len(), blocks.len());
    }

    /// Where a control is along an arc at a share of its angle.
    fn along(arc: &Arc, from: Point, share: f64) -> Point {
        let [a, b, c] = arc.plane.0;
        let [i, j] = arc.centre_mm;
        let begins = (from[b] - j).atan2(from[a] - i);
        let sweep = ((arc.to[b] - j).atan2(arc.to[a] - i) - begins + 9.0 * std::f64::consts::PI)
            .rem_euclid(2.0 * std::f64::consts::PI)
            - std::f64::consts::PI;
        assert_eq!(sweep < 0.0, arc.clockwise);
        let radius = (from[a] - i).hypot(from[b] - j);
        let mut at = from;
        (at[a], at[b]) = (i + radius * (begins + share * sweep).cos(), j + radius * (begins + share * sweep).sin());
        at[c] = from[c] + share * (arc.to[c] - from[c]);
        at
    }

    #[test]
    fn the_whole_of_every_arc_is_as_near_to_the_path_as_is_told() {
        let spiral = PathOptions { pattern: Pattern::Spiral, ..ball(8.0) };
        let below = PathOptions { from_below: true, ..ball(8.0) };
        for (options, per_mm) in [(ball(8.0), 1e6), (ball(8.0), 1e4), (spiral, 1e6), (below, 1e6)] {
            let path = path(quadric(0.01, -0.006), PathOptions { chord_error_mm: 2e-4, ..options }).unwrap();
            let within = ArcOptions { within_mm: 2e-4, per_mm, ..OPTIONS };
            let written = |p: Point| p.map(|v| (v * per_mm).round() / per_mm);
            for (k, blocks) in path.arcs_by_track(&within).into_iter().enumerate().step_by(2) {
                let span = path.tracks.spans[k];
                let (first, last) = span.with_leads(path.options());
                let centre = |t: f64| {
                    let p = path.stand(&span, t).at;
                    Point::new(p.x, p.y, path.upright(p.z))
                };
                let (mut from, mut t) = (Point::origin(), first);
                for block in blocks {
                    if let Block::Arc(arc) = block {
                        assert!(arc.deviation_mm <= 2e-4);
                        for share in 0..=40 {
                            let at = along(&arc, from, f64::from(share) / 40.0);
                            // The nearest place of the path, which is a little further than the last one.
                            let speed = span.speed_mm(t) * (last - first).signum();
                            for _ in 0..60 {
                                let [p, q] = [centre(t), centre(t + 1e-4 / speed)];
                                let along = (q - p) * 1e4;
                                t += (at - p).dot(&along) / along.norm_squared() / speed;
                            }
                            let off = (at - centre(t)).norm();
                            // By rounding of its ends, which the path has none of.
                            assert!(
                                off <= arc.deviation_mm + 1.0 / per_mm + 1e-9,
                                "{off} {arc:?} {t} {span:?} {share}"
                            );
                        }
                        from = written(arc.to);
                    } else if let Block::Straight(Move::Feed { at, .. }) = block {
                        from = written(at);
                    }
                }
            }
        }
    }

    #[test]
    fn a_path_in_arcs_is_much_shorter_and_its_summary_counts_it() {
        for pattern in [Pattern::Raster, Pattern::Spiral] {
            // A spiral rises evenly on what is round about its middle.
            let path = path(quadric(0.01, 0.01), PathOptions { pattern, ..ball(8.0) }).unwrap();
            let plain = path.summary().unwrap();
            let summary = path.arc_summary(&OPTIONS);
            let blocks: Vec<Block> = path.arcs_by_track(&OPTIONS).into_iter().flatten().collect();
            assert_eq!(summary.moves, blocks.len() as u64);
            assert_eq!(summary.arcs, arcs_of(&blocks).len() as u64);
            assert!(summary.deviation_mm <= OPTIONS.within_mm && summary.deviation_mm > 0.3 * OPTIONS.within_mm);
            let at_feed = summary.arcs + summary.lines;
            assert!(3 * at_feed < plain.points, "{at_feed} for {} {pattern:?}", plain.points);
            assert!(summary.corner_rad[0] < summary.corner_rad[1], "{:?}", summary.corner_rad);
        }
    }
}
