//! Curves of CAD systems: edges of faces, and profiles of surfaces.

use super::bspline::BSplineCurve;
use super::frame::Frame;
use crate::geometry::{Point, Pose, Vector};

/// Curve in space, given by one parameter.
#[derive(Clone, Debug, PartialEq)]
pub enum Curve {
    /// origin + t direction; the direction can have any length.
    Line {
        /// Point at t = 0.
        origin: Point,
        /// Step for t = 1.
        direction: Vector,
    },
    /// Circle or ellipse: origin + a cos t x + b sin t y.
    Ellipse {
        /// Centre and axes.
        frame: Frame,
        /// Semi-axes a along x and b along y, in millimetres.
        semi_axes_mm: [f64; 2],
    },
    /// Branch of a hyperbola: origin + a cosh t x + b sinh t y.
    Hyperbola {
        /// Centre and axes.
        frame: Frame,
        /// Semi-axes a along x and b along y, in millimetres.
        semi_axes_mm: [f64; 2],
    },
    /// Parabola: origin + f t^2 x + 2 f t y.
    Parabola {
        /// Apex and axes.
        frame: Frame,
        /// Focal length f in millimetres.
        focal_mm: f64,
    },
    /// B-spline, rational or not.
    BSpline(BSplineCurve),
    /// Part of a curve between two parameters.
    Part {
        /// The whole curve.
        whole: Box<Curve>,
        /// First and last parameter of the part.
        ends: [f64; 2],
    },
}

impl Curve {
    /// Returns the point at the parameter `t`, with the first and the second derivative.
    pub fn evaluate(&self, t: f64) -> (Point, Vector, Vector) {
        match self {
            Self::Line { origin, direction } => (origin + direction * t, *direction, Vector::zeros()),
            Self::Ellipse { frame, semi_axes_mm: [a, b] } => {
                let (sine, cosine) = t.sin_cos();
                let out = frame.direction(a * cosine, b * sine, 0.0);
                (frame.origin + out, frame.direction(-a * sine, b * cosine, 0.0), -out)
            }
            Self::Hyperbola { frame, semi_axes_mm: [a, b] } => {
                let out = frame.direction(a * t.cosh(), b * t.sinh(), 0.0);
                (frame.origin + out, frame.direction(a * t.sinh(), b * t.cosh(), 0.0), out)
            }
            Self::Parabola { frame, focal_mm: f } => {
                let out = frame.direction(f * t * t, 2.0 * f * t, 0.0);
                let second = frame.direction(2.0 * f, 0.0, 0.0);
                (frame.origin + out, frame.direction(2.0 * f * t, 2.0 * f, 0.0), second)
            }
            Self::BSpline(curve) => curve.evaluate(t),
            Self::Part { whole, .. } => whole.evaluate(t),
        }
    }

    /// Returns the part of the curve between two parameters.
    pub fn part(self, ends: [f64; 2]) -> Self {
        let ends = [ends[0].min(ends[1]), ends[0].max(ends[1])];
        Self::Part { whole: Box::new(self), ends }
    }

    /// Returns the same curve with the parameter -t in place of t.
    pub fn reversed(&self) -> Self {
        let mirrored = |frame: &Frame| {
            let [x, y, z] = frame.axes;
            Frame { origin: frame.origin, axes: [x, -y, -z] }
        };
        match self {
            Self::Line { origin, direction } => Self::Line { origin: *origin, direction: -direction },
            Self::Ellipse { frame, semi_axes_mm } => {
                Self::Ellipse { frame: mirrored(frame), semi_axes_mm: *semi_axes_mm }
            }
            Self::Hyperbola { frame, semi_axes_mm } => {
                Self::Hyperbola { frame: mirrored(frame), semi_axes_mm: *semi_axes_mm }
            }
            Self::Parabola { frame, focal_mm } => Self::Parabola { frame: mirrored(frame), focal_mm: *focal_mm },
            Self::BSpline(curve) => Self::BSpline(curve.reversed()),
            Self::Part { whole, ends: [low, high] } => {
                Self::Part { whole: Box::new(whole.reversed()), ends: [-high, -low] }
            }
        }
    }

    /// Returns the first and the last parameter: the domain of a B-spline, one turn of an ellipse. Returns `None` for a
    /// curve without ends.
    pub fn domain(&self) -> Option<[f64; 2]> {
        match self {
            Self::BSpline(curve) => Some(curve.knots().domain()),
            Self::Part { ends, .. } => Some(*ends),
            Self::Ellipse { .. } => Some([0.0, std::f64::consts::TAU]),
            _ => None,
        }
    }

