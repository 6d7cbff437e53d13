//! Faces of an IGES file: B-spline surfaces (128), surfaces of revolution (120), tabulated cylinders (122), planes,
//! cylinders, cones, spheres and tori (190 to 198), bare, or with an outline (143, 144, 510).

use std::cell::RefCell;
use std::collections::{HashMap, HashSet};
use std::path::Path;
use std::rc::Rc;

use nalgebra::Matrix3;
use regrind_core::geometry::{Point, Pose, Vector};
use regrind_core::surface::parametric::{
    BSplineCurve, BSplineSurface, Curve, Face, Frame, Knots, MAX_OUTLINE_PLACES, OUTLINE_TOLERANCE_MM,
    ParametricSurface, natural_outlines,
};

use super::super::error::FormatError;
use super::iges_text::{Entry, IgesText, Parameter};
use super::model::{CadFace, CadModel};
use super::outline::{EdgePlaces, joined_outlines};

/// Distance up to which two ends of curves are one vertex, as a share of the size of the face.
const NEAR: f64 = 1e-4;

/// Maximum number of edges between two vertices among which a seam is looked for.
const MAX_ALIKE: usize = 16;

/// Maximum depth of curves within curves and of transformations.
const MAX_DEPTH: usize = 16;

/// Reads the faces of an IGES file.
///
/// # Errors
/// Text that is not IGES; a unit that is not known; a file without faces. A face that cannot be read is in the result,
/// with the reason.
pub(super) fn parse_iges(path: &Path, bytes: &[u8]) -> Result<CadModel, FormatError> {
    let text = IgesText::new(path, bytes)?;
    let reader = Reader { text: &text, unit_mm: unit_mm(&text)?, edge_lists: RefCell::default() };
    let used = reader.used();
    let is_free = |entry: &&Entry| {
        matches!(entry.kind, 143 | 144 | 510) || (is_surface(entry.kind) && !used.contains(&entry.number))
    };
    let placed = reader.placed();
    let free: Vec<&Entry> = text.entries().iter().filter(is_free).collect();
    let is_any_shown = free.iter().any(|entry| !entry.is_hidden);
    let shown = free.into_iter().filter(|entry| entry.is_hidden != is_any_shown);
    let faces: Vec<CadFace> = shown.map(|entry| reader.face(entry, &placed)).collect();
    if faces.is_empty() {
        return Err(FormatError::NoData { path: path.to_owned(), expected: "face or surface" });
    }
    Ok(CadModel::new(faces))
}

fn is_surface(kind: u64) -> bool {
    matches!(kind, 108 | 114 | 118 | 120 | 122 | 128 | 140 | 190 | 192 | 194 | 196 | 198)
}

/// Returns the millimetres in a unit of length, from the global section.
fn unit_mm(text: &IgesText<'_>) -> Result<f64, FormatError> {
    // Parameters 13, 14 and 15: scale of the model, flag and name of the unit.
    let number = |at: usize, default: f64| match text.global.get(at - 1) {
        Some(Parameter::Number(value)) => *value,
        _ => default,
    };
    let wrong = |expected: &str, found: String| FormatError::Unexpected {
        path: text.path().to_owned(),
        place: "global section".to_owned(),
        expected: expected.to_owned(),
        found,
    };
    let scale = number(13, 1.0);
    if scale != 1.0 {
        return Err(wrong("a model in its true size (parameter 13 is 1)", scale.to_string()));
    }
    let name = match text.global.get(14) {
        Some(Parameter::Text(name)) => name.to_uppercase(),
        _ => String::new(),
    };
    let flag = number(14, 1.0);
    let by_name = [
        ("IN", 25.4),
        ("INCH", 25.4),
        ("MM", 1.0),
        ("FT", 304.8),
        ("MI", 1_609_344.0),
        ("M", 1e3),
        ("KM", 1e6),
        ("MIL", 0.0254),
        ("UM", 1e-3),
        ("CM", 10.0),
        ("UIN", 2.54e-5),
    ];
    let by_flag = [25.4, 1.0, f64::NAN, 304.8, 1_609_344.0, 1e3, 1e6, 0.0254, 1e-3, 10.0, 2.54e-5];
    let named = by_name.into_iter().find(|(unit, _)| *unit == name).map(|(_, mm)| mm);
    let flagged = (flag >= 1.0 && flag.fract() == 0.0).then(|| by_flag.get(flag as usize - 1).copied()).flatten();
    match (flagged, named) {
        // 3: the name alone tells.
        (Some(mm), Some(named)) if mm.is_nan() => Ok(named),
        (Some(mm), Some(named)) if mm != named => {
            Err(wrong("one unit of length in parameters 14 and 15", format!("{flag}, {name}")))
        }
        (Some(mm), _) if !mm.is_nan() => Ok(mm),
        _ => Err(wrong("a known unit of length (parameters 14 and 15)", format!("{flag}, {name}"))),
    }
}

