//! Nominal shape of the part, from formulas of its own: the truth must share no error with the code under test.
//!
//! Closed-form surfaces z(x, y) with exact derivatives.

use crate::Vec3;

/// Surface given as a height over the plane.
///
/// Units: millimetres; `gradient` is dimensionless, `hessian` in 1/mm.
pub trait Shape: Send + Sync {
    /// Returns the height z of the surface at (x, y), in mm.
    fn height(&self, x: f64, y: f64) -> f64;
    /// Returns the derivatives dz/dx and dz/dy of the surface at (x, y).
    fn gradient(&self, x: f64, y: f64) -> [f64; 2];
    /// Returns the second derivatives d²z/dx², d²z/(dx dy) and d²z/dy² of the surface at (x, y), in 1/mm.
    fn hessian(&self, x: f64, y: f64) -> [f64; 3];

    /// Returns the point (x, y, z) of the surface at the position (x, y), in mm.
    fn point(&self, x: f64, y: f64) -> Vec3 {
        [x, y, self.height(x, y)]
    }

    /// Returns the unit normal of the surface at the position (x, y). The z component of the normal is positive.
    fn normal(&self, x: f64, y: f64) -> Vec3 {
        let [p, q] = self.gradient(x, y);
        let w = 1.0 / (1.0 + p * p + q * q).sqrt();
        [-p * w, -q * w, w]
    }

    /// Returns the points of the surface on a rectangular grid, in mm. The rectangle has the size `width_mm` in x and
    /// `depth_mm` in y, and its centre is the origin. The grid has `columns` points along x and `rows` points along y;
    /// both numbers must be at least 2. The points are in row order: x changes fastest.
    fn grid(&self, width_mm: f64, depth_mm: f64, columns: usize, rows: usize) -> Vec<Vec3> {
        let at = |i: usize, n: usize, size: f64| size * (i as f64 / (n - 1) as f64 - 0.5);
        (0..rows)
            .flat_map(|j| (0..columns).map(move |i| (i, j)))
            .map(|(i, j)| self.point(at(i, columns, width_mm), at(j, rows, depth_mm)))
            .collect()
    }
}

/// Free-form mirror of the trials: about 102 x 62 mm, slopes to 30 degrees, curvature of both signs, no symmetry.
#[derive(Clone, Copy, Debug)]
pub struct FreeForm {
    /// Factor of the height; 1 for the part of the trials.
    pub scale: f64,
}

impl FreeForm {
    /// Width in x, in millimetres.
    pub const WIDTH_MM: f64 = 102.0;
    /// Depth in y, in millimetres.
    pub const DEPTH_MM: f64 = 62.0;
    /// Columns and rows of the nominal cloud, of the size in the paper: 451,401 points.
    pub const PAPER_GRID: (usize, usize) = (901, 501);
}

impl Default for FreeForm {
    fn default() -> Self {
        Self { scale: 1.0 }
    }
}

/// Wave vector, phase and amplitude of each ripple of the free form.
const RIPPLES: [[f64; 4]; 3] = [[0.042, 0.016, 0.4, 7.0], [-0.018, 0.062, 1.1, 3.5], [0.070, -0.035, 2.3, 0.5]];

impl Shape for FreeForm {
    fn height(&self, x: f64, y: f64) -> f64 {
        let bowl = x * x / 420.0 - y * y / 310.0 + 6e-6 * x * x * x - 1.1e-5 * x * x * y;
        let ripples: f64 = RIPPLES.iter().map(|[kx, ky, phase, a]| a * (kx * x + ky * y + phase).sin()).sum();
        self.scale * (bowl + ripples)
    }

    fn gradient(&self, x: f64, y: f64) -> [f64; 2] {
        let mut p = x / 210.0 + 1.8e-5 * x * x - 2.2e-5 * x * y;
        let mut q = -y / 155.0 - 1.1e-5 * x * x;
        for [kx, ky, phase, a] in RIPPLES {
            let c = a * (kx * x + ky * y + phase).cos();
            p += kx * c;
            q += ky * c;
        }
        [self.scale * p, self.scale * q]
    }

    fn hessian(&self, x: f64, y: f64) -> [f64; 3] {
        let mut second = [1.0 / 210.0 + 3.6e-5 * x - 2.2e-5 * y, -2.2e-5 * x, -1.0 / 155.0];
        for [kx, ky, phase, a] in RIPPLES {
            let s = -a * (kx * x + ky * y + phase).sin();
            second[0] += kx * kx * s;
            second[1] += kx * ky * s;
            second[2] += ky * ky * s;
        }
        second.map(|c| self.scale * c)
    }
}

