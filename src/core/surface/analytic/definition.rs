//! Nominal surface given by a formula: its definition in TOML, and the checks of this definition.
//!
//! ```toml
//! [surface]
//! kind = "asphere"
//! radius_mm = 150.0
//! conic = -1.0
//! coefficients = { A4 = 1.0e-8 }
//!
//! [aperture]
//! kind = "circle"
//! radius_mm = 30.0
//!
//! [sampling]             # may be left out: accuracy_nm = 0.1
//! spacing_mm = 0.5       # either the spacing of the nodes,
//! # accuracy_nm = 0.1    # or how exact the surface between them must be
//! ```

use std::ops::Range;

use serde::{Deserialize, Serialize};
use toml::Spanned;
use toml::de::{DeTable, DeValue, ValueDeserializer};

use super::analytic_surface::{AnalyticSurface, OffAxis, SectionFrame};
use super::biconic_zernike::{BiconicZernike, BiconicZernikeDefinition};
use super::conic::{Asphere, AsphereDefinition, Conic, ConicDefinition};
use super::error::{self, DefinitionError};
use super::forbes::{Qbfs, QbfsDefinition, Qcon, QconDefinition};
use super::polynomial::{XyPolynomial, XyPolynomialDefinition};
use super::q2d::{Q2d, Q2dDefinition};
use super::tensor_polynomial::{PolynomialFamily, TensorPolynomial, TensorPolynomialDefinition};
use super::toroid::{Biconic, BiconicDefinition, Toroid, ToroidDefinition};
use super::zernike::{Zernike, ZernikeDefinition};
use crate::geometry::Aperture;

/// Maximum error of a sampling if the definition does not state it, in nanometres.
const DEFAULT_ACCURACY_NM: f64 = 0.1;

/// Definition of a nominal surface in a file.
#[derive(Clone, Debug, Deserialize, PartialEq, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct SurfaceDefinition {
    /// The formula.
    pub surface: Formula,
    /// The outline of the part, in the frame of the surface.
    pub aperture: Aperture,
    /// Sampling of the surface. Default: an accuracy of 0.1 nm.
    pub sampling: Option<SamplingDefinition>,
}

/// Formula of a surface in a file; `kind` selects its form.
#[derive(Clone, Debug, Deserialize, PartialEq, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(tag = "kind", rename_all = "kebab-case")]
pub enum Formula {
    /// The plane z = 0.
    Plane(PlaneDefinition),
    /// A sphere.
    Sphere(SphereDefinition),
    /// A conic of revolution.
    Conic(ConicDefinition),
    /// A conic plus powers of the distance from the axis.
    Asphere(AsphereDefinition),
    /// A section of a surface of another kind, away from its axis.
    OffAxis(OffAxisDefinition),
    /// A curve rotated about a line.
    Toroid(ToroidDefinition),
    /// Two conics, one in x and one in y.
    Biconic(BiconicDefinition),
    /// Two conics, one in x and one in y, plus Zernike polynomials.
    BiconicZernike(BiconicZernikeDefinition),
    /// Powers of x and y.
    XyPolynomial(XyPolynomialDefinition),
    /// Zernike polynomials.
    Zernike(ZernikeDefinition),
    /// Forbes' polynomials for strong aspheres.
    Qcon(QconDefinition),
    /// Forbes' polynomials for mild aspheres.
    Qbfs(QbfsDefinition),
    /// Forbes' polynomials for freeform surfaces.
    Q2d(Q2dDefinition),
    /// Chebyshev polynomials in x and y.
    Chebyshev(TensorPolynomialDefinition),
    /// Legendre polynomials in x and y.
    Legendre(TensorPolynomialDefinition),
}

