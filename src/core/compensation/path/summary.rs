//! Summary of a whole path, and the check against the limits of a machine.

use rayon::prelude::*;

use super::{Move, Moves, PathError, RotaryAxis, ToolPath};
use crate::geometry::{Point, Vector};

/// Maximum number of points of a path.
const MAX_POINTS: u64 = 200_000_000;

/// Limits of a machine; `None` if a limit is unknown.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct MachineLimits {
    /// Minimum and maximum x, y, z of the programmed point, in the frame of the program.
    pub travel_mm: Option<[[f64; 3]; 2]>,
    /// Maximum speed of an axis.
    pub speed_mm_s: Option<f64>,
    /// Maximum acceleration.
    pub acceleration_mm_s2: Option<f64>,
    /// Maximum jerk: rate of change of the acceleration.
    pub jerk_mm_s3: Option<f64>,
}

impl MachineLimits {
    /// Returns the distance, in millimetres, that the machine needs to accelerate from standstill to the feed
    /// `feed_mm_min`.
    ///
    /// Symbols: v is the feed, a is the maximum acceleration and j is the maximum jerk.
    ///
    /// - With both limits: v / 2 (v / a + a / j). If the machine does not reach the acceleration a (v j < a^2): v (v /
    ///   j)^(1/2).
    /// - With a jerk limit only: v (v / j)^(1/2).
    /// - With an acceleration limit only: v^2 / (2 a).
    /// - With no limit: 0.
    pub fn run_up_mm(&self, feed_mm_min: f64) -> f64 {
        let speed = feed_mm_min / 60.0;
        match (self.acceleration_mm_s2, self.jerk_mm_s3) {
            (Some(a), Some(j)) if speed * j >= a * a => 0.5 * speed * (speed / a + a / j),
            (_, Some(j)) => speed * (speed / j).sqrt(),
            (Some(a), None) => speed * speed / (2.0 * a),
            (None, None) => 0.0,
        }
    }

    /// Returns the highest feed, in mm/min, that the machine reaches from standstill within the distance `way_mm`.
    fn feed_for_run_up(&self, way_mm: f64) -> f64 {
        let (mut low, mut high) = (0.0, 1.0);
        while self.run_up_mm(high) < way_mm && high < 1e9 {
            high *= 2.0;
        }
        for _ in 0..60 {
            let middle = 0.5 * (low + high);
            if self.run_up_mm(middle) <= way_mm { low = middle } else { high = middle }
        }
        low
    }
}

/// Extreme value along a path, and its place.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Peak {
    /// Extreme value.
    pub value: f64,
    /// Place in x and y.
    pub place_mm: [f64; 2],
    /// Feed at this place.
    pub feed_mm_min: f64,
}

/// Rotation of the head along a path. Angles are right-handed, in rad.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HeadRotation {
    /// Rotary axis of the head.
    pub rotary: RotaryAxis,
    /// Smallest tilt.
    pub min_tilt_rad: Peak,
    /// Largest tilt.
    pub max_tilt_rad: Peak,
    /// Largest angular speed at feed.
    pub max_rate_rad_s: Peak,
}

/// Summary of a whole path.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PathSummary {
    /// Number of moves, including rapid moves.
    pub moves: u64,
    /// Number of points at feed.
    pub points: u64,
    /// Smallest x, y, z.
    pub min_mm: [f64; 3],
    /// Largest x, y, z.
    pub max_mm: [f64; 3],
    /// Length of the path of the wheel's centre at feed.
    pub length_mm: f64,
    /// Length of the rapid moves along z. Rapid moves in x and y do not count.
    pub rapid_mm: f64,
    /// Time of the moves at feed, in s, without time for acceleration.
    pub duration_s: f64,
    /// Largest speed of each axis, in mm/s.
    pub speed_mm_s: [Peak; 3],
    /// Largest acceleration across the path, in mm/s²: v^2 times the curvature.
    pub acceleration_mm_s2: Peak,
    /// Largest jerk while the wheel is on the part or its overrun, in mm/s³: v^3 (k'^2 + k^4)^(1/2) for a curvature k
    /// with the derivative k' along the path. Leads do not count: there a controller can move more slowly without
    /// harm.
    pub jerk_mm_s3: Peak,
    /// Feed at the start of the tracks.
    pub feed_mm_min: f64,
    /// Distance from standstill to the part: overrun plus lead.
    pub run_up_mm: f64,
    /// Rotation of the head; `None` if the wheel is not tilted.
    pub head_rotation: Option<HeadRotation>,
}

