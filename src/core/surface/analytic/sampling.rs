//! Sampling of a nominal surface on a grid, and the choice of the node spacing.

use rayon::prelude::*;

use super::analytic_surface::normal_from_gradient;
use super::definition::{DefinedSurface, Sampling};
use super::error::{self, DefinitionError};
use crate::geometry::{Aperture, Point, Vector};
use crate::surface::facet::Facet;

/// Maximum number of nodes of a sampling.
const MAX_NODES: f64 = 2e7;

/// Maximum number of terms and corners that a sampling evaluates; they take about a minute on one core.
const MAX_WORK: f64 = 2e10;

/// Distance outside the aperture, in spacings, beyond which nodes are omitted. The corners of a cell that touches the
/// aperture are within the diagonal of a cell, 1.42 spacings.
const MARGIN: f64 = 1.5;

/// Largest spacing that is tried for an accuracy, as a share of the shorter side of the aperture's bounding box.
const MAX_SPACING_SHARE: f64 = 1.0 / 32.0;

/// Number of times that the spacing is halved before the accuracy counts as out of reach.
const HALVINGS: u32 = 14;

/// Surface sampled on a grid, row by row with x fastest.
#[derive(Clone, Debug)]
pub struct SampledSurface {
    /// Number of nodes along x.
    pub columns: usize,
    /// Number of nodes along y.
    pub rows: usize,
    /// Place of the first node in x and y.
    pub origin_mm: [f64; 2],
    /// Distance of the nodes along x and along y.
    pub spacing_mm: [f64; 2],
    /// Nodes in the surface's frame, in millimetres; NaN for omitted nodes.
    pub points: Vec<Point>,
    /// Unit normals on the +z side; NaN for omitted nodes.
    pub normals: Vec<Vector>,
}

impl DefinedSurface {
    /// Samples the surface on a grid. The grid covers the bounding box of the aperture, and one more ring of nodes
    /// around this box. `spacing_mm` is the largest node spacing. The spacing along x and along y is reduced a little,
    /// so that each divides the side of the box.
    ///
    /// Units: millimetres. A node is NaN if it is farther than 1.5 spacings outside the aperture, or if the formula has
    /// no value at this node.
    ///
    /// # Errors
    /// Returns an error if the spacing is not positive or above 1e6 mm, if there would be more than 2e7 nodes, or if
    /// the computation would take more than about a minute.
    pub fn sample(&self, spacing_mm: f64) -> Result<SampledSurface, DefinitionError> {
        error::check_positive("sampling.spacing_mm", spacing_mm)?;
        let bounds = self.aperture().bounds();
        let cells = [0, 1].map(|k| ((bounds[1][k] - bounds[0][k]) / spacing_mm * (1.0 - 1e-12)).ceil().max(1.0));
        let nodes = (cells[0] + 3.0) * (cells[1] + 3.0);
        self.check_size(nodes, spacing_mm)?;
        let spacing = [0, 1].map(|k| (bounds[1][k] - bounds[0][k]) / cells[k]);
        let [columns, rows] = cells.map(|n| n as usize + 3);
        let margin = MARGIN * spacing[0].max(spacing[1]);
        let place = |k: usize, i: usize| bounds[0][k] + (i as f64 - 1.0) * spacing[k];
        let node = |i: usize| self.node(place(0, i % columns), place(1, i / columns), margin);
        let (points, normals) = (0..columns * rows).into_par_iter().with_min_len(1024).map(node).unzip();
        Ok(SampledSurface {
            columns,
            rows,
            origin_mm: [place(0, 0), place(1, 0)],
            spacing_mm: spacing,
            points,
            normals,
        })
    }

    /// Returns the node spacing in mm. If the definition gives an accuracy instead of a spacing, computes the spacing
    /// that reaches this accuracy.
    ///
    /// # Errors
    /// Returns an error if the accuracy is not positive, or if no spacing reaches the accuracy.
    pub fn spacing_mm(&self) -> Result<f64, DefinitionError> {
        match self.sampling() {
            Sampling::Spacing { spacing_mm } => Ok(spacing_mm),
            Sampling::Accuracy { accuracy_mm } => self.spacing_for_accuracy(accuracy_mm),
        }
    }

