//! Arcs in place of straight lines. From each point of a track, the longest arc within a tolerance of the path
//! replaces the lines.
//!
//! ```text
//!  Moves --middle of each step--> window of points --longest--> Arc, or the lines as they were
//! ```
//!
//! An arc lies in a plane of two axes; the third axis may move in proportion to the angle (helix). The deviation is
//! computed for the arc as written: both ends and the centre are rounded to the last digit. It is evaluated at the
//! points of the path and at the middle of every step between them.

use std::collections::VecDeque;

use rayon::prelude::*;

use super::{Move, Moves, ToolPath};
use crate::geometry::{Point, Vector};

/// Maximum number of points that one arc can replace.
const WINDOW: usize = 1024;
/// Maximum ratio of the half chord to the distance of the centre from the chord. At 1 the arc is a quarter of a turn,
/// so that no control can take the longer way round.
const MAX_CHORD_RATIO: f64 = 1.0;
/// Maximum travel of the third axis, as a share of the chord. Some controls apply the feed in the plane, others along
/// the helix. With this limit the two differ by 0.5 % at most.
const MAX_HELIX_SLOPE: f64 = 0.1;

/// Plane of an arc: indices of its first axis, its second axis, and the axis across. A turn from the first to the
/// second is counter-clockwise.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Plane(pub [usize; 3]);

impl Plane {
    /// Plane of x and y.
    pub const XY: Self = Self([0, 1, 2]);
    /// Plane of z and x.
    pub const ZX: Self = Self([2, 0, 1]);
    /// Plane of y and z.
    pub const YZ: Self = Self([1, 2, 0]);
}

/// Tolerances and limits of arcs.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ArcOptions {
    /// Maximum deviation of an arc from the path of the wheel's centre, in millimetres.
    pub tolerance_mm: f64,
    /// Number of steps of the last written digit in a millimetre.
    pub steps_per_mm: f64,
    /// Maximum difference between the radius at the end and at the start, in millimetres.
    pub max_radius_error_mm: f64,
    /// Maximum coordinate of a centre, and maximum offset of a centre from the start along an axis, in millimetres.
    pub max_coordinate_mm: f64,
    /// True if the third axis may move during an arc.
    pub allows_helix: bool,
    /// Minimum number of lines that an arc must replace.
    pub min_lines: usize,
}

/// Arc at a feed, from the end of the previous move.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Arc {
    /// Plane of the arc.
    pub plane: Plane,
    /// True if the arc turns from the second axis of the plane to the first.
    pub clockwise: bool,
    /// End point, in millimetres, in the model frame.
    pub to: Point,
    /// Centre along the two axes of the plane, in millimetres, rounded to whole steps of the last digit.
    pub centre_mm: [f64; 2],
    /// Feed of the wheel's centre.
    pub feed_mm_min: f64,
    /// Upper bound of the deviation from the path of the wheel's centre, in millimetres.
    pub deviation_mm: f64,
}

/// Content of one program block, or of two blocks that belong together.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ProgramBlock {
    /// Straight move.
    Straight(Move),
    /// An arc.
    Arc(Arc),
}

impl From<Move> for ProgramBlock {
    fn from(one: Move) -> Self {
        Self::Straight(one)
    }
}

/// Comparison of a path in arcs with the same path in lines.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ArcSummary {
    /// Number of moves, including arcs and rapid moves.
    pub moves: u64,
    /// Number of arcs.
    pub arcs: u64,
    /// Number of remaining lines at feed.
    pub lines: u64,
    /// Largest deviation of an arc from the path of the wheel's centre, in millimetres.
    pub deviation_mm: f64,
    /// Largest angle between the end direction of one move at feed and the start direction of the next, in rad: for
    /// the path in arcs, then for the path in lines.
    pub corner_rad: [f64; 2],
}