impl ToolPath {
    /// Computes the summary of the whole path: numbers of moves and points, extent, lengths, time, and the largest
    /// speed, acceleration, jerk and tilt. Tracks are computed in parallel.
    ///
    /// # Errors
    /// Returns [`PathError::TooManyPoints`] for more than 2e8 points.
    pub fn summary(&self) -> Result<PathSummary, PathError> {
        let options = self.options();
        let empty = PathSummary {
            moves: 0,
            points: 0,
            min_mm: [f64::INFINITY; 3],
            max_mm: [f64::NEG_INFINITY; 3],
            length_mm: 0.0,
            rapid_mm: 0.0,
            duration_s: 0.0,
            speed_mm_s: [Peak::default(); 3],
            acceleration_mm_s2: Peak::default(),
            jerk_mm_s3: Peak::default(),
            feed_mm_min: options.feed_mm_min,
            run_up_mm: options.overrun_mm + options.lead_mm,
            head_rotation: options.tilting_axis().map(HeadRotation::empty),
        };
        let tracks: Vec<PathSummary> = (0..self.track_count())
            .into_par_iter()
            .map(|k| {
                let mut one = empty;
                one.add_track(Moves::new(self, k, k + 1), self.safe_z_mm());
                one
            })
            .collect();
        // Add up in the order of the tracks, so that the length does not depend on the order of the threads.
        let whole = tracks.into_iter().fold(empty, PathSummary::merge);
        if whole.points > MAX_POINTS {
            return Err(PathError::TooManyPoints { points: whole.points, limit: MAX_POINTS });
        }
        Ok(whole)
    }
}

impl PathSummary {
    /// Adds the moves of one track to this summary: their number, lengths and time, and their largest speed,
    /// acceleration and jerk. `safe_z_mm` is the z, in mm, at which the first move of the track begins.
    fn add_track(&mut self, mut moves: Moves, safe_z_mm: f64) {
        let mut last: Option<Point> = None;
        let mut before: Option<ChordCurvature> = None;
        let (mut height, mut tilted) = (safe_z_mm, None);
        while let Some(one) = moves.next() {
            self.moves += 1;
            match one {
                Move::RapidZ(z) => {
                    let from = last.take().map_or(height, |p| p.z);
                    self.rapid_mm += (z - from).abs();
                    (self.min_mm[2], self.max_mm[2]) = (self.min_mm[2].min(z), self.max_mm[2].max(z));
                    height = z;
                }
                Move::RapidXy(_) => {}
                Move::RapidTilted { to_mm, tilt_rad } => {
                    tilted = Some(tilt_rad);
                    self.head_rotation.iter_mut().for_each(|turned| turned.add_tilt(tilt_rad, to_mm));
                }
                Move::FeedTilted { to: at, tilt_rad, feed_mm_min, centre_mm } => {
                    let seconds = 60.0 * centre_mm / feed_mm_min;
                    let by_rad = tilted.replace(tilt_rad).map_or(0.0, |from| tilt_rad - from);
                    self.head_rotation
                        .iter_mut()
                        .for_each(|turned| turned.add_rotation(by_rad, tilt_rad, seconds, &at, feed_mm_min));
                    self.add_feed(&mut last, &mut before, &moves, (at, feed_mm_min, Some(centre_mm)));
                }
                Move::Feed { to: at, feed_mm_min } => {
                    self.add_feed(&mut last, &mut before, &moves, (at, feed_mm_min, None))
                }
            }
        }
    }