/// Cap of a sphere about the z axis, with its vertex at the origin; a positive radius opens towards +z.
#[derive(Clone, Copy, Debug)]
pub struct Sphere {
    /// Radius of curvature in millimetres, signed.
    pub radius_mm: f64,
}

impl Shape for Sphere {
    fn height(&self, x: f64, y: f64) -> f64 {
        let h2 = x * x + y * y;
        h2 / (self.radius_mm * (1.0 + (1.0 - h2 / (self.radius_mm * self.radius_mm)).sqrt()))
    }

    fn gradient(&self, x: f64, y: f64) -> [f64; 2] {
        let root = (self.radius_mm * self.radius_mm - x * x - y * y).sqrt() * self.radius_mm.signum();
        [x / root, y / root]
    }

    fn hessian(&self, x: f64, y: f64) -> [f64; 3] {
        let root2 = self.radius_mm * self.radius_mm - x * x - y * y;
        let root3 = root2 * root2.sqrt() * self.radius_mm.signum();
        [(root2 + x * x) / root3, x * y / root3, (root2 + y * y) / root3]
    }
}

/// Conic with different radii and conic constants in x and y.
#[derive(Clone, Copy, Debug)]
pub struct Biconic {
    /// Radii of curvature in x and y, in millimetres.
    pub radius_mm: [f64; 2],
    /// Conic constants in x and y.
    pub conic: [f64; 2],
}

impl Shape for Biconic {
    fn height(&self, x: f64, y: f64) -> f64 {
        let c = self.radius_mm.map(|r| 1.0 / r);
        let s = 1.0 - (1.0 + self.conic[0]) * (c[0] * x).powi(2) - (1.0 + self.conic[1]) * (c[1] * y).powi(2);
        (c[0] * x * x + c[1] * y * y) / (1.0 + s.sqrt())
    }

    fn gradient(&self, x: f64, y: f64) -> [f64; 2] {
        let c = self.radius_mm.map(|r| 1.0 / r);
        let k = self.conic.map(|k| 1.0 + k);
        let root = (1.0 - k[0] * (c[0] * x).powi(2) - k[1] * (c[1] * y).powi(2)).sqrt();
        let (numerator, denominator) = (c[0] * x * x + c[1] * y * y, 1.0 + root);
        let along = |c: f64, k: f64, t: f64| {
            2.0 * c * t / denominator + numerator * k * c * c * t / (root * denominator.powi(2))
        };
        [along(c[0], k[0], x), along(c[1], k[1], y)]
    }

    /// Returns the second derivatives d²z/dx², d²z/(dx dy) and d²z/dy² of the surface at (x, y), in 1/mm.
    ///
    /// z = N / (1 + r), with N = cx x^2 + cy y^2 and r = sqrt(1 - (1 + kx) cx^2 x^2 - (1 + ky) cy^2 y^2). cx and cy are
    /// the curvatures, kx and ky the conic constants along x and y.
    fn hessian(&self, x: f64, y: f64) -> [f64; 3] {
        let c = self.radius_mm.map(|r| 1.0 / r);
        let a = [0, 1].map(|i| (1.0 + self.conic[i]) * c[i] * c[i]);
        let root = (1.0 - a[0] * x * x - a[1] * y * y).sqrt();
        let (n, d) = (c[0] * x * x + c[1] * y * y, 1.0 + root);
        let (n1, r1) = ([2.0 * c[0] * x, 2.0 * c[1] * y], [-a[0] * x / root, -a[1] * y / root]);
        let of = |i: usize, j: usize| {
            let same = if i == j { 1.0 } else { 0.0 };
            let n2 = same * 2.0 * c[i];
            let r2 = (-same * a[i] - r1[i] * r1[j]) / root;
            (n2 - (n1[i] * r1[j] + n1[j] * r1[i]) / d - n * r2 / d + 2.0 * n * r1[i] * r1[j] / (d * d)) / d
        };
        [of(0, 0), of(0, 1), of(1, 1)]
    }
}

/// Off-axis section of an even asphere: the parent's surface about (`shift_mm`, 0), in parent coordinates moved so that
/// the section's centre is the origin.
#[derive(Clone, Copy, Debug)]
pub struct OffAxisAsphere {
    /// Vertex radius of the parent in millimetres.
    pub radius_mm: f64,
    /// Conic constant of the parent.
    pub conic: f64,
    /// Coefficient of the fourth power of the parent's radius, in mm^-3.
    pub fourth: f64,
    /// Distance of the section's centre from the parent's axis, in millimetres.
    pub shift_mm: f64,
}