    /// Returns the length after which the parameter repeats; infinite for a curve that is not closed.
    pub fn period(&self) -> f64 {
        match self {
            Self::Ellipse { .. } => std::f64::consts::TAU,
            Self::Part { whole, ends: [low, high] } if high - low >= whole.period() * (1.0 - 1e-12) => whole.period(),
            Self::BSpline(curve) => {
                let [low, high] = curve.knots().domain();
                let [first, middle, last] = [low, 0.5 * (low + high), high].map(|t| curve.evaluate(t).0);
                if (first - last).norm() <= 1e-9 * (first - middle).norm() { high - low } else { f64::INFINITY }
            }
            _ => f64::INFINITY,
        }
    }

    /// Returns the parameter of the point of the curve that is nearest to `p`.
    pub fn parameter_near(&self, p: &Point) -> f64 {
        match self {
            Self::Line { origin, direction } => (p - origin).dot(direction) / direction.norm_squared(),
            Self::Ellipse { frame, semi_axes_mm: [a, b] } => {
                let local = frame.local(p);
                (local.y / b).atan2(local.x / a)
            }
            Self::Hyperbola { frame, semi_axes_mm: [_, b] } => (frame.local(p).y / b).asinh(),
            Self::Parabola { frame, focal_mm } => frame.local(p).y / (2.0 * focal_mm),
            Self::BSpline(curve) => parameter_on_spline(curve, p),
            Self::Part { whole, ends: [low, high] } => {
                let mut t = whole.parameter_near(p);
                if matches!(**whole, Self::Ellipse { .. }) {
                    let middle = 0.5 * (low + high);
                    t += ((middle - t) / std::f64::consts::TAU).round() * std::f64::consts::TAU;
                }
                t.clamp(*low, *high)
            }
        }
    }

    /// Returns places on the curve from the parameter `from` to `to`, both included. Neighbours are so near that the
    /// chord between them leaves the curve by at most `tolerance_mm`, but there are at most `most` of them.
    pub fn places(&self, from: f64, to: f64, tolerance_mm: f64, most: usize) -> Vec<Point> {
        if matches!(self, Self::Line { .. }) {
            return vec![self.evaluate(from).0, self.evaluate(to).0];
        }
        let mut steps = vec![from, to];
        if let Self::BSpline(curve) = self {
            let [low, high] = [from.min(to), from.max(to)];
            steps.extend(curve.knots().breaks().into_iter().filter(|&t| t > low && t < high));
            steps.sort_by(|a, b| if from < to { a.total_cmp(b) } else { b.total_cmp(a) });
        }
        let mut parts = 4;
        loop {
            let places: Vec<f64> = steps
                .windows(2)
                .flat_map(|pair| (0..parts).map(move |i| pair[0] + (pair[1] - pair[0]) * i as f64 / parts as f64))
                .chain([to])
                .collect();
            let leaves = places.windows(2).map(|pair| self.chord_error_mm(pair[0], pair[1])).fold(0.0, f64::max);
            if leaves <= tolerance_mm || 2 * places.len() > most {
                return places.into_iter().map(|t| self.evaluate(t).0).collect();
            }
            parts *= 2;
        }
    }

    /// Returns the distance of the middle of the arc between two parameters from its chord.
    fn chord_error_mm(&self, from: f64, to: f64) -> f64 {
        let [a, m, b] = [from, 0.5 * (from + to), to].map(|t| self.evaluate(t).0);
        let chord = b - a;
        let along = if chord.norm_squared() > 0.0 { (m - a).dot(&chord) / chord.norm_squared() } else { 0.0 };
        (m - (a + chord * along)).norm()
    }

    /// Returns the curve moved by `motion`.
    pub fn moved(&self, motion: &Pose) -> Self {
        match self {
            Self::Line { origin, direction } => {
                Self::Line { origin: motion.transform_point(origin), direction: motion.transform_direction(direction) }
            }
            Self::Ellipse { frame, semi_axes_mm } => {
                Self::Ellipse { frame: frame.moved(motion), semi_axes_mm: *semi_axes_mm }
            }
            Self::Hyperbola { frame, semi_axes_mm } => {
                Self::Hyperbola { frame: frame.moved(motion), semi_axes_mm: *semi_axes_mm }
            }
            Self::Parabola { frame, focal_mm } => Self::Parabola { frame: frame.moved(motion), focal_mm: *focal_mm },
            Self::BSpline(curve) => Self::BSpline(curve.moved(motion)),
            Self::Part { whole, ends } => Self::Part { whole: Box::new(whole.moved(motion)), ends: *ends },
        }
    }
}