impl ToolPath {
    /// Returns the moves of the wheel's centre as program blocks, one iterator for each track. An arc replaces several
    /// straight moves if the arc deviates from the path by at most the tolerance in `options`. All other moves stay
    /// straight.
    ///
    /// Frame: model. Units: mm, mm/min.
    pub fn arcs_by_track(&self, options: &ArcOptions) -> Vec<ArcBlocks<MovesWithMiddles<'_>>> {
        self.moves_by_track().into_iter().map(|moves| ArcBlocks::new(MovesWithMiddles(moves), options)).collect()
    }

    /// Converts the whole path into arcs and returns a comparison with the path in straight lines. The result contains
    /// the numbers of moves, arcs and lines, the largest deviation of an arc from the path, and the largest corner
    /// angle with arcs and without. A corner angle is the change of direction between two successive moves. The tracks
    /// are converted in parallel.
    pub fn arc_summary(&self, options: &ArcOptions) -> ArcSummary {
        let one = |k: usize| {
            let mut one = ArcSummary::default();
            let moves = || Moves::new(self, k, k + 1);
            corners(ArcBlocks::new(MovesWithMiddles(moves()), options), |block, corner| one.add_block(block, corner));
            corners(moves().map(ProgramBlock::from), |_, corner| one.corner_rad[1] = one.corner_rad[1].max(corner));
            one
        };
        (0..self.track_count()).into_par_iter().map(one).reduce(ArcSummary::default, ArcSummary::merge)
    }
}

impl ArcSummary {
    fn add_block(&mut self, block: &ProgramBlock, corner: f64) {
        self.moves += 1;
        self.corner_rad[0] = self.corner_rad[0].max(corner);
        match block {
            ProgramBlock::Arc(arc) => {
                self.arcs += 1;
                self.deviation_mm = self.deviation_mm.max(arc.deviation_mm);
            }
            ProgramBlock::Straight(Move::Feed { .. }) => self.lines += 1,
            ProgramBlock::Straight(_) => {}
        }
    }

    fn merge(self, other: Self) -> Self {
        Self {
            moves: self.moves + other.moves,
            arcs: self.arcs + other.arcs,
            lines: self.lines + other.lines,
            deviation_mm: self.deviation_mm.max(other.deviation_mm),
            corner_rad: [0, 1].map(|k| self.corner_rad[k].max(other.corner_rad[k])),
        }
    }
}

/// Iterator over the moves of a path, each with the middle of its step. A move without a middle stays a line.
#[derive(Clone, Debug)]
pub struct MovesWithMiddles<'a>(Moves<'a>);

impl Iterator for MovesWithMiddles<'_> {
    type Item = (Move, Option<Point>);

    fn next(&mut self) -> Option<Self::Item> {
        let one = self.0.next()?;
        Some((one, self.0.middle))
    }
}

/// Point of the path, middle of the step to it, and feed.
#[derive(Clone, Copy, Debug)]
struct PathPoint {
    middle: Point,
    point: Point,
    feed_mm_min: f64,
}

/// Iterator over the blocks of a path: arcs where a fit within the tolerance exists, straight moves otherwise.
#[derive(Clone, Debug)]
pub struct ArcBlocks<S> {
    source: S,
    options: ArcOptions,
    /// End point of the last block.
    from: Point,
    window: VecDeque<PathPoint>,
    /// Number of points at the front of the window that stay lines.
    lines: usize,
    /// Move after the window that cannot be part of an arc.
    after: Option<Move>,
}

impl<S: Iterator<Item = (Move, Option<Point>)>> ArcBlocks<S> {
    fn new(source: S, options: &ArcOptions) -> Self {
        let (from, window) = (Point::origin(), VecDeque::new());
        Self { source, options: *options, from, window, lines: 0, after: None }
    }

    fn fill(&mut self) {
        while self.window.len() < WINDOW && self.after.is_none() {
            match self.source.next() {
                Some((Move::Feed { to: at, feed_mm_min }, Some(middle))) => {
                    self.window.push_back(PathPoint { middle, point: at, feed_mm_min });
                }
                Some((other, _)) => self.after = Some(other),
                None => break,
            }
        }
    }

