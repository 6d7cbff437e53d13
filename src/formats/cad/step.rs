//! Faces of a STEP file: AP203, AP214 and AP242 (ISO 10303-21, 10303-42).
//!
//! ```text
//!  assembly --relationship with a transformation--> part --items--> shells --> faces --> surface and edges
//! ```
//!
//! A part that occurs several times gives its faces several times. Surfaces that no face refers to are faces with the
//! border of their domain as the outline. Units are those of the context of each representation.

use std::collections::HashSet;
use std::path::Path;

use regrind_core::geometry::{Point, Pose};
use regrind_core::surface::parametric::{
    Curve, Face, MAX_OUTLINE_PLACES, OUTLINE_TOLERANCE_MM, ParametricSurface, natural_outlines,
};

use super::super::error::FormatError;
use super::model::{CadFace, CadModel};
use super::outline::{EdgePlaces, joined_outlines};
use super::step_geometry::{Attributes, Geometry, OrientedSurface};
use super::step_structure::Structure;
use super::step_text::StepText;

/// Maximum number of faces, with those of parts that occur several times.
const MAX_FACES: usize = 200_000;

/// Maximum number of places of all outlines, with those of parts that occur several times: about 250 MB.
const MAX_PLACES: usize = 10_000_000;

/// Maximum number of items of all representations, with those of sets that occur several times.
const MAX_ITEMS: usize = 500_000;

/// Maximum depth of shells and of representations within each other.
const MAX_DEPTH: usize = 32;

/// Names of the types of a surface that a bare surface can have.
const SURFACES: [&str; 12] = [
    "B_SPLINE_SURFACE_WITH_KNOTS",
    "BEZIER_SURFACE",
    "UNIFORM_SURFACE",
    "QUASI_UNIFORM_SURFACE",
    "RECTANGULAR_TRIMMED_SURFACE",
    "CURVE_BOUNDED_SURFACE",
    "PLANE",
    "CYLINDRICAL_SURFACE",
    "CONICAL_SURFACE",
    "SPHERICAL_SURFACE",
    "TOROIDAL_SURFACE",
    "SURFACE_OF_REVOLUTION",
];

/// Reads the faces of a STEP file.
///
/// # Errors
/// Text that is not STEP; a unit that is not known; a file without faces. A face that cannot be read is in the result,
/// with the reason.
pub(super) fn parse_step(path: &Path, bytes: &[u8]) -> Result<CadModel, FormatError> {
    let text = StepText::new(path, bytes)?;
    let structure = Structure::new(&text)?;
    let mut reader = Reader {
        text: &text,
        structure: &structure,
        faces: Vec::new(),
        taken: HashSet::new(),
        item_count: 0,
        place_count: 0,
    };
    for representation in structure.with_items.iter().filter(|shape| !structure.mapped.contains(&shape.number)) {
        let geometry = Geometry { text: &text, units: structure.units_of(&text, representation.number)? };
        let mut found = Vec::new();
        for &item in &representation.items {
            reader.collect(&geometry, item, Way::start(), &mut found)?;
        }
        if found.is_empty() {
            continue;
        }
        for placement in structure.placements(&text, representation.number)? {
            for face in &found {
                reader.push(face.moved(&placement))?;
            }
        }
    }
    reader.collect_bare()?;
    if reader.faces.is_empty() {
        return Err(FormatError::NoData { path: path.to_owned(), expected: "face or surface" });
    }
    Ok(CadModel::new(reader.faces))
}

/// Collector of faces.
struct Reader<'a> {
    text: &'a StepText<'a>,
    structure: &'a Structure,
    faces: Vec<CadFace>,
    /// Surfaces that a face has.
    taken: HashSet<u64>,
    /// Number of items that were visited.
    item_count: usize,
    /// Number of places of the outlines of all faces.
    place_count: usize,
}

/// Way from a representation to one of its items.
#[derive(Clone, Copy)]
struct Way {
    placement: Pose,
    depth: usize,
    /// True if the item lies in a shell around a solid, so that its outside is known.
    is_closed: bool,
    /// True if the item is used with its sides exchanged.
    is_turned: bool,
}

impl Way {
    fn start() -> Self {
        Self { placement: Pose::identity(), depth: 0, is_closed: false, is_turned: false }
    }
}

