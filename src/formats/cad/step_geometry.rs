//! Curves and surfaces of a STEP file (ISO 10303-42).

use regrind_core::geometry::{Point, Vector};
use regrind_core::surface::parametric::{BSplineCurve, BSplineSurface, Curve, Frame, Knots, ParametricSurface};

use super::super::error::FormatError;
use super::step_text::{Record, StepText, Value};

/// Units of a representation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Units {
    /// Millimetres in a unit of length.
    pub length_mm: f64,
    /// Radians in a unit of angle.
    pub angle_rad: f64,
}

/// Entity whose attributes are taken one after the other.
pub(super) struct Attributes<'a> {
    text: &'a StepText<'a>,
    number: u64,
    records: Vec<Record>,
}

impl<'a> Attributes<'a> {
    pub(super) fn new(text: &'a StepText<'a>, number: u64) -> Result<Self, FormatError> {
        Ok(Self { text, number, records: text.entity(number)? })
    }

    /// Returns the name of the only type; of a complex entity, of the first.
    pub(super) fn name(&self) -> &str {
        self.records.first().map_or("", |record| &record.name)
    }

    pub(super) fn has(&self, name: &str) -> bool {
        self.records.iter().any(|record| record.name == name)
    }

    /// Returns the values of one of the types of a complex entity.
    pub(super) fn values_of(&self, name: &str) -> Option<&[Value]> {
        self.records.iter().find(|record| record.name == name).map(|record| &record.values[..])
    }

    /// Returns the attribute `at` of an entity of one type, counted from 0 with the name field as the first.
    pub(super) fn at(&self, at: usize) -> Result<&Value, FormatError> {
        let values = self.records.first().map(|record| &record.values[..]).unwrap_or_default();
        values.get(at).ok_or_else(|| self.wrong(&format!("at least {} attributes", at + 1)))
    }

    pub(super) fn reference(&self, at: usize) -> Result<u64, FormatError> {
        as_reference(self.at(at)?).ok_or_else(|| self.wrong(&format!("an entity as attribute {}", at + 1)))
    }

    pub(super) fn references(&self, at: usize) -> Result<Vec<u64>, FormatError> {
        as_references(self.at(at)?).ok_or_else(|| self.wrong(&format!("a list of entities as attribute {}", at + 1)))
    }

    pub(super) fn number_at(&self, at: usize) -> Result<f64, FormatError> {
        as_number(self.at(at)?).ok_or_else(|| self.wrong(&format!("a number as attribute {}", at + 1)))
    }

    /// Returns the logical value of the attribute `at`; `None` for `.U.`.
    pub(super) fn logical(&self, at: usize) -> Result<Option<bool>, FormatError> {
        match self.at(at)? {
            Value::Word(word) if word == "T" => Ok(Some(true)),
            Value::Word(word) if word == "F" => Ok(Some(false)),
            Value::Word(word) if word == "U" => Ok(None),
            _ => Err(self.wrong(&format!(".T. or .F. as attribute {}", at + 1))),
        }
    }

    /// Returns the text of the name field; empty if it is not there, or is only `NONE`.
    pub(super) fn label(&self) -> String {
        let values = self.values_of("REPRESENTATION_ITEM").or(self.records.first().map(|record| &record.values[..]));
        match values.and_then(<[Value]>::first) {
            Some(Value::Text(text)) if text != "NONE" => text.trim().to_owned(),
            _ => String::new(),
        }
    }

    /// Creates the error that the entity is not as expected.
    pub(super) fn wrong(&self, expected: &str) -> FormatError {
        self.text.unexpected(self.number, expected, self.name())
    }
}

pub(super) fn as_reference(value: &Value) -> Option<u64> {
    if let Value::Reference(number) = value { Some(*number) } else { None }
}

pub(super) fn as_references(value: &Value) -> Option<Vec<u64>> {
    let Value::List(values) = value else { return None };
    values.iter().map(as_reference).collect()
}

pub(super) fn as_number(value: &Value) -> Option<f64> {
    match value {
        Value::Integer(number) => Some(*number as f64),
        Value::Real(number) => Some(*number),
        // A measure, such as POSITIVE_LENGTH_MEASURE(3.).
        Value::Typed(_, values) => values.first().and_then(as_number),
        _ => None,
    }
}