    /// Searches the longest arc that begins at the current point and stays within the tolerance. Returns the number of
    /// path points that the arc replaces, and the arc. If no arc fits, returns the number of points that stay straight
    /// moves, and `None`.
    ///
    /// The search doubles the number of points until the fit fails, and then bisects.
    fn longest_arc(&mut self) -> (usize, Option<Arc>) {
        let least = self.options.min_lines.max(2);
        let from = self.from;
        let window = self.window.make_contiguous();
        let feed = window[0].feed_mm_min;
        let most = window.iter().take_while(|sample| sample.feed_mm_min == feed).count();
        if most < least {
            return (most, None);
        }
        let fit = |count: usize| fit_arc(from, &window[..count], &self.options);
        let mut found = match fit(least) {
            ArcFit::Neither => return (1, None),
            found => (least, found),
        };
        let mut beyond = most + 1;
        while 2 * found.0 < beyond {
            match fit(2 * found.0) {
                ArcFit::Neither => beyond = 2 * found.0,
                better => found = (2 * found.0, better),
            }
        }
        while beyond - found.0 > 1 {
            let count = usize::midpoint(found.0, beyond);
            match fit(count) {
                ArcFit::Neither => beyond = count,
                better => found = (count, better),
            }
        }
        match found {
            (count, ArcFit::Arc(arc)) => (count, Some(arc)),
            (count, _) => (count, None),
        }
    }
}

impl<S: Iterator<Item = (Move, Option<Point>)>> Iterator for ArcBlocks<S> {
    type Item = ProgramBlock;

    fn next(&mut self) -> Option<ProgramBlock> {
        self.fill();
        if self.window.is_empty() {
            let one = self.after.take()?;
            if let Move::Feed { to: at, .. } = one {
                self.from = at;
            }
            return Some(ProgramBlock::Straight(one));
        }
        if self.lines == 0 {
            match self.longest_arc() {
                (count, Some(arc)) => {
                    self.window.drain(..count);
                    self.from = arc.to;
                    return Some(ProgramBlock::Arc(arc));
                }
                (count, None) => self.lines = count,
            }
        }
        self.lines -= 1;
        let PathPoint { point: at, feed_mm_min, .. } = self.window.pop_front()?;
        self.from = at;
        Some(ProgramBlock::Straight(Move::Feed { to: at, feed_mm_min }))
    }
}

/// Result of a fit to successive points.
enum ArcFit {
    /// An arc.
    Arc(Arc),
    /// A straight line within the tolerance.
    Straight,
    /// Neither an arc nor a line within the tolerance.
    Neither,
}

/// Fits an arc or a straight line through successive points of the path. The curve begins at `from` and ends at the
/// last point of `samples`. No point may deviate from the curve by more than the tolerance in `options`. Returns
/// [`ArcFit::Neither`] if no arc and no line meets the tolerance.
fn fit_arc(from: Point, samples: &[PathPoint], options: &ArcOptions) -> ArcFit {
    let Some(frame) = Chord::new(from, samples, options) else { return ArcFit::Neither };
    let Some([low, high]) = frame.curvature_interval(samples, options.tolerance_mm) else { return ArcFit::Neither };
    if low <= 0.0 && 0.0 <= high {
        return if frame.is_level(samples, options.tolerance_mm) { ArcFit::Straight } else { ArcFit::Neither };
    }
    match frame.arc(from, samples, 0.5 * (low + high), options) {
        Some(arc) if arc.deviation_mm <= options.tolerance_mm => ArcFit::Arc(arc),
        _ => ArcFit::Neither,
    }
}

/// Chord of an arc, with both ends rounded as they are written.
struct Chord {
    plane: Plane,
    ends: [Point; 2],
    /// Middle of the chord, unit direction from the first end to the second, and half of its length, all in the plane.
    middle: [f64; 2],
    along: [f64; 2],
    half: f64,
}