    /// Adds a move at feed that ends at the point `at`: updates the number of points, extent, length, time, and the
    /// largest speed, acceleration and jerk.
    ///
    /// `last` is the end point of the previous move, and `before` is the curvature of the path along the previous move.
    /// The function replaces `last` and `before` by the values of this move. `centre_mm` is the distance that the
    /// wheel's centre moves, in mm. If `centre_mm` is `None`, this distance is the distance between `last` and `at`.
    #[inline]
    fn add_feed(
        &mut self,
        last: &mut Option<Point>,
        before: &mut Option<ChordCurvature>,
        moves: &Moves,
        (at, feed_mm_min, centre_mm): (Point, f64, Option<f64>),
    ) {
        self.points += 1;
        for k in 0..3 {
            (self.min_mm[k], self.max_mm[k]) = (self.min_mm[k].min(at[k]), self.max_mm[k].max(at[k]));
        }
        if let Some(from) = *last {
            let chord_mm = centre_mm.unwrap_or_else(|| (at - from).norm());
            self.add_step(&(at - from), chord_mm, &at, feed_mm_min, moves.curvature_per_mm);
            let now = moves.on_span.then_some(ChordCurvature { curvature_per_mm: moves.curvature_per_mm, chord_mm });
            if let Some((before, now)) = before.zip(now) {
                self.update_jerk(before, now, from, feed_mm_min);
            }
            *before = now;
        }
        *last = Some(at);
    }

    #[inline]
    fn add_step(&mut self, by: &Vector, length: f64, at: &Point, feed_mm_min: f64, bend: f64) {
        let speed = feed_mm_min / 60.0;
        self.length_mm += length;
        self.duration_s += length / speed;
        let share = if length > 0.0 { speed / length } else { 0.0 };
        let peak = |value: f64| Peak { value, place_mm: [at.x, at.y], feed_mm_min };
        for k in 0..3 {
            if by[k].abs() * share > self.speed_mm_s[k].value {
                self.speed_mm_s[k] = peak(by[k].abs() * share);
            }
        }
        if speed * speed * bend > self.acceleration_mm_s2.value {
            self.acceleration_mm_s2 = peak(speed * speed * bend);
        }
    }

    /// Computes the jerk at the point `at` between two successive straight moves, and stores it in this summary if it
    /// is the largest so far. `before` and `now` hold the curvature of the path along each of the two moves and their
    /// lengths. `feed_mm_min` is the feed at `at`.
    #[inline]
    fn update_jerk(&mut self, before: ChordCurvature, now: ChordCurvature, at: Point, feed_mm_min: f64) {
        let speed = feed_mm_min / 60.0;
        let changes = (now.curvature_per_mm - before.curvature_per_mm)
            / (0.5 * (now.chord_mm + before.chord_mm)).max(f64::MIN_POSITIVE);
        let value = speed.powi(3) * changes.hypot(now.curvature_per_mm.max(before.curvature_per_mm).powi(2));
        if value > self.jerk_mm_s3.value {
            self.jerk_mm_s3 = Peak { value, place_mm: [at.x, at.y], feed_mm_min };
        }
    }

    fn merge(self, other: Self) -> Self {
        let larger = |a: Peak, b: Peak| if b.value > a.value { b } else { a };
        Self {
            moves: self.moves + other.moves,
            points: self.points + other.points,
            min_mm: std::array::from_fn(|k| self.min_mm[k].min(other.min_mm[k])),
            max_mm: std::array::from_fn(|k| self.max_mm[k].max(other.max_mm[k])),
            length_mm: self.length_mm + other.length_mm,
            rapid_mm: self.rapid_mm + other.rapid_mm,
            duration_s: self.duration_s + other.duration_s,
            speed_mm_s: std::array::from_fn(|k| larger(self.speed_mm_s[k], other.speed_mm_s[k])),
            acceleration_mm_s2: larger(self.acceleration_mm_s2, other.acceleration_mm_s2),
            jerk_mm_s3: larger(self.jerk_mm_s3, other.jerk_mm_s3),
            head_rotation: self.head_rotation.zip(other.head_rotation).map(|(a, b)| a.merge(b)),
            ..self
        }
    }

