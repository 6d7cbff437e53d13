//! B-spline curves and tensor-product B-spline surfaces, rational or not, with exact derivatives.
//!
//! **Conventions.** A direction of degree p with n control points has n + p + 1 knots in ascending order; its domain is
//! from knot p to knot n (counted from 0). The basis comes from the recurrence of Cox and de Boor, its derivatives from
//! the bases of the two degrees below (Piegl and Tiller, The NURBS Book, eq. 2.5 and 2.7). Outside the domain the
//! polynomial of the first or last span goes on. A rational point is (w x, w y, w z, w).

use thiserror::Error;

use crate::geometry::{Point, Pose, Vector};

/// Largest degree of a direction.
pub const MAX_DEGREE: usize = 25;

/// Maximum number of control points of one curve or surface.
const MAX_CONTROL_POINTS: usize = 4_000_000;

/// Reason why numbers are not a B-spline.
#[derive(Clone, Debug, Error, PartialEq)]
#[allow(missing_docs)]
#[non_exhaustive]
pub enum BSplineError {
    /// The degree is 0 or too large.
    #[error("the degree is {degree}; it must be from 1 to {MAX_DEGREE}")]
    Degree { degree: usize },
    /// There are too few control points for the degree, or too many for the memory.
    #[error("{count} control points in a direction of degree {degree}; it needs from {least} to {MAX_CONTROL_POINTS}")]
    ControlPoints { count: usize, degree: usize, least: usize },
    /// The number of knots does not fit.
    #[error("{found} knots; a degree of {degree} with {count} control points needs {expected}")]
    KnotCount { found: usize, degree: usize, count: usize, expected: usize },
    /// A knot is not finite, less than the knot before, or repeated too often; or the domain is empty.
    #[error("knot {number} is {value}; knots must be finite and ascending, and the domain must not be empty")]
    Knot { number: usize, value: f64 },
    /// The control points do not form the net.
    #[error("{found} control points; the net needs {expected}")]
    Net { found: usize, expected: usize },
    /// A coordinate is not finite.
    #[error("control point {number} has a coordinate that is not finite")]
    NotFinite { number: usize },
    /// A weight is zero, negative or not finite.
    #[error("the weight of control point {number} is {weight}; it must be greater than 0")]
    Weight { number: usize, weight: f64 },
}

/// Degree and knots of one direction.
#[derive(Clone, Debug, PartialEq)]
pub struct Knots {
    degree: usize,
    values: Vec<f64>,
}

/// Values of the basis functions that are not zero at a parameter, with their first and second derivatives.
struct Basis {
    /// Index of the first of these functions.
    first: usize,
    /// Function, first and second derivative; the first `degree + 1` of each are used.
    values: [[f64; MAX_DEGREE + 1]; 3],
}

impl Knots {
    /// Checks the knots of a direction with `count` control points.
    ///
    /// # Errors
    /// Returns an error if degree, number or order of the knots is not valid, or if the domain is empty.
    pub fn new(degree: usize, values: Vec<f64>, count: usize) -> Result<Self, BSplineError> {
        if !(1..=MAX_DEGREE).contains(&degree) {
            return Err(BSplineError::Degree { degree });
        }
        if !(degree + 1..=MAX_CONTROL_POINTS).contains(&count) {
            return Err(BSplineError::ControlPoints { count, degree, least: degree + 1 });
        }
        let expected = count + degree + 1;
        if values.len() != expected {
            return Err(BSplineError::KnotCount { found: values.len(), degree, count, expected });
        }
        let falls = |i: &usize| !values[*i].is_finite() || (*i > 0 && values[*i] < values[*i - 1]);
        // A knot that is repeated more than degree + 1 times makes a basis function of width zero.
        let repeats = |i: &usize| *i > degree && *i + 1 < expected && values[*i + 1] == values[*i - degree];
        if let Some(at) = (0..expected).find(|i| falls(i) || repeats(i)) {
            return Err(BSplineError::Knot { number: at + 1, value: values[at] });
        }
        if values[degree] >= values[count] {
            return Err(BSplineError::Knot { number: degree + 1, value: values[degree] });
        }
        Ok(Self { degree, values })
    }

    /// Returns the number of control points of the direction.
    pub fn count(&self) -> usize {
        self.values.len() - self.degree - 1
    }

    /// Returns the degree.
    pub fn degree(&self) -> usize {
        self.degree
    }