impl Chord {
    fn new(from: Point, samples: &[PathPoint], options: &ArcOptions) -> Option<Self> {
        let last = samples.last()?.point;
        let ends = [from, last].map(|p| p.map(|v| written(v, options)));
        // Choose the plane in which the points turn most: half-way they are farthest from their chord.
        let turn: Vector = (samples[(samples.len() - 1) / 2].point - ends[0]).cross(&(ends[1] - ends[0]));
        let plane = [Plane::XY, Plane::ZX, Plane::YZ].into_iter().max_by(|p, q| {
            let share = |plane: &Plane| turn[plane.0[2]].abs();
            share(p).total_cmp(&share(q))
        })?;
        let [a, b, c] = plane.0;
        let by = ends[1] - ends[0];
        let length = by[a].hypot(by[b]);
        let moves_along = if options.allows_helix { MAX_HELIX_SLOPE * length } else { 0.0 };
        if by[c].abs() > moves_along || length < 2.0 / options.steps_per_mm {
            return None;
        }
        let middle = [a, b].map(|k| 0.5 * (ends[0][k] + ends[1][k]));
        Some(Self { plane, ends, middle, along: [by[a] / length, by[b] / length], half: 0.5 * length })
    }

    /// Returns two coordinates of the point `p` in the plane of the arc, in mm. The chord is the straight line from the
    /// start of the arc to its end, projected onto this plane. The origin is the middle of the chord. The first
    /// coordinate is along the chord, the second is perpendicular to the chord, positive to its left.
    fn coordinates(&self, p: &Point) -> [f64; 2] {
        let [a, b, _] = self.plane.0;
        let [x, y] = [p[a] - self.middle[0], p[b] - self.middle[1]];
        let [s, t] = self.along;
        [x * s + y * t, y * s - x * t]
    }

    /// Returns the interval `[low, high]` of 1 / t, in 1/mm, for which an arc through both ends of the chord passes all
    /// `samples` within `within_mm`. The chord is the straight line from the start of the arc to its end. t is the
    /// distance, in mm, of the centre of the arc from the chord, positive if the centre is to the left of the chord.
    /// Returns `None` if no value of 1 / t is suitable.
    ///
    /// Derivation: (u, v) are the [`Self::coordinates`] of a point, h is half the length of the chord, and d is the
    /// signed distance of the point from the circle with the centre (0, t) through (h, 0) and (-h, 0). Then u^2 + v^2 -
    /// h^2 - 2 v t = 2 d (t^2 + h^2)^(1/2) + d^2. After multiplication by 1 / t, this is linear in 1 / t, except for
    /// d^2 and for the factor (1 + h^2 / t^2)^(1/2) of d. The bounds omit d^2 and this factor. The factor is at least 1
    /// and would only make the interval wider.
    fn curvature_interval(&self, samples: &[PathPoint], within_mm: f64) -> Option<[f64; 2]> {
        let widest = MAX_CHORD_RATIO / self.half;
        let [mut low, mut high] = [-widest, widest];
        for p in samples.iter().flat_map(|s| [&s.middle, &s.point]) {
            let [u, v] = self.coordinates(p);
            let w = u * u + v * v - self.half * self.half;
            if w.abs() < f64::EPSILON {
                continue;
            }
            let [p, q] = [(2.0 * (v - within_mm)) / w, (2.0 * (v + within_mm)) / w];
            // Points near the ends constrain little: if w is small, the interval is wide.
            (low, high) = (low.max(p.min(q)), high.min(p.max(q)));
            if low > high {
                return None;
            }
        }
        Some([low, high])
    }

    /// Returns true if the path between the two ends of this chord can be one arc or one helix. For this, the
    /// coordinate perpendicular to the plane of the arc must change linearly from the first end of the chord to the
    /// second. At each of `samples` this coordinate may deviate from the linear change by at most `within_mm`.
    fn is_level(&self, samples: &[PathPoint], within_mm: f64) -> bool {
        let c = self.plane.0[2];
        let [first, last] = [self.ends[0][c], self.ends[1][c]];
        samples.iter().all(|sample| {
            let share = 0.5 * (1.0 + self.coordinates(&sample.point)[0] / self.half);
            (sample.point[c] - first - share * (last - first)).abs() <= within_mm
        })
    }

