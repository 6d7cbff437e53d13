//! Face of a CAD model: a parametric surface with its outline, and the part that it defines.

use std::sync::Arc;

use nalgebra::Matrix3;
use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::bspline::SurfacePoint;
use super::height_field::HeightField;
use super::parametric_surface::{ParametricSurface, natural_outlines, range};
use super::trimmed_domain::{TrimmedDomain, nearest_parameters};
use crate::geometry::pose::min_rotation;
use crate::geometry::{Aperture, ApertureError, Point, Pose, Vector};
use crate::surface::analytic::{AnalyticSurface, DefinedSurface, DefinitionError, Sampling};

/// Largest chord error, in mm, of an outline that is neither a rectangle nor a circle.
pub const OUTLINE_TOLERANCE_MM: f64 = 1e-3;

/// Maximum number of corners that the outline of one face is given by.
pub const MAX_OUTLINE_PLACES: usize = 3900;

/// Number of small patches along u and along v by which an area is found.
const PATCHES: usize = 160;

/// Largest distance in mm from a circle or from an axis-parallel line at which an outline counts as one.
const RECOGNITION_MM: f64 = 1e-5;

/// Smallest z of the mean normal of a face that faces +z or -z.
const MIN_UP: f64 = 1e-3;

/// Face of a CAD model.
#[derive(Clone, Debug, PartialEq)]
pub struct Face {
    /// Its name in the file; empty if it has none.
    pub name: String,
    /// The surface on which it lies.
    pub surface: ParametricSurface,
    /// Whether du x dv points out of the material. `None` if the file does not say.
    pub normal_points_out: Option<bool>,
    /// Its closed outlines as places in order, the first not repeated at the end. An outline of one place is a pole or an
    /// apex. Without an outline, the face is the whole domain of a B-spline.
    pub outlines: Vec<Vec<Point>>,
}

/// Frame in which a face becomes the nominal surface.
#[derive(Clone, Copy, Debug, Default, Deserialize, Eq, PartialEq, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "kebab-case")]
pub enum FaceFrame {
    /// The frame of the file.
    #[default]
    File,
    /// A frame with its origin on the face, in the middle of its outline, and z along the outward normal there. The
    /// smallest rotation leads to it from the frame of the file; for a normal along -z, half a turn about x and the
    /// smallest rotation after it. If the file does not say which side is outside, it is the one that faces +z of the
    /// file.
    Face,
}

/// Face as a nominal surface, and where it is in the file.
#[derive(Clone, Debug, PartialEq)]
pub struct FacePlacement {
    /// The surface with its outline.
    pub surface: DefinedSurface,
    /// Pose that transforms the frame of the surface to that of the file.
    pub file_from_surface: Pose,
}