    /// Returns the first and the last parameter.
    pub fn domain(&self) -> [f64; 2] {
        [self.values[self.degree], self.values[self.count()]]
    }

    /// Returns the borders of the spans within the domain, in ascending order, each once.
    pub fn breaks(&self) -> Vec<f64> {
        let mut breaks = self.values[self.degree..=self.count()].to_vec();
        breaks.dedup();
        breaks
    }

    /// Returns the index of the knot at which the span of the parameter `t` begins. Outside the domain, the first or
    /// last span is taken.
    fn span(&self, t: f64) -> usize {
        let [low, high] = self.domain();
        let inside = &self.values[self.degree..=self.count()];
        let after = if t >= high {
            inside.partition_point(|&knot| knot < high)
        } else {
            inside.partition_point(|&knot| knot <= t.max(low))
        };
        self.degree + after - 1
    }

    /// Evaluates the basis and its derivatives at `t`.
    fn basis(&self, t: f64) -> Basis {
        let (p, span) = (self.degree, self.span(t));
        let mut rows = [[0.0; MAX_DEGREE + 1]; 3];
        // Rows of the degrees p, p - 1 and p - 2; row k has the functions span - (p - k) ..= span.
        let mut row = [0.0; MAX_DEGREE + 1];
        row[0] = 1.0;
        for degree in 0..=p {
            if degree > 0 {
                self.raise(&mut row, degree, span, t);
            }
            if degree + 2 >= p {
                rows[p - degree] = row;
            }
        }
        let first = if p >= 1 { self.derivative(&rows[1], p, span) } else { [0.0; MAX_DEGREE + 1] };
        let second = if p >= 2 {
            let below = self.derivative(&rows[2], p - 1, span);
            self.derivative(&below, p, span)
        } else {
            [0.0; MAX_DEGREE + 1]
        };
        Basis { first: span - p, values: [rows[0], first, second] }
    }

    /// Turns the functions of degree `degree` - 1 on the span into those of `degree`: the recurrence of Cox and de Boor.
    fn raise(&self, row: &mut [f64; MAX_DEGREE + 1], degree: usize, span: usize, t: f64) {
        let mut carried = 0.0;
        for (i, value) in row.iter_mut().enumerate().take(degree) {
            let [left, right] = [self.values[span + i + 1 - degree], self.values[span + i + 1]];
            let share = *value / (right - left);
            *value = carried + (right - t) * share;
            carried = (t - left) * share;
        }
        row[degree] = carried;
    }

    /// Returns the derivatives of the functions of degree `degree` from the functions `below` of one degree less.
    fn derivative(&self, below: &[f64; MAX_DEGREE + 1], degree: usize, span: usize) -> [f64; MAX_DEGREE + 1] {
        let mut row = [0.0; MAX_DEGREE + 1];
        for i in 0..degree {
            let width = self.values[span + i + 1] - self.values[span + i + 1 - degree];
            let share = degree as f64 * below[i] / width;
            row[i] -= share;
            row[i + 1] += share;
        }
        row
    }
}

/// Homogeneous point (w x, w y, w z, w).
type Homogeneous = [f64; 4];

/// B-spline curve.
#[derive(Clone, Debug, PartialEq)]
pub struct BSplineCurve {
    knots: Knots,
    controls: Vec<Homogeneous>,
}

impl BSplineCurve {
    /// Creates a curve. `weights` is empty for a curve that is not rational.
    ///
    /// # Errors
    /// Returns an error if the numbers of points, weights and knots do not fit together, or if one is not valid.
    pub fn new(degree: usize, knots: Vec<f64>, points: &[Point], weights: &[f64]) -> Result<Self, BSplineError> {
        let knots = Knots::new(degree, knots, points.len())?;
        Ok(Self { knots, controls: homogeneous(points, weights)? })
    }

    /// Returns degree and knots.
    pub fn knots(&self) -> &Knots {
        &self.knots
    }

    /// Returns the curve moved by `motion`.
    pub fn moved(&self, motion: &Pose) -> Self {
        Self { knots: self.knots.clone(), controls: self.controls.iter().map(|c| moved(c, motion)).collect() }
    }

