//! Outline of the part.

use serde::{Deserialize, Serialize};

/// Outline of the part over the plane of the model frame.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
pub enum Aperture {
    /// A rectangle along the axes.
    Rectangle {
        /// Half the width in x.
        half_x_mm: f64,
        /// Half the depth in y.
        half_y_mm: f64,
        /// Its middle.
        #[serde(default)]
        centre_mm: [f64; 2],
    },
    /// A circle.
    Circle {
        /// Its radius.
        radius_mm: f64,
        /// Its middle.
        #[serde(default)]
        centre_mm: [f64; 2],
    },
    /// An ellipse along the axes.
    Ellipse {
        /// Half its size along x and along y.
        semi_axes_mm: [f64; 2],
        /// Its middle.
        #[serde(default)]
        centre_mm: [f64; 2],
    },
    /// A disc with a round hole in its middle.
    Annulus {
        /// Radius of the hole.
        inner_radius_mm: f64,
        /// Radius of the rim.
        outer_radius_mm: f64,
        /// Its middle.
        #[serde(default)]
        centre_mm: [f64; 2],
    },
    /// A simple polygon, convex or not; the last corner joins the first.
    Polygon {
        /// The corners in order, each once.
        corners_mm: Vec<[f64; 2]>,
    },
}

impl Aperture {
    /// Creates a rectangle about the origin.
    pub fn rectangle(half_x_mm: f64, half_y_mm: f64) -> Self {
        Self::Rectangle { half_x_mm, half_y_mm, centre_mm: [0.0; 2] }
    }

    /// Creates a circle about the origin.
    pub fn circle(radius_mm: f64) -> Self {
        Self::Circle { radius_mm, centre_mm: [0.0; 2] }
    }

    /// Creates the convex hull of some places (x, y), as a polygon. It has no corner if there is no place.
    pub fn convex_hull(mut places: Vec<[f64; 2]>) -> Self {
        places.sort_unstable_by(|a, b| a[0].total_cmp(&b[0]).then(a[1].total_cmp(&b[1])));
        places.dedup();
        let turns_left =
            |a: [f64; 2], b: [f64; 2], c: [f64; 2]| (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]) > 0.0;
        // The lower chain from left to right, then the upper one back (Andrew 1979).
        let mut corners_mm: Vec<[f64; 2]> = Vec::new();
        for chain in [places.clone(), places.into_iter().rev().collect()] {
            let first = corners_mm.len();
            for place in chain {
                while let [.., a, b] = corners_mm[first..]
                    && !turns_left(a, b, place)
                {
                    corners_mm.pop();
                }
                corners_mm.push(place);
            }
            // The last place of a chain is the first of the other.
            corners_mm.pop();
        }
        Self::Polygon { corners_mm }
    }

    /// Returns the minimum and the maximum of x, and those of y, in mm. All are 0 for a polygon without a corner.
    pub fn bounds_mm(&self) -> [[f64; 2]; 2] {
        let around = |[x, y]: &[f64; 2], half: [f64; 2]| [[x - half[0], x + half[0]], [y - half[1], y + half[1]]];
        match self {
            Self::Rectangle { half_x_mm, half_y_mm, centre_mm } => around(centre_mm, [*half_x_mm, *half_y_mm]),
            Self::Circle { radius_mm, centre_mm } => around(centre_mm, [*radius_mm; 2]),
            Self::Ellipse { semi_axes_mm, centre_mm } => around(centre_mm, *semi_axes_mm),
            Self::Annulus { outer_radius_mm, centre_mm, .. } => around(centre_mm, [*outer_radius_mm; 2]),
            Self::Polygon { corners_mm } => [0, 1].map(|k| {
                let bound = |better: fn(f64, f64) -> f64| corners_mm.iter().map(|corner| corner[k]).reduce(better);
                [bound(f64::min).unwrap_or(0.0), bound(f64::max).unwrap_or(0.0)]
            }),
        }
    }

    /// Returns the middle of the bounding rectangle of the aperture, in mm.
    pub fn middle_mm(&self) -> [f64; 2] {
        self.bounds_mm().map(|[min, max]| 0.5 * (min + max))
    }

    /// Returns half the width (along x) and half the depth (along y) of the bounding rectangle of the aperture, in mm.
    pub fn half_mm(&self) -> [f64; 2] {
        self.bounds_mm().map(|[min, max]| 0.5 * (max - min))
    }

    /// Returns true if the position (x, y) is inside the aperture.
    pub fn contains(&self, x: f64, y: f64) -> bool {
        let from = |[cx, cy]: &[f64; 2]| [x - cx, y - cy];
        match self {
            Self::Rectangle { half_x_mm, half_y_mm, centre_mm } => {
                let [u, v] = from(centre_mm);
                u.abs() <= *half_x_mm && v.abs() <= *half_y_mm
            }
            Self::Circle { radius_mm, centre_mm } => {
                let [u, v] = from(centre_mm);
                u.hypot(v) <= *radius_mm
            }
            Self::Ellipse { semi_axes_mm: [a, b], centre_mm } => {
                let [u, v] = from(centre_mm);
                (u / a).powi(2) + (v / b).powi(2) <= 1.0
            }
            Self::Annulus { inner_radius_mm, outer_radius_mm, centre_mm } => {
                let [u, v] = from(centre_mm);
                (*inner_radius_mm..=*outer_radius_mm).contains(&u.hypot(v))
            }
            Self::Polygon { corners_mm } => is_in_polygon(corners_mm, [x, y]),
        }
    }

    /// Returns the outermost position of the aperture on the ray from its middle in the direction `angle_rad`. Returns
    /// `None` if no position of the ray is inside.
    pub fn rim(&self, angle_rad: f64) -> Option<[f64; 2]> {
        const STEPS: usize = 256;
        let ([x, y], [half_x, half_y]) = (self.middle_mm(), self.half_mm());
        let (sine, cosine) = angle_rad.sin_cos();
        let far_mm = half_x.hypot(half_y);
        let at = |share: f64| [x + share * far_mm * cosine, y + share * far_mm * sine];
        let is_inside = |share: f64| self.contains(at(share)[0], at(share)[1]);
        let shares = (0..=STEPS).rev().map(|k| k as f64 / STEPS as f64);
        let mut inside = shares.into_iter().find(|share| is_inside(*share))?;
        let mut outside = inside + 1.0 / STEPS as f64;
        for _ in 0..40 {
            let between = 0.5 * (inside + outside);
            match is_inside(between) {
                true => inside = between,
                false => outside = between,
            }
        }
        Some(at(inside))
    }
}