/// Reason why a face cannot be a nominal surface.
#[derive(Clone, Debug, Error, PartialEq)]
#[allow(missing_docs)]
#[non_exhaustive]
pub enum FaceError {
    /// The face does not face +z of the chosen frame.
    #[error(
        "the face does not face +z: its outward normal is about ({:.3}, {:.3}, {:.3}); take it in its own frame: \
         `face_frame = \"face\"`, or --face-frame face",
        .normal[0], .normal[1], .normal[2]
    )]
    FacesAway { normal: [f64; 3] },
    /// The file does not say which side is outside, and neither side faces +z of the file.
    #[error(
        "the file does not say on which side of the face the material is, and the face stands vertical: its normal is \
         about ({:.3}, {:.3}, {:.3}); export it as a face of a solid, or turn it so that its outside faces +z",
        .normal[0], .normal[1], .normal[2]
    )]
    UnknownOutside { normal: [f64; 3] },
    /// Somewhere the face stands vertical, or hangs over.
    #[error(
        "the face is vertical, or hangs over, near ({x_mm:.3} mm, {y_mm:.3} mm) of its frame; give an outline that \
         leaves this place out, or sample the face as points"
    )]
    Overhang { x_mm: f64, y_mm: f64 },
    /// The face has no area, or closes around itself.
    #[error("the face has no outline with an area, or closes around itself; choose another face, or export it anew")]
    NoArea,
    /// No place of the face faces +z.
    #[error("no place of the face faces +z of its frame, as on a whole cylinder; choose another face")]
    NotAHeight,
    /// The outline has holes that no aperture can have.
    #[error(
        "the face has {outlines} outlines; only one, or two circles with one centre, can be taken from the file: give the \
         outline of the part as the aperture"
    )]
    Holes { outlines: usize },
    /// The outline is not a simple polygon.
    #[error("the outline of the face cannot be taken: {0}; give the outline of the part as the aperture")]
    Outline(#[from] ApertureError),
    /// The surface within the outline is not valid.
    #[error(transparent)]
    Definition(#[from] DefinitionError),
}

impl Face {
    /// Returns the outward normal of the face on average, of length 1, or the normal of the surface if the file does not
    /// say which side is outside. Returns `None` for a face without area, or one that closes around itself.
    pub fn mean_normal(&self) -> Option<Vector> {
        let outline = self.outer_outline();
        let around = newell(&outline).try_normalize(1e-300)?;
        // The sense of an outline is not trusted: the surface tells the side.
        let centre = mean(&outline);
        let (trimmed, domain) = self.trimmed_domain();
        let trimmed = if trimmed.is_ambiguous() { trimmed.everything() } else { trimmed };
        let near = self.patches(trimmed.bounds(domain), &trimmed, PATCHES).filter(|patch| patch.normal.norm() > 0.0);
        let nearest =
            near.min_by(|a, b| (a.point - centre).norm_squared().total_cmp(&(b.point - centre).norm_squared()))?;
        let side = nearest.normal.dot(&around) * self.side().unwrap_or(1.0);
        Some(if side < 0.0 { -around } else { around })
    }

    /// Returns the place of the surface that is nearest to `p`, with its derivatives. `p` is near the face.
    pub fn nearest_point(&self, p: &Point) -> SurfacePoint {
        let (_, domain) = self.trimmed_domain();
        let [u, v] = nearest_parameters(&self.surface, domain, p, None);
        self.surface.evaluate(u, v)
    }

    /// Returns the area in mm^2, within about a per cent.
    pub fn area_mm2(&self) -> f64 {
        area_mm2(&self.enclosed_patches(PATCHES))
    }

    /// Returns the area in mm^2, within some per cent, in a twenty-fifth of the time.
    pub fn rough_area_mm2(&self) -> f64 {
        area_mm2(&self.enclosed_patches(PATCHES / 5))
    }

    /// Returns small patches of the surface, `count` in each direction, those that the outlines enclose.
    fn enclosed_patches(&self, count: usize) -> Vec<SmallPatch> {
        let (trimmed, domain) = self.trimmed_domain();
        let enclosed = |trimmed: &TrimmedDomain| -> Vec<SmallPatch> {
            let inside = |bounds| self.patches(bounds, trimmed, count);
            // Once over all of the domain, and once over the box of what is enclosed.
            let wide = trimmed.bounds(domain);
            let found = [0, 1].map(|k| range(inside(wide).map(|patch| patch.at[k])));
            if found[0][0] > found[0][1] {
                return Vec::new();
            }
            let cell = [0, 1].map(|k| (wide[k][1] - wide[k][0]) / count as f64);
            let narrow =
                [0, 1].map(|k| [(found[k][0] - cell[k]).max(wide[k][0]), (found[k][1] + cell[k]).min(wide[k][1])]);
            inside(narrow).collect()
        };
        let found = enclosed(&trimmed);
        if !trimmed.is_ambiguous() {
            return found;
        }
        // A ring on a sphere has a small and a large side; a face of an optic is the small one.
        let other = enclosed(&trimmed.inverted());
        let (small, large) = if area_mm2(&found) <= area_mm2(&other) { (found, other) } else { (other, found) };
        // A ring at the end of the domain has nothing on its other side.
        if area_mm2(&small) > 1e-3 * area_mm2(&large) { small } else { large }
    }

    /// Returns the part of (u, v) that the face has, and the domain around it.
    fn trimmed_domain(&self) -> (TrimmedDomain, [[f64; 2]; 2]) {
        TrimmedDomain::of_outlines(&self.surface, &self.all_outlines())
    }

    /// Returns the corners of the box along the axes of the file that contains the face.
    pub fn bounds(&self) -> [Point; 2] {
        let start = [Point::from(Vector::repeat(f64::INFINITY)), Point::from(Vector::repeat(f64::NEG_INFINITY))];
        let patches = self.enclosed_patches(PATCHES).into_iter().map(|patch| patch.point);
        let places = self.all_outlines().into_iter().flatten().chain(patches);
        places.fold(start, |[low, high], p| [low.inf(&p), high.sup(&p)])
    }

    /// Returns the face as a nominal surface in a frame. `aperture` replaces the outline of the face; it is in the frame
    /// of the surface.
    ///
    /// # Errors
    /// Returns an error if the face does not face +z, if it is vertical within the outline, or if its outline is no
    /// aperture.
    pub fn place(
        &self,
        frame: FaceFrame,
        aperture: Option<Aperture>,
        sampling: Sampling,
    ) -> Result<FacePlacement, FaceError> {
        let file_from_surface = match frame {
            FaceFrame::File => Pose::identity(),
            FaceFrame::Face => self.own_frame()?,
        };
        let field = self.height_field(&file_from_surface)?;
        let aperture = match aperture {
            Some(aperture) => aperture,
            None => self.aperture(&file_from_surface)?,
        };
        let surface = AnalyticSurface::Face(Arc::new(field));
        let defined = DefinedSurface::new(surface, aperture, sampling).map_err(|error| match error {
            DefinitionError::NotDefined { x_mm, y_mm } => FaceError::Overhang { x_mm, y_mm },
            error => FaceError::Definition(error),
        })?;
        Ok(FacePlacement { surface: defined, file_from_surface })
    }

    /// Returns the face moved by `motion`.
    pub fn moved(&self, motion: &Pose) -> Self {
        let outlines = self.outlines.iter().map(|outline| outline.iter().map(|p| motion.transform_point(p)).collect());
        Self { surface: self.surface.moved(motion), outlines: outlines.collect(), ..self.clone() }
    }

    /// Returns 1 if du x dv points out of the material, -1 if it points into it.
    fn side(&self) -> Option<f64> {
        self.normal_points_out.map(|out| if out { 1.0 } else { -1.0 })
    }

    /// Returns the surface as heights in a frame. A face whose outside is not known takes the side that faces +z.
    fn height_field(&self, file_from_surface: &Pose) -> Result<HeightField, FaceError> {
        let surface_from_file = file_from_surface.inverse();
        let normal = self.mean_normal().ok_or(FaceError::NoArea)?;
        let up = surface_from_file.transform_direction(&normal);
        let faces_away = || FaceError::FacesAway { normal: normal.into() };
        // With an outside that is known, the normal tells which way the face looks.
        if self.normal_points_out.is_some() && up.z <= 0.0 || up.z.abs() < MIN_UP {
            return Err(faces_away());
        }
        let side = self.side().unwrap_or(if up.z < 0.0 { -1.0 } else { 1.0 });
        let Self { surface, .. } = &self;
        let outlines: Vec<Vec<Point>> = (self.all_outlines().iter())
            .map(|outline| outline.iter().map(|p| surface_from_file.transform_point(p)).collect())
            .collect();
        HeightField::new(surface.moved(&surface_from_file), &outlines, side).ok_or(FaceError::NotAHeight)
    }

    /// Returns the pose that transforms the face's own frame to that of the file.
    fn own_frame(&self) -> Result<Pose, FaceError> {
        let mut normal = self.mean_normal().ok_or(FaceError::NoArea)?;
        if self.normal_points_out.is_none() {
            if normal.z.abs() < MIN_UP {
                return Err(FaceError::UnknownOutside { normal: normal.into() });
            }
            normal *= normal.z.signum();
        }
        // About the middle of the outline, and then on the surface there.
        let rough = Pose { rotation: own_rotation(&normal), translation_mm: self.centre().coords };
        let field = self.height_field(&rough)?;
        let bounds = self.flat_bounds(&rough);
        let [x, y] = [0, 1].map(|k| 0.5 * (bounds[0][k] + bounds[1][k]));
        let (z, [gx, gy]) = field.sag_and_gradient(x, y).ok_or(FaceError::Overhang { x_mm: x, y_mm: y })?;
        let normal = rough.transform_direction(&Vector::new(-gx, -gy, 1.0).normalize());
        let origin = rough.transform_point(&Point::new(x, y, z));
        Ok(Pose { rotation: own_rotation(&normal), translation_mm: origin.coords })
    }

    /// Returns the mean of the places of the outer outline.
    fn centre(&self) -> Point {
        mean(&self.outer_outline())
    }

    /// Returns the box of the outlines in x and y of a frame.
    fn flat_bounds(&self, file_from_surface: &Pose) -> [[f64; 2]; 2] {
        let surface_from_file = file_from_surface.inverse();
        let outlines = self.all_outlines();
        crate::geometry::bounds(outlines.iter().flatten().map(|p| {
            let p = surface_from_file.transform_point(p);
            [p.x, p.y]
        }))
    }

    /// Returns the outline in x and y of a frame as an aperture: a circle, an annulus, a rectangle or a polygon.
    fn aperture(&self, file_from_surface: &Pose) -> Result<Aperture, FaceError> {
        let surface_from_file = file_from_surface.inverse();
        let flat = |p: &Point| {
            let p = surface_from_file.transform_point(p);
            [p.x, p.y]
        };
        let outlines: Vec<Vec<[f64; 2]>> =
            self.borders().iter().map(|outline| outline.iter().map(flat).collect()).collect();
        let aperture = match &outlines[..] {
            [] => return Err(FaceError::NoArea),
            [outline] => simple_aperture(outline),
            [a, b] => {
                let [Some(a), Some(b)] = [a, b].map(|outline| circle(outline)) else {
                    return Err(FaceError::Holes { outlines: 2 });
                };
                let (inner, outer) = if a.1 < b.1 { (a, b) } else { (b, a) };
                let apart = (a.0[0] - b.0[0]).hypot(a.0[1] - b.0[1]);
                if apart > 2.0 * RECOGNITION_MM {
                    return Err(FaceError::Holes { outlines: 2 });
                }
                Aperture::Annulus { centre_mm: outer.0, inner_radius_mm: inner.1, outer_radius_mm: outer.1 }
            }
            more => return Err(FaceError::Holes { outlines: more.len() }),
        };
        aperture.validate()?;
        Ok(aperture)
    }

    /// Returns the outlines without single places, such as the pole of a sphere.
    fn borders(&self) -> Vec<Vec<Point>> {
        self.all_outlines().into_iter().filter(|outline| outline.len() > 2).collect()
    }

    /// Returns the outlines of the face, or the border of the domain of a B-spline without outlines.
    fn all_outlines(&self) -> Vec<Vec<Point>> {
        if !self.outlines.is_empty() {
            return self.outlines.clone();
        }
        let ParametricSurface::BSpline(surface) = &self.surface else { return Vec::new() };
        natural_outlines(&self.surface, surface.knots().map(|knots| knots.domain()))
    }

    /// Returns the outline that encloses the largest area.
    fn outer_outline(&self) -> Vec<Point> {
        let outlines = self.all_outlines().into_iter();
        outlines.max_by(|a, b| newell(a).norm().total_cmp(&newell(b).norm())).unwrap_or_default()
    }

    /// Returns small patches of the surface over ranges of u and v, those that the outlines enclose.
    fn patches<'a>(
        &'a self,
        [u, v]: [[f64; 2]; 2],
        trimmed: &'a TrimmedDomain,
        count: usize,
    ) -> impl Iterator<Item = SmallPatch> + 'a {
        let place = |[low, high]: [f64; 2], i: usize| low + (high - low) * (i as f64 + 0.5) / count as f64;
        let cell = (u[1] - u[0]) * (v[1] - v[0]) / (count * count) as f64;
        let patch = move |at: [f64; 2]| {
            let [u, v] = trimmed.wrapped(at);
            let found = self.surface.evaluate(u, v);
            let area = found.area_vector();
            SmallPatch { at, point: found.point, normal: area, area_mm2: area.norm() * cell }
        };
        let places = |bounds: [f64; 2]| (0..count).map(|i| place(bounds, i)).collect();
        trimmed.enclosed(places(u), places(v)).map(patch)
    }
}