    /// Checks the path against the limits of a machine. A limit that is `None` is not checked.
    ///
    /// # Errors
    /// Returns an error for the first limit that the path exceeds. The order of the checks is:
    ///
    /// - travel of each axis X, Y, Z
    /// - speed of each axis
    /// - angle range and angular speed of the head, if the path tilts the wheel
    /// - acceleration across the path
    /// - jerk while the wheel is on the part or its overrun
    /// - run-up: the distance that the machine needs to reach the feed must not be longer than overrun plus lead
    pub fn check(&self, limits: &MachineLimits) -> Result<(), PathError> {
        if let Some([least, most]) = limits.travel_mm {
            for (k, axis) in ['X', 'Y', 'Z'].into_iter().enumerate() {
                for found_mm in [self.min_mm[k], self.max_mm[k]] {
                    if !(least[k]..=most[k]).contains(&found_mm) {
                        return Err(PathError::Travel { axis, found_mm, min_mm: least[k], max_mm: most[k] });
                    }
                }
            }
        }
        if let Some(limit_mm_s) = limits.speed_mm_s {
            for (axis, peak) in ['X', 'Y', 'Z'].into_iter().zip(self.speed_mm_s) {
                // Tolerate rounding errors.
                if peak.value > limit_mm_s * (1.0 + 1e-9) {
                    let ([x_mm, y_mm], found_mm_s) = (peak.place_mm, peak.value);
                    let feed_mm_min = (peak.feed_mm_min * limit_mm_s / found_mm_s).floor();
                    return Err(PathError::Speed { axis, found_mm_s, x_mm, y_mm, limit_mm_s, feed_mm_min });
                }
            }
        }
        self.head_rotation.map_or(Ok(()), |turned| turned.check())?;
        let Peak { value: found_mm_s2, place_mm: [x_mm, y_mm], feed_mm_min } = self.acceleration_mm_s2;
        if let Some(limit_mm_s2) = limits.acceleration_mm_s2.filter(|limit| found_mm_s2 > *limit) {
            let feed_mm_min = (feed_mm_min * (limit_mm_s2 / found_mm_s2).sqrt()).floor();
            return Err(PathError::Acceleration { x_mm, y_mm, found_mm_s2, limit_mm_s2, feed_mm_min });
        }
        let Peak { value: found_mm_s3, place_mm: [x_mm, y_mm], feed_mm_min } = self.jerk_mm_s3;
        if let Some(limit_mm_s3) = limits.jerk_mm_s3.filter(|limit| found_mm_s3 > *limit) {
            let feed_mm_min = (feed_mm_min * (limit_mm_s3 / found_mm_s3).cbrt()).floor();
            return Err(PathError::Jerk { x_mm, y_mm, found_mm_s3, limit_mm_s3, feed_mm_min });
        }
        let found_mm = limits.run_up_mm(self.feed_mm_min);
        if found_mm > self.run_up_mm {
            let feed_mm_min = limits.feed_for_run_up(self.run_up_mm).floor();
            return Err(PathError::RunUp { found_mm, limit_mm: self.run_up_mm, feed_mm_min });
        }
        Ok(())
    }
}

impl HeadRotation {
    fn empty(rotary: &RotaryAxis) -> Self {
        let [least, most] = [f64::INFINITY, f64::NEG_INFINITY].map(|value| Peak { value, ..Peak::default() });
        Self { rotary: *rotary, min_tilt_rad: least, max_tilt_rad: most, max_rate_rad_s: Peak::default() }
    }

    fn add_tilt(&mut self, tilt_rad: f64, at_mm: [f64; 2]) {
        let here = Peak { value: tilt_rad, place_mm: at_mm, feed_mm_min: 0.0 };
        if tilt_rad < self.min_tilt_rad.value {
            self.min_tilt_rad = here;
        }
        if tilt_rad > self.max_tilt_rad.value {
            self.max_tilt_rad = here;
        }
    }

    fn add_rotation(&mut self, by_rad: f64, tilt_rad: f64, seconds: f64, at: &Point, feed_mm_min: f64) {
        let at_mm = [at.x, at.y];
        self.add_tilt(tilt_rad, at_mm);
        let value = if by_rad == 0.0 { 0.0 } else { by_rad.abs() / seconds.max(f64::MIN_POSITIVE) };
        if value > self.max_rate_rad_s.value {
            self.max_rate_rad_s = Peak { value, place_mm: at_mm, feed_mm_min };
        }
    }

