//! Ball probe that touches the part.

use rand::RngExt;
use rand_distr::{Distribution, StandardNormal};

use crate::form::FormError;
use crate::shape::Shape;
use crate::vector::{cross, dot, length};
use crate::{Rng, Vec3};

/// Rigid motion, given by its rotation matrix (rows) and its translation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Placement {
    /// Rotation matrix, row by column.
    pub rotation: [[f64; 3]; 3],
    /// Translation in mm, applied after the rotation.
    pub translation_mm: Vec3,
}

impl Placement {
    /// Identity: the part's frame and the machine's frame are the same.
    pub const IDENTITY: Self =
        Self { rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], translation_mm: [0.0; 3] };

    /// Returns the placement that first rotates and then translates by `translation_mm`, in mm. `angles_deg` are the
    /// angles of rotation about x, y and z, in degrees. The rotation is about x first, then about y, then about z;
    /// these axes are fixed.
    pub fn new(translation_mm: Vec3, angles_deg: Vec3) -> Self {
        let [(sx, cx), (sy, cy), (sz, cz)] = angles_deg.map(|a| a.to_radians().sin_cos());
        Self {
            rotation: [
                [cz * cy, cz * sy * sx - sz * cx, cz * sy * cx + sz * sx],
                [sz * cy, sz * sy * sx + cz * cx, sz * sy * cx - cz * sx],
                [-sy, cy * sx, cy * cx],
            ],
            translation_mm,
        }
    }

    /// Draws a rotation uniformly from all rotations, and a translation of up to `reach_mm` in any direction.
    pub fn random(rng: &mut Rng, reach_mm: f64) -> Self {
        let q = unit::<4>(rng);
        let [w, x, y, z] = q;
        let direction = unit::<3>(rng);
        let reach = reach_mm * rng.random::<f64>();
        Self {
            rotation: [
                [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
                [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
                [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
            ],
            translation_mm: direction.map(|d| d * reach),
        }
    }

    /// Transforms the point `p` from the part's frame to the machine's frame, by the rotation and then the translation
    /// of this placement.
    pub fn apply(&self, p: Vec3) -> Vec3 {
        let turned = self.turned(p);
        std::array::from_fn(|i| turned[i] + self.translation_mm[i])
    }

    /// Transforms the point `p` back, from the machine's frame to the part's frame.
    pub(crate) fn apply_inverse(&self, p: Vec3) -> Vec3 {
        self.turned_back(std::array::from_fn(|i| p[i] - self.translation_mm[i]))
    }

    /// Rotates the direction `v` from the part's frame to the machine's frame.
    pub(crate) fn turned(&self, v: Vec3) -> Vec3 {
        self.rotation.map(|row| dot(row, v))
    }

    /// Rotates the direction `v` back, from the machine's frame to the part's frame.
    pub(crate) fn turned_back(&self, v: Vec3) -> Vec3 {
        std::array::from_fn(|i| (0..3).map(|k| self.rotation[k][i] * v[k]).sum())
    }
}

/// Draws a unit vector uniformly from the sphere in N dimensions.
fn unit<const N: usize>(rng: &mut Rng) -> [f64; N] {
    let v: [f64; N] = std::array::from_fn(|_| StandardNormal.sample(&mut *rng));
    let norm = v.iter().map(|c: &f64| c * c).sum::<f64>().sqrt();
    v.map(|c| c / norm)
}

/// Returns the centre, in mm, of a probe ball that touches the ground surface (the nominal surface with its form
/// error). The ball has the radius `radius_mm`. The contact point is S + e n: S is the nominal point of `shape` at (x,
/// y), n the nominal unit normal at S, and e the error of `form` at (x, y), in mm.
///
/// The ball touches along the normal of the ground surface, not along n. This normal is computed from n, e and the
/// gradient of e, without linearization. The centre therefore contains the second-order term of eq. (6) of the paper
/// that docs/method.md describes.
pub fn centre(shape: &dyn Shape, form: &FormError, radius_mm: f64, x: f64, y: f64) -> Vec3 {
    let (s, n, e) = (shape.point(x, y), shape.normal(x, y), form.height(x, y));
    let [p, q] = shape.gradient(x, y);
    let [ex, ey] = form.gradient(x, y);
    // Tangents of the ground surface r(x, y) = S + e n, with dn by central differences of the exact normal.
    let h = 1e-4;
    let dn = |dx: f64, dy: f64| -> Vec3 {
        let (a, b) = (shape.normal(x + dx, y + dy), shape.normal(x - dx, y - dy));
        std::array::from_fn(|i| (a[i] - b[i]) / (2.0 * h))
    };
    let (nx, ny) = (dn(h, 0.0), dn(0.0, h));
    let tx: Vec3 = std::array::from_fn(|i| [1.0, 0.0, p][i] + ex * n[i] + e * nx[i]);
    let ty: Vec3 = std::array::from_fn(|i| [0.0, 1.0, q][i] + ey * n[i] + e * ny[i]);
    let m = cross(tx, ty);
    let norm = length(m);
    std::array::from_fn(|i| s[i] + e * n[i] + radius_mm * m[i] / norm)
}

/// Adds Gaussian noise to each coordinate of every point. `sigma_mm` is the standard deviation of the noise, in mm.
pub fn add_noise(rng: &mut Rng, points: &mut [Vec3], sigma_mm: f64) {
    for c in points.iter_mut().flatten() {
        let z: f64 = StandardNormal.sample(&mut *rng);
        *c += sigma_mm * z;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shape::{FreeForm, Sphere};

    #[test]
    fn probe_centre_concentric_on_sphere() {
        let sphere = Sphere { radius_mm: -50.0 };
        for (x, y) in [(0.0, 0.0), (10.0, -20.0), (-30.0, 5.0)] {
            let c = centre(&sphere, &FormError::none(), 1.5, x, y);
            let distance = (c[0] * c[0] + c[1] * c[1] + (c[2] + 50.0).powi(2)).sqrt();
            assert!((distance - 51.5).abs() < 1e-13, "{distance}");
        }
    }

    #[test]
    fn probe_ball_touches_without_cutting() {
        let (shape, form) = (FreeForm::default(), FormError::new(7, 30.0, 6.657e-3, 102.0, 62.0));
        let c = centre(&shape, &form, 1.5, 12.0, -8.0);
        let mut nearest = f64::INFINITY;
        for i in -200..=200 {
            for j in -200..=200 {
                let (x, y) = (c[0] + f64::from(i) * 0.005, c[1] + f64::from(j) * 0.005);
                let (s, n, e) = (shape.point(x, y), shape.normal(x, y), form.height(x, y));
                let d2: f64 = (0..3).map(|k| (s[k] + e * n[k] - c[k]).powi(2)).sum();
                nearest = nearest.min(d2.sqrt());
            }
        }
        assert!((1.5..1.5 + 1e-5).contains(&nearest), "{nearest}");
    }
}
