//! Structure of a STEP file: its representations, where they occur, and their units.

use std::collections::{HashMap, HashSet};

use regrind_core::geometry::Pose;

use super::super::error::FormatError;
use super::step_geometry::{Attributes, Geometry, Units, as_number, as_reference, as_references};
use super::step_text::{StepText, Value};

/// Maximum number of places of all representations.
pub(super) const MAX_PLACEMENTS: usize = 200_000;

/// Maximum depth of assemblies.
const MAX_DEPTH: usize = 32;

/// Representation that has items.
pub(super) struct Representation {
    pub number: u64,
    pub items: Vec<u64>,
}

/// Relation of the parts: their representations, contexts and placements.
pub(super) struct Structure {
    pub with_items: Vec<Representation>,
    /// Contexts by the number of the representation.
    contexts: HashMap<u64, Option<u64>>,
    /// Sets of representations with the same frame: for each but one of a set, another one of it that is nearer to the
    /// one that stands for the set.
    same: HashMap<u64, u64>,
    /// Sizes of the sets, by the one that stands for the set.
    sizes: HashMap<u64, usize>,
    /// Occurrences of a set of representations: the outer one, and the two placements whose frames coincide.
    outer: HashMap<u64, Vec<Occurrence>>,
    /// Contexts that state a unit of length, in the order of the file.
    contexts_with_units: Vec<u64>,
    /// The same as a set.
    with_units: HashSet<u64>,
    /// Units on which all contexts agree.
    common_units: Option<Units>,
    /// Representations that occur as an item of another one.
    pub mapped: HashSet<u64>,
}

/// Place of a representation in another one.
#[derive(Clone, Copy)]
struct Occurrence {
    outer: u64,
    /// Placement in the inner one and in the outer one, with the representations that tell their units.
    frames: [(u64, u64); 2],
}

impl Structure {
    pub(super) fn new(text: &StepText<'_>) -> Result<Self, FormatError> {
        let mut structure = Self {
            with_items: Vec::new(),
            contexts: HashMap::new(),
            same: HashMap::new(),
            sizes: HashMap::new(),
            outer: HashMap::new(),
            contexts_with_units: Vec::new(),
            with_units: HashSet::new(),
            common_units: None,
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
        structure.with_units = structure.contexts_with_units.iter().copied().collect();
        let mut occurrences = Vec::new();
        for relation in relations {
            occurrences.extend(structure.relate(text, relation, &products)?);
        }
        for (inner, occurrence) in occurrences {
            structure.outer.entry(structure.frame_of(inner)).or_default().push(occurrence);
        }
        structure.outer.values_mut().for_each(|found| found.sort_by_key(|place| (place.outer, place.frames)));
        structure.common_units = structure.common_units(text).ok();
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
            self.with_items.push(Representation { number, items });
        }
        Ok(())
    }

    /// Notes a relationship of two representations: with a transformation the first is a part of the second, and where it
    /// occurs is returned; without one both have the same frame.
    fn relate(
        &mut self,
        text: &StepText<'_>,
        number: u64,
        products: &Products,
    ) -> Result<Option<(u64, Occurrence)>, FormatError> {
        let entity = Attributes::new(text, number)?;
        let values =
            entity.values_of("REPRESENTATION_RELATIONSHIP").or(entity.values_of("SHAPE_REPRESENTATION_RELATIONSHIP"));
        let pair = values.and_then(|values| Some([as_reference(values.get(2)?)?, as_reference(values.get(3)?)?]));
        let Some([first, second]) = pair else { return Ok(None) };
        let with = entity.values_of("REPRESENTATION_RELATIONSHIP_WITH_TRANSFORMATION");
        let Some(operator) = with.and_then(<[Value]>::first).and_then(as_reference) else {
            self.unite(first, second);
            return Ok(None);
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
        Ok(Some((inner, Occurrence { outer, frames })))
    }

    /// Notes that two representations have the same frame. The smaller set joins the larger one, so the way to the one
    /// that stands for a set is short.
    fn unite(&mut self, first: u64, second: u64) {
        let (a, b) = (self.frame_of(first), self.frame_of(second));
        if a == b {
            return;
        }
        let size = |structure: &Self, n: u64| structure.sizes.get(&n).copied().unwrap_or(1);
        let (from, to) = if size(self, a) > size(self, b) { (b, a) } else { (a, b) };
        self.sizes.insert(to, size(self, a) + size(self, b));
        self.same.insert(from, to);
    }

    /// Returns the number that stands for all representations with the same frame as this one.
    fn frame_of(&self, mut number: u64) -> u64 {
        while let Some(&next) = self.same.get(&number) {
            number = next;
        }
        number
    }

    /// Returns the poses at which a representation occurs in the file.
    pub(super) fn placements(&self, text: &StepText<'_>, number: u64) -> Result<Vec<Pose>, FormatError> {
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
        if depth > MAX_DEPTH || placements.len() > MAX_PLACEMENTS {
            return Err(text.unexpected(number, "an assembly that is not a part of itself", "a deep nest"));
        }
        let Some(occurrences) = self.outer.get(&self.frame_of(number)) else {
            placements.push(pose);
            return Ok(());
        };
        for &Occurrence { outer, frames } in occurrences {
            let frame = |(placement, representation): (u64, u64)| {
                let units = self.units_of(text, representation)?;
                Ok::<_, FormatError>(Geometry { text, units }.frame(placement)?.pose())
            };
            let step = frame(frames[1])? * frame(frames[0])?.inverse();
            self.add_placements(text, outer, step * pose, depth + 1, placements)?;
        }
        Ok(())
    }

    /// Returns the units of a representation.
    pub(super) fn units_of(&self, text: &StepText<'_>, representation: u64) -> Result<Units, FormatError> {
        self.units(text, self.contexts.get(&representation).copied().flatten())
    }

    /// Returns the units of a context. Without a context, those on which all contexts of the file agree.
    pub(super) fn units(&self, text: &StepText<'_>, context: Option<u64>) -> Result<Units, FormatError> {
        match (context.filter(|context| self.with_units.contains(context)), self.common_units) {
            (Some(context), _) => context_units(text, context),
            (None, Some(units)) => Ok(units),
            (None, None) => self.common_units(text),
        }
    }

    fn common_units(&self, text: &StepText<'_>) -> Result<Units, FormatError> {
        let mut units: Option<Units> = None;
        for &context in &self.contexts_with_units {
            let found = context_units(text, context)?;
            if units.is_some_and(|units| units != found) {
                return Err(text.unexpected(context, "one unit of length for a surface without a context", "several"));
            }
            units = Some(found);
        }
        units.ok_or_else(|| text.unexpected(0, "a context with a unit of length", "none"))
    }

    /// Returns the surfaces that a face or another surface refers to.
    pub(super) fn used_surfaces(&self, text: &StepText<'_>) -> Result<HashSet<u64>, FormatError> {
        let mut used = HashSet::new();
        for &number in text.numbers() {
            let name = text.type_name(number).unwrap_or_default();
            let at = match name.as_str() {
                "RECTANGULAR_TRIMMED_SURFACE" | "CURVE_BOUNDED_SURFACE" | "OFFSET_SURFACE" | "PCURVE" => 1,
                "ADVANCED_FACE" | "FACE_SURFACE" => 2,
                _ => continue,
            };
            used.insert(Attributes::new(text, number)?.reference(at)?);
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