/// Kinds of [`Formula`] from which a section can be cut: all except the section itself. Used only for the schema.
#[cfg(feature = "schema")]
#[derive(schemars::JsonSchema)]
#[serde(tag = "kind", rename_all = "kebab-case")]
#[expect(dead_code, reason = "only its schema is used")]
pub(super) enum WholeFormula {
    Plane(PlaneDefinition),
    Sphere(SphereDefinition),
    Conic(ConicDefinition),
    Asphere(AsphereDefinition),
    Toroid(ToroidDefinition),
    Biconic(BiconicDefinition),
    BiconicZernike(BiconicZernikeDefinition),
    XyPolynomial(XyPolynomialDefinition),
    Zernike(ZernikeDefinition),
    Qcon(QconDefinition),
    Qbfs(QbfsDefinition),
    Q2d(Q2dDefinition),
    Chebyshev(TensorPolynomialDefinition),
    Legendre(TensorPolynomialDefinition),
}

/// [`Formula`] whose kind is the key of an inner table. A reader that must find `kind` first would buffer the other
/// keys and lose their places in the text. This form keeps the places, for messages with line and column.
#[derive(Deserialize)]
#[serde(remote = "Formula", rename_all = "kebab-case")]
enum FormulaByKind {
    Plane(PlaneDefinition),
    Sphere(SphereDefinition),
    Conic(ConicDefinition),
    Asphere(AsphereDefinition),
    OffAxis(OffAxisDefinition),
    Toroid(ToroidDefinition),
    Biconic(BiconicDefinition),
    BiconicZernike(BiconicZernikeDefinition),
    XyPolynomial(XyPolynomialDefinition),
    Zernike(ZernikeDefinition),
    Qcon(QconDefinition),
    Qbfs(QbfsDefinition),
    Q2d(Q2dDefinition),
    Chebyshev(TensorPolynomialDefinition),
    Legendre(TensorPolynomialDefinition),
}

/// [`Aperture`] whose kind is the key of an inner table, see [`FormulaByKind`].
#[derive(Deserialize)]
#[serde(remote = "Aperture", rename_all = "kebab-case", deny_unknown_fields)]
enum ApertureByKind {
    Rectangle {
        #[serde(default)]
        centre_mm: [f64; 2],
        width_mm: f64,
        height_mm: f64,
    },
    Circle {
        #[serde(default)]
        centre_mm: [f64; 2],
        radius_mm: f64,
    },
    Ellipse {
        #[serde(default)]
        centre_mm: [f64; 2],
        semi_axes_mm: [f64; 2],
    },
    Annulus {
        #[serde(default)]
        centre_mm: [f64; 2],
        inner_radius_mm: f64,
        outer_radius_mm: f64,
    },
    Polygon {
        corners_mm: Vec<[f64; 2]>,
    },
}

/// Definition of a plane in a file: it has no keys.
#[derive(Clone, Copy, Debug, Deserialize, PartialEq, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct PlaneDefinition {}

/// Definition of a sphere in a file.
#[derive(Clone, Copy, Debug, Deserialize, PartialEq, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct SphereDefinition {
    /// Radius in millimetres, positive if the centre is at +z.
    #[cfg_attr(feature = "schema", schemars(extend("x-infinite" = true)))]
    pub radius_mm: f64,
}

/// Sampling of a surface in a file: one of the two keys.
#[derive(Clone, Copy, Debug, Default, Deserialize, PartialEq, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct SamplingDefinition {
    /// Distance between nodes along x and y, in millimetres.
    pub spacing_mm: Option<f64>,
    /// Maximum error of the surface between the nodes, in nanometres.
    pub accuracy_nm: Option<f64>,
}

/// Rule for the node spacing of a sampling.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Sampling {
    /// Nodes with this spacing along x and y.
    Spacing {
        /// Distance between nodes in millimetres.
        spacing_mm: f64,
    },
    /// Nodes so dense that the surface between them has at most this error.
    Accuracy {
        /// Maximum error in millimetres.
        accuracy_mm: f64,
    },
}

/// Nominal surface given by a formula, checked: the formula has a value everywhere in the aperture.
#[derive(Clone, Debug, PartialEq)]
pub struct DefinedSurface {
    formula: AnalyticSurface,
    aperture: Aperture,
    sampling: Sampling,
}

