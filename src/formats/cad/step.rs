//! Faces of a STEP file: AP203, AP214 and AP242 (ISO 10303-21, 10303-42).
//!
//! ```text
//!  assembly --relationship with a transformation--> part --items--> shells --> faces --> surface and edges
//! ```
//!
//! A part that occurs several times gives its faces several times. Surfaces that no face refers to are faces with the
//! border of their domain as the outline. Units are those of the context of each representation.

use std::collections::{HashMap, HashSet};
use std::path::Path;

use regrind_core::geometry::{Point, Pose};
use regrind_core::surface::parametric::{
    Curve, Face, MAX_OUTLINE_PLACES, OUTLINE_TOLERANCE_MM, ParametricSurface, natural_outlines,
};

use super::super::error::FormatError;
use super::model::{CadFace, CadModel};
use super::outline::{EdgePlaces, joined_outlines};
use super::step_geometry::{Attributes, Geometry, Units, as_number, as_reference, as_references};
use super::step_text::{StepText, Value};

/// Maximum number of faces, with those of parts that occur several times.
const MAX_FACES: usize = 200_000;

/// Maximum depth of assemblies and of shells.
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
    let mut reader = Reader { text: &text, faces: Vec::new(), taken: HashSet::new() };
    for representation in structure.with_items.iter().filter(|shape| !structure.mapped.contains(&shape.number)) {
        let units = structure.units(&text, representation.context)?;
        let mut found = Vec::new();
        let geometry = Geometry { text: &text, units };
        for &item in &representation.items {
            reader.collect(&geometry, item, &Pose::identity(), 0, &mut found)?;
        }
        for placement in structure.placements(&text, representation.number)? {
            for face in &found {
                reader.push(face.moved(&placement))?;
            }
        }
    }
    reader.collect_bare(&structure)?;
    if reader.faces.is_empty() {
        return Err(FormatError::NoData { path: path.to_owned(), expected: "face or surface" });
    }
    Ok(CadModel::new(reader.faces))
}

/// Collector of faces.
struct Reader<'a> {
    text: &'a StepText<'a>,
    faces: Vec<CadFace>,
    /// Surfaces that a face has.
    taken: HashSet<u64>,
}

impl<'a> Reader<'a> {
    fn push(&mut self, face: CadFace) -> Result<(), FormatError> {
        if self.faces.len() == MAX_FACES {
            return Err(self.text.unexpected(0, "at most 200000 faces", "more"));
        }
        self.faces.push(face);
        Ok(())
    }

    /// Collects the faces of an item of a representation: of a solid, a shell, a set or another representation.
    fn collect(
        &mut self,
        geometry: &Geometry<'a>,
        item: u64,
        placement: &Pose,
        depth: usize,
        found: &mut Vec<CadFace>,
    ) -> Result<(), FormatError> {
        if depth > MAX_DEPTH || found.len() > MAX_FACES {
            return Err(self.text.unexpected(item, "items that are not made of themselves", "a deep nest"));
        }
        let entity = geometry.entity(item)?;
        let mut all = |numbers: Vec<u64>, found: &mut Vec<CadFace>| {
            numbers.into_iter().try_for_each(|n| self.collect(geometry, n, placement, depth + 1, found))
        };
        match entity.name() {
            "MANIFOLD_SOLID_BREP" | "FACETED_BREP" => all(vec![entity.reference(1)?], found),
            "BREP_WITH_VOIDS" => {
                all(vec![entity.reference(1)?], found)?;
                all(entity.references(2)?, found)
            }
            "ORIENTED_CLOSED_SHELL" | "ORIENTED_OPEN_SHELL" => all(vec![entity.reference(2)?], found),
            "SHELL_BASED_SURFACE_MODEL"
            | "FACE_BASED_SURFACE_MODEL"
            | "OPEN_SHELL"
            | "CLOSED_SHELL"
            | "CONNECTED_FACE_SET"
            | "GEOMETRIC_SET" => all(entity.references(1)?, found),
            "ADVANCED_FACE" | "FACE_SURFACE" => {
                found.push(self.face(geometry, &entity)?.moved(placement));
                Ok(())
            }
            "ORIENTED_FACE" => all(vec![entity.reference(2)?], found),
            "MAPPED_ITEM" => self.mapped(geometry, &entity, placement, depth, found),
            name if SURFACES.contains(&name) || entity.has("B_SPLINE_SURFACE") => {
                self.taken.insert(item);
                found.push(bare_face(geometry, item, &entity).moved(placement));
                Ok(())
            }
            // Curves, points, placements, notes.
            _ => Ok(()),
        }
    }