fn as_numbers(value: &Value) -> Option<Vec<f64>> {
    let Value::List(values) = value else { return None };
    values.iter().map(as_number).collect()
}

fn as_count(value: &Value) -> Option<usize> {
    as_number(value).filter(|n| (0.0..1e9).contains(n) && n.fract() == 0.0).map(|n| n as usize)
}

/// Surface of a file.
pub(super) struct OrientedSurface {
    pub(super) surface: ParametricSurface,
    /// True if du x dv of `surface` is the opposite of the normal of the surface in the file.
    pub(super) is_turned: bool,
}

/// Geometry of one representation, in its units.
pub(super) struct Geometry<'a> {
    pub(super) text: &'a StepText<'a>,
    pub(super) units: Units,
}

impl<'a> Geometry<'a> {
    pub(super) fn entity(&self, number: u64) -> Result<Attributes<'a>, FormatError> {
        Attributes::new(self.text, number)
    }

    pub(super) fn point(&self, number: u64) -> Result<Point, FormatError> {
        let entity = self.entity(number)?;
        if entity.name() != "CARTESIAN_POINT" {
            return Err(entity.wrong("CARTESIAN_POINT"));
        }
        let coordinates = as_numbers(entity.at(1)?).unwrap_or_default();
        let &[x, y, z] = &coordinates[..] else { return Err(entity.wrong("a point of three coordinates")) };
        let point = Point::new(x, y, z) * self.units.length_mm;
        if point.coords.amax() <= super::super::LIMIT_MM {
            Ok(point)
        } else {
            Err(entity.wrong("coordinates within 1e7 mm"))
        }
    }

    fn direction(&self, number: u64) -> Result<Vector, FormatError> {
        let entity = self.entity(number)?;
        let ratios = as_numbers(entity.at(1)?).unwrap_or_default();
        let (&[x, y, z], "DIRECTION") = (&ratios[..], entity.name()) else {
            return Err(entity.wrong("a direction of three ratios"));
        };
        Vector::new(x, y, z).try_normalize(1e-300).ok_or_else(|| entity.wrong("a direction that is not zero"))
    }

    /// Reads a vector: direction and length.
    fn vector(&self, number: u64) -> Result<Vector, FormatError> {
        let entity = self.entity(number)?;
        if entity.name() != "VECTOR" {
            return Err(entity.wrong("VECTOR"));
        }
        let length = entity.number_at(2)? * self.units.length_mm;
        if length == 0.0 {
            return Err(entity.wrong("a vector that is not zero"));
        }
        Ok(self.direction(entity.reference(1)?)? * length)
    }

    /// Reads a placement. Axes that are left out are z and x.
    pub(super) fn frame(&self, number: u64) -> Result<Frame, FormatError> {
        let entity = self.entity(number)?;
        if entity.name() != "AXIS2_PLACEMENT_3D" {
            return Err(entity.wrong("AXIS2_PLACEMENT_3D"));
        }
        let origin = self.point(entity.reference(1)?)?;
        let axis = |at: usize| entity.at(at).ok().and_then(as_reference).map(|n| self.direction(n)).transpose();
        let z = axis(2)?.unwrap_or_else(Vector::z);
        let given = axis(3)?;
        // A reference along the axis leaves the direction about it open. Then, and without one, it is x, or y if the axis
        // is along x: ISO 10303-42, first_proj_axis.
        let references = [given, Some(Vector::x()), Some(Vector::y())];
        let frame = references.into_iter().flatten().find_map(|x| Frame::new(origin, z, x));
        frame.ok_or_else(|| entity.wrong("a placement with axes that are not parallel"))
    }

    /// Reads a point and a direction: the axis of a surface of revolution.
    fn axis(&self, number: u64) -> Result<(Point, Vector), FormatError> {
        let entity = self.entity(number)?;
        if entity.name() != "AXIS1_PLACEMENT" {
            return Err(entity.wrong("AXIS1_PLACEMENT"));
        }
        let direction = entity.at(2).ok().and_then(as_reference).map(|n| self.direction(n)).transpose()?;
        Ok((self.point(entity.reference(1)?)?, direction.unwrap_or_else(Vector::z)))
    }

    fn length(&self, entity: &Attributes<'_>, at: usize) -> Result<f64, FormatError> {
        let length = entity.number_at(at)? * self.units.length_mm;
        if length > 0.0 && length <= super::super::LIMIT_MM {
            Ok(length)
        } else {
            Err(entity.wrong("a radius above 0"))
        }
    }

    /// Reads a curve. A trimmed curve is taken without its ends, an edge on a surface by its curve in space. The parameter
    /// runs as that of the curve of the file.
    pub(super) fn curve(&self, number: u64) -> Result<Curve, FormatError> {
        self.curve_within(number, 0)
    }

    fn curve_within(&self, number: u64, depth: usize) -> Result<Curve, FormatError> {
        let entity = self.entity(number)?;
        if depth > 8 {
            return Err(entity.wrong("a curve that is not made of itself"));
        }
        if entity.has("B_SPLINE_CURVE")
            || entity.name().ends_with("_CURVE_WITH_KNOTS")
            || is_spline_curve(entity.name())
        {
            return self.spline_curve(&entity).map(Curve::BSpline);
        }
        Ok(match entity.name() {
            "LINE" => {
                Curve::Line { origin: self.point(entity.reference(1)?)?, direction: self.vector(entity.reference(2)?)? }
            }
            "CIRCLE" => {
                let radius = self.length(&entity, 2)?;
                Curve::Ellipse { frame: self.frame(entity.reference(1)?)?, semi_axes_mm: [radius; 2] }
            }
            name @ ("ELLIPSE" | "HYPERBOLA") => {
                let (frame, semi_axes_mm) =
                    (self.frame(entity.reference(1)?)?, [self.length(&entity, 2)?, self.length(&entity, 3)?]);
                if name == "ELLIPSE" {
                    Curve::Ellipse { frame, semi_axes_mm }
                } else {
                    Curve::Hyperbola { frame, semi_axes_mm }
                }
            }
            "PARABOLA" => {
                Curve::Parabola { frame: self.frame(entity.reference(1)?)?, focal_mm: self.length(&entity, 2)? }
            }
            "SURFACE_CURVE" | "SEAM_CURVE" | "INTERSECTION_CURVE" | "BOUNDED_SURFACE_CURVE" => {
                self.curve_within(entity.reference(1)?, depth + 1)?
            }
            "TRIMMED_CURVE" => {
                let whole = self.curve_within(entity.reference(1)?, depth + 1)?;
                if entity.logical(4)? == Some(false) { whole.reversed() } else { whole }
            }
            _ => return Err(entity.wrong("a line, circle, ellipse, hyperbola, parabola or B-spline curve")),
        })
    }

    /// Reads the profile of a surface: a curve, or a part of one.
    fn profile(&self, number: u64) -> Result<Curve, FormatError> {
        let entity = self.entity(number)?;
        if entity.name() != "TRIMMED_CURVE" {
            return self.curve(number);
        }
        let whole = self.curve(entity.reference(1)?)?;
        let end = |at: usize| -> Result<f64, FormatError> {
            let Value::List(ways) = entity.at(at)? else { return Err(entity.wrong("the ends of a trimmed curve")) };
            let by_point = ways.iter().find_map(as_reference).map(|n| self.point(n)).transpose()?;
            let by_parameter = ways.iter().find_map(as_number).map(|t| match whole {
                Curve::Ellipse { .. } => t * self.units.angle_rad,
                _ => t,
            });
            let point = by_point.map(|p| whole.parameter_near(&p));
            by_parameter.or(point).ok_or_else(|| entity.wrong("the ends of a trimmed curve"))
        };
        let is_turned = entity.logical(4)? == Some(false);
        let mut ends = part_range([end(2)?, end(3)?], whole.period(), !is_turned);
        if let (Curve::BSpline(_), Some(domain)) = (&whole, whole.domain()) {
            ends = within(ends, domain).ok_or_else(|| entity.wrong("a part within the curve"))?;
        }
        let part = whole.part(ends);
        Ok(if is_turned { part.reversed() } else { part })
    }

    /// Reads the part of a surface that a rectangle in (u, v) bounds: the whole surface, and the ranges of u and v.
    pub(super) fn rectangle(
        &self,
        entity: &Attributes<'_>,
        depth: usize,
    ) -> Result<(OrientedSurface, [[f64; 2]; 2]), FormatError> {
        let OrientedSurface { surface, mut is_turned } = self.surface_within(entity.reference(1)?, depth + 1)?;
        let (lengths, angles) = (self.units.length_mm, self.units.angle_rad);
        let of_profile = |profile: &Curve| match profile {
            Curve::Part { whole, .. } if matches!(**whole, Curve::Ellipse { .. }) => angles,
            Curve::Ellipse { .. } => angles,
            _ => 1.0,
        };
        let units = match &surface {
            ParametricSurface::Plane { .. } => [lengths; 2],
            ParametricSurface::Cylinder { .. } | ParametricSurface::Cone { .. } => [angles, lengths],
            ParametricSurface::Sphere { .. } | ParametricSurface::Torus { .. } => [angles; 2],
            ParametricSurface::Revolution { profile, .. } => [angles, of_profile(profile)],
            ParametricSurface::Extrusion { profile, .. } => [of_profile(profile), 1.0],
            ParametricSurface::BSpline(_) => [1.0; 2],
        };
        let period = surface.period();
        let of_spline = |profile: &Curve| profile.domain().filter(|_| !matches!(profile, Curve::Ellipse { .. }));
        let domains = match &surface {
            ParametricSurface::BSpline(surface) => surface.knots().map(|knots| Some(knots.domain())),
            ParametricSurface::Revolution { profile, .. } => [None, of_spline(profile)],
            ParametricSurface::Extrusion { profile, .. } => [of_spline(profile), None],
            _ => [None; 2],
        };
        let mut part = [[0.0; 2]; 2];
        for k in 0..2 {
            let ends = [entity.number_at(2 + 2 * k)? * units[k], entity.number_at(3 + 2 * k)? * units[k]];
            let is_upwards = entity.logical(6 + k)?.unwrap_or(true);
            is_turned ^= !is_upwards;
            part[k] = part_range(ends, period[k], is_upwards);
            if let Some(domain) = domains[k] {
                part[k] = within(part[k], domain).ok_or_else(|| entity.wrong("a part within the surface"))?;
            }
        }
        Ok((OrientedSurface { surface, is_turned }, part))
    }

    fn spline_curve(&self, entity: &Attributes<'_>) -> Result<BSplineCurve, FormatError> {
        // In a simple entity the attributes of all types follow the name field.
        let complex = entity.values_of("B_SPLINE_CURVE").filter(|_| entity.records.len() > 1);
        let base = complex.unwrap_or_else(|| entity.records[0].values.get(1..).unwrap_or_default());
        let degree = base.first().and_then(as_count).ok_or_else(|| entity.wrong("the degree of a curve"))?;
        let numbers = base.get(1).and_then(as_references).ok_or_else(|| entity.wrong("the points of a curve"))?;
        let points = numbers.iter().map(|&n| self.point(n)).collect::<Result<Vec<_>, _>>()?;
        let known = if complex.is_some() {
            entity.values_of("B_SPLINE_CURVE_WITH_KNOTS")
        } else {
            base.get(5..).filter(|_| entity.name() == "B_SPLINE_CURVE_WITH_KNOTS")
        };
        let knots = match known {
            Some([multiplicities, values, ..]) => repeated_knots(multiplicities, values),
            Some(_) => None,
            None => implied_knots(entity, degree, points.len()),
        };
        let knots = knots.ok_or_else(|| entity.wrong("knots with their multiplicities"))?;
        let weights = match entity.values_of("RATIONAL_B_SPLINE_CURVE") {
            None => Vec::new(),
            Some(values) => {
                let weights = values.first().and_then(as_numbers).filter(|weights| weights.len() == points.len());
                weights.ok_or_else(|| entity.wrong("as many weights as control points"))?
            }
        };
        BSplineCurve::new(degree, knots, &points, &weights)
            .map_err(|error| entity.wrong(&format!("a valid B-spline: {error}")))
    }

    /// Reads a surface, and whether its sides are exchanged in the file.
    pub(super) fn oriented_surface(&self, number: u64) -> Result<OrientedSurface, FormatError> {
        self.surface_within(number, 0)
    }

    fn surface_within(&self, number: u64, depth: usize) -> Result<OrientedSurface, FormatError> {
        let entity = self.entity(number)?;
        if depth > 8 {
            return Err(entity.wrong("a surface that is not made of itself"));
        }
        if entity.name() == "RECTANGULAR_TRIMMED_SURFACE" {
            return self.rectangle(&entity, depth).map(|(surface, _)| surface);
        }
        Ok(OrientedSurface { surface: self.whole_surface(&entity)?, is_turned: false })
    }

    fn whole_surface(&self, entity: &Attributes<'_>) -> Result<ParametricSurface, FormatError> {
        if entity.has("B_SPLINE_SURFACE") || is_spline_surface(entity.name()) {
            return self.spline_surface(entity).map(ParametricSurface::BSpline);
        }
        let frame = || self.frame(entity.reference(1)?);
        Ok(match entity.name() {
            "PLANE" => ParametricSurface::Plane { frame: frame()? },
            "CYLINDRICAL_SURFACE" => {
                ParametricSurface::Cylinder { frame: frame()?, radius_mm: self.length(entity, 2)? }
            }
            "CONICAL_SURFACE" => {
                let angle = entity.number_at(3)? * self.units.angle_rad;
                let radius_mm = entity.number_at(2)? * self.units.length_mm;
                if !(angle.abs() < 1.57 && angle != 0.0 && (0.0..=super::super::LIMIT_MM).contains(&radius_mm)) {
                    return Err(entity.wrong("a cone with a half angle below 90 degrees"));
                }
                ParametricSurface::Cone { frame: frame()?, radius_mm, half_angle_rad: angle }
            }
            "SPHERICAL_SURFACE" => ParametricSurface::Sphere { frame: frame()?, radius_mm: self.length(entity, 2)? },
            "TOROIDAL_SURFACE" | "DEGENERATE_TOROIDAL_SURFACE" => ParametricSurface::Torus {
                frame: frame()?,
                major_radius_mm: self.length(entity, 2)?,
                minor_radius_mm: self.length(entity, 3)?,
            },
            "SURFACE_OF_REVOLUTION" => {
                let (origin, axis) = self.axis(entity.reference(2)?)?;
                ParametricSurface::revolution(self.profile(entity.reference(1)?)?, origin, axis)
            }
            "SURFACE_OF_LINEAR_EXTRUSION" => ParametricSurface::Extrusion {
                profile: self.profile(entity.reference(1)?)?,
                direction: self.vector(entity.reference(2)?)?,
            },
            _ => {
                return Err(entity.wrong(
                    "a plane, cylinder, cone, sphere, torus, surface of revolution or extrusion, or a B-spline surface",
                ));
            }
        })
    }

    fn spline_surface(&self, entity: &Attributes<'_>) -> Result<BSplineSurface, FormatError> {
        let complex = entity.values_of("B_SPLINE_SURFACE").filter(|_| entity.records.len() > 1);
        let base = complex.unwrap_or_else(|| entity.records[0].values.get(1..).unwrap_or_default());
        let degree = |at: usize| base.get(at).and_then(as_count).ok_or_else(|| entity.wrong("two degrees"));
        let degrees = [degree(0)?, degree(1)?];
        let (rows, columns, net) =
            grid(base.get(2)).ok_or_else(|| entity.wrong("rows of control points of one length"))?;
        let numbers = net.iter().map(|value| as_reference(value)).collect::<Option<Vec<_>>>();
        let numbers = numbers.ok_or_else(|| entity.wrong("rows of control points"))?;
        let points = numbers.iter().map(|&n| self.point(n)).collect::<Result<Vec<_>, _>>()?;
        let known = if complex.is_some() {
            entity.values_of("B_SPLINE_SURFACE_WITH_KNOTS")
        } else {
            base.get(7..).filter(|_| entity.name() == "B_SPLINE_SURFACE_WITH_KNOTS")
        };
        let knots = match known {
            Some([mu, mv, ku, kv, ..]) => repeated_knots(mu, ku).zip(repeated_knots(mv, kv)),
            Some(_) => None,
            None => implied_knots(entity, degrees[0], rows).zip(implied_knots(entity, degrees[1], columns)),
        };
        let (ku, kv) = knots.ok_or_else(|| entity.wrong("knots with their multiplicities"))?;
        let weights = match entity.values_of("RATIONAL_B_SPLINE_SURFACE") {
            None => Vec::new(),
            Some(values) => {
                let weights = grid(values.first()).filter(|(r, c, _)| [*r, *c] == [rows, columns]);
                let weights = weights.and_then(|(.., net)| net.iter().map(|value| as_number(value)).collect());
                weights.ok_or_else(|| entity.wrong("as many weights as control points"))?
            }
        };
        let spline = || {
            BSplineSurface::new(
                Knots::new(degrees[0], ku, rows)?,
                Knots::new(degrees[1], kv, columns)?,
                &points,
                &weights,
            )
        };
        spline().map_err(|error| entity.wrong(&format!("a valid B-spline: {error}")))
    }
}