    /// Returns the arc that begins at `from` and ends at the last of `samples`. The chord is the straight line from the
    /// start of the arc to its end. `bend` gives the centre of the arc: its distance from the chord is 1 / `bend`.
    /// `bend` is in 1/mm, positive if the centre is to the left of the chord.
    ///
    /// The centre is rounded to the last digit that a program writes. [`Arc::deviation_mm`] of the result is an upper
    /// bound of the deviation of this arc from the path.
    ///
    /// Returns `None` in each of these cases:
    ///
    /// - A coordinate of the centre exceeds the maximum coordinate in `options`, in the model frame or relative to the
    ///   start of the arc.
    /// - The radius at the end differs from the radius at the start by more than `options` allow.
    /// - A sample is not between the ends of the arc.
    fn arc(&self, from: Point, samples: &[PathPoint], bend: f64, options: &ArcOptions) -> Option<Arc> {
        let [s, t] = self.along;
        let centre_mm = [self.middle[0] - t / bend, self.middle[1] + s / bend].map(|v| written(v, options));
        let circle = Circle::new(self, centre_mm);
        let [a, b, _] = self.plane.0;
        let from_start = [centre_mm[0] - self.ends[0][a], centre_mm[1] - self.ends[0][b]];
        let too_far = centre_mm.iter().chain(&from_start).any(|v| v.abs() > options.max_coordinate_mm);
        if too_far || circle.radius_error().abs() > options.max_radius_error_mm {
            return None;
        }
        let mut last = circle.deviation_mm(&from)?;
        let [mut most, mut between] = [size(last), 0.0f64];
        for sample in samples {
            let (half_way, now) = (circle.deviation_mm(&sample.middle)?, circle.deviation_mm(&sample.point)?);
            most = most.max(size(half_way)).max(size(now));
            // The deviation curves a quarter as much between a point and the middle as between two points.
            let bend = [0, 1].map(|k| half_way[k] - 0.5 * (last[k] + now[k]));
            between = between.max(0.25 * size(bend));
            last = now;
        }
        // Controls differ in where along the arc they put the difference between the radii.
        let deviation_mm = most + between + circle.radius_error().abs();
        let PathPoint { point: to, feed_mm_min, .. } = *samples.last()?;
        Some(Arc { plane: self.plane, clockwise: bend < 0.0, to, centre_mm, feed_mm_min, deviation_mm })
    }
}

/// Circle of an arc as a control executes it: radius and third axis change in proportion to the angle.
struct Circle {
    plane: Plane,
    centre_mm: [f64; 2],
    /// Vector from the centre to the start, radii at both ends, sweep in rad, and third axis at both ends.
    arm: [f64; 2],
    radii: [f64; 2],
    sweep: f64,
    across: [f64; 2],
}