impl OffAxisAsphere {
    fn parent(&self, h2: f64) -> (f64, f64) {
        let c = 1.0 / self.radius_mm;
        let root = (1.0 - (1.0 + self.conic) * c * c * h2).sqrt();
        (c * h2 / (1.0 + root) + self.fourth * h2 * h2, c / root + 4.0 * self.fourth * h2)
    }
}

impl Shape for OffAxisAsphere {
    fn height(&self, x: f64, y: f64) -> f64 {
        self.parent((x + self.shift_mm).powi(2) + y * y).0
    }

    fn gradient(&self, x: f64, y: f64) -> [f64; 2] {
        let u = x + self.shift_mm;
        let slope_over_h = self.parent(u * u + y * y).1;
        [slope_over_h * u, slope_over_h * y]
    }

    fn hessian(&self, x: f64, y: f64) -> [f64; 3] {
        let u = x + self.shift_mm;
        let h2 = u * u + y * y;
        let c = 1.0 / self.radius_mm;
        let root = (1.0 - (1.0 + self.conic) * c * c * h2).sqrt();
        let slope_over_h = self.parent(h2).1;
        // The derivative of the slope over h, by h, over h.
        let bend = (1.0 + self.conic) * c.powi(3) / root.powi(3) + 8.0 * self.fourth;
        [slope_over_h + bend * u * u, bend * u * y, slope_over_h + bend * y * y]
    }
}

/// Shallow wave on a nearly flat part.
#[derive(Clone, Copy, Debug)]
pub struct Wave {
    /// Peak to valley of the wave in millimetres.
    pub height_mm: f64,
}

impl Shape for Wave {
    fn height(&self, x: f64, y: f64) -> f64 {
        let a = self.height_mm / 4.0;
        a * (0.21 * x + 0.3).sin() + a * (0.17 * y - 0.08 * x + 1.0).sin()
    }

    fn gradient(&self, x: f64, y: f64) -> [f64; 2] {
        let a = self.height_mm / 4.0;
        let (first, second) = ((0.21 * x + 0.3).cos(), (0.17 * y - 0.08 * x + 1.0).cos());
        [a * (0.21 * first - 0.08 * second), a * 0.17 * second]
    }

    fn hessian(&self, x: f64, y: f64) -> [f64; 3] {
        let a = -self.height_mm / 4.0;
        let (first, second) = ((0.21 * x + 0.3).sin(), (0.17 * y - 0.08 * x + 1.0).sin());
        [a * (0.21 * 0.21 * first + 0.08 * 0.08 * second), -a * 0.08 * 0.17 * second, a * 0.17 * 0.17 * second]
    }
}

/// Sum of powers of x and y.
#[derive(Clone, Debug)]
pub struct XyPolynomial {
    /// Normalization radius by which x and y are divided, in mm.
    pub normalisation_radius_mm: f64,
    /// The powers of x and of y, and the coefficient in millimetres.
    pub terms: Vec<(u32, u32, f64)>,
}

impl XyPolynomial {
    /// Returns the derivative of the polynomial at (x, y), `dx` times with respect to x and `dy` times with respect to
    /// y.
    fn derivative(&self, x: f64, y: f64, dx: u32, dy: u32) -> f64 {
        let power = |t: f64, n: u32, times: u32| {
            let factor: f64 = (0..times).map(|k| f64::from(n) - f64::from(k)).product();
            if factor == 0.0 { 0.0 } else { factor * (t / self.normalisation_radius_mm).powi((n - times) as i32) }
        };
        let sum: f64 = self.terms.iter().map(|&(i, j, a)| a * power(x, i, dx) * power(y, j, dy)).sum();
        sum / self.normalisation_radius_mm.powi((dx + dy) as i32)
    }
}

impl Shape for XyPolynomial {
    fn height(&self, x: f64, y: f64) -> f64 {
        self.derivative(x, y, 0, 0)
    }

    fn gradient(&self, x: f64, y: f64) -> [f64; 2] {
        [self.derivative(x, y, 1, 0), self.derivative(x, y, 0, 1)]
    }

    fn hessian(&self, x: f64, y: f64) -> [f64; 3] {
        [self.derivative(x, y, 2, 0), self.derivative(x, y, 1, 1), self.derivative(x, y, 0, 2)]
    }
}

/// Surface moved along z so that it passes through the origin.
#[derive(Clone, Debug)]
pub struct ThroughOrigin<S>(pub S);

impl<S: Shape> Shape for ThroughOrigin<S> {
    fn height(&self, x: f64, y: f64) -> f64 {
        self.0.height(x, y) - self.0.height(0.0, 0.0)
    }