impl SurfaceDefinition {
    /// Reads a definition from TOML text. Does not check the values; [`Self::resolve`] does that.
    ///
    /// # Errors
    /// Returns an error with line and column if the text is not TOML, or if a key is missing, unknown or of the wrong
    /// type.
    pub fn from_toml(text: &str) -> Result<Self, DefinitionError> {
        let in_text = |error: toml::de::Error| toml_error(text, error.span(), error.message());
        let mut tables = DeTable::parse(text).map_err(in_text)?.into_inner();
        let mut take = |name: &str| tables.remove(name);
        let missing = |name: &str| toml_error(text, None, &format!("the table [{name}] is missing"));
        let surface = take("surface").ok_or_else(|| missing("surface"))?;
        let aperture = take("aperture").ok_or_else(|| missing("aperture"))?;
        let sampling = take("sampling");
        if let Some((name, _)) = tables.iter().next() {
            let message = format!("unknown table `{}`, expected surface, aperture or sampling", name.get_ref());
            return Err(toml_error(text, Some(name.span()), &message));
        }
        Ok(Self {
            surface: FormulaByKind::deserialize(deserialize_by_kind(text, "surface", surface)?).map_err(in_text)?,
            aperture: ApertureByKind::deserialize(deserialize_by_kind(text, "aperture", aperture)?).map_err(in_text)?,
            sampling: sampling
                .map(|table| SamplingDefinition::deserialize(ValueDeserializer::from(table)))
                .transpose()
                .map_err(in_text)?,
        })
    }

    /// Checks the values of the definition, and returns the surface.
    ///
    /// # Errors
    /// Returns an error about the first value that is not valid, with its key, the limit and a remedy.
    pub fn resolve(&self) -> Result<DefinedSurface, DefinitionError> {
        let formula = self.surface.resolve().map_err(|error| error.in_table("surface"))?;
        let sampling = match &self.sampling {
            None => Sampling::Accuracy { accuracy_mm: 1e-6 * DEFAULT_ACCURACY_NM },
            Some(written) => written.resolve().map_err(|error| error.in_table("sampling"))?,
        };
        DefinedSurface::new(formula, self.aperture.clone(), sampling)
    }
}

impl Formula {
    /// Checks the values of the formula, and returns the surface without an aperture.
    ///
    /// # Errors
    /// Returns an error about the first value that is not valid. The path of its key starts below the table of the
    /// formula, as in `radius_mm` instead of `surface.radius_mm`.
    pub fn resolve(&self) -> Result<AnalyticSurface, DefinitionError> {
        Ok(match self {
            Self::Plane(PlaneDefinition {}) => AnalyticSurface::Conic(Conic::PLANE),
            Self::Sphere(sphere) => AnalyticSurface::Conic(Conic::new(sphere.radius_mm, 0.0)?),
            Self::Conic(conic) => AnalyticSurface::Conic(Conic::try_from(conic)?),
            Self::Asphere(asphere) => AnalyticSurface::Asphere(Asphere::try_from(asphere)?),
            Self::OffAxis(section) => AnalyticSurface::OffAxis(OffAxis::try_from(section)?),
            Self::Toroid(toroid) => AnalyticSurface::Toroid(Toroid::try_from(toroid)?),
            Self::Biconic(biconic) => AnalyticSurface::Biconic(Biconic::try_from(biconic)?),
            Self::BiconicZernike(surface) => AnalyticSurface::BiconicZernike(BiconicZernike::try_from(surface)?),
            Self::XyPolynomial(polynomial) => AnalyticSurface::XyPolynomial(XyPolynomial::try_from(polynomial)?),
            Self::Zernike(zernike) => AnalyticSurface::Zernike(Zernike::try_from(zernike)?),
            Self::Qcon(qcon) => AnalyticSurface::Qcon(Qcon::try_from(qcon)?),
            Self::Qbfs(qbfs) => AnalyticSurface::Qbfs(Qbfs::try_from(qbfs)?),
            Self::Q2d(q2d) => AnalyticSurface::Q2d(Q2d::try_from(q2d)?),
            Self::Chebyshev(polynomial) => {
                AnalyticSurface::TensorPolynomial(TensorPolynomial::new(PolynomialFamily::Chebyshev, polynomial)?)
            }
            Self::Legendre(polynomial) => {
                AnalyticSurface::TensorPolynomial(TensorPolynomial::new(PolynomialFamily::Legendre, polynomial)?)
            }
        })
    }
}