/// Parameters of an entity, taken one after the other.
struct Taken<'a> {
    text: &'a IgesText<'a>,
    entry: &'a Entry,
    parameters: Vec<Parameter>,
    at: usize,
}

impl Taken<'_> {
    fn number(&mut self) -> Result<f64, FormatError> {
        let found = self.parameters.get(self.at);
        self.at += 1;
        match found {
            Some(Parameter::Number(value)) => Ok(*value),
            // A number that is left out is 0.
            Some(Parameter::Empty) => Ok(0.0),
            other => Err(self.text.wrong(
                self.entry.number,
                &format!("a number as parameter {}", self.at),
                &other.map_or("the end".to_owned(), |other| format!("{other:?}")),
            )),
        }
    }

    fn count(&mut self) -> Result<usize, FormatError> {
        let value = self.number()?;
        if (0.0..=1e8).contains(&value) && value.fract() == 0.0 {
            return Ok(value as usize);
        }
        Err(self.wrong(&format!("a number from 0 to 1e8 as parameter {}", self.at), &value.to_string()))
    }

    /// Takes a pointer to another entity; a negative one means the same entity.
    fn pointer(&mut self) -> Result<u64, FormatError> {
        Ok(self.number()?.abs() as u64)
    }

    fn numbers(&mut self, count: usize) -> Result<Vec<f64>, FormatError> {
        if count > self.parameters.len() {
            return Err(self.wrong(&format!("{count} more numbers"), "fewer"));
        }
        (0..count).map(|_| self.number()).collect()
    }

    fn point(&mut self) -> Result<Point, FormatError> {
        let xyz = self.numbers(3)?;
        Ok(Point::new(xyz[0], xyz[1], xyz[2]))
    }

    fn wrong(&self, expected: &str, found: &str) -> FormatError {
        self.text.wrong(self.entry.number, expected, found)
    }
}

/// Edge of an edge list: the number of its curve, and those of the vertices at its ends.
type ListedEdge = (u64, [u64; 2]);

struct Reader<'a> {
    text: &'a IgesText<'a>,
    unit_mm: f64,
    /// Edge lists (504) by their number. Each edge of a solid asks for its list, which would be read again each time.
    edge_lists: RefCell<HashMap<u64, Rc<[ListedEdge]>>>,
}

impl<'a> Reader<'a> {
    fn parameters_of(&self, entry: &'a Entry) -> Result<Taken<'a>, FormatError> {
        Ok(Taken { text: self.text, entry, parameters: self.text.parameters(entry)?, at: 0 })
    }

    fn parameters_of_number(&self, number: u64) -> Result<Taken<'a>, FormatError> {
        self.parameters_of(self.text.entry_of(number)?)
    }

    /// Returns the entities to which a face or a surface refers.
    fn used(&self) -> HashSet<u64> {
        let mut used = HashSet::new();
        for entry in self.text.entries() {
            let pointers = match entry.kind {
                144 | 510 => 0..1,
                143 => 1..2,
                140 => 4..5,
                _ => continue,
            };
            if let Ok(parameters) = self.text.parameters(entry) {
                let pointed = parameters.get(pointers).unwrap_or_default();
                used.extend(
                    pointed
                        .iter()
                        .filter_map(|p| if let Parameter::Number(n) = p { Some(n.abs() as u64) } else { None }),
                );
            }
        }
        used
    }

    /// Returns the entities of subfigures (308) of which an instance (408) is moved or scaled.
    fn placed(&self) -> HashSet<u64> {
        let mut placed = HashSet::new();
        for entry in self.text.entries().iter().filter(|entry| entry.kind == 408) {
            let Ok(mut taken) = self.parameters_of(entry) else { continue };
            let place = taken.pointer().and_then(|definition| Ok((definition, taken.point()?, taken.number())));
            let Ok((definition, shift, scale)) = place else { continue };
            let is_moved = shift != Point::origin() || !matches!(scale, Ok(1.0) | Err(_)) || entry.transformation != 0;
            let Ok(mut taken) = self.parameters_of_number(definition) else { continue };
            // Depth, name, number of entities, and the entities.
            taken.at = 2;
            let count = taken.count().unwrap_or(0);
            if is_moved {
                placed.extend(taken.numbers(count).unwrap_or_default().into_iter().map(|n| n.abs() as u64));
            }
        }
        placed
    }