/// Returns the rotation that maps z to `normal`, a vector of length 1.
fn own_rotation(normal: &Vector) -> Matrix3<f64> {
    // Near -z the axis of the smallest rotation would be left to rounding.
    const NEARLY_OPPOSITE: f64 = -0.999;
    if normal.z > NEARLY_OPPOSITE {
        return min_rotation(normal);
    }
    let half_turn = Matrix3::from_diagonal(&Vector::new(1.0, -1.0, -1.0));
    half_turn * min_rotation(&(half_turn * normal))
}

fn area_mm2(patches: &[SmallPatch]) -> f64 {
    patches.iter().map(|patch| patch.area_mm2).sum()
}

/// Small part of a surface.
struct SmallPatch {
    /// Its middle in (u, v).
    at: [f64; 2],
    point: Point,
    /// du x dv.
    normal: Vector,
    area_mm2: f64,
}

/// Returns the vector whose length is the area of a closed outline in the plane across it.
fn newell(outline: &[Point]) -> Vector {
    let Some(first) = outline.first() else { return Vector::zeros() };
    let next = outline.iter().skip(1).chain([first]);
    outline.iter().zip(next).fold(Vector::zeros(), |sum, (a, b)| sum + (a - first).cross(&(b - first)) * 0.5)
}

/// Returns the mean of points.
fn mean(points: &[Point]) -> Point {
    let sum = points.iter().fold(Vector::zeros(), |sum, p| sum + p.coords);
    Point::from(sum / points.len().max(1) as f64)
}