    /// Collects the faces of a representation that stands in another one.
    fn mapped(
        &mut self,
        geometry: &Geometry<'a>,
        entity: &Attributes<'a>,
        placement: &Pose,
        depth: usize,
        found: &mut Vec<CadFace>,
    ) -> Result<(), FormatError> {
        let map = geometry.entity(entity.reference(1)?)?;
        let (origin, source) = (map.reference(0)?, geometry.entity(map.reference(1)?)?);
        let target = geometry.frame(entity.reference(2)?)?;
        let motion = target.pose() * geometry.frame(origin)?.pose().inverse();
        let placement = *placement * motion;
        source.references(1)?.into_iter().try_for_each(|n| self.collect(geometry, n, &placement, depth + 1, found))
    }

    /// Reads a face with its outlines. The reason why it cannot be read is kept with it.
    fn face(&mut self, geometry: &Geometry<'a>, entity: &Attributes<'a>) -> Result<CadFace, FormatError> {
        let surface_number = entity.reference(2)?;
        self.taken.insert(surface_number);
        let surface = geometry.entity(surface_number)?;
        let kind = readable_kind(&surface);
        let label = [entity.label(), surface.label()].into_iter().find(|label| !label.is_empty()).unwrap_or_default();
        let same_sense = entity.logical(3)?.unwrap_or(true);
        let read = || {
            let outlines = outlines(geometry, &entity.references(1)?)?;
            let surface = geometry.surface(surface_number)?;
            Ok(Face { name: label.clone(), surface, normal_points_out: Some(same_sense), outlines })
        };
        Ok(CadFace::new(label.clone(), kind, read()))
    }