impl<'a> Reader<'a> {
    fn push(&mut self, face: CadFace) -> Result<(), FormatError> {
        if self.faces.len() == MAX_FACES {
            return Err(self.text.unexpected(0, "at most 200000 faces", "more"));
        }
        let outlines = face.face.as_ref().map_or(&[][..], |face| &face.outlines);
        self.place_count += outlines.iter().map(Vec::len).sum::<usize>();
        if self.place_count > MAX_PLACES {
            return Err(self.text.unexpected(0, "outlines of at most 10000000 places", "more"));
        }
        self.faces.push(face);
        Ok(())
    }

    /// Collects the faces of an item of a representation: of a solid, a shell, a set or another representation.
    fn collect(
        &mut self,
        geometry: &Geometry<'a>,
        item: u64,
        way: Way,
        found: &mut Vec<CadFace>,
    ) -> Result<(), FormatError> {
        self.item_count += 1;
        if way.depth > MAX_DEPTH || self.item_count > MAX_ITEMS || found.len() > MAX_FACES {
            return Err(self.text.unexpected(item, "at most 500000 items, not made of themselves", "more"));
        }
        let entity = geometry.entity(item)?;
        let way = Way { depth: way.depth + 1, ..way };
        let mut all = |numbers: Vec<u64>, way: Way, found: &mut Vec<CadFace>| {
            numbers.into_iter().try_for_each(|n| self.collect(geometry, n, way, found))
        };
        match entity.name() {
            "MANIFOLD_SOLID_BREP" | "FACETED_BREP" => all(vec![entity.reference(1)?], way, found),
            "BREP_WITH_VOIDS" => {
                all(vec![entity.reference(1)?], way, found)?;
                all(entity.references(2)?, way, found)
            }
            "ORIENTED_CLOSED_SHELL" | "ORIENTED_OPEN_SHELL" | "ORIENTED_FACE" => {
                let is_turned = way.is_turned == entity.logical(3)?.unwrap_or(true);
                all(vec![entity.reference(2)?], Way { is_turned, ..way }, found)
            }
            "CLOSED_SHELL" => all(entity.references(1)?, Way { is_closed: true, ..way }, found),
            "OPEN_SHELL" | "CONNECTED_FACE_SET" => all(entity.references(1)?, Way { is_closed: false, ..way }, found),
            "SHELL_BASED_SURFACE_MODEL" | "FACE_BASED_SURFACE_MODEL" | "GEOMETRIC_SET" => {
                all(entity.references(1)?, way, found)
            }
            "ADVANCED_FACE" | "FACE_SURFACE" => {
                found.push(self.face(geometry, &entity, way)?.moved(&way.placement));
                Ok(())
            }
            "MAPPED_ITEM" => self.mapped(geometry, &entity, way, found),
            name if SURFACES.contains(&name) || entity.has("B_SPLINE_SURFACE") => {
                self.taken.insert(item);
                found.push(bare_face(geometry, item, &entity).moved(&way.placement));
                Ok(())
            }
            // Curves, points, placements, notes.
            _ => Ok(()),
        }
    }

    /// Collects the faces of a representation that stands in another one. It has the units of its own context.
    fn mapped(
        &mut self,
        geometry: &Geometry<'a>,
        entity: &Attributes<'a>,
        way: Way,
        found: &mut Vec<CadFace>,
    ) -> Result<(), FormatError> {
        let map = geometry.entity(entity.reference(1)?)?;
        let (origin, source_number) = (map.reference(0)?, map.reference(1)?);
        let inner = Geometry { text: self.text, units: self.structure.units_of(self.text, source_number)? };
        let source = inner.entity(source_number)?;
        let target = geometry.frame(entity.reference(2)?)?;
        let motion = target.pose() * inner.frame(origin)?.pose().inverse();
        let way = Way { placement: way.placement * motion, ..way };
        source.references(1)?.into_iter().try_for_each(|n| self.collect(&inner, n, way, found))
    }