impl Circle {
    fn new(chord: &Chord, centre_mm: [f64; 2]) -> Self {
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

    /// Returns two signed deviations of the point `p` from the arc, in mm. The first is in the plane of the arc, along
    /// the radius, and is positive outside the arc. The second is perpendicular to the plane. Returns `None` if the
    /// point is not between the ends of the arc.
    fn deviation_mm(&self, p: &Point) -> Option<[f64; 2]> {
        let [a, b, c] = self.plane.0;
        let arm = [p[a] - self.centre_mm[0], p[b] - self.centre_mm[1]];
        let share = angle(self.arm, arm) / self.sweep;
        // Rounding can move an end by one step.
        let beyond = 0.01;
        if !(-beyond..=1.0 + beyond).contains(&share) {
            return None;
        }
        let radius = self.radii[0] + share * self.radius_error();
        let across = self.across[0] + share * (self.across[1] - self.across[0]);
        Some([arm[0].hypot(arm[1]) - radius, p[c] - across])
    }
}

/// Returns the signed angle from the vector `[x, y]` to the vector `[u, v]`, in rad, positive counter-clockwise.
fn angle([x, y]: [f64; 2], [u, v]: [f64; 2]) -> f64 {
    (x * v - y * u).atan2(x * u + y * v)
}

fn size([x, y]: [f64; 2]) -> f64 {
    x.hypot(y)
}

/// Rounds the coordinate `value_mm` to the last digit that a program writes, and returns the rounded value in mm. The
/// last digit has the step 1 / `options.steps_per_mm`.
fn written(value_mm: f64, options: &ArcOptions) -> f64 {
    (value_mm * options.steps_per_mm).round() / options.steps_per_mm
}

/// Calls `tell` once for every block, with the block and its corner angle in rad. The corner angle is the angle between
/// the direction at the end of the previous block and the direction at the start of this block, from 0 to pi. The angle
/// is 0 for rapid moves, and for the first two moves at feed after a rapid move, because these have no previous
/// direction.
fn corners(blocks: impl Iterator<Item = ProgramBlock>, mut tell: impl FnMut(&ProgramBlock, f64)) {
    let (mut from, mut heading): (Option<Point>, Option<Vector>) = (None, None);
    for block in blocks {
        let (to, directions) = match (&block, from) {
            (ProgramBlock::Straight(Move::Feed { to: at, .. }), from) => (Some(*at), from.map(|from| [at - from; 2])),
            (ProgramBlock::Arc(arc), Some(from)) => (Some(arc.to), Some(arc.directions(from))),
            _ => (None, None),
        };
        let corner = heading.zip(directions).map_or(0.0, |(a, [b, _])| a.cross(&b).norm().atan2(a.dot(&b)));
        tell(&block, corner);
        (from, heading) = (to, directions.map(|[_, out]| out));
    }
}

impl Arc {
    /// Returns the tangent vectors of the arc at its start and at its end, not normalized. `from` is the start point.
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
    use super::super::wheel_fit::tests::{ball, path, quadric};
    use super::super::{PathOptions, TrackPattern};
    use super::*;

    const OPTIONS: ArcOptions = ArcOptions {
        tolerance_mm: 1e-4,
        steps_per_mm: 1e6,
        max_radius_error_mm: 2e-3,
        max_coordinate_mm: 1e6,
        allows_helix: true,
        min_lines: 2,
    };

    /// Returns a track along a curve over a parameter from 0 to 1, in equal steps.
    fn track(curve: impl Fn(f64) -> Point, steps: usize) -> impl Iterator<Item = (Move, Option<Point>)> {
        fed(curve, steps, |_| 600.0)
    }

    fn fed(
        curve: impl Fn(f64) -> Point,
        steps: usize,
        feed: impl Fn(usize) -> f64,
    ) -> impl Iterator<Item = (Move, Option<Point>)> {
        let of = |k: f64| k / steps as f64;
        let began = Move::Feed { to: curve(0.0), feed_mm_min: feed(0) };
        let along: Vec<_> = (1..=steps)
            .map(|k| (Move::Feed { to: curve(of(k as f64)), feed_mm_min: feed(k) }, Some(curve(of(k as f64 - 0.5)))))
            .collect();
        let ends = [(Move::RapidZ(10.0), None)];
        [(Move::RapidZ(9.0), None), (began, None)].into_iter().chain(along).chain(ends)
    }

    fn arcs_of(blocks: &[ProgramBlock]) -> Vec<Arc> {
        blocks.iter().filter_map(|block| if let ProgramBlock::Arc(arc) = block { Some(*arc) } else { None }).collect()
    }

    /// Returns an arc of 0.4 rad with a radius of 40 mm about (3, 7, -5), from +z towards +x, while y rises by `y_mm`.
    fn quarter(y_mm: f64) -> impl Fn(f64) -> Point + Copy {
        move |t: f64| {
            let (s, c) = (0.4 * t).sin_cos();
            Point::new(3.0 + 40.0 * s, 7.0 + y_mm * t, -5.0 + 40.0 * c)
        }
    }