/// Returns an outline as a circle, as a rectangle along the axes, or as a polygon.
fn simple_aperture(outline: &[[f64; 2]]) -> Aperture {
    if let Some((centre_mm, radius_mm)) = circle(outline) {
        return Aperture::Circle { centre_mm, radius_mm };
    }
    let [low, high] = crate::geometry::bounds(outline.iter().copied());
    let on_border = |[x, y]: &[f64; 2]| {
        let off = |t: f64, k: usize| (t - low[k]).abs().min((t - high[k]).abs());
        off(*x, 0).min(off(*y, 1)) <= RECOGNITION_MM
    };
    let has_corner = |corner: [f64; 2]| {
        outline.iter().any(|p| (p[0] - corner[0]).abs().max((p[1] - corner[1]).abs()) <= RECOGNITION_MM)
    };
    let corners = [low, [high[0], low[1]], high, [low[0], high[1]]];
    if outline.iter().all(on_border) && corners.into_iter().all(has_corner) {
        let [low, high] = [low, high].map(|corner| corner.map(rounded));
        return Aperture::Rectangle {
            centre_mm: [0, 1].map(|k| rounded(0.5 * (low[k] + high[k]))),
            width_mm: rounded(high[0] - low[0]),
            height_mm: rounded(high[1] - low[1]),
        };
    }
    Aperture::Polygon { corners_mm: without_needless(outline) }
}