    /// Returns a node spacing in mm at which the interpolated surface between the nodes differs from the formula by at
    /// most `accuracy_mm`. The difference is estimated along the normal.
    ///
    /// Tests square cells at fixed places over the whole aperture and along its outline. In each cell, compares the
    /// formula with the cubic triangles that interpolate between the nodes, and with the distances that a registration
    /// finds between the formula and the facets. The spacing starts at a 32nd of the
    /// shorter side of the aperture's bounding box. It is halved until twice the largest difference is within
    /// `accuracy_mm`, and then refined by bisection.
    ///
    /// # Errors
    /// Returns an error if the accuracy is not positive, or if 14 halvings do not reach the accuracy.
    fn spacing_for_accuracy(&self, accuracy_mm: f64) -> Result<f64, DefinitionError> {
        error::check_positive("sampling.accuracy_mm", accuracy_mm)?;
        let [least, most] = self.aperture().bounds();
        let places = self.aperture().places_mm();
        let error = |h: f64| 2.0 * places.par_iter().map(|&place| self.cell_error(place, h)).reduce(|| 0.0, f64::max);
        let coarsest = MAX_SPACING_SHARE * (most[0] - least[0]).min(most[1] - least[1]);
        let mut fine = coarsest;
        for halving in 0.. {
            let found = error(fine);
            if found <= accuracy_mm {
                break;
            }
            if halving == HALVINGS {
                let [accuracy_nm, reached_nm] = [accuracy_mm, found].map(|mm| 1e6 * mm);
                return Err(DefinitionError::AccuracyOutOfReach { accuracy_nm, reached_nm, spacing_mm: fine });
            }
            fine *= 0.5;
        }
        if fine == coarsest {
            return Ok(fine);
        }
        let mut coarse = 2.0 * fine;
        for _ in 0..6 {
            let middle = (fine * coarse).sqrt();
            *(if error(middle) <= accuracy_mm { &mut fine } else { &mut coarse }) = middle;
        }
        Ok(fine)
    }

    /// Checks that a sampling with this number of nodes is not too large. `spacing_mm` is the node spacing, for the
    /// error message only.
    ///
    /// # Errors
    /// Returns an error if there are more than 2e7 nodes, or if the computation would take more than about a minute.
    fn check_size(&self, nodes: f64, spacing_mm: f64) -> Result<(), DefinitionError> {
        if nodes > MAX_NODES {
            return Err(DefinitionError::TooManyNodes { spacing_mm, nodes, limit: MAX_NODES });
        }
        let corners = if let Aperture::Polygon { corners_mm } = self.aperture() { corners_mm.len() } else { 0 };
        let terms = self.formula().term_count() + corners;
        let work = nodes * terms as f64;
        if work > MAX_WORK {
            return Err(DefinitionError::TooMuchWork { nodes, terms, work, limit: MAX_WORK });
        }
        Ok(())
    }

    /// Returns the node at (x, y) and its unit normal, in the frame of the surface. Both are NaN if the place is more
    /// than `margin` (in mm) outside the aperture, or if the formula has no value there.
    fn node(&self, x: f64, y: f64, margin: f64) -> (Point, Vector) {
        let near = self.aperture().distance_mm(x, y) <= margin;
        match self.formula().sag_and_gradient(x, y).filter(|_| near) {
            Some((z, gradient)) => (Point::new(x, y, z), normal_from_gradient(gradient)),
            None => (Point::new(f64::NAN, f64::NAN, f64::NAN), Vector::repeat(f64::NAN)),
        }
    }