    /// Reads a face with its outlines. The reason why it cannot be read is kept with it.
    fn face(&mut self, geometry: &Geometry<'a>, entity: &Attributes<'a>, way: Way) -> Result<CadFace, FormatError> {
        let surface_number = entity.reference(2)?;
        self.taken.insert(surface_number);
        let surface = geometry.entity(surface_number)?;
        let kind = readable_kind(&surface);
        let label = [entity.label(), surface.label()].into_iter().find(|label| !label.is_empty()).unwrap_or_default();
        let same_sense = entity.logical(3)?.unwrap_or(true);
        let read = || {
            let outlines = outlines(geometry, &entity.references(1)?)?;
            let OrientedSurface { surface, is_turned } = geometry.oriented_surface(surface_number)?;
            let points_out = same_sense != (is_turned != way.is_turned);
            let normal_points_out = way.is_closed.then_some(points_out);
            Ok(Face { name: label.clone(), surface, normal_points_out, outlines })
        };
        Ok(CadFace::new(label.clone(), kind, read()))
    }

    /// Adds the surfaces to which no face and no representation refers.
    fn collect_bare(&mut self) -> Result<(), FormatError> {
        let used = self.structure.used_surfaces(self.text)?;
        let bare: Vec<u64> =
            self.text.numbers().iter().copied().filter(|n| !self.taken.contains(n) && !used.contains(n)).collect();
        for number in bare {
            let name = self.text.type_name(number).unwrap_or_default();
            if name != "B_SPLINE_SURFACE_WITH_KNOTS" && name != "BOUNDED_SURFACE" && name != "B_SPLINE_SURFACE" {
                continue;
            }
            let entity = Attributes::new(self.text, number)?;
            if !SURFACES.contains(&entity.name()) && !entity.has("B_SPLINE_SURFACE") {
                continue;
            }
            let units = self.structure.units(self.text, None)?;
            let face = bare_face(&Geometry { text: self.text, units }, number, &entity);
            self.push(face)?;
        }
        Ok(())
    }
}

/// Returns a surface that no face refers to as a face with the border of its domain as the outline.
fn bare_face(geometry: &Geometry<'_>, number: u64, entity: &Attributes<'_>) -> CadFace {
    let label = entity.label();
    let read = || {
        let (surface, outlines) = if entity.name() == "RECTANGULAR_TRIMMED_SURFACE" {
            let (OrientedSurface { surface, .. }, part) = geometry.rectangle(entity, 0)?;
            let outlines = natural_outlines(&surface, part);
            (surface, outlines)
        } else {
            (geometry.oriented_surface(number)?.surface, Vec::new())
        };
        if outlines.is_empty() && !matches!(surface, ParametricSurface::BSpline(_)) {
            return Err(entity.wrong("a face with an outline; this surface is endless"));
        }
        Ok(Face { name: label.clone(), surface, normal_points_out: None, outlines })
    };
    CadFace::new(label.clone(), readable_kind(entity), read())
}

/// Returns the name of a surface's type in plain words.
fn readable_kind(surface: &Attributes<'_>) -> String {
    if surface.has("RATIONAL_B_SPLINE_SURFACE") {
        return "rational B-spline surface".to_owned();
    }
    if surface.has("B_SPLINE_SURFACE") || surface.name() == "B_SPLINE_SURFACE_WITH_KNOTS" {
        return "B-spline surface".to_owned();
    }
    surface
        .name()
        .to_lowercase()
        .replace('_', " ")
        .replace("spherical surface", "sphere")
        .replace("conical surface", "cone")
        .replace("cylindrical surface", "cylinder")
        .replace("toroidal surface", "torus")
}

/// Reads the closed outlines of a face. An edge that the face has twice is a seam, and no border.
fn outlines(geometry: &Geometry<'_>, bounds: &[u64]) -> Result<Vec<Vec<Point>>, FormatError> {
    let mut edges: Vec<EdgePlaces> = Vec::new();
    let mut outlines = Vec::new();
    for &bound in bounds {
        let bound = geometry.entity(bound)?;
        let with = geometry.entity(bound.reference(1)?)?;
        match with.name() {
            "EDGE_LOOP" => {
                for oriented in with.references(1)? {
                    edges.push(oriented_edge(geometry, oriented)?);
                }
            }
            "POLY_LOOP" => {
                let corners = with.references(1)?;
                outlines.push(corners.into_iter().map(|n| geometry.point(n)).collect::<Result<Vec<_>, _>>()?);
            }
            // The pole of a sphere, or the apex of a cone.
            "VERTEX_LOOP" => {
                let vertex = geometry.entity(with.reference(1)?)?;
                outlines.push(vec![geometry.point(vertex.reference(1)?)?]);
            }
            _ => return Err(with.wrong("EDGE_LOOP, POLY_LOOP or VERTEX_LOOP")),
        }
    }
    let joined = joined_outlines(edges);
    outlines.extend(joined.ok_or_else(|| geometry.text.unexpected(bounds[0], "a closed outline", "an open one"))?);
    Ok(outlines)
}