    fn face(&self, entry: &'a Entry, placed: &HashSet<u64>) -> CadFace {
        let surface_number = self.base_surface(entry);
        let kind =
            surface_number.as_ref().ok().and_then(|&n| self.text.entry_of(n).ok()).map_or(entry.kind, |e| e.kind);
        let name = self.name(entry, surface_number.as_ref().ok().copied());
        let read = || {
            if placed.contains(&entry.number) {
                let expected = "a face that is not in a placed subfigure; export the model without subfigures";
                return Err(self.text.wrong(entry.number, expected, "a subfigure (308) that an instance (408) moves"));
            }
            let surface_number = surface_number?;
            let (surface, natural) = self.surface(surface_number)?;
            let outlines = match entry.kind {
                143 => self.bounded_outlines(entry)?,
                144 => self.trimmed_outlines(entry, &surface, natural.clone())?,
                510 => self.loops(entry)?,
                _ => Vec::new(),
            };
            let outlines = if outlines.is_empty() { natural } else { outlines };
            if outlines.is_empty() && !matches!(surface, ParametricSurface::BSpline(_)) {
                return Err(self.text.wrong(entry.number, "an outline; this surface is endless", kind_in_words(kind)));
            }
            Ok(Face { name: name.clone(), surface, normal_points_out: None, outlines })
        };
        CadFace::new(name.clone(), kind_in_words(kind).to_owned(), read())
    }

    /// Returns the label of the face or of its surface.
    fn name(&self, entry: &Entry, surface: Option<u64>) -> String {
        let of_surface = surface.and_then(|n| self.text.entry_of(n).ok()).map(|entry| entry.label.clone());
        if entry.label.is_empty() { of_surface.unwrap_or_default() } else { entry.label.clone() }
    }

    fn base_surface(&self, entry: &'a Entry) -> Result<u64, FormatError> {
        let mut taken = match entry.kind {
            143 | 144 | 510 => self.parameters_of(entry)?,
            _ => return Ok(entry.number),
        };
        if entry.kind == 143 {
            taken.number()?;
        }
        taken.pointer()
    }

    /// Returns the pose of an entity's transformation, with those that apply to it.
    fn transformation(&self, entry: &Entry) -> Result<Pose, FormatError> {
        let mut pose = Pose::identity();
        let mut number = entry.transformation;
        for _ in 0..MAX_DEPTH {
            if number == 0 {
                return Ok(pose);
            }
            let mut taken = self.parameters_of_number(number)?;
            if taken.entry.kind != 124 {
                return Err(taken.wrong("a transformation (124)", &taken.entry.kind.to_string()));
            }
            let m = taken.numbers(12)?;
            let rotation = Matrix3::new(m[0], m[1], m[2], m[4], m[5], m[6], m[8], m[9], m[10]);
            let off = (rotation * rotation.transpose() - Matrix3::identity()).amax();
            if off > 1e-6 || rotation.determinant() < 0.0 {
                return Err(taken.wrong("a rotation without scale and mirror image", &format!("{rotation:?}")));
            }
            let translation_mm = Vector::new(m[3], m[7], m[11]) * self.unit_mm;
            pose = Pose { rotation, translation_mm }.orthonormalised() * pose;
            number = taken.entry.transformation;
        }
        Err(self.text.wrong(entry.number, "a transformation that is not its own", "a circle"))
    }

    /// Reads a surface, and the border of the part of it that the entity has, if it has ends.
    fn surface(&self, number: u64) -> Result<(ParametricSurface, Vec<Vec<Point>>), FormatError> {
        let entry = self.text.entry_of(number)?;
        let mut taken = self.parameters_of(entry)?;
        let (surface, part) = match entry.kind {
            128 => {
                let (surface, part) = self.spline_surface(&mut taken)?;
                (ParametricSurface::BSpline(surface), Some(part))
            }
            120 => {
                let (axis, profile) = (taken.pointer()?, taken.pointer()?);
                let angles = [taken.number()?, taken.number()?];
                let Curve::Line { origin, direction } = self.curve(axis, 0)? else {
                    return Err(taken.wrong("a line (110) as the axis", &axis.to_string()));
                };
                let (profile, ends) = self.curve_with_ends(profile, 0)?;
                let axis = direction.normalize();
                (ParametricSurface::Revolution { profile: profile.part(ends), origin, axis }, Some([angles, ends]))
            }
            122 => {
                let (profile, ends) = self.curve_with_ends(taken.pointer()?, 0)?;
                let end = taken.point()? * self.unit_mm;
                let direction = end - profile.evaluate(ends[0]).0;
                (ParametricSurface::Extrusion { profile: profile.part(ends), direction }, Some([ends, [0.0, 1.0]]))
            }
            190..=198 => (self.elementary(&mut taken)?, None),
            108 => {
                let n = taken.numbers(4)?;
                let normal = Vector::new(n[0], n[1], n[2]);
                let origin = Point::from(normal * (n[3] * self.unit_mm / normal.norm_squared()));
                let x = if normal.x.abs() < 0.9 * normal.norm() { Vector::x() } else { Vector::y() };
                let frame = Frame::new(origin, normal, x);
                let frame = frame.ok_or_else(|| taken.wrong("a plane with a normal", &format!("{normal:?}")))?;
                (ParametricSurface::Plane { frame }, None)
            }
            kind => {
                let expected = "surface 108, 120, 122, 128 or 190 to 198";
                return Err(taken.wrong(expected, &format!("{kind}, a {}", kind_in_words(kind))));
            }
        };
        let surface = surface.moved(&self.transformation(entry)?);
        let border = part.map(|part| natural_outlines(&surface, part)).unwrap_or_default();
        Ok((surface, border))
    }