    /// Returns the point at the parameter `t`, with the first and the second derivative.
    pub fn evaluate(&self, t: f64) -> (Point, Vector, Vector) {
        let basis = self.knots.basis(t);
        let controls = &self.controls[basis.first..=basis.first + self.knots.degree];
        let sums = [0, 1, 2].map(|k| weighted(controls, &basis.values[k]));
        let point = Vector::new(sums[0][0], sums[0][1], sums[0][2]) / sums[0][3];
        let part = |k: usize| Vector::new(sums[k][0], sums[k][1], sums[k][2]);
        let first = (part(1) - point * sums[1][3]) / sums[0][3];
        let second = (part(2) - first * (2.0 * sums[1][3]) - point * sums[2][3]) / sums[0][3];
        (point.into(), first, second)
    }

    /// Returns the same curve with the parameter -t in place of t.
    pub(super) fn reversed(&self) -> Self {
        let values = self.knots.values.iter().rev().map(|knot| -knot).collect();
        let knots = Knots { degree: self.knots.degree, values };
        Self { knots, controls: self.controls.iter().rev().copied().collect() }
    }
}

/// Tensor-product B-spline surface.
#[derive(Clone, Debug, PartialEq)]
pub struct BSplineSurface {
    u: Knots,
    v: Knots,
    /// Control points, row by row with v fastest.
    controls: Vec<Homogeneous>,
}

/// Point of a surface at (u, v), with its derivatives.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SurfacePoint {
    /// The point in millimetres.
    pub point: Point,
    /// First derivatives by u and by v.
    pub first: [Vector; 2],
    /// Second derivatives by u u, u v and v v.
    pub second: [Vector; 3],
}

impl BSplineSurface {
    /// Creates a surface from `points`, row by row with v fastest. `weights` is empty for a surface that is not rational.
    ///
    /// # Errors
    /// Returns an error if the numbers of points, weights and knots do not fit together, or if one is not valid.
    pub fn new(u: Knots, v: Knots, points: &[Point], weights: &[f64]) -> Result<Self, BSplineError> {
        let expected = u.count().saturating_mul(v.count());
        if points.len() != expected || expected > MAX_CONTROL_POINTS {
            return Err(BSplineError::Net { found: points.len(), expected });
        }
        Ok(Self { u, v, controls: homogeneous(points, weights)? })
    }

    /// Returns degrees and knots along u and v.
    pub fn knots(&self) -> [&Knots; 2] {
        [&self.u, &self.v]
    }

    /// Returns the surface moved by `motion`.
    pub fn moved(&self, motion: &Pose) -> Self {
        let controls = self.controls.iter().map(|control| moved(control, motion)).collect();
        Self { u: self.u.clone(), v: self.v.clone(), controls }
    }

    /// Returns the control points, without their weights.
    pub fn control_points(&self) -> impl Iterator<Item = Point> {
        self.controls.iter().map(|[x, y, z, w]| Point::new(x / w, y / w, z / w))
    }

    /// Returns the point at (`u`, `v`) with its first and second derivatives.
    pub fn evaluate(&self, u: f64, v: f64) -> SurfacePoint {
        let [along_u, along_v] = [self.u.basis(u), self.v.basis(v)];
        let columns = self.v.count();
        // Sums over v for each row, then over u: by derivative (u, v) = 00, 10, 01, 20, 11, 02.
        const ORDERS: [[usize; 2]; 6] = [[0, 0], [1, 0], [0, 1], [2, 0], [1, 1], [0, 2]];
        let mut sums = [[0.0; 4]; 6];
        for row in 0..=self.u.degree {
            let begin = (along_u.first + row) * columns + along_v.first;
            let controls = &self.controls[begin..=begin + self.v.degree];
            let by_v = [0, 1, 2].map(|k| weighted(controls, &along_v.values[k]));
            for (sum, [du, dv]) in sums.iter_mut().zip(ORDERS) {
                for c in 0..4 {
                    sum[c] += along_u.values[du][row] * by_v[dv][c];
                }
            }
        }
        let part = |k: usize| Vector::new(sums[k][0], sums[k][1], sums[k][2]);
        let weight = |k: usize| sums[k][3];
        let w = weight(0);
        let point = part(0) / w;
        let [du, dv] = [1, 2].map(|k| (part(k) - point * weight(k)) / w);
        let duu = (part(3) - du * (2.0 * weight(1)) - point * weight(3)) / w;
        let duv = (part(4) - du * weight(2) - dv * weight(1) - point * weight(4)) / w;
        let dvv = (part(5) - dv * (2.0 * weight(2)) - point * weight(5)) / w;
        SurfacePoint { point: point.into(), first: [du, dv], second: [duu, duv, dvv] }
    }
}