/// Returns the range of a parameter from one end to the other: upwards, or downwards. A parameter with a period goes on
/// where it repeats.
fn part_range([from, to]: [f64; 2], period: f64, is_upwards: bool) -> [f64; 2] {
    let [low, high] = if is_upwards { [from, to] } else { [to, from] };
    if period.is_finite() && high <= low {
        let turns = ((low - high) / period).floor() + 1.0;
        return [low, high + turns * period];
    }
    [low.min(high), low.max(high)]
}

/// Returns the part of a range that is in `domain`. Returns `None` if more than rounding lies outside, because the
/// polynomials of a spline go on there.
fn within([low, high]: [f64; 2], domain: [f64; 2]) -> Option<[f64; 2]> {
    let small = 1e-9 * (domain[1] - domain[0]);
    (low >= domain[0] - small && high <= domain[1] + small).then(|| [low.max(domain[0]), high.min(domain[1])])
}

fn is_spline_curve(name: &str) -> bool {
    matches!(name, "BEZIER_CURVE" | "UNIFORM_CURVE" | "QUASI_UNIFORM_CURVE" | "B_SPLINE_CURVE_WITH_KNOTS")
}

fn is_spline_surface(name: &str) -> bool {
    matches!(name, "BEZIER_SURFACE" | "UNIFORM_SURFACE" | "QUASI_UNIFORM_SURFACE" | "B_SPLINE_SURFACE_WITH_KNOTS")
}