/// Reads the places along an edge, in the sense in which the outline passes it.
fn oriented_edge(geometry: &Geometry<'_>, number: u64) -> Result<EdgePlaces, FormatError> {
    let oriented = geometry.entity(number)?;
    let edge_number = oriented.reference(3)?;
    let forward = oriented.logical(4)?.unwrap_or(true);
    let edge = geometry.entity(edge_number)?;
    if edge.name() != "EDGE_CURVE" {
        return Err(edge.wrong("EDGE_CURVE"));
    }
    let vertices = [edge.reference(1)?, edge.reference(2)?];
    let vertex = |n: u64| {
        let vertex = geometry.entity(n)?;
        if vertex.name() == "VERTEX_POINT" {
            geometry.point(vertex.reference(1)?)
        } else {
            Err(vertex.wrong("VERTEX_POINT"))
        }
    };
    let ends = [vertex(vertices[0])?, vertex(vertices[1])?];
    let same_sense = edge.logical(4)?.unwrap_or(true);
    let curve_number = edge.reference(3)?;
    let mut places = if geometry.text.type_name(curve_number).as_deref() == Some("POLYLINE") {
        let polyline = geometry.entity(curve_number)?;
        let mut places =
            polyline.references(1)?.into_iter().map(|n| geometry.point(n)).collect::<Result<Vec<_>, _>>()?;
        if !same_sense {
            places.reverse();
        }
        places
    } else {
        edge_places(&geometry.curve(curve_number)?, ends, vertices[0] == vertices[1], same_sense)
    };
    let mut vertices = vertices;
    if !forward {
        places.reverse();
        vertices.reverse();
    }
    Ok(EdgePlaces { edge: edge_number, ends: vertices, places })
}

/// Returns places along a curve from one vertex to the other. `same_sense` tells whether the parameter rises on the way.
/// The places at the ends are the vertices.
pub(super) fn edge_places(curve: &Curve, ends: [Point; 2], is_closed: bool, same_sense: bool) -> Vec<Point> {
    let [mut from, mut to] = ends.map(|p| curve.parameter_near(&p));
    let turn = std::f64::consts::TAU;
    let is_ring = matches!(curve, Curve::Ellipse { .. });
    let mut wraps = false;
    if is_ring {
        if same_sense && (to <= from || is_closed) {
            to = if is_closed { from + turn } else { to + turn };
        } else if !same_sense && (to >= from || is_closed) {
            to = if is_closed { from - turn } else { to - turn };
        }
    } else if let Some([low, high]) = curve.domain() {
        let small = 1e-9 * (high - low);
        if is_closed {
            // The vertex can lie anywhere on the closed curve.
            wraps = from - low > small && high - from > small;
            if !wraps {
                [from, to] = if same_sense { [low, high] } else { [high, low] };
            }
        } else if (to - from) * if same_sense { 1.0 } else { -1.0 } < 0.0 {
            // The nearest parameter of the point where the curve closes is that of the other end, or the edge passes it.
            let [first, last] = if same_sense { [low, high] } else { [high, low] };
            if (to - first).abs() <= small {
                to = last;
            } else if (from - last).abs() <= small {
                from = first;
            } else {
                wraps = true;
            }
        }
    }
    let most = MAX_OUTLINE_PLACES / 4;
    let mut places = if wraps {
        let [low, high] = curve.domain().unwrap_or([from, to]);
        let [first, last] = if same_sense { [low, high] } else { [high, low] };
        let mut places = curve.places(from, last, OUTLINE_TOLERANCE_MM, most / 2);
        places.extend(curve.places(first, to, OUTLINE_TOLERANCE_MM, most / 2));
        places
    } else {
        curve.places(from, to, OUTLINE_TOLERANCE_MM, most)
    };
    let count = places.len();
    places[0] = ends[0];
    places[count - 1] = ends[1];
    places
}