impl SamplingDefinition {
    /// Checks the two keys `spacing_mm` and `accuracy_nm`. Returns the rule for the node spacing: a fixed spacing, or
    /// an accuracy from which the spacing is computed.
    ///
    /// # Errors
    /// Returns an error if a value is outside its range, or if none or both of the keys are given.
    pub fn resolve(&self) -> Result<Sampling, DefinitionError> {
        match (self.spacing_mm, self.accuracy_nm) {
            (Some(spacing), None) => {
                Ok(Sampling::Spacing { spacing_mm: error::check_positive("spacing_mm", spacing)? })
            }
            (None, Some(nm)) if nm > 0.0 && nm <= 1e6 => Ok(Sampling::Accuracy { accuracy_mm: 1e-6 * nm }),
            (None, Some(nm)) => {
                let limit = "greater than 0 and at most 1e6 nm";
                Err(DefinitionError::out_of_range("accuracy_nm", nm, limit, "0.1 is a usual value"))
            }
            (spacing, accuracy) => {
                let count = usize::from(spacing.is_some()) + usize::from(accuracy.is_some());
                Err(DefinitionError::Sampling { count })
            }
        }
    }
}

impl DefinedSurface {
    /// Joins a formula with the aperture (the outline of the part) and the rule for the node spacing. Formula and
    /// aperture are in the frame of the surface.
    ///
    /// # Errors
    /// Returns an error if the aperture is not a valid outline, reaches beyond the normalisation radius of the
    /// polynomials, or contains a place where the formula has no value. Returns an error for an off-axis section that
    /// is described in the frame of its parent (the whole surface), if the aperture does not contain the centre of the
    /// section.
    pub fn new(formula: AnalyticSurface, aperture: Aperture, sampling: Sampling) -> Result<Self, DefinitionError> {
        aperture.validate()?;
        if let AnalyticSurface::OffAxis(section) = &formula {
            let (x_mm, y_mm) = (section.centre().x, section.centre().y);
            if section.frame() == SectionFrame::Parent && aperture.distance_mm(x_mm, y_mm) > 0.0 {
                return Err(DefinitionError::SectionOutsideAperture { x_mm, y_mm });
            }
        }
        let undefined = |[x, y]: &[f64; 2]| formula.sag_and_gradient(*x, *y).is_none();
        if let Some([x_mm, y_mm]) = aperture.places_mm().into_iter().find(undefined) {
            return Err(DefinitionError::NotDefined { x_mm, y_mm });
        }
        if let Some(limit_mm) = formula.normalisation_radius_mm() {
            let reach_mm = formula.reach_mm(&aperture);
            // An aperture as large as the disc must pass in spite of rounding.
            if reach_mm > limit_mm * (1.0 + 1e-9) {
                return Err(DefinitionError::BeyondNormalisation { reach_mm, limit_mm });
            }
        }
        Ok(Self { formula, aperture, sampling })
    }

    /// Reads and checks a definition in TOML text.
    ///
    /// # Errors
    /// Returns an error with line and column for the first fault in the text or in a value.
    pub fn from_toml(text: &str) -> Result<Self, DefinitionError> {
        SurfaceDefinition::from_toml(text)?.resolve().map_err(|error| with_location(text, error))
    }

    /// Returns the formula of the surface, without the aperture.
    pub fn formula(&self) -> &AnalyticSurface {
        &self.formula
    }

    /// Returns the outline of the part.
    pub fn aperture(&self) -> &Aperture {
        &self.aperture
    }

    /// Returns the rule for the node spacing: a fixed spacing, or an accuracy from which the spacing is computed.
    pub fn sampling(&self) -> Sampling {
        self.sampling
    }
}