    fn spline_surface(&self, taken: &mut Taken<'_>) -> Result<(BSplineSurface, [[f64; 2]; 2]), FormatError> {
        let (k1, k2, m1, m2) = (taken.count()?, taken.count()?, taken.count()?, taken.count()?);
        taken.numbers(5)?;
        let (rows, columns) = (k1 + 1, k2 + 1);
        let knots = [taken.numbers(rows + m1 + 1)?, taken.numbers(columns + m2 + 1)?];
        let count = rows.saturating_mul(columns);
        let weights = taken.numbers(count)?;
        let xyz = taken.numbers(count.saturating_mul(3))?;
        let part = [[taken.number()?, taken.number()?], [taken.number()?, taken.number()?]];
        // The file has u fastest, a surface has v fastest.
        let order = || (0..rows).flat_map(|i| (0..columns).map(move |j| j * rows + i));
        let point = |k: usize| Point::new(xyz[3 * k], xyz[3 * k + 1], xyz[3 * k + 2]) * self.unit_mm;
        let points: Vec<Point> = order().map(point).collect();
        let weights: Vec<f64> = order().map(|k| weights[k]).collect();
        let [u, v] = knots;
        let spline = || BSplineSurface::new(Knots::new(m1, u, rows)?, Knots::new(m2, v, columns)?, &points, &weights);
        let spline = spline().map_err(|error| taken.wrong(&format!("a valid B-spline: {error}"), "others"))?;
        let part = if part[0][0] < part[0][1] && part[1][0] < part[1][1] {
            let domain = spline.knots().map(|knots| knots.domain());
            [0, 1].map(|k| [part[k][0].max(domain[k][0]), part[k][1].min(domain[k][1])])
        } else {
            spline.knots().map(|knots| knots.domain())
        };
        Ok((spline, part))
    }

    /// Reads a plane, cylinder, cone, sphere or torus (190 to 198).
    fn elementary(&self, taken: &mut Taken<'_>) -> Result<ParametricSurface, FormatError> {
        let location = taken.pointer()?;
        let origin = self.parameters_of_number(location)?.point()? * self.unit_mm;
        let kind = taken.entry.kind;
        let sphere_radius = if kind == 196 { taken.number()? } else { 0.0 };
        // A sphere without parametrisation ends with its radius.
        let has_axis = kind != 196 || taken.entry.form == 1;
        let z = if has_axis { self.direction(taken.pointer()?)? } else { None }.unwrap_or_else(Vector::z);
        let radius = if matches!(kind, 190 | 196) { sphere_radius } else { taken.number()? } * self.unit_mm;
        let second = if matches!(kind, 194 | 198) { taken.number()? } else { 0.0 };
        let reference = if taken.entry.form == 1 { self.direction(taken.pointer()?)? } else { None };
        let x = reference.unwrap_or_else(|| if z.x.abs() < 0.9 { Vector::x() } else { Vector::y() });
        let frame = Frame::new(origin, z, x).ok_or_else(|| taken.wrong("axes that are not parallel", "others"))?;
        if kind != 190 && (radius <= 0.0 && !(kind == 194 && radius == 0.0) || !radius.is_finite()) {
            return Err(taken.wrong("a radius above 0", &radius.to_string()));
        }
        Ok(match kind {
            190 => ParametricSurface::Plane { frame },
            192 => ParametricSurface::Cylinder { frame, radius_mm: radius },
            194 if second.abs() > 0.0 && second.abs() < 89.9 => {
                ParametricSurface::Cone { frame, radius_mm: radius, half_angle_rad: second.to_radians() }
            }
            196 => ParametricSurface::Sphere { frame, radius_mm: radius },
            198 if second > 0.0 => {
                ParametricSurface::Torus { frame, major_radius_mm: radius, minor_radius_mm: second * self.unit_mm }
            }
            _ => return Err(taken.wrong("a cone or torus with valid sizes", &second.to_string())),
        })
    }

    /// Reads a direction (123); `None` for pointer 0.
    fn direction(&self, number: u64) -> Result<Option<Vector>, FormatError> {
        if number == 0 {
            return Ok(None);
        }
        let mut taken = self.parameters_of_number(number)?;
        let d = taken.point()?.coords;
        d.try_normalize(1e-300).map(Some).ok_or_else(|| taken.wrong("a direction that is not zero", "0, 0, 0"))
    }