    #[test]
    fn arc_fits_planted_circle() {
        for y_mm in [0.0, 0.3] {
            let blocks: Vec<ProgramBlock> = ArcBlocks::new(track(quarter(y_mm), 300), &OPTIONS).collect();
            assert!(matches!(
                blocks[..2],
                [ProgramBlock::Straight(Move::RapidZ(9.0)), ProgramBlock::Straight(Move::Feed { .. })]
            ));
            assert!(matches!(blocks[3..], [ProgramBlock::Straight(Move::RapidZ(10.0))]), "{blocks:?}");
            let ProgramBlock::Arc(arc) = blocks[2] else { panic!("{blocks:?}") };
            // A turn from z towards x is counter-clockwise in the plane of z and x.
            assert!(arc.plane == Plane::ZX && !arc.clockwise && arc.to == quarter(y_mm)(1.0));
            // With a sagitta of 0.8 mm the radius is 25 times less certain than the middle of the arc.
            assert!((arc.centre_mm[0] + 5.0).abs() < 0.01 && (arc.centre_mm[1] - 3.0).abs() < 0.01, "{arc:?}");
            assert!(arc.deviation_mm < 1e-4);
            let flat = ArcOptions { allows_helix: false, ..OPTIONS };
            let flat = arcs_of(&ArcBlocks::new(track(quarter(y_mm), 300), &flat).collect::<Vec<_>>()).len();
            assert_eq!(flat, usize::from(y_mm == 0.0));
        }
    }

    #[test]
    fn arc_plane_and_direction() {
        let turned = |p: Point| [Point::new(-p.x, p.y, p.z), Point::new(p.y, p.z, p.x), Point::new(p.z, p.x, p.y)];
        let expected = [(Plane::ZX, true), (Plane::YZ, false), (Plane::XY, false)];
        for (k, (plane, clockwise)) in expected.into_iter().enumerate() {
            let curve = move |t| turned(quarter(0.0)(t))[k];
            let arcs = arcs_of(&ArcBlocks::new(track(curve, 100), &OPTIONS).collect::<Vec<_>>());
            assert_eq!(arcs.iter().map(|a| (a.plane, a.clockwise)).collect::<Vec<_>>(), [(plane, clockwise)], "{k}");
        }
    }

    #[test]
    fn arcs_leave_lines_and_still_points() {
        let straight = |t: f64| Point::new(80.0 * t, 1.0, 0.2 - 3.0 * t);
        let still = |_: f64| Point::new(1.0, 1.0, 0.0);
        // A track of one step, and jumps to and fro.
        let jump = |t: f64| Point::new((40.0 * t).fract(), 0.0, (97.0 * t).fract());
        let all: [(Vec<_>, usize); 4] = [
            (track(straight, 500).collect(), 500),
            (track(still, 20).collect(), 20),
            (track(quarter(0.0), 1).collect(), 1),
            (track(jump, 30).collect(), 30),
        ];
        for (moves, steps) in all {
            let blocks: Vec<ProgramBlock> = ArcBlocks::new(moves.clone().into_iter(), &OPTIONS).collect();
            let same: Vec<ProgramBlock> = moves.into_iter().map(|(one, _)| ProgramBlock::Straight(one)).collect();
            assert_eq!(blocks, same, "{steps}");
        }
    }

    #[test]
    fn arc_ends_at_feed_or_curve_change() {
        let slower = |k: usize| if k > 120 { 300.0 } else { 600.0 };
        let arcs = arcs_of(&ArcBlocks::new(fed(quarter(0.0), 300, slower), &OPTIONS).collect::<Vec<_>>());
        assert_eq!(arcs.iter().map(|a| a.feed_mm_min).collect::<Vec<_>>(), [600.0, 300.0]);
        assert_eq!(arcs[0].to, quarter(0.0)(0.4));
        // A line that continues into a circle: the line stays a line except for its last points.
        let joined = |t: f64| {
            let (s, c) = (t.max(0.0)).sin_cos();
            if t < 0.0 { Point::new(20.0 * t, 0.0, 20.0) } else { Point::new(20.0 * s, 0.0, 20.0 * c) }
        };
        let blocks: Vec<ProgramBlock> = ArcBlocks::new(track(|t| joined(t - 0.5), 200), &OPTIONS).collect();
        let arcs = arcs_of(&blocks);
        assert!(arcs.len() <= 2 && blocks.len() > 95 && blocks.len() < 110, "{} {}", arcs.len(), blocks.len());
    }