/// Moves a homogeneous point.
fn moved([x, y, z, w]: &Homogeneous, motion: &Pose) -> Homogeneous {
    let p = motion.rotation * Vector::new(*x, *y, *z) + motion.translation_mm * *w;
    [p.x, p.y, p.z, *w]
}

/// Sums control points with the basis values that belong to them.
fn weighted(controls: &[Homogeneous], basis: &[f64]) -> Homogeneous {
    let mut sum = [0.0; 4];
    for (control, value) in controls.iter().zip(basis) {
        for c in 0..4 {
            sum[c] += control[c] * value;
        }
    }
    sum
}

/// Joins points and weights. Without weights each weight is 1.
fn homogeneous(points: &[Point], weights: &[f64]) -> Result<Vec<Homogeneous>, BSplineError> {
    if !weights.is_empty() && weights.len() != points.len() {
        return Err(BSplineError::Net { found: weights.len(), expected: points.len() });
    }
    let joined = points.iter().enumerate().map(|(i, p)| {
        let w = weights.get(i).copied().unwrap_or(1.0);
        if !(p.x + p.y + p.z).is_finite() {
            return Err(BSplineError::NotFinite { number: i + 1 });
        }
        if !(w > 0.0 && w.is_finite()) {
            return Err(BSplineError::Weight { number: i + 1, weight: w });
        }
        Ok([w * p.x, w * p.y, w * p.z, w])
    });
    joined.collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Quarter of the unit circle from +x to +y.
    fn quarter_circle() -> BSplineCurve {
        let points = [Point::new(1.0, 0.0, 0.0), Point::new(1.0, 1.0, 0.0), Point::new(0.0, 1.0, 0.0)];
        BSplineCurve::new(2, vec![0.0, 0.0, 0.0, 1.0, 1.0, 1.0], &points, &[1.0, 0.5f64.sqrt(), 1.0]).unwrap()
    }

    #[test]
    fn rational_quadratic_is_circle() {
        let circle = quarter_circle();
        for i in 0..=20 {
            let (p, first, second) = circle.evaluate(f64::from(i) / 20.0);
            assert!((p.coords.norm() - 1.0).abs() < 1e-15);
            assert!(p.coords.dot(&first).abs() < 1e-14, "the tangent is perpendicular to the radius");
            let curvature = first.cross(&second).norm() / first.norm().powi(3);
            assert!((curvature - 1.0).abs() < 1e-13, "{curvature}");
        }
    }

    #[test]
    fn uniform_cubic_by_hand() {
        let points: Vec<Point> = [0.0, 1.0, 4.0, 9.0].iter().map(|&x| Point::new(x, 0.0, 0.0)).collect();
        let curve = BSplineCurve::new(3, (0..8).map(f64::from).collect(), &points, &[]).unwrap();
        assert_eq!(curve.knots().domain(), [3.0, 4.0]);
        // (1, 4, 1) / 6 at a knot; its derivative (-1, 0, 1) / 2, its second (1, -2, 1).
        let (p, first, second) = curve.evaluate(3.0);
        assert!((p.x - 8.0 / 6.0).abs() < 1e-15 && (first.x - 2.0).abs() < 1e-15 && (second.x - 2.0).abs() < 1e-14);
    }

    /// Surface z = x^2 - x y + 0.5 y^3 over [0, 2] x [0, 3], with a knot inside each direction.
    fn polynomial() -> BSplineSurface {
        // Coefficients of a monomial in a clamped spline are its blossom at the knots.
        let blossom = |degree: usize, knots: &[f64], i: usize, power: usize| -> f64 {
            let k = &knots[i + 1..=i + degree];
            match power {
                0 => 1.0,
                1 => k.iter().sum::<f64>() / degree as f64,
                2 => {
                    let pairs = (0..degree).flat_map(|a| (a + 1..degree).map(move |b| k[a] * k[b]));
                    pairs.sum::<f64>() / (degree * (degree - 1) / 2) as f64
                }
                _ => k[0] * k[1] * k[2],
            }
        };
        let (ku, kv) = (vec![0.0, 0.0, 0.0, 0.7, 2.0, 2.0, 2.0], vec![0.0, 0.0, 0.0, 0.0, 1.1, 3.0, 3.0, 3.0, 3.0]);
        let mut points = Vec::new();
        for i in 0..4 {
            for j in 0..5 {
                let u = |power| blossom(2, &ku, i, power);
                let v = |power| blossom(3, &kv, j, power);
                points.push(Point::new(u(1), v(1), u(2) - u(1) * v(1) + 0.5 * v(3)));
            }
        }
        let knots = [Knots::new(2, ku, 4).unwrap(), Knots::new(3, kv, 5).unwrap()];
        let [u, v] = knots;
        BSplineSurface::new(u, v, &points, &[]).unwrap()
    }

    #[test]
    fn surface_reproduces_polynomial() {
        let surface = polynomial();
        // The last two places are outside the domain, where the polynomial goes on.
        for (u, v) in [(0.0, 0.0), (0.7, 1.1), (1.3, 0.4), (2.0, 3.0), (2.2, 3.1), (-0.3, -0.2)] {
            let SurfacePoint { point, first, second } = surface.evaluate(u, v);
            let expected = Point::new(u, v, u * u - u * v + 0.5 * v * v * v);
            assert!((point - expected).norm() < 1e-13, "{point} at {u}, {v}");
            assert!((first[0] - Vector::new(1.0, 0.0, 2.0 * u - v)).norm() < 1e-13);
            assert!((first[1] - Vector::new(0.0, 1.0, -u + 1.5 * v * v)).norm() < 1e-13);
            let zs = second.map(|d| d.z);
            assert!((zs[0] - 2.0).abs() < 1e-12 && (zs[1] + 1.0).abs() < 1e-12 && (zs[2] - 3.0 * v).abs() < 1e-12);
        }
    }

    #[test]
    fn equal_weights_change_nothing() {
        let surface = polynomial();
        let points: Vec<Point> = surface.control_points().collect();
        let weighted =
            BSplineSurface::new(surface.u.clone(), surface.v.clone(), &points, &[3.7; 20]).unwrap().evaluate(0.4, 2.2);
        let plain = surface.evaluate(0.4, 2.2);
        assert!((weighted.point - plain.point).norm() < 1e-14);
        assert!((weighted.second[2] - plain.second[2]).norm() < 1e-12);
    }

    #[test]
    fn bad_knots_are_refused() {
        let knots = |degree, values: &[f64], count| Knots::new(degree, values.to_vec(), count);
        assert!(matches!(knots(0, &[0.0, 1.0], 1), Err(BSplineError::Degree { degree: 0 })));
        assert!(matches!(knots(26, &[0.0; 54], 27), Err(BSplineError::Degree { degree: 26 })));
        assert!(matches!(knots(2, &[0.0, 1.0], 2), Err(BSplineError::ControlPoints { .. })));
        assert!(matches!(knots(1, &[0.0, 0.0, 1.0], 2), Err(BSplineError::KnotCount { expected: 4, .. })));
        assert!(matches!(knots(1, &[0.0, 0.5, 0.2, 1.0], 2), Err(BSplineError::Knot { number: 3, .. })));
        assert!(matches!(knots(1, &[0.0, 0.0, f64::NAN, 1.0], 2), Err(BSplineError::Knot { number: 3, .. })));
        assert!(matches!(knots(1, &[0.0; 4], 2), Err(BSplineError::Knot { .. })));
        assert!(matches!(knots(1, &[0.0, 0.0, 1.0, 1.0, 1.0, 2.0, 2.0], 5), Err(BSplineError::Knot { .. })));
        let line = [Point::origin(), Point::new(1.0, 0.0, 0.0)];
        let curve = |weights: &[f64]| BSplineCurve::new(1, vec![0.0, 0.0, 1.0, 1.0], &line, weights);
        assert!(matches!(curve(&[1.0, 0.0]), Err(BSplineError::Weight { number: 2, .. })));
        assert!(matches!(curve(&[1.0]), Err(BSplineError::Net { found: 1, expected: 2 })));
        let far = [Point::origin(), Point::new(f64::INFINITY, 0.0, 0.0)];
        let refused = BSplineCurve::new(1, vec![0.0, 0.0, 1.0, 1.0], &far, &[]);
        assert!(matches!(refused, Err(BSplineError::NotFinite { number: 2 })));
    }
}