    fn curve(&self, number: u64, depth: usize) -> Result<Curve, FormatError> {
        self.curve_with_ends(number, depth).map(|(curve, _)| curve)
    }

    /// Reads a curve of one piece, and the parameters of its ends.
    fn curve_with_ends(&self, number: u64, depth: usize) -> Result<(Curve, [f64; 2]), FormatError> {
        let entry = self.text.entry_of(number)?;
        let mut taken = self.parameters_of(entry)?;
        let (curve, ends) = match entry.kind {
            100 => {
                let z = taken.number()? * self.unit_mm;
                let n = taken.numbers(6)?.into_iter().map(|n| n * self.unit_mm).collect::<Vec<_>>();
                let centre = Point::new(n[0], n[1], z);
                let [from, to] = [[n[2], n[3]], [n[4], n[5]]].map(|[x, y]| (y - n[1]).atan2(x - n[0]));
                let radius = (n[2] - n[0]).hypot(n[3] - n[1]);
                let frame = Frame::new(centre, Vector::z(), Vector::x()).filter(|_| radius > 0.0);
                let frame = frame.ok_or_else(|| taken.wrong("an arc with a radius", "0"))?;
                let closed = (n[2] - n[4]).hypot(n[3] - n[5]) <= 1e-9 * radius;
                let to = if closed || to <= from { to.max(from - 1e-12) + std::f64::consts::TAU } else { to };
                let to = if closed { from + std::f64::consts::TAU } else { to };
                (Curve::Ellipse { frame, semi_axes_mm: [radius; 2] }, [from, to])
            }
            110 => {
                let [a, b] = [taken.point()? * self.unit_mm, taken.point()? * self.unit_mm];
                if a == b {
                    return Err(taken.wrong("a line between two points", "one point"));
                }
                (Curve::Line { origin: a, direction: b - a }, [0.0, 1.0])
            }
            126 => {
                let (k, m) = (taken.count()?, taken.count()?);
                taken.numbers(4)?;
                let knots = taken.numbers(k + m + 2)?;
                let weights = taken.numbers(k + 1)?;
                let points: Vec<Point> =
                    (0..=k).map(|_| taken.point().map(|p| p * self.unit_mm)).collect::<Result<_, _>>()?;
                let ends = [taken.number()?, taken.number()?];
                let spline = BSplineCurve::new(m, knots, &points, &weights)
                    .map_err(|error| taken.wrong(&format!("a valid B-spline: {error}"), "others"))?;
                let domain = spline.knots().domain();
                (Curve::BSpline(spline), if ends[0] < ends[1] { ends } else { domain })
            }
            102 if depth < MAX_DEPTH => {
                let count = taken.count()?;
                if count != 1 {
                    return Err(taken.wrong("a curve of one piece", &format!("{count} pieces")));
                }
                self.curve_with_ends(taken.pointer()?, depth + 1)?
            }
            104 => self.ellipse(&mut taken)?,
            kind => return Err(taken.wrong("a curve 100, 104, 110 or 126", &kind.to_string())),
        };
        let pose = self.transformation(entry)?;
        Ok((curve.moved(&pose), ends))
    }

    /// Reads an ellipse with its axes along x and y (104).
    fn ellipse(&self, taken: &mut Taken<'_>) -> Result<(Curve, [f64; 2]), FormatError> {
        let n = taken.numbers(11)?;
        let (a, c, f) = (n[0], n[2], n[5]);
        let is_ellipse = n[1] == 0.0 && n[3] == 0.0 && n[4] == 0.0 && -f / a > 0.0 && -f / c > 0.0;
        let frame = Frame::new(Point::new(0.0, 0.0, n[6] * self.unit_mm), Vector::z(), Vector::x());
        let (Some(frame), true) = (frame, is_ellipse) else {
            return Err(taken.wrong("an ellipse about the origin with its axes along x and y", "another conic"));
        };
        let semi_axes_mm = [(-f / a).sqrt() * self.unit_mm, (-f / c).sqrt() * self.unit_mm];
        let angle = |x: f64, y: f64| (y * self.unit_mm / semi_axes_mm[1]).atan2(x * self.unit_mm / semi_axes_mm[0]);
        let (from, to) = (angle(n[7], n[8]), angle(n[9], n[10]));
        let to = if to <= from + 1e-12 { to + std::f64::consts::TAU } else { to };
        Ok((Curve::Ellipse { frame, semi_axes_mm }, [from, to]))
    }