    fn merge(self, other: Self) -> Self {
        let larger = |a: Peak, b: Peak| if b.value > a.value { b } else { a };
        let less = |a: Peak, b: Peak| if b.value < a.value { b } else { a };
        Self {
            min_tilt_rad: less(self.min_tilt_rad, other.min_tilt_rad),
            max_tilt_rad: larger(self.max_tilt_rad, other.max_tilt_rad),
            max_rate_rad_s: larger(self.max_rate_rad_s, other.max_rate_rad_s),
            ..self
        }
    }

    fn check(&self) -> Result<(), PathError> {
        let RotaryAxis { letter, range_rad, rate_rad_s, .. } = self.rotary;
        let [min_deg, max_deg] = range_rad.map(f64::to_degrees);
        for Peak { value, place_mm: [x_mm, y_mm], .. } in [self.min_tilt_rad, self.max_tilt_rad] {
            let found_deg = self.rotary.scale_reading_rad(value).to_degrees();
            // Tolerate rounding errors.
            let by_deg = (min_deg - found_deg).max(found_deg - max_deg);
            if by_deg > 1e-9 {
                return Err(PathError::Tilt { letter, found_deg, x_mm, y_mm, min_deg, max_deg, by_deg });
            }
        }
        let Peak { value, place_mm: [x_mm, y_mm], feed_mm_min } = self.max_rate_rad_s;
        if value > rate_rad_s * (1.0 + 1e-9) {
            let [found_deg_min, limit_deg_min] = [value, rate_rad_s].map(|rate| 60.0 * rate.to_degrees());
            // A slower spiral has its own feed at this place.
            let feed_mm_min = feed_mm_min * rate_rad_s / value;
            return Err(PathError::Rate { letter, found_deg_min, x_mm, y_mm, limit_deg_min, feed_mm_min });
        }
        Ok(())
    }
}

/// Curvature of a path along a chord, in 1/mm, and length of the chord.
#[derive(Clone, Copy)]
struct ChordCurvature {
    curvature_per_mm: f64,
    chord_mm: f64,
}

#[cfg(test)]
mod tests {
    use super::super::PathOptions;
    use super::super::wheel_fit::tests::{PART, ball, path, quadric, surface};
    use super::*;

    #[test]
    fn summary_checks_machine_limits() {
        let path = path(quadric(0.01, 0.01), ball(10.0)).unwrap();
        let summary = path.summary().unwrap();
        // 10 mm/s.
        let Peak { value, .. } = summary.acceleration_mm_s2;
        // The lead-in has a radius of 5 mm over x and y, which is a little more along the slope.
        assert!((value - 100.0 / 5.0).abs() < 1.5, "{value}");
        assert!(summary.check(&MachineLimits::default()).is_ok());
        let travel_mm = Some([[-9.0, -50.0, 0.0], [50.0, 50.0, 50.0]]);
        assert!(matches!(
            summary.check(&MachineLimits { travel_mm, ..MachineLimits::default() }),
            Err(PathError::Travel { axis: 'X', .. })
        ));
        let speed_mm_s = Some(9.0);
        assert!(matches!(
            summary.check(&MachineLimits { speed_mm_s, ..MachineLimits::default() }),
            Err(PathError::Speed { axis: 'X', .. })
        ));
        let limited =
            |a: f64| summary.check(&MachineLimits { acceleration_mm_s2: Some(a), ..MachineLimits::default() });
        assert!(limited(25.0).is_ok());
        let Err(PathError::Acceleration { feed_mm_min, .. }) = limited(10.0) else { panic!() };
        assert!((feed_mm_min - 600.0 * (10.0 / value).sqrt()).abs() < 1.0);
        let straight = PathSummary { acceleration_mm_s2: Peak::default(), ..summary };
        let slow = MachineLimits { acceleration_mm_s2: Some(1.0), ..MachineLimits::default() };
        assert!(matches!(straight.check(&slow), Err(PathError::RunUp { .. })));
    }