/// Returns the rows and columns of a list of lists, and all values row by row.
fn grid(value: Option<&Value>) -> Option<(usize, usize, Vec<&Value>)> {
    let Some(Value::List(rows)) = value else { return None };
    let rows: Option<Vec<&Vec<Value>>> =
        rows.iter().map(|row| if let Value::List(row) = row { Some(row) } else { None }).collect();
    let rows = rows?;
    let columns = rows.first()?.len();
    rows.iter().all(|row| row.len() == columns).then(|| (rows.len(), columns, rows.into_iter().flatten().collect()))
}

/// Returns all knots from the different ones and their multiplicities.
fn repeated_knots(multiplicities: &Value, values: &Value) -> Option<Vec<f64>> {
    const MAX_KNOTS: usize = 10_000_000;
    let (Value::List(counts), Some(values)) = (multiplicities, as_numbers(values)) else { return None };
    let counts = counts.iter().map(as_count).collect::<Option<Vec<_>>>()?;
    let total = counts.iter().fold(0usize, |sum, count| sum.saturating_add(*count));
    (counts.len() == values.len() && total <= MAX_KNOTS)
        .then(|| counts.iter().zip(&values).flat_map(|(&count, &knot)| std::iter::repeat_n(knot, count)).collect())
}

/// Returns the knots of a spline whose type implies them: ISO 10303-42, 4.4.37 to 4.4.40.
fn implied_knots(entity: &Attributes<'_>, degree: usize, count: usize) -> Option<Vec<f64>> {
    let is = |kind: &str| entity.records.iter().any(|record| record.name.starts_with(kind));
    let last = count.checked_sub(degree)?.max(1);
    if is("UNIFORM") {
        return Some((0..count + degree + 1).map(|i| i as f64 - degree as f64).collect());
    }
    let ends = |middle: Vec<f64>, high: f64| {
        let first = std::iter::repeat_n(0.0, degree + 1);
        first.chain(middle).chain(std::iter::repeat_n(high, degree + 1)).collect()
    };
    if is("QUASI_UNIFORM") {
        return Some(ends((1..last).map(|i| i as f64).collect(), last as f64));
    }
    if is("BEZIER") && degree > 0 && (count - 1).is_multiple_of(degree) {
        let segments = (count - 1) / degree;
        let middle = (1..segments).flat_map(|i| std::iter::repeat_n(i as f64, degree)).collect();
        return Some(ends(middle, segments as f64));
    }
    None
}