    /// Returns places along a curve of one or several pieces, from its begin to its end, both included.
    fn curve_places(&self, number: u64, depth: usize) -> Result<Vec<Point>, FormatError> {
        let entry = self.text.entry_of(number)?;
        let mut taken = self.parameters_of(entry)?;
        if depth > MAX_DEPTH {
            return Err(taken.wrong("a curve that is not made of itself", "a deep nest"));
        }
        let places: Vec<Point> = match entry.kind {
            102 => {
                let count = taken.count()?;
                let mut places: Vec<Point> = Vec::new();
                for _ in 0..count {
                    let piece = self.curve_places(taken.pointer()?, depth + 1)?;
                    places.pop();
                    places.extend(piece);
                }
                places
            }
            106 if matches!(entry.form, 11 | 12 | 63) => {
                let (kind, count) = (taken.count()?, taken.count()?);
                let z = if kind == 1 { taken.number()? } else { 0.0 };
                let point = |taken: &mut Taken<'_>| {
                    let (x, y) = (taken.number()?, taken.number()?);
                    let z = if kind == 1 { z } else { taken.number()? };
                    Ok::<_, FormatError>(Point::new(x, y, z) * self.unit_mm)
                };
                (0..count.min(taken.parameters.len())).map(|_| point(&mut taken)).collect::<Result<_, _>>()?
            }
            _ => {
                let (curve, [from, to]) = self.curve_with_ends(number, depth)?;
                return Ok(curve.places(from, to, OUTLINE_TOLERANCE_MM, MAX_OUTLINE_PLACES / 4));
            }
        };
        let pose = self.transformation(entry)?;
        Ok(places.iter().map(|p| pose.transform_point(p)).collect())
    }

    /// Returns the outlines of a trimmed surface (144).
    fn trimmed_outlines(
        &self,
        entry: &'a Entry,
        surface: &ParametricSurface,
        natural: Vec<Vec<Point>>,
    ) -> Result<Vec<Vec<Point>>, FormatError> {
        let mut taken = self.parameters_of(entry)?;
        taken.pointer()?;
        let (outer_given, inner) = (taken.count()?, taken.count()?);
        let outer = taken.pointer()?;
        let mut outlines = Vec::new();
        if outer_given == 1 {
            outlines.extend(self.curve_on_surface(outer, surface)?);
        } else {
            outlines.extend(natural);
        }
        for _ in 0..inner.min(taken.parameters.len()) {
            outlines.extend(self.curve_on_surface(taken.pointer()?, surface)?);
        }
        Ok(outlines)
    }

    /// Returns the outlines that a closed curve on a surface (142) makes: the curve in space, or that in (u, v).
    fn curve_on_surface(&self, number: u64, surface: &ParametricSurface) -> Result<Vec<Vec<Point>>, FormatError> {
        let mut taken = self.parameters_of_number(number)?;
        if taken.entry.kind != 142 {
            return Err(taken.wrong("a curve on a surface (142)", &taken.entry.kind.to_string()));
        }
        taken.numbers(2)?;
        let (in_parameters, in_space) = (taken.pointer()?, taken.pointer()?);
        let pieces = if in_space != 0 {
            self.pieces(in_space, 0)?
        } else {
            let ParametricSurface::BSpline(spline) = surface else {
                return Err(taken.wrong("the outline as a curve in space", "only one in (u, v)"));
            };
            // The curve in (u, v) has no unit.
            let flat =
                Reader { text: self.text, unit_mm: 1.0, edge_lists: RefCell::default() }.pieces(in_parameters, 0)?;
            let lift = |piece: Vec<Point>| piece.iter().map(|p| spline.evaluate(p.x, p.y).point).collect();
            flat.into_iter().map(|piece| lift(finer(piece))).collect()
        };
        let outlines = joined_outlines(as_edges(pieces));
        outlines.ok_or_else(|| taken.wrong("a closed outline", "an open one"))
    }

    /// Returns the places along each piece of a curve.
    fn pieces(&self, number: u64, depth: usize) -> Result<Vec<Vec<Point>>, FormatError> {
        let mut taken = self.parameters_of_number(number)?;
        if taken.entry.kind != 102 || depth > MAX_DEPTH {
            return Ok(vec![self.curve_places(number, depth)?]);
        }
        let pose = self.transformation(taken.entry)?;
        let count = taken.count()?;
        let mut pieces = Vec::new();
        for _ in 0..count.min(taken.parameters.len()) {
            pieces.extend(self.pieces(taken.pointer()?, depth + 1)?);
        }
        let moved = |piece: Vec<Point>| piece.iter().map(|p| pose.transform_point(p)).collect();
        Ok(pieces.into_iter().map(moved).collect())
    }

    /// Returns the outlines of a bounded surface (143).
    fn bounded_outlines(&self, entry: &'a Entry) -> Result<Vec<Vec<Point>>, FormatError> {
        let mut taken = self.parameters_of(entry)?;
        taken.numbers(2)?;
        let count = taken.count()?;
        let mut pieces = Vec::new();
        for _ in 0..count.min(taken.parameters.len()) {
            let mut boundary = self.parameters_of_number(taken.pointer()?)?;
            boundary.numbers(3)?;
            let curves = boundary.count()?;
            for _ in 0..curves.min(boundary.parameters.len()) {
                let (curve, sense) = (boundary.pointer()?, boundary.count()?);
                let mut piece = self.curve_places(curve, 0)?;
                if sense == 2 {
                    piece.reverse();
                }
                pieces.push(piece);
                let in_parameters = boundary.count()?;
                boundary.numbers(in_parameters)?;
            }
        }
        joined_outlines(as_edges(pieces)).ok_or_else(|| taken.wrong("closed outlines", "an open one"))
    }

    /// Returns the outlines of a face of a shell (510): its loops (508) of edges (504).
    fn loops(&self, entry: &'a Entry) -> Result<Vec<Vec<Point>>, FormatError> {
        let mut taken = self.parameters_of(entry)?;
        taken.pointer()?;
        let count = taken.count()?;
        taken.number()?;
        let mut edges = Vec::new();
        for _ in 0..count.min(taken.parameters.len()) {
            let mut around = self.parameters_of_number(taken.pointer()?)?;
            let members = around.count()?;
            for _ in 0..members.min(around.parameters.len()) {
                let is_vertex = around.count()? == 1;
                let (list, index) = (around.pointer()?, around.count()?);
                let forward = around.number()? != 0.0;
                let in_parameters = around.count()?;
                around.numbers(in_parameters.saturating_mul(2))?;
                if !is_vertex {
                    edges.push(self.edge(list, index, forward)?);
                }
            }
        }
        let outlines = joined_outlines(edges);
        outlines.ok_or_else(|| self.text.wrong(entry.number, "closed outlines", "an open one"))
    }

    /// Reads an edge of an edge list (504), in the sense in which a loop passes it.
    fn edge(&self, list: u64, index: usize, forward: bool) -> Result<EdgePlaces, FormatError> {
        let known = self.edge_lists.borrow().get(&list).cloned();
        let edges = match known {
            Some(edges) => edges,
            None => {
                let edges = self.edge_list(list)?;
                self.edge_lists.borrow_mut().entry(list).or_insert(edges).clone()
            }
        };
        let Some(&(curve, mut ends)) = index.checked_sub(1).and_then(|at| edges.get(at)) else {
            return Err(self.text.wrong(list, &format!("an edge from 1 to {}", edges.len()), &index.to_string()));
        };
        let mut places = self.curve_places(curve, 0)?;
        if !forward {
            places.reverse();
            ends.reverse();
        }
        Ok(EdgePlaces { edge: list.saturating_mul(100_000_000).saturating_add(index as u64), ends, places })
    }

    /// Reads the edges of an edge list (504): the number of the curve and those of the vertices at its ends.
    fn edge_list(&self, list: u64) -> Result<Rc<[ListedEdge]>, FormatError> {
        let mut taken = self.parameters_of_number(list)?;
        let count = taken.count()?;
        let mut edges = Vec::new();
        for _ in 0..count {
            let curve = taken.pointer()?;
            let mut ends = [0; 2];
            for end in &mut ends {
                let (vertices, at) = (taken.pointer()?, taken.count()?);
                *end = vertices.saturating_mul(100_000_000).saturating_add(at as u64);
            }
            edges.push((curve, ends));
        }
        Ok(edges.into())
    }
}