    #[test]
    fn summary_jerk_of_sine_path() {
        // z = h sin(k x) along the tracks. The path of a very small ball is nearly the surface itself: its third
        // derivative is h k^3.
        let (h, k) = (0.02, 0.4);
        let wave = surface(move |[x, _]| (h * (k * x).sin(), [h * k * (k * x).cos(), 0.0]));
        let options = PathOptions { chord_error_mm: 1e-6, ..ball(0.05) };
        let summary = path(wave, options).unwrap().summary().unwrap();
        let of = 10.0_f64.powi(3) * h * k.powi(3);
        assert!((summary.jerk_mm_s3.value / of - 1.0).abs() < 0.02, "{} for {of}", summary.jerk_mm_s3.value);
        let limited = |j: f64| summary.check(&MachineLimits { jerk_mm_s3: Some(j), ..MachineLimits::default() });
        let Err(PathError::Jerk { feed_mm_min, .. }) = limited(0.5 * of) else { panic!("{:?}", limited(0.5 * of)) };
        assert!((feed_mm_min - 600.0 * 0.5f64.cbrt()).abs() < 6.0, "{feed_mm_min}");
        let slower = path(
            surface(move |[x, _]| (h * (k * x).sin(), [h * k * (k * x).cos(), 0.0])),
            PathOptions { feed_mm_min, lead_mm: 50.0, ..options },
        );
        let limits = MachineLimits { jerk_mm_s3: Some(0.5 * of), ..MachineLimits::default() };
        assert_eq!(slower.unwrap().summary().unwrap().check(&limits), Ok(()));
    }

    #[test]
    fn run_up_from_acceleration_and_jerk() {
        let limits = |a: Option<f64>, j: Option<f64>| MachineLimits {
            acceleration_mm_s2: a,
            jerk_mm_s3: j,
            ..MachineLimits::default()
        };
        // 10 mm/s with 100 mm/s²: 0.1 s, 0.5 mm. With 1000 mm/s³ the acceleration rises for 0.1 s and falls for 0.1 s;
        // its limit is just reached.
        assert!((limits(Some(100.0), None).run_up_mm(600.0) - 0.5).abs() < 1e-12);
        assert!((limits(Some(100.0), Some(1000.0)).run_up_mm(600.0) - 1.0).abs() < 1e-12);
        assert!((limits(Some(1e9), Some(1000.0)).run_up_mm(600.0) - 1.0).abs() < 1e-12);
        assert!((limits(None, Some(1000.0)).run_up_mm(600.0) - 1.0).abs() < 1e-12);
        // 20 mm/s: 0.1 s rise, 0.1 s at 100 mm/s², 0.1 s fall. The mean speed is half of 20 mm/s.
        assert!((limits(Some(100.0), Some(1000.0)).run_up_mm(1200.0) - 3.0).abs() < 1e-12);
        for feed in [1.0, 600.0, 1e5] {
            for limits in [limits(Some(100.0), None), limits(Some(100.0), Some(1000.0)), limits(None, Some(50.0))] {
                assert!((limits.feed_for_run_up(limits.run_up_mm(feed)) / feed - 1.0).abs() < 1e-9);
            }
        }
        assert_eq!(MachineLimits::default().run_up_mm(600.0), 0.0);
    }

    #[test]
    fn tool_path_chords_within_tolerance() {
        let path = path(quadric(0.01, -0.005), ball(10.0)).unwrap();
        let summary = path.summary().unwrap();
        assert_eq!(path.moves().count() as u64, summary.moves);
        let mut last: Option<Point> = None;
        for one in path.moves() {
            if let (Move::Feed { to: at, .. }, Some(from)) = (one, last) {
                let middle = nalgebra::center(&from, &at);
                // The centre of a ball in contact is 10 mm from the surface; in a lead it is further away.
                let nearest = |p: &Point| {
                    let mut place = [p.x, p.y];
                    for _ in 0..50 {
                        let contact = path.target().at(place);
                        let off = p - contact.point;
                        let aside = off - contact.normal * off.dot(&contact.normal);
                        place = [place[0] + 0.7 * aside.x, place[1] + 0.7 * aside.y];
                    }
                    (p - path.target().at(place).point).norm()
                };
                let off = nearest(&middle) - 10.0;
                let on_part = PART.contains(middle.x, middle.y);
                assert!(off > -1.1e-4 && (!on_part || off < 1.1e-4), "{off} at {middle}");
            }
            last = if let Move::Feed { to: at, .. } = one { Some(at) } else { None };
        }
    }
}