/// Adds line and column in `text` to an error about a value. Returns the error unchanged if it has no key, or if `text`
/// contains neither the key nor a table on its path.
fn with_location(text: &str, error: DefinitionError) -> DefinitionError {
    let Some(span) = error.key().and_then(|key| key_span(text, &key)) else { return error };
    let (line, column) = line_and_column(text, span.start);
    DefinitionError::Located { line, column, source: Box::new(error) }
}

/// Returns the byte range in `text` of the value of a key. `path` is the path of the key, such as `surface.radius_mm`.
/// If the key is missing, returns the range of the name of the innermost table on the path that exists. Returns `None`
/// if none of these tables exists, or if `text` is not TOML.
fn key_span(text: &str, path: &str) -> Option<Range<usize>> {
    let root = DeTable::parse(text).ok()?;
    let mut table = root.get_ref();
    let mut found = None;
    for name in path.split('.') {
        let Some((key, value)) = table.get_key_value(name) else { break };
        found = Some(key.span());
        match value.get_ref() {
            DeValue::Table(inner) => table = inner,
            _ => return Some(value.span()),
        }
    }
    found
}

/// Converts the table `{ kind = "a", b = 1 }` to `{ a = { b = 1 } }`. The second form is needed to read an enum whose
/// variant is an outer key. `text` is the whole TOML text, and `name` is the name of the table; both are for error
/// messages. Each value keeps its position in `text`, so that later errors give the correct line.
///
/// # Errors
/// Returns an error with line and column if `table` is not a table, or if `kind` is missing or not a string.
fn deserialize_by_kind<'t>(
    text: &str,
    name: &str,
    table: Spanned<DeValue<'t>>,
) -> Result<ValueDeserializer<'t>, DefinitionError> {
    let span = table.span();
    let DeValue::Table(mut keys) = table.into_inner() else {
        return Err(toml_error(text, Some(span), &format!("`{name}` must be a table, [{name}]")));
    };
    let Some(kind) = keys.remove("kind") else {
        return Err(toml_error(text, Some(span), &format!("missing key `kind` in [{name}]")));
    };
    let kind_span = kind.span();
    let DeValue::String(kind) = kind.into_inner() else {
        return Err(toml_error(text, Some(kind_span), "`kind` must be a name in quotes"));
    };
    let mut outer = DeTable::new();
    outer.insert(Spanned::new(kind_span, kind), Spanned::new(span.clone(), DeValue::Table(keys)));
    Ok(ValueDeserializer::from(Spanned::new(span, DeValue::Table(outer))))
}

/// Creates a TOML error with `message`, and with the line and column where the byte range `span` of `text` starts. Uses
/// the start of `text` if `span` is `None`.
fn toml_error(text: &str, span: Option<Range<usize>>, message: &str) -> DefinitionError {
    let (line, column) = line_and_column(text, span.map_or(0, |span| span.start));
    DefinitionError::Toml { line, column, message: message.to_owned() }
}

/// Returns the line and the column of the byte with the index `byte`, both counted from 1. Columns are counted in
/// characters.
fn line_and_column(text: &str, byte: usize) -> (usize, usize) {
    let before = text.get(..byte).unwrap_or(text);
    let line_start = before.rfind('\n').map_or(0, |newline| newline + 1);
    (before.matches('\n').count() + 1, before[line_start..].chars().count() + 1)
}

/// Definition of an off-axis section in a file.
#[derive(Clone, Debug, Deserialize, PartialEq, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct OffAxisDefinition {
    /// The whole surface, of any kind except an off-axis section.
    #[cfg_attr(feature = "schema", schemars(with = "WholeFormula"))]
    pub parent: Box<Formula>,
    /// Distance of the section's centre from the parent's axis, perpendicular to the axis, in millimetres.
    pub distance_mm: f64,
    /// Azimuth of the section's centre in the parent's frame, from x towards y, in degrees.
    #[serde(default)]
    pub azimuth_deg: f64,
    /// The frame of the section.
    pub frame: SectionFrame,
}