    /// Adds the surfaces to which no face and no representation refers.
    fn collect_bare(&mut self, structure: &Structure) -> Result<(), FormatError> {
        let used = structure.used_surfaces(self.text)?;
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
            let units = structure.units(self.text, None)?;
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
            let (surface, part) = geometry.rectangle(entity)?;
            let outlines = natural_outlines(&surface, part);
            (surface, outlines)
        } else {
            (geometry.surface(number)?, Vec::new())
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
        if is_closed {
            [from, to] = if same_sense { [low, high] } else { [high, low] };
        } else if (to - from) * if same_sense { 1.0 } else { -1.0 } < 0.0 {
            // The nearest parameter of the point where the curve closes is that of the other end, or the edge passes it.
            let [first, last] = if same_sense { [low, high] } else { [high, low] };
            let small = 1e-9 * (high - low);
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

/// Representation that has items.
struct Representation {
    number: u64,
    items: Vec<u64>,
    context: Option<u64>,
}

/// Relation of the parts: their representations, contexts and placements.
struct Structure {
    with_items: Vec<Representation>,
    /// Contexts by the number of the representation.
    contexts: HashMap<u64, Option<u64>>,
    /// Representations with the same frame: the number of one of them for each.
    same: HashMap<u64, u64>,
    /// Where a representation occurs: the outer one, and the two placements whose frames coincide.
    outer: HashMap<u64, Vec<Occurrence>>,
    /// Contexts that state a unit of length.
    contexts_with_units: Vec<u64>,
    /// Representations that occur as an item of another one.
    mapped: HashSet<u64>,
}

/// Place of a representation in another one.
#[derive(Clone, Copy)]
struct Occurrence {
    outer: u64,
    /// Placement in the inner one and in the outer one, with the representations that tell their units.
    frames: [(u64, u64); 2],
}

impl Structure {
    fn new(text: &StepText<'_>) -> Result<Self, FormatError> {
        let mut structure = Self {
            with_items: Vec::new(),
            contexts: HashMap::new(),
            same: HashMap::new(),
            outer: HashMap::new(),
            contexts_with_units: Vec::new(),
            mapped: HashSet::new(),
        };
        let mut relations = Vec::new();
        let mut products = Products::default();
        for &number in text.numbers() {
            let Some(name) = text.type_name(number) else { continue };
            if name.ends_with("REPRESENTATION_CONTEXT") || name.starts_with("GLOBAL_UN") {
                let entity = Attributes::new(text, number)?;
                if entity.has("GLOBAL_UNIT_ASSIGNED_CONTEXT") {
                    structure.contexts_with_units.push(number);
                }
            } else if is_representation(&name) {
                structure.add_representation(text, number)?;
            } else if name == "REPRESENTATION_MAP" {
                structure.mapped.insert(Attributes::new(text, number)?.reference(1)?);
            } else if name.contains("REPRESENTATION_RELATIONSHIP") {
                relations.push(number);
            } else {
                products.note(text, number, &name)?;
            }
        }
        for relation in relations {
            structure.relate(text, relation, &products)?;
        }
        Ok(structure)
    }

    fn add_representation(&mut self, text: &StepText<'_>, number: u64) -> Result<(), FormatError> {
        let entity = Attributes::new(text, number)?;
        // A complex entity has the attributes in the part of the general type.
        let values = entity.values_of("REPRESENTATION").map(<[Value]>::to_vec);
        let (items, context) = match values {
            Some(values) => {
                (values.get(1).and_then(as_references).unwrap_or_default(), values.get(2).and_then(as_reference))
            }
            None => (as_references(entity.at(1)?).unwrap_or_default(), entity.at(2).ok().and_then(as_reference)),
        };
        self.contexts.insert(number, context);
        // Symbols and pictures have no shape.
        if entity.name().ends_with("SHAPE_REPRESENTATION") {
            self.with_items.push(Representation { number, items, context });
        }
        Ok(())
    }

    /// Notes a relationship of two representations: with a transformation the first is a part of the second, without one
    /// both have the same frame.
    fn relate(&mut self, text: &StepText<'_>, number: u64, products: &Products) -> Result<(), FormatError> {
        let entity = Attributes::new(text, number)?;
        let values =
            entity.values_of("REPRESENTATION_RELATIONSHIP").or(entity.values_of("SHAPE_REPRESENTATION_RELATIONSHIP"));
        let pair = values.and_then(|values| Some([as_reference(values.get(2)?)?, as_reference(values.get(3)?)?]));
        let Some([first, second]) = pair else { return Ok(()) };
        let with = entity.values_of("REPRESENTATION_RELATIONSHIP_WITH_TRANSFORMATION");
        let Some(operator) = with.and_then(<[Value]>::first).and_then(as_reference) else {
            let (a, b) = (self.frame_of(first), self.frame_of(second));
            if a != b {
                self.same.insert(a, b);
            }
            return Ok(());
        };
        let transformation = Attributes::new(text, operator)?;
        if transformation.name() != "ITEM_DEFINED_TRANSFORMATION" {
            return Err(transformation.wrong("ITEM_DEFINED_TRANSFORMATION"));
        }
        let frames = [(transformation.reference(2)?, first), (transformation.reference(3)?, second)];
        // Some programs write the assembly first; the product structure tells which is the part.
        let is_turned = products.part_of(number).is_some_and(|part| part == second);
        let (inner, outer, frames) =
            if is_turned { (second, first, [frames[1], frames[0]]) } else { (first, second, frames) };
        self.outer.entry(inner).or_default().push(Occurrence { outer, frames });
        Ok(())
    }

    /// Returns the number that stands for all representations with the same frame as this one.
    fn frame_of(&self, mut number: u64) -> u64 {
        while let Some(&next) = self.same.get(&number) {
            number = next;
        }
        number
    }

    /// Returns the poses at which a representation occurs in the file.
    fn placements(&self, text: &StepText<'_>, number: u64) -> Result<Vec<Pose>, FormatError> {
        let mut placements = Vec::new();
        self.add_placements(text, number, Pose::identity(), 0, &mut placements)?;
        Ok(placements)
    }

    fn add_placements(
        &self,
        text: &StepText<'_>,
        number: u64,
        pose: Pose,
        depth: usize,
        placements: &mut Vec<Pose>,
    ) -> Result<(), FormatError> {
        if depth > MAX_DEPTH || placements.len() > MAX_FACES {
            return Err(text.unexpected(number, "an assembly that is not a part of itself", "a deep nest"));
        }
        let frame = self.frame_of(number);
        let alike = self.outer.iter().filter(|(inner, _)| self.frame_of(**inner) == frame);
        let mut occurrences: Vec<Occurrence> = alike.flat_map(|(_, occurrences)| occurrences).copied().collect();
        occurrences.sort_by_key(|occurrence| (occurrence.outer, occurrence.frames));
        if occurrences.is_empty() {
            placements.push(pose);
            return Ok(());
        }
        for Occurrence { outer, frames } in occurrences {
            let frame = |(placement, representation): (u64, u64)| {
                let units = self.units(text, self.contexts.get(&representation).copied().flatten())?;
                Ok::<_, FormatError>(Geometry { text, units }.frame(placement)?.pose())
            };
            let step = frame(frames[1])? * frame(frames[0])?.inverse();
            self.add_placements(text, outer, step * pose, depth + 1, placements)?;
        }
        Ok(())
    }

    /// Returns the units of a context. Without a context, those on which all contexts of the file agree.
    fn units(&self, text: &StepText<'_>, context: Option<u64>) -> Result<Units, FormatError> {
        let stated = context.filter(|context| self.contexts_with_units.contains(context));
        let contexts = match stated {
            Some(context) => vec![context],
            None => self.contexts_with_units.clone(),
        };
        let mut units: Option<Units> = None;
        for context in contexts {
            let found = context_units(text, context)?;
            if units.is_some_and(|units| units != found) {
                return Err(text.unexpected(context, "one unit of length for a surface without a context", "several"));
            }
            units = Some(found);
        }
        units.ok_or_else(|| text.unexpected(context.unwrap_or(0), "a context with a unit of length", "none"))
    }

    /// Returns the surfaces that are a part of another surface.
    fn used_surfaces(&self, text: &StepText<'_>) -> Result<HashSet<u64>, FormatError> {
        let mut used = HashSet::new();
        for &number in text.numbers() {
            let name = text.type_name(number).unwrap_or_default();
            if matches!(
                name.as_str(),
                "RECTANGULAR_TRIMMED_SURFACE" | "CURVE_BOUNDED_SURFACE" | "OFFSET_SURFACE" | "PCURVE"
            ) {
                used.insert(Attributes::new(text, number)?.reference(1)?);
            }
        }
        Ok(used)
    }
}

fn is_representation(name: &str) -> bool {
    // This one relates a placement and an occurrence.
    let is_relation = name == "CONTEXT_DEPENDENT_SHAPE_REPRESENTATION";
    (name.ends_with("SHAPE_REPRESENTATION") && !is_relation) || name == "REPRESENTATION"
}

/// Product structure, by which an assembly and its parts are told apart.
#[derive(Default)]
struct Products {
    /// Representation by the definition of the shape that it represents.
    by_shape: HashMap<u64, u64>,
    /// Product or occurrence that a definition of a shape defines.
    defined: HashMap<u64, u64>,
    /// Product that occurs, by the occurrence.
    occurring: HashMap<u64, u64>,
    /// Definition of the shape by the relationship that places it.
    by_relation: HashMap<u64, u64>,
}

impl Products {
    fn note(&mut self, text: &StepText<'_>, number: u64, name: &str) -> Result<(), FormatError> {
        let (map, key, value) = match name {
            "SHAPE_DEFINITION_REPRESENTATION" => (&mut self.by_shape, 0, 1),
            "CONTEXT_DEPENDENT_SHAPE_REPRESENTATION" => (&mut self.by_relation, 0, 1),
            "PRODUCT_DEFINITION_SHAPE" => {
                let defined = Attributes::new(text, number)?.reference(2)?;
                self.defined.insert(number, defined);
                return Ok(());
            }
            "NEXT_ASSEMBLY_USAGE_OCCURRENCE" => {
                let part = Attributes::new(text, number)?.reference(4)?;
                self.occurring.insert(number, part);
                return Ok(());
            }
            _ => return Ok(()),
        };
        let entity = Attributes::new(text, number)?;
        map.insert(entity.reference(key)?, entity.reference(value)?);
        Ok(())
    }

    /// Returns the representation of the part that a relationship places.
    fn part_of(&self, relation: u64) -> Option<u64> {
        let occurrence = self.defined.get(self.by_relation.get(&relation)?)?;
        let part = self.occurring.get(occurrence)?;
        let mut shapes: Vec<u64> =
            self.defined.iter().filter(|(_, defined)| *defined == part).map(|(shape, _)| *shape).collect();
        shapes.sort_unstable();
        shapes.into_iter().find_map(|shape| self.by_shape.get(&shape).copied())
    }
}

/// Reads the units of length and of plane angle of a context.
fn context_units(text: &StepText<'_>, context: u64) -> Result<Units, FormatError> {
    let entity = Attributes::new(text, context)?;
    let units = entity.values_of("GLOBAL_UNIT_ASSIGNED_CONTEXT").and_then(<[Value]>::first).and_then(as_references);
    let (mut length_mm, mut angle_rad) = (None, 1.0);
    for unit in units.unwrap_or_default() {
        let described = Attributes::new(text, unit)?;
        if described.has("LENGTH_UNIT") {
            length_mm = Some(1e3 * unit_size(text, &described, 0)?);
        } else if described.has("PLANE_ANGLE_UNIT") {
            angle_rad = unit_size(text, &described, 0)?;
        }
    }
    let length_mm = length_mm.ok_or_else(|| entity.wrong("a unit of length"))?;
    Ok(Units { length_mm, angle_rad })
}

/// Returns the size of a unit in metres or radians.
fn unit_size(text: &StepText<'_>, unit: &Attributes<'_>, depth: usize) -> Result<f64, FormatError> {
    if let Some(values) = unit.values_of("SI_UNIT") {
        let word = |at: usize| match values.get(at) {
            Some(Value::Word(word)) => word.as_str(),
            _ => "",
        };
        let factor = match word(0) {
            "" => 1.0,
            "KILO" => 1e3,
            "HECTO" => 1e2,
            "DECA" => 1e1,
            "DECI" => 1e-1,
            "CENTI" => 1e-2,
            "MILLI" => 1e-3,
            "MICRO" => 1e-6,
            "NANO" => 1e-9,
            _ => return Err(unit.wrong("a unit with a prefix from nano to kilo")),
        };
        return if matches!(word(1), "METRE" | "RADIAN") { Ok(factor) } else { Err(unit.wrong("metre or radian")) };
    }
    let measure = unit.values_of("CONVERSION_BASED_UNIT").and_then(|values| values.get(1)).and_then(as_reference);
    let (Some(measure), true) = (measure, depth < 8) else {
        return Err(unit.wrong("a unit of the SI, or one that is derived from it"));
    };
    let measure = Attributes::new(text, measure)?;
    let values = measure.values_of("MEASURE_WITH_UNIT").map(<[Value]>::to_vec);
    let (factor, base) = match values {
        Some(values) => (values.first().and_then(as_number), values.get(1).and_then(as_reference)),
        None => (as_number(measure.at(0)?), as_reference(measure.at(1)?)),
    };
    let (Some(factor), Some(base)) = (factor.filter(|f| *f > 0.0), base) else {
        return Err(measure.wrong("a factor above 0 and its unit"));
    };
    // 25.4 mm in metres must be 0.0254 exactly, and the product with 1000 again 25.4.
    Ok(factor * unit_size(text, &Attributes::new(text, base)?, depth + 1)?)
}