    /// Returns the largest error, in mm, of the cubic triangles that interpolate the surface, and of the distances to its
    /// facets, in the square cell with the centre (`x`, `y`) and the side `h` in mm.
    ///
    /// Returns infinity if the formula has no value at a corner of the cell, or at a corner of the square with twice
    /// the side. A grid with this spacing could then have a gap at (`x`, `y`).
    fn cell_error(&self, [x, y]: [f64; 2], h: f64) -> f64 {
        let corner = |i: f64, j: f64| {
            let place = [x + (i - 0.5) * h, y + (j - 0.5) * h];
            self.formula().sag_and_gradient(place[0], place[1]).map(|(z, gradient)| (place, z, gradient))
        };
        let all = |low, high| Some([corner(low, low)?, corner(high, low)?, corner(high, high)?, corner(low, high)?]);
        let Some([a, b, c, d]) = all(-0.5, 1.5).and_then(|_| all(0.0, 1.0)) else {
            return f64::INFINITY;
        };
        // Whichever way the cell is cut in two.
        let triangles = [[a, b, c], [a, c, d], [a, b, d], [b, c, d]];
        let errors = triangles.iter().flat_map(|corners| {
            TEST_WEIGHTS.iter().map(|&weights| {
                let [px, py] = [0, 1].map(|k| (0..3).map(|i| weights[i] * corners[i].0[k]).sum::<f64>());
                let curved =
                    curved_triangle_sag(corners.map(|v| v.0), corners.map(|v| v.1), corners.map(|v| v.2), weights);
                let found = self.formula().sag_and_gradient(px, py);
                found.map_or(0.0, |(z, gradient)| {
                    let between = (curved - z).abs() * normal_from_gradient(gradient).z;
                    between.max(distance_from_facet(corners, [px, py, z]))
                })
            })
        });
        errors.fold(0.0, f64::max)
    }
}

/// Returns the distance, in mm, that a registration finds between the surface and one of its own points `p`. The facet
/// has the given corners: place, sag and gradient.
fn distance_from_facet(corners: &[([f64; 2], f64, [f64; 2]); 3], p: [f64; 3]) -> f64 {
    let corner =
        |&([x, y], z, gradient): &([f64; 2], f64, [f64; 2])| ([x, y, z], normal_from_gradient(gradient).into());
    let facet = Facet::new([corner(&corners[0]), corner(&corners[1]), corner(&corners[2])], 1.0);
    let w = facet.vector_from_corner(0, &p);
    facet.curved_distance(&w, &facet.weights(&w)).0.abs()
}

/// Barycentric weights of the places of a triangle at which the error is evaluated: the middles of the edges, the
/// centroid, and three places between them.
const TEST_WEIGHTS: [[f64; 3]; 7] = [
    [0.5, 0.5, 0.0],
    [0.0, 0.5, 0.5],
    [0.5, 0.0, 0.5],
    [1.0 / 3.0, 1.0 / 3.0, 1.0 / 3.0],
    [0.5, 0.25, 0.25],
    [0.25, 0.5, 0.25],
    [0.25, 0.25, 0.5],
];