/// Largest distance of the middle of an edge of an outline from the circle of its ends: a part in mm that the outline's
/// own tolerance explains, and a share of the radius for outlines with as many places as they may have.
const MAX_SAGITTA_MM: f64 = 2.0 * OUTLINE_TOLERANCE_MM;
const MAX_SAGITTA: f64 = 1e-5;

/// Returns centre and radius of an outline that is a circle.
fn circle(outline: &[[f64; 2]]) -> Option<([f64; 2], f64)> {
    const LEAST: usize = 12;
    if outline.len() < LEAST {
        return None;
    }
    let third = outline.len() / 3;
    let [a, b, c] = [outline[0], outline[third], outline[2 * third]];
    let (bx, by, cx, cy) = (b[0] - a[0], b[1] - a[1], c[0] - a[0], c[1] - a[1]);
    let area = 2.0 * (bx * cy - by * cx);
    let (bb, cc) = (bx * bx + by * by, cx * cx + cy * cy);
    let centre = [a[0] + (cy * bb - by * cc) / area, a[1] + (bx * cc - cx * bb) / area];
    let radius = (a[0] - centre[0]).hypot(a[1] - centre[1]);
    let fits = outline.iter().all(|p| ((p[0] - centre[0]).hypot(p[1] - centre[1]) - radius).abs() <= RECOGNITION_MM);
    // The corners of a polygon can lie on a circle, and so can the ends of a flat: the middles of the edges must too.
    let next = outline.iter().skip(1).chain(outline.first());
    let dense = outline.iter().zip(next).all(|(p, q)| {
        let middle = (0.5 * (p[0] + q[0]) - centre[0]).hypot(0.5 * (p[1] + q[1]) - centre[1]);
        radius - middle <= MAX_SAGITTA_MM + MAX_SAGITTA * radius
    });
    (fits && dense && radius.is_finite()).then(|| (centre.map(rounded), rounded(radius)))
}