/// Gives pieces of a curve numbers by which they are joined. Two pieces along the same places in opposite senses are one
/// edge, a seam. Ends that are nearly at one place are one vertex.
fn as_edges(pieces: Vec<Vec<Point>>) -> Vec<EdgePlaces> {
    let Some(first) = pieces.iter().flatten().next().copied() else { return Vec::new() };
    let size = pieces.iter().flatten().fold(0.0, |size: f64, p| size.max((p - first).norm()));
    let near_mm = NEAR * size;
    let near = |a: &Point, b: &Point| (a - b).norm() <= near_mm;
    let mut vertices = Vertices { near_mm, count: 0, cells: HashMap::new() };
    let mut edges: Vec<EdgePlaces> = Vec::new();
    let mut by_ends: HashMap<[u64; 2], Vec<usize>> = HashMap::new();
    for places in pieces.into_iter().filter(|places| places.len() > 1) {
        let last = places[places.len() - 1];
        let ends = [vertices.number_of(&places[0]), vertices.number_of(&last)];
        // A piece without length is a pole.
        if ends[0] == ends[1] && places.iter().all(|p| near(p, &last)) {
            continue;
        }
        let run_back = by_ends.get(&[ends[1], ends[0]]).filter(|_| ends[0] != ends[1]);
        let same = run_back.into_iter().flatten().take(MAX_ALIKE).map(|&at| &edges[at]).find(|edge| {
            // An arc and its chord have the same ends, too.
            let along = |of: &[Point], on: &[Point]| distance_from_line(&middle(of), on) <= near_mm;
            along(&places, &edge.places) && along(&edge.places, &places)
        });
        let edge = same.map_or(edges.len() as u64, |edge| edge.edge);
        by_ends.entry(ends).or_default().push(edges.len());
        edges.push(EdgePlaces { edge, ends, places });
    }
    edges
}