impl TryFrom<&OffAxisDefinition> for OffAxis {
    type Error = DefinitionError;

    fn try_from(written: &OffAxisDefinition) -> Result<Self, DefinitionError> {
        if matches!(*written.parent, Formula::OffAxis(_)) {
            return Err(DefinitionError::NestedSection { key: "parent".to_owned() });
        }
        let parent = written.parent.resolve().map_err(|error| error.in_table("parent"))?;
        Self::new(parent, written.distance_mm, written.azimuth_deg.to_radians(), written.frame)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CIRCLE: &str = "[aperture]\nkind = 'circle'\nradius_mm = 20\n";

    const KINDS: [&str; 15] = [
        "plane",
        "sphere",
        "conic",
        "asphere",
        "off-axis",
        "toroid",
        "biconic",
        "biconic-zernike",
        "xy-polynomial",
        "zernike",
        "qcon",
        "qbfs",
        "q2d",
        "chebyshev",
        "legendre",
    ];

    /// One definition of every kind.
    fn every_kind() -> Vec<String> {
        [
            "kind = 'plane'",
            "kind = 'sphere'\nradius_mm = 100",
            "kind = 'conic'\nradius_mm = -100.0\nconic = -1.5",
            "kind = 'asphere'\nradius_mm = 150\nconic = -1\ncoefficients = { A4 = 1e-8, 6 = 1e-14 }",
            "kind = 'off-axis'\ndistance_mm = 60\nazimuth_deg = 30\nframe = 'tilted'\n\
             parent = { kind = 'conic', radius_mm = 400, conic = -1 }",
            "kind = 'toroid'\nradius_x_mm = 100\nradius_y_mm = inf\ncoefficients = { A2 = 1e-4 }",
            "kind = 'biconic'\nradius_x_mm = 100\nradius_y_mm = 80\nconic_x = 1",
            "kind = 'biconic-zernike'\nradius_x_mm = 100\nradius_y_mm = inf\nnumbering = 'noll'\n\
             normalisation_radius_mm = 20\ncoefficients_mm = { Z5 = 0.01 }",
            "kind = 'xy-polynomial'\nnormalisation_radius_mm = 10\nterms = [[1, 1, 0.01], [0, 3, 1]]",
            "kind = 'zernike'\nnumbering = 'fringe'\nnormalisation_radius_mm = 20\ncoefficients_mm = { Z5 = 0.01, 9 = 1e-3 }\n\
             base = { radius_mm = 200 }",
            "kind = 'qcon'\nradius_mm = 100\nconic = -1\nnormalisation_radius_mm = 20\ncoefficients_mm = [0.01, 0.002]",
            "kind = 'qbfs'\nradius_mm = 100\nnormalisation_radius_mm = 20\ncoefficients_mm = [0.01, 0.002]",
            "kind = 'q2d'\nradius_mm = 100\nnormalisation_radius_mm = 20\ncoefficients_mm = [0.01]\n\
             terms = [[0, 2, 0.01, 0], [1, 1, 0, 1e-3]]",
            "kind = 'chebyshev'\nhalf_widths_mm = [20, 20]\nterms = [[1, 1, 0.01], [0, 3, 1]]\nbase = { radius_mm = 200 }",
            "kind = 'legendre'\nhalf_widths_mm = [20, 25.5]\nterms = [[1, 1, 0.01], [0, 3, 1]]",
        ]
        .map(|surface| format!("{CIRCLE}[surface]\n{surface}\n"))
        .into()
    }

    /// A sphere of radius 100 whose definition was changed in one place.
    fn changed(from: &str, to: &str) -> Result<DefinedSurface, DefinitionError> {
        let sphere =
            format!("[surface]\nkind = 'sphere'\nradius_mm = 100.0\n\n{CIRCLE}\n[sampling]\nspacing_mm = 0.5\n");
        assert!(sphere.contains(from));
        DefinedSurface::from_toml(&sphere.replace(from, to))
    }

    fn place(error: &DefinitionError) -> (usize, usize) {
        match error {
            DefinitionError::Toml { line, column, .. } | DefinitionError::Located { line, column, .. } => {
                (*line, *column)
            }
            other => panic!("{other} has no place"),
        }
    }

    #[test]
    fn definition_readers_agree() {
        let texts = every_kind();
        assert_eq!(texts.len(), KINDS.len());
        for (text, kind) in texts.iter().zip(KINDS) {
            assert!(text.contains(&format!("kind = '{kind}'")));
            let written = SurfaceDefinition::from_toml(text).unwrap();
            assert_eq!(toml::from_str::<SurfaceDefinition>(text).unwrap(), written);
            assert_eq!(SurfaceDefinition::from_toml(&toml::to_string(&written).unwrap()).unwrap(), written);
            let defined = written.resolve().unwrap();
            assert_eq!(defined.sampling(), Sampling::Accuracy { accuracy_mm: 1e-7 });
            assert!(defined.formula().normal(20.0, 0.0).is_some());
        }
    }

    #[test]
    fn definition_doc_example() {
        let text: String = include_str!("definition.rs")
            .lines()
            .skip_while(|line| !line.starts_with("//! ```toml"))
            .skip(1)
            .take_while(|line| !line.starts_with("//! ```"))
            .map(|line| format!("{}\n", &line[3..]))
            .collect();
        let defined = DefinedSurface::from_toml(&text).unwrap();
        assert_eq!(defined.sampling(), Sampling::Spacing { spacing_mm: 0.5 });
        assert_eq!(defined.aperture(), &Aperture::Circle { centre_mm: [0.0; 2], radius_mm: 30.0 });
        let expected = 900.0 / 300.0 + 1e-8 * 810_000.0;
        assert!((defined.formula().sag(0.0, 30.0).unwrap() - expected).abs() < 1e-15);
    }

    #[test]
    fn toml_errors_give_line_and_column() {
        for (from, to, expected, word) in [
            ("radius_mm = 100.0", "radius = 100.0", (3, 1), "radius"),
            ("radius_mm = 100.0", "radius_mm = '100'", (3, 13), "string"),
            ("radius_mm = 100.0", "radius_mm = ", (3, 13), "value"),
            ("'sphere'", "'ball'", (2, 8), "off-axis"),
            ("kind = 'sphere'", "", (1, 1), "kind"),
            ("radius_mm = 100.0", "", (1, 1), "radius_mm"),
            ("radius_mm = 20", "radius_cm = 2", (7, 1), "radius_cm"),
            ("radius_mm = 20", "radius_mm = '20'", (7, 13), "string"),
            ("'circle'", "'disc'", (6, 8), "annulus"),
            ("[sampling]", "[sampling_mm]", (9, 2), "sampling_mm"),
            ("spacing_mm", "grid_mm", (10, 1), "grid_mm"),
        ] {
            let error = changed(from, to).unwrap_err();
            assert!(matches!(error, DefinitionError::Toml { .. }), "{error}");
            assert_eq!(place(&error), expected, "{error}");
            assert!(error.to_string().contains(word), "{error}");
        }
        let error = DefinedSurface::from_toml(CIRCLE).unwrap_err();
        assert!(error.to_string().contains("[surface] is missing"));
    }

    #[test]
    fn value_errors_name_key_and_place() {
        for (from, to, expected, words) in [
            ("radius_mm = 100.0", "radius_mm = 0", (3, 13), ["surface.radius_mm", "is 0;"]),
            ("radius_mm = 100.0", "radius_mm = nan", (3, 13), ["surface.radius_mm", "NaN"]),
            ("radius_mm = 20", "radius_mm = -20", (7, 13), ["radius_mm", "-20"]),
            ("spacing_mm = 0.5", "spacing_mm = -0.5", (10, 14), ["sampling.spacing_mm", "-0.5"]),
            ("spacing_mm = 0.5", "accuracy_nm = inf", (10, 15), ["sampling.accuracy_nm", "inf"]),
            ("spacing_mm = 0.5", "", (9, 2), ["spacing_mm", "accuracy_nm"]),
            ("spacing_mm = 0.5", "spacing_mm = 0.5\naccuracy_nm = 1", (9, 2), ["has 2", "exactly one"]),
            ("radius_mm = 20", "radius_mm = 100", (5, 2), ["not defined", "aperture"]),
        ] {
            let error = changed(from, to).unwrap_err();
            assert!(matches!(error, DefinitionError::Located { .. }), "{error}");
            assert_eq!(place(&error), expected, "{error}");
            assert!(words.iter().all(|word| error.to_string().contains(word)), "{error}");
        }
    }

    #[test]
    fn nested_errors_give_line_and_column() {
        let read = |surface: &str| DefinedSurface::from_toml(&format!("{CIRCLE}[surface]\n{surface}")).unwrap_err();
        let error = read("kind = 'asphere'\nradius_mm = 100\n[surface.coefficients]\nA4 = 1\nA1 = 1\n");
        assert_eq!(place(&error), (9, 6), "{error}");
        let error = read("kind = 'asphere'\nradius_mm = 100\ncoefficients = { A4 = 1, 4 = 1 }\n");
        assert!(error.to_string().contains("twice"), "{error}");
        let error =
            read("kind = 'zernike'\nnumbering = 'noll'\nnormalisation_radius_mm = 20\ncoefficients_mm = { 0 = 1 }");
        assert_eq!(place(&error), (8, 25), "{error}");
        let cut = "kind = 'off-axis'\ndistance_mm = 60\nframe = 'tilted'\n";
        let error = read(&format!("{cut}[surface.parent]\nkind = 'sphere'\nradius_mm = 0\n"));
        assert_eq!((place(&error), error.key().as_deref()), ((10, 13), Some("surface.parent.radius_mm")), "{error}");
        let error = read(&format!("{cut}[surface.parent]\nkind = 'sphere'\nradius_mm = 50\n"));
        assert_eq!(place(&error), (6, 15), "{error}");
        let nested = format!("{cut}[surface.parent]\n{cut}[surface.parent.parent]\nkind = 'plane'\n");
        assert!(matches!(read(&nested), DefinitionError::Located { source, .. }
            if matches!(*source, DefinitionError::NestedSection { .. })));
    }

    #[test]
    fn aperture_must_fit_formula() {
        let read = |aperture: &str, surface: &str| {
            DefinedSurface::from_toml(&format!("[aperture]\n{aperture}\n[surface]\n{surface}\n"))
        };
        let qbfs = "kind = 'qbfs'\nradius_mm = 100\nnormalisation_radius_mm = 20\ncoefficients_mm = [0.01]";
        assert!(read("kind = 'circle'\nradius_mm = 20", qbfs).is_ok());
        let error = read("kind = 'rectangle'\nwidth_mm = 30\nheight_mm = 30", qbfs).unwrap_err();
        assert!(error.to_string().contains("21.2"), "{error}");
        let cut = |frame: &str| {
            format!(
                "kind = 'off-axis'\ndistance_mm = 12\nframe = '{frame}'\n[surface.parent]\nkind = 'qcon'\nradius_mm = 100\n\
                 normalisation_radius_mm = 20\ncoefficients_mm = [0.01]"
            )
        };
        for frame in ["shifted", "tilted"] {
            assert!(read("kind = 'circle'\nradius_mm = 7.99", &cut(frame)).is_ok());
            let error = read("kind = 'circle'\nradius_mm = 8.4", &cut(frame)).unwrap_err();
            assert!(error.to_string().contains("reaches 20."), "{error}");
        }
        let error = read("kind = 'circle'\nradius_mm = 5", &cut("parent")).unwrap_err();
        assert!(error.to_string().contains("centre_mm = [12, 0]"), "{error}");
        assert!(read("kind = 'circle'\nradius_mm = 5\ncentre_mm = [12, 0]", &cut("parent")).is_ok());
    }
}