/// Returns a length rounded to 1e-9 mm, so that rounding in the file or in a unit does not show.
fn rounded(mm: f64) -> f64 {
    let rounded = (mm * 1e9).round() / 1e9;
    // Coordinates of more than a few metres keep their digits.
    if mm.abs() < 4e6 { rounded + 0.0 } else { mm }
}

/// Returns the places of an outline without repeated ones and without those in the middle of a straight edge.
fn without_needless(outline: &[[f64; 2]]) -> Vec<[f64; 2]> {
    let mut kept: Vec<[f64; 2]> = Vec::new();
    for &[x, y] in outline {
        let place = [rounded(x), rounded(y)];
        if kept.last().is_none_or(|last| (last[0] - x).hypot(last[1] - y) > 1e-6) {
            kept.push(place);
        }
    }
    while kept.len() > 1 && (kept[0][0] - kept[kept.len() - 1][0]).hypot(kept[0][1] - kept[kept.len() - 1][1]) <= 1e-6 {
        kept.pop();
    }
    let count = kept.len();
    let is_needed = |i: usize| {
        let [a, b, c] = [kept[(i + count - 1) % count], kept[i], kept[(i + 1) % count]];
        let cross = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]);
        cross.abs() > 1e-7 * (c[0] - a[0]).hypot(c[1] - a[1])
    };
    (0..count).filter(|&i| is_needed(i)).map(|i| kept[i]).collect()
}

#[cfg(test)]
mod tests {
    use super::super::curve::Curve;
    use super::super::frame::Frame;
    use super::*;

    /// Returns places on a circle of radius 50 mm around (3, -2) mm, from one angle to another.
    fn arc(from: f64, to: f64, count: usize) -> Vec<[f64; 2]> {
        let place = |k: usize| {
            let (sine, cosine) = (from + (to - from) * k as f64 / count as f64).sin_cos();
            [3.0 + 50.0 * cosine, -2.0 + 50.0 * sine]
        };
        (0..count).map(place).collect()
    }

    fn ring(count: usize, place: impl Fn(f64) -> Point) -> Vec<Point> {
        (0..count).map(|k| place(k as f64 * std::f64::consts::TAU / count as f64)).collect()
    }

    fn on_axes(axes: [Vector; 3]) -> Frame {
        Frame { origin: Point::origin(), axes }
    }

    fn face(surface: ParametricSurface, outlines: Vec<Vec<Point>>) -> Face {
        Face { name: String::new(), surface, normal_points_out: Some(true), outlines }
    }