    fn gradient(&self, x: f64, y: f64) -> [f64; 2] {
        self.0.gradient(x, y)
    }

    fn hessian(&self, x: f64, y: f64) -> [f64; 3] {
        self.0.hessian(x, y)
    }
}

/// Projects the point `centre` onto the surface `shape` by Newton's method. The last parameter is the start (x, y) of
/// the iteration, in mm. Returns two results: (x, y) of the projection, and the signed distance of `centre` from the
/// surface, in mm. The distance is positive on the side to which the normal points. Returns `None` if the iteration
/// does not converge.
///
/// Solves (c - S) . S_x = 0 and (c - S) . S_y = 0. Here c is the point `centre`, S the point of the surface at (x, y),
/// and S_x and S_y are the derivatives of S with respect to x and y.
pub(crate) fn project_onto(shape: &dyn Shape, centre: Vec3, [mut x, mut y]: [f64; 2]) -> Option<([f64; 2], f64)> {
    for _ in 0..40 {
        let ([p, q], [r, s, t]) = (shape.gradient(x, y), shape.hessian(x, y));
        let off = [centre[0] - x, centre[1] - y, centre[2] - shape.height(x, y)];
        let miss = [off[0] + p * off[2], off[1] + q * off[2]];
        let [a, b, d] = [1.0 + p * p - r * off[2], p * q - s * off[2], 1.0 + q * q - t * off[2]];
        let determinant = a * d - b * b;
        let step = [(d * miss[0] - b * miss[1]) / determinant, (a * miss[1] - b * miss[0]) / determinant];
        let longest = step[0].abs().max(step[1].abs());
        if !longest.is_finite() || determinant <= 0.0 {
            return None;
        }
        let damping = if longest > 2.0 { 2.0 / longest } else { 1.0 };
        (x, y) = (x + damping * step[0], y + damping * step[1]);
        if longest < 1e-10 {
            let n = shape.normal(x, y);
            let point = shape.point(x, y);
            return Some(([x, y], (0..3).map(|k| (centre[k] - point[k]) * n[k]).sum()));
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shape_derivatives_match_differences() {
        let polynomial = XyPolynomial {
            normalisation_radius_mm: 50.0,
            terms: vec![(2, 0, 3.0), (1, 1, -0.7), (0, 3, 0.4), (4, 2, 0.2)],
        };
        let off_axis = OffAxisAsphere { radius_mm: 200.0, conic: -1.1, fourth: 2e-8, shift_mm: 60.0 };
        let shapes: [&dyn Shape; 7] = [
            &FreeForm::default(),
            &Sphere { radius_mm: -80.0 },
            &Biconic { radius_mm: [90.0, -140.0], conic: [-0.7, 1.2] },
            &off_axis,
            &Wave { height_mm: 0.01 },
            &polynomial,
            &ThroughOrigin(off_axis),
        ];
        for (which, shape) in shapes.iter().enumerate() {
            for (x, y) in [(0.0, 0.0), (13.0, -7.0), (-41.0, 22.0)] {
                let h = 1e-4;
                let [p, q] = shape.gradient(x, y);
                let fd = |dx: f64, dy: f64| (shape.height(x + dx, y + dy) - shape.height(x - dx, y - dy)) / (2.0 * h);
                assert!((p - fd(h, 0.0)).abs() < 1e-8, "shape {which} at ({x}, {y}): {p}");
                assert!((q - fd(0.0, h)).abs() < 1e-8, "shape {which} at ({x}, {y}): {q}");
                let [xx, xy, yy] = shape.hessian(x, y);
                let second = |dx: f64, dy: f64| {
                    let (a, b) = (shape.gradient(x + dx, y + dy), shape.gradient(x - dx, y - dy));
                    [(a[0] - b[0]) / (2.0 * h), (a[1] - b[1]) / (2.0 * h)]
                };
                let ([fxx, fxy], [fyx, fyy]) = (second(h, 0.0), second(0.0, h));
                for (exact, differences) in [(xx, fxx), (xy, fxy), (xy, fyx), (yy, fyy)] {
                    assert!((exact - differences).abs() < 1e-8, "shape {which} at ({x}, {y}): {exact} {differences}");
                }
            }
        }
    }

    #[test]
    fn freeform_max_slope_30_degrees() {
        let steepest = FreeForm::default()
            .grid(102.0, 62.0, 205, 125)
            .iter()
            .map(|p| FreeForm::default().gradient(p[0], p[1]))
            .map(|[p, q]| p.hypot(q).atan().to_degrees())
            .fold(0.0, f64::max);
        assert!((28.0..32.0).contains(&steepest), "{steepest}");
    }
}