/// Returns the parameter of the point of a B-spline that is nearest to `p`: the nearest of places in each span, and
/// Newton's method from there.
fn parameter_on_spline(curve: &BSplineCurve, p: &Point) -> f64 {
    let breaks = curve.knots().breaks();
    let inside = |pair: &[f64]| {
        let (low, width) = (pair[0], pair[1] - pair[0]);
        (0..=8).map(move |i| low + width * f64::from(i) / 8.0)
    };
    let distance = |t: &f64| (curve.evaluate(*t).0 - p).norm_squared();
    let places = breaks.windows(2).flat_map(inside);
    let Some(mut t) = places.min_by(|a, b| distance(a).total_cmp(&distance(b))) else { return breaks[0] };
    let [low, high] = curve.knots().domain();
    for _ in 0..20 {
        let (point, first, second) = curve.evaluate(t);
        let off = point - p;
        let slope = first.norm_squared() + off.dot(&second);
        if slope <= 0.0 {
            break;
        }
        let step = off.dot(&first) / slope;
        t = (t - step).clamp(low, high);
        if step.abs() <= 1e-14 * (high - low) {
            break;
        }
    }
    t
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame() -> Frame {
        Frame::new(Point::new(1.0, 2.0, 3.0), Vector::new(0.0, 1.0, 0.0), Vector::new(1.0, 5.0, 0.0)).unwrap()
    }

    fn curves() -> Vec<Curve> {
        let points: Vec<Point> = [[0.0, 0.0, 0.0], [1.0, 2.0, 0.0], [3.0, 1.0, 1.0], [4.0, 4.0, 0.0], [6.0, 3.0, 2.0]]
            .map(Point::from)
            .into();
        let knots = vec![0.0, 0.0, 0.0, 0.0, 0.4, 1.0, 1.0, 1.0, 1.0];
        vec![
            Curve::Line { origin: Point::new(1.0, 0.0, 2.0), direction: Vector::new(0.0, 3.0, 0.5) },
            Curve::Ellipse { frame: frame(), semi_axes_mm: [3.0, 2.0] },
            Curve::Hyperbola { frame: frame(), semi_axes_mm: [3.0, 2.0] },
            Curve::Parabola { frame: frame(), focal_mm: 1.5 },
            Curve::BSpline(BSplineCurve::new(3, knots, &points, &[1.0, 2.0, 0.5, 1.0, 3.0]).unwrap()),
        ]
    }

    #[test]
    fn reversed_curve_has_negative_parameter() {
        let part = curves()[4].clone().part([0.1, 0.8]);
        for curve in curves().into_iter().chain([part]) {
            let reversed = curve.reversed();
            for t in [0.1, 0.25, 0.3, 0.75] {
                let ((p, first, second), (q, back, other)) = (curve.evaluate(t), reversed.evaluate(-t));
                assert!((p - q).norm() < 1e-14 && (first + back).norm() < 1e-12 && (second - other).norm() < 1e-11);
            }
            if let (Some([low, high]), false) = (curve.domain(), matches!(curve, Curve::Ellipse { .. })) {
                assert_eq!(reversed.domain(), Some([-high, -low]));
            }
        }
    }

    #[test]
    fn derivatives_match_differences() {
        for curve in curves() {
            for t in [0.1, 0.35, 0.77] {
                let h = 1e-5;
                let (_, first, second) = curve.evaluate(t);
                let [below, above] = [t - h, t + h].map(|t| curve.evaluate(t));
                assert!(((above.0 - below.0) / (2.0 * h) - first).norm() < 1e-6, "{curve:?}");
                assert!(((above.1 - below.1) / (2.0 * h) - second).norm() < 1e-5, "{curve:?}");
            }
        }
    }

    #[test]
    fn parameter_of_point_is_found() {
        for curve in curves() {
            for t in [0.05, 0.4, 0.9] {
                let found = curve.parameter_near(&curve.evaluate(t).0);
                assert!((found - t).abs() < 1e-12, "{found} for {t}: {curve:?}");
            }
        }
    }

    #[test]
    fn moved_curve_has_moved_points() {
        let motion = frame().pose();
        for curve in curves() {
            let (p, first, _) = curve.evaluate(0.3);
            let (q, turned, _) = curve.moved(&motion).evaluate(0.3);
            assert!(
                (q - motion.transform_point(&p)).norm() < 1e-14 && (turned - motion.rotation * first).norm() < 1e-14
            );
            let back = motion.inverse() * motion;
            assert!((back.transform_point(&p) - p).norm() < 1e-14);
        }
    }

    #[test]
    fn chords_stay_within_tolerance() {
        let circle = Curve::Ellipse { frame: frame(), semi_axes_mm: [10.0, 10.0] };
        let places = circle.places(0.0, std::f64::consts::TAU, 1e-3, 4000);
        assert!(places.windows(2).all(|pair| {
            let middle = Point::from((pair[0].coords + pair[1].coords) / 2.0);
            10.0 - (middle - Point::new(1.0, 2.0, 3.0)).norm() <= 1e-3
        }));
        assert!(places.len() < 600, "{}", places.len());
        assert!(circle.places(0.0, 1.0, 0.0, 100).len() <= 100);
    }
}