/// Returns true if a position is inside a polygon, or on an edge of it up to rounding.
fn is_in_polygon(corners: &[[f64; 2]], [x, y]: [f64; 2]) -> bool {
    const EDGE_MM: f64 = 1e-9;
    let mut inside = false;
    let mut before = corners.last();
    for corner in corners {
        let Some([ax, ay]) = before else { return false };
        let [bx, by] = corner;
        let [u, v] = [bx - ax, by - ay];
        let along = (((x - ax) * u + (y - ay) * v) / (u * u + v * v).max(f64::MIN_POSITIVE)).clamp(0.0, 1.0);
        if (x - ax - along * u).hypot(y - ay - along * v) <= EDGE_MM {
            return true;
        }
        if (*ay > y) != (*by > y) && x < ax + (y - ay) / v * u {
            inside = !inside;
        }
        before = Some(corner);
    }
    inside
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_kind_contains_its_inside() {
        let centre_mm = [10.0, -5.0];
        let l_shape = vec![[0.0, 0.0], [4.0, 0.0], [4.0, 2.0], [2.0, 2.0], [2.0, 4.0], [0.0, 4.0]];
        let cases = [
            (Aperture::Rectangle { half_x_mm: 3.0, half_y_mm: 2.0, centre_mm }, [13.0, -7.0], [13.1, -7.0]),
            (Aperture::Circle { radius_mm: 2.0, centre_mm }, [12.0, -5.0], [11.5, -3.5]),
            (Aperture::Ellipse { semi_axes_mm: [4.0, 1.0], centre_mm }, [13.9, -5.0], [10.0, -3.9]),
            (Aperture::Annulus { inner_radius_mm: 1.0, outer_radius_mm: 3.0, centre_mm }, [10.0, -7.0], [10.5, -5.0]),
            (Aperture::Polygon { corners_mm: l_shape }, [2.0, 3.0], [3.0, 3.0]),
        ];
        for (aperture, [ix, iy], [ox, oy]) in cases {
            assert!(aperture.contains(ix, iy) && !aperture.contains(ox, oy), "{aperture:?}");
            let [[min_x, max_x], [min_y, max_y]] = aperture.bounds_mm();
            assert!((min_x..=max_x).contains(&ix) && (min_y..=max_y).contains(&iy), "{aperture:?}");
        }
        let none = Aperture::Polygon { corners_mm: Vec::new() };
        assert!(!none.contains(0.0, 0.0));
        assert_eq!((none.bounds_mm(), none.rim(0.3)), ([[0.0; 2]; 2], None));
    }

    #[test]
    fn rim_is_on_the_outline() {
        let [x, y] = Aperture::circle(7.0).rim(0.7).unwrap();
        assert!((x.hypot(y) - 7.0).abs() < 1e-9);
        let [x, y] = Aperture::rectangle(3.0, 2.0).rim(std::f64::consts::FRAC_PI_4).unwrap();
        assert!((x - 2.0).abs() < 1e-9 && (y - 2.0).abs() < 1e-9);
        let ring = Aperture::Annulus { inner_radius_mm: 4.0, outer_radius_mm: 5.0, centre_mm: [1.0, 1.0] };
        let [x, y] = ring.rim(0.0).unwrap();
        assert!((x - 6.0).abs() < 1e-9 && (y - 1.0).abs() < 1e-12);
    }

    #[test]
    fn hull_surrounds_places() {
        let places: Vec<[f64; 2]> = (0..5).flat_map(|x| (0..4).map(move |y| [f64::from(x), f64::from(y)])).collect();
        let hull = Aperture::convex_hull(places.clone());
        let Aperture::Polygon { corners_mm } = &hull else { panic!("{hull:?}") };
        assert_eq!(corners_mm, &[[0.0, 0.0], [4.0, 0.0], [4.0, 3.0], [0.0, 3.0]]);
        assert!(places.iter().all(|[x, y]| hull.contains(*x, *y)));
        for few in [Vec::new(), vec![[1.0, 2.0]], vec![[1.0, 2.0], [3.0, 4.0]]] {
            assert!(matches!(Aperture::convex_hull(few), Aperture::Polygon { corners_mm } if corners_mm.len() < 3));
        }
    }
}