/// Vertices of a face, in cells of space so that those nearby are found at once.
struct Vertices {
    /// Distance up to which two places are one vertex.
    near_mm: f64,
    count: u64,
    cells: HashMap<[i64; 3], Vec<(Point, u64)>>,
}

impl Vertices {
    /// Returns the number of the vertex at `p`, a new one if none is near.
    fn number_of(&mut self, p: &Point) -> u64 {
        let cell = [0, 1, 2].map(|k| (p[k] / self.near_mm).floor() as i64);
        let around = (0..27).map(|i| [0, 1, 2].map(|k| cell[k].saturating_add(i / [1, 3, 9][k] % 3 - 1)));
        let is_near = |known: &Point| (known - p).norm() <= self.near_mm;
        let known = around.filter_map(|cell| self.cells.get(&cell)).flatten().find(|(known, _)| is_near(known));
        if let Some((_, number)) = known {
            return *number;
        }
        let number = self.count;
        self.count += 1;
        self.cells.entry(cell).or_default().push((*p, number));
        number
    }
}

/// Adds places between those of a curve in (u, v), which is curved in space even where it is straight in (u, v).
fn finer(places: Vec<Point>) -> Vec<Point> {
    const LEAST: usize = 64;
    let parts = LEAST.div_ceil(places.len().max(2) - 1);
    let between = |pair: &[Point]| {
        let (a, step) = (pair[0], (pair[1] - pair[0]) / parts as f64);
        (0..parts).map(move |i| a + step * i as f64).collect::<Vec<_>>()
    };
    let last = places.last().copied();
    places.windows(2).flat_map(between).chain(last).collect()
}

fn kind_in_words(kind: u64) -> &'static str {
    match kind {
        108 | 190 => "plane",
        114 => "parametric spline surface",
        118 => "ruled surface",
        120 => "surface of revolution",
        122 => "tabulated cylinder",
        128 => "B-spline surface",
        140 => "offset surface",
        192 => "cylinder",
        194 => "cone",
        196 => "sphere",
        198 => "torus",
        _ => "surface",
    }
}

/// Returns a place near the middle of a line of at least two places that is none of its ends.
fn middle(places: &[Point]) -> Point {
    match places {
        [a, b] => nalgebra::center(a, b),
        _ => places[places.len() / 2],
    }
}

/// Returns the distance of `p` from the straight segments between places.
fn distance_from_line(p: &Point, places: &[Point]) -> f64 {
    let from_segment = |pair: &[Point]| {
        let along = pair[1] - pair[0];
        let share = (p - pair[0]).dot(&along) / along.norm_squared();
        // A segment without length is its first place.
        let share = if share.is_finite() { share.clamp(0.0, 1.0) } else { 0.0 };
        (p - (pair[0] + along * share)).norm()
    };
    places.windows(2).map(from_segment).fold(f64::INFINITY, f64::min)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A half circle and its chord enclose a face. A line that is passed in both senses is a seam.
    #[test]
    fn arc_and_chord_are_no_seam() {
        let arc: Vec<Point> = (0..=20)
            .map(|k| {
                let (sine, cosine) = (f64::from(k) * std::f64::consts::PI / 20.0).sin_cos();
                Point::new(10.0 * cosine, 10.0 * sine, 0.0)
            })
            .collect();
        let chord = vec![arc[20], arc[0]];
        for pieces in [vec![arc.clone(), chord.clone()], vec![chord.clone(), arc.clone()]] {
            let edges = as_edges(pieces);
            assert_ne!(edges[0].edge, edges[1].edge);
            assert_eq!(joined_outlines(edges).unwrap().len(), 1);
        }
        for line in [chord, arc] {
            let back: Vec<Point> = line.iter().rev().copied().collect();
            let edges = as_edges(vec![line, back]);
            assert_eq!(edges[0].edge, edges[1].edge);
        }
    }

    /// A curve without places in a composite curve is no edge.
    #[test]
    fn empty_piece_of_curve_is_left_out() {
        let line = vec![Point::new(0.0, 0.0, 0.0), Point::new(1.0, 0.0, 0.0)];
        let edges = as_edges(vec![Vec::new(), line.clone()]);
        assert_eq!(edges.len(), 1);
        assert_eq!((edges[0].ends, &edges[0].places), ([0, 1], &line));
        assert!(as_edges(vec![Vec::new(), Vec::new()]).is_empty());
    }
}