/// Returns the sag of a cubic triangle at one point, in mm. The three corners have the given `places` (x, y), `sags`
/// and `gradients`. `weights` are the barycentric coordinates of the point.
///
/// Along each edge the triangle is the cubic Hermite polynomial. One coefficient, in the middle, is free. It is chosen
/// so that quadratic surfaces are exact: in Bernstein's form it is a quarter of the sum of the six edge coefficients,
/// minus a sixth of the sum of the three corner coefficients. With the edge length h, the error is O(h^4) on the edges
/// and O(h^3) inside.
fn curved_triangle_sag(places: [[f64; 2]; 3], sags: [f64; 3], gradients: [[f64; 2]; 3], weights: [f64; 3]) -> f64 {
    let (mut sag, mut edge_sum) = (0.0, 0.0);
    for i in 0..3 {
        sag += weights[i].powi(3) * sags[i];
        for j in [(i + 1) % 3, (i + 2) % 3] {
            let [dx, dy] = [0, 1].map(|k| places[j][k] - places[i][k]);
            let edge = sags[i] + (gradients[i][0] * dx + gradients[i][1] * dy) / 3.0;
            sag += 3.0 * weights[i] * weights[i] * weights[j] * edge;
            edge_sum += edge;
        }
    }
    let middle = edge_sum / 4.0 - sags.iter().sum::<f64>() / 6.0;
    sag + 6.0 * weights[0] * weights[1] * weights[2] * middle
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::{FacetIndex, Nominal, OffsetSurface, Side};

    fn defined(surface: &str, aperture: &str) -> DefinedSurface {
        DefinedSurface::from_toml(&format!("[surface]\n{surface}\n[aperture]\n{aperture}\n")).unwrap()
    }

    const ASPHERE: &str = "kind = 'asphere'\nradius_mm = 150\nconic = -1\ncoefficients = { A4 = 1e-7, A6 = -2e-11 }";
    const L_SHAPE: &str = "kind = 'polygon'\ncorners_mm = [[0, 0], [40, 0], [40, 20], [20, 20], [20, 40], [0, 40]]";

    #[test]
    fn sampled_grid_by_hand() {
        let flat = defined("kind = 'plane'", "kind = 'rectangle'\nwidth_mm = 4\nheight_mm = 2");
        let sampled = flat.sample(1.1).unwrap();
        // 4 mm in 4 cells and 2 mm in 2, and a ring.
        assert_eq!((sampled.columns, sampled.rows), (7, 5));
        assert_eq!((sampled.origin_mm, sampled.spacing_mm), ([-3.0, -2.0], [1.0, 1.0]));
        assert_eq!(sampled.points[0], Point::new(-3.0, -2.0, 0.0));
        assert_eq!(sampled.points[1], Point::new(-2.0, -2.0, 0.0));
        assert_eq!(sampled.points[7], Point::new(-3.0, -1.0, 0.0));
        assert!(sampled.normals.iter().all(|n| *n == Vector::z()));
        // A spacing that divides the bounds is kept in spite of rounding.
        assert_eq!(flat.sample(0.1).unwrap().columns, 43);
    }

    #[test]
    fn sampled_cells_cover_aperture() {
        for aperture in [
            L_SHAPE,
            "kind = 'circle'\nradius_mm = 25\ncentre_mm = [3, -2]",
            "kind = 'ellipse'\nsemi_axes_mm = [40, 3]",
            "kind = 'annulus'\ninner_radius_mm = 15\nouter_radius_mm = 25",
            "kind = 'rectangle'\nwidth_mm = 40\nheight_mm = 3",
        ] {
            let surface = defined(ASPHERE, aperture);
            let sampled = surface.sample(0.9).unwrap();
            let mut missing = 0;
            for [x, y] in surface.aperture().places_mm().into_iter().chain(surface.aperture().outline_mm(5000)) {
                let cell = |k: usize, v: f64| ((v - sampled.origin_mm[k]) / sampled.spacing_mm[k]).floor() as usize;
                let (i, j) = (cell(0, x), cell(1, y));
                for (di, dj) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
                    let n = (j + dj) * sampled.columns + i + di;
                    assert!(sampled.points[n].z.is_finite() && sampled.normals[n].z > 0.0, "{aperture} ({x}, {y})");
                }
            }
            for (point, normal) in sampled.points.iter().zip(&sampled.normals) {
                assert_eq!(point.coords.map(f64::is_nan), normal.map(f64::is_nan));
                missing += usize::from(point.z.is_nan());
                let far = surface.aperture().distance_mm(point.x, point.y) > 1.5 * 0.9;
                assert!(point.z.is_nan() || !far);
            }
            assert!(aperture.contains("rectangle") || missing > 0);
        }
    }

    #[test]
    fn curved_triangle_exact_for_quadratics() {
        let places = [[0.0, 0.0], [2.0, 0.5], [-0.5, 1.5]];
        let quadratic = |[x, y]: [f64; 2]| {
            (1.0 + x - 2.0 * y + x * x - 3.0 * x * y + 0.5 * y * y, [1.0 + 2.0 * x - 3.0 * y, -2.0 - 3.0 * x + y])
        };
        let cubic = |[x, y]: [f64; 2]| (x * x * x - x * y * y, [3.0 * x * x - y * y, -2.0 * x * y]);
        let at = |weights: [f64; 3]| [0, 1].map(|k| (0..3).map(|i| weights[i] * places[i][k]).sum::<f64>());
        for weights in TEST_WEIGHTS {
            let found =
                curved_triangle_sag(places, places.map(|p| quadratic(p).0), places.map(|p| quadratic(p).1), weights);
            assert!((found - quadratic(at(weights)).0).abs() < 1e-14);
        }
        for weights in [[0.3, 0.7, 0.0], [0.0, 0.9, 0.1], [0.5, 0.0, 0.5]] {
            let found = curved_triangle_sag(places, places.map(|p| cubic(p).0), places.map(|p| cubic(p).1), weights);
            assert!((found - cubic(at(weights)).0).abs() < 1e-14);
        }
    }

    /// The largest error along the normal at places other than those the spacing was found with.
    fn true_error(surface: &DefinedSurface, spacing_mm: f64) -> f64 {
        let s = surface.sample(spacing_mm).unwrap();
        let corner = |n: usize| (s.points[n], s.normals[n]);
        let mut worst = 0.0f64;
        for n in 0..(s.rows - 1) * s.columns {
            if n % s.columns == s.columns - 1 {
                continue;
            }
            let triangle = [n, n + 1, n + s.columns + 1].map(corner);
            let middle = (triangle[0].0.coords + triangle[1].0.coords + triangle[2].0.coords) / 3.0;
            if !surface.aperture().contains(middle.x, middle.y) {
                continue;
            }
            for weights in [[1.0 / 3.0; 3], [0.5, 0.0, 0.5], [0.6, 0.2, 0.2], [0.2, 0.6, 0.2], [0.2, 0.2, 0.6]] {
                let [x, y] = [0, 1].map(|k| (0..3).map(|i| weights[i] * triangle[i].0[k]).sum::<f64>());
                let gradients = triangle.map(|(_, n)| [-n.x / n.z, -n.y / n.z]);
                let curved = curved_triangle_sag(
                    triangle.map(|(p, _)| [p.x, p.y]),
                    triangle.map(|(p, _)| p.z),
                    gradients,
                    weights,
                );
                let (z, gradient) = surface.formula().sag_and_gradient(x, y).unwrap();
                worst = worst.max((curved - z).abs() * normal_from_gradient(gradient).z);
            }
        }
        worst
    }

    #[test]
    fn spacing_meets_accuracy() {
        let qbfs = "kind = 'qbfs'\nradius_mm = 80\nnormalisation_radius_mm = 30\ncoefficients_mm = [0.1, 0.02, -0.01]";
        let toroid = "kind = 'toroid'\nradius_x_mm = 120\nradius_y_mm = -90";
        let section = "kind = 'off-axis'\ndistance_mm = 60\nframe = 'tilted'\n\
                       [surface.parent]\nkind = 'conic'\nradius_mm = 200\nconic = -1";
        let circle = "kind = 'circle'\nradius_mm = 30";
        for (surface, aperture, accuracy_mm) in [
            (ASPHERE, L_SHAPE, 1e-6),
            (ASPHERE, circle, 1e-5),
            (qbfs, circle, 1e-5),
            (toroid, circle, 1e-6),
            (section, "kind = 'ellipse'\nsemi_axes_mm = [30, 20]", 1e-6),
        ] {
            let surface = defined(surface, aperture);
            let spacing_mm = surface.spacing_for_accuracy(accuracy_mm).unwrap();
            let error = true_error(&surface, spacing_mm);
            assert!(error <= accuracy_mm, "{error}");
            // No finer than needed, unless the coarsest that is tried is good enough.
            let [low, high] = surface.aperture().bounds();
            let coarsest = MAX_SPACING_SHARE * (high[0] - low[0]).min(high[1] - low[1]);
            let is_needed = error >= 0.15 * accuracy_mm || spacing_mm == coarsest;
            assert!(is_needed, "{error} at {spacing_mm} mm for {accuracy_mm}");
        }
    }

    #[test]
    fn spacing_of_plane_and_as_defined() {
        let plane = defined("kind = 'plane'", "kind = 'circle'\nradius_mm = 20");
        assert_eq!(plane.spacing_for_accuracy(1e-9).unwrap(), 1.25);
        assert_eq!(plane.spacing_mm().unwrap(), 1.25);
        let asked = defined(ASPHERE, "kind = 'circle'\nradius_mm = 20\n[sampling]\nspacing_mm = 0.3");
        assert_eq!(asked.spacing_mm().unwrap(), 0.3);
    }

    #[test]
    fn sampling_refuses_excess() {
        let disc = defined(ASPHERE, "kind = 'circle'\nradius_mm = 20");
        assert!(matches!(disc.sample(0.001), Err(DefinitionError::TooManyNodes { .. })));
        assert!(matches!(disc.sample(1e-300), Err(DefinitionError::TooManyNodes { .. })));
        for bad in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            assert!(matches!(disc.sample(bad), Err(DefinitionError::OutOfRange { .. })));
            assert!(matches!(disc.spacing_for_accuracy(bad), Err(DefinitionError::OutOfRange { .. })));
        }
        assert!(matches!(disc.spacing_for_accuracy(1e-18), Err(DefinitionError::AccuracyOutOfReach { .. })));
        let corners: Vec<String> = (0..4000)
            .map(|i| (f64::from(i) * std::f64::consts::TAU / 4000.0).sin_cos())
            .map(|(sine, cosine)| format!("[{:.12}, {:.12}]", 20.0 * cosine, 20.0 * sine))
            .collect();
        let fringed = defined(ASPHERE, &format!("kind = 'polygon'\ncorners_mm = [{}]", corners.join(", ")));
        assert!(matches!(fringed.sample(0.01), Err(DefinitionError::TooMuchWork { .. })));
    }

    #[test]
    fn sampled_ring_ends_with_formula() {
        let dome = defined("kind = 'sphere'\nradius_mm = -20", "kind = 'circle'\nradius_mm = 19.9");
        let sampled = dome.sample(0.5).unwrap();
        assert!(sampled.points.iter().all(|p| p.z.is_nan() || p.x.hypot(p.y) < 20.0));
        assert!(sampled.points.iter().filter(|p| p.z.is_finite()).count() > 4900);
        // A spacing found for an accuracy is so fine that no cell of the aperture lacks a corner.
        let spacing_mm = dome.spacing_for_accuracy(1e-3).unwrap();
        assert!(2f64.sqrt() * spacing_mm < 0.1 + 1e-9 && spacing_mm > 0.01, "{spacing_mm}");
    }

    /// Distances of points of a surface to its own sampling are within the accuracy, also on a quadratic surface, whose
    /// cubic triangles are exact at any spacing.
    #[test]
    fn accuracy_bounds_distances() {
        const SQUARE: &str = "kind = 'rectangle'\nwidth_mm = 30\nheight_mm = 30";
        for surface in [
            "kind = 'conic'\nradius_mm = 100\nconic = -1",
            "kind = 'sphere'\nradius_mm = -80",
            ASPHERE,
            "kind = 'plane'",
        ] {
            let surface = defined(surface, SQUARE);
            let grid = surface.sample(surface.spacing_mm().unwrap()).unwrap();
            let nominal = Nominal::from_grid_with_normals(grid.columns, grid.rows, grid.points, grid.normals).unwrap();
            let offset = OffsetSurface::new(&nominal, 0.0, Side::Normal).unwrap();
            let place = |k: usize, step: f64| 28.0 * ((k as f64 * step).fract() - 0.5);
            let distance = |k: usize| {
                let [x, y] = [place(k, 0.754_877_666), place(k, 0.569_840_291)];
                let z = surface.formula().sag(x, y).unwrap();
                offset.project(&Point::new(x, y, z), FacetIndex::UNKNOWN).distance_mm.abs()
            };
            let worst = (0..2000).map(distance).fold(0.0, f64::max);
            assert!(worst <= 1e-7, "{worst:e} mm at {:?}", grid.spacing_mm);
        }
    }
}