    /// Areas by hand of faces whose outlines go around the surface in every way.
    #[test]
    fn areas_of_faces_that_go_around() {
        let pi = std::f64::consts::PI;
        let standard = on_axes([Vector::x(), Vector::y(), Vector::z()]);
        let level = |radius: f64, z: f64| ring(200, |t| Point::new(radius * t.cos(), radius * t.sin(), z));
        let near = |face: &Face, area: f64, name: &str| {
            let found = face.area_mm2();
            assert!((found / area - 1.0).abs() < 0.02, "{name}: {found} instead of {area}");
        };
        // A cone to its apex: only its rim is an outline. The slant is 5 for a height of 4 and a radius of 3.
        let cone = ParametricSurface::Cone { frame: standard, radius_mm: 3.0, half_angle_rad: 0.75f64.atan() };
        near(&face(cone, vec![level(3.0, 0.0)]), pi * 3.0 * 5.0, "cone");
        let line = Curve::Line { origin: Point::new(3.0, 0.0, 0.0), direction: Vector::new(3.0, 0.0, 4.0) };
        let turned = ParametricSurface::revolution(line, Point::origin(), Vector::z());
        near(&face(turned, vec![level(3.0, 0.0)]), pi * 3.0 * 5.0, "turned line");
        // A paraboloid z = r^2 / 4f: area 8 pi f^2 / 3 ((1 + r^2 / 4f^2)^1.5 - 1).
        let vertex = on_axes([Vector::z(), Vector::x(), Vector::y()]);
        let parabola = Curve::Parabola { frame: vertex, focal_mm: 10.0 };
        let paraboloid = ParametricSurface::revolution(parabola, Point::origin(), Vector::z());
        let area = 8.0 * pi * 100.0 / 3.0 * (1.25f64.powf(1.5) - 1.0);
        near(&face(paraboloid, vec![level(10.0, 2.5)]), area, "paraboloid");
        // A band of a sphere of radius 10, made by a circle around its axis: 2 pi r h.
        let circle = |frame: Frame| Curve::Ellipse { frame, semi_axes_mm: [10.0, 10.0] };
        for (x, y) in [(Vector::x(), Vector::z()), (Vector::z(), Vector::x()), (-Vector::z(), -Vector::x())] {
            let sphere =
                ParametricSurface::revolution(circle(on_axes([x, y, x.cross(&y)])), Point::origin(), Vector::z());
            let rings = vec![level(91.0f64.sqrt(), -3.0), level(96.0f64.sqrt(), -2.0)];
            near(&face(sphere, rings), 2.0 * pi * 10.0, "band of a sphere");
        }
        // A quarter of the tube of a torus, between two rings: 2 pi (R r pi / 2 + r^2 (sin b - sin a)).
        let torus = ParametricSurface::Torus { frame: standard, major_radius_mm: 10.0, minor_radius_mm: 2.0 };
        let fillet = face(torus.clone(), vec![level(12.0, 0.0), level(10.0, 2.0)]);
        near(&fillet, 2.0 * pi * (10.0 * 2.0 * pi / 2.0 + 4.0), "fillet");
        // A bend of a pipe: two rings around the tube, a quarter of a turn from each other.
        let around_tube = |u: f64| ring(200, |v| torus.evaluate(u, v).point);
        let bend = face(torus.clone(), vec![around_tube(0.3), around_tube(0.3 + pi / 2.0)]);
        near(&bend, pi * pi * 2.0 * 10.0, "bend");
        // A strip of an elliptic cylinder over the place where its profile begins.
        let ellipse = Curve::Ellipse { frame: standard, semi_axes_mm: [10.0, 10.0] };
        let tube = ParametricSurface::Extrusion { profile: ellipse, direction: Vector::z() };
        let at = |u: f64, z: f64| Point::new(10.0 * u.cos(), 10.0 * u.sin(), z);
        let side = |from: [f64; 2], to: [f64; 2]| {
            (0..20).map(move |k| {
                let share = f64::from(k) / 20.0;
                at(from[0] + share * (to[0] - from[0]), from[1] + share * (to[1] - from[1]))
            })
        };
        let corners = [[-0.3, 0.0], [0.2, 0.0], [0.2, 7.0], [-0.3, 7.0]];
        let strip = (0..4).flat_map(|k| side(corners[k], corners[(k + 1) % 4])).collect();
        near(&face(tube, vec![strip]), 0.5 * 10.0 * 7.0, "strip");
    }

    /// Rounding of a normal along -z does not turn the frame about it.
    #[test]
    fn frame_of_underside_is_half_turn_about_x() {
        let half_turn = Matrix3::from_diagonal(&Vector::new(1.0, -1.0, -1.0));
        for (x, y) in [(0.0, 0.0), (1e-14, 0.0), (-1e-14, 0.0), (0.0, 1e-14), (1e-9, -1e-9)] {
            let normal = Vector::new(x, y, -1.0).normalize();
            let found = own_rotation(&normal);
            assert!((found - half_turn).amax() < 2e-9, "{x}, {y}");
            assert!((found.column(2) - normal).amax() < 1e-15);
        }
        let normal = Vector::new(0.03, -0.02, -0.99935).normalize();
        let found = own_rotation(&normal);
        assert!((found * Vector::z() - normal).amax() < 1e-15 && (found.determinant() - 1.0).abs() < 1e-14);
    }

    #[test]
    fn circle_is_told_from_polygon_and_flat() {
        const TURN: f64 = std::f64::consts::TAU;
        assert_eq!(circle(&arc(0.0, TURN, 512)), Some(([3.0, -2.0], 50.0)));
        // Corners on the circle are no circle.
        assert_eq!(circle(&arc(0.0, TURN, 12)), None);
        assert_eq!(circle(&arc(0.0, TURN, 60)), None);
        // A flat of 29 mm and one of 5 mm: only their ends lie on the outline. The flat of 5 mm is 0.06 mm deep.
        for half in [0.294, 0.05] {
            let mut with_flat = arc(half, TURN - half, 512);
            let (sine, cosine) = (TURN - half).sin_cos();
            with_flat.push([3.0 + 50.0 * cosine, -2.0 + 50.0 * sine]);
            assert_eq!(circle(&with_flat), None, "{half}");
        }
    }
}