    /// Returns the position of a control on an arc after a share of its angle.
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
    fn arc_deviation_bounds_path_error() {
        let spiral = PathOptions { pattern: TrackPattern::Spiral, ..ball(8.0) };
        let below = PathOptions { from_below: true, ..ball(8.0) };
        for (options, per_mm) in [(ball(8.0), 1e6), (ball(8.0), 1e4), (spiral, 1e6), (below, 1e6)] {
            let path = path(quadric(0.01, -0.006), PathOptions { chord_error_mm: 2e-4, ..options }).unwrap();
            let within = ArcOptions { tolerance_mm: 2e-4, steps_per_mm: per_mm, ..OPTIONS };
            let written = |p: Point| p.map(|v| (v * per_mm).round() / per_mm);
            for (k, blocks) in path.arcs_by_track(&within).into_iter().enumerate().step_by(2) {
                let span = path.tracks.spans[k];
                let (first, last) = span.with_leads(path.options());
                let centre = |t: f64| {
                    let p = path.wheel_position(&span, t).programmed_point;
                    Point::new(p.x, p.y, path.flipped_height_mm(p.z))
                };
                let (mut from, mut t) = (Point::origin(), first);
                for block in blocks {
                    if let ProgramBlock::Arc(arc) = block {
                        assert!(arc.deviation_mm <= 2e-4);
                        for share in 0..=40 {
                            let at = along(&arc, from, f64::from(share) / 40.0);
                            // The nearest place of the path, a little after the last one.
                            let speed = span.length_per_parameter_mm(t) * (last - first).signum();
                            for _ in 0..60 {
                                let [p, q] = [centre(t), centre(t + 1e-4 / speed)];
                                let along = (q - p) * 1e4;
                                t += (at - p).dot(&along) / along.norm_squared() / speed;
                            }
                            let off = (at - centre(t)).norm();
                            // The tolerance covers the rounding of the ends; the path itself is not rounded.
                            assert!(
                                off <= arc.deviation_mm + 1.0 / per_mm + 1e-9,
                                "{off} {arc:?} {t} {span:?} {share}"
                            );
                        }
                        from = written(arc.to);
                    } else if let ProgramBlock::Straight(Move::Feed { to: at, .. }) = block {
                        from = written(at);
                    }
                }
            }
        }
    }

    #[test]
    fn arc_summary_counts_fewer_blocks() {
        for pattern in [TrackPattern::Raster, TrackPattern::Spiral] {
            // On a surface that is rotationally symmetric about its middle a spiral rises evenly.
            let path = path(quadric(0.01, 0.01), PathOptions { pattern, ..ball(8.0) }).unwrap();
            let plain = path.summary().unwrap();
            let summary = path.arc_summary(&OPTIONS);
            let blocks: Vec<ProgramBlock> = path.arcs_by_track(&OPTIONS).into_iter().flatten().collect();
            assert_eq!(summary.moves, blocks.len() as u64);
            assert_eq!(summary.arcs, arcs_of(&blocks).len() as u64);
            assert!(summary.deviation_mm <= OPTIONS.tolerance_mm && summary.deviation_mm > 0.3 * OPTIONS.tolerance_mm);
            let at_feed = summary.arcs + summary.lines;
            assert!(3 * at_feed < plain.points, "{at_feed} for {} {pattern:?}", plain.points);
            assert!(summary.corner_rad[0] < summary.corner_rad[1], "{:?}", summary.corner_rad);
        }
    }
}
