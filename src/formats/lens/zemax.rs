//! Surfaces of a lens file of Zemax OpticStudio (`.zmx`).
//!
//! A line has a keyword and its values. A block `SURF n` has the lines of a surface, set in by blanks, in any order.
//! Lengths are in the unit of `UNIT`. Extra data of a surface stand in lines `XDAT n`, parameters in lines `PARM n`. What
//! the parameters of each type mean is in the OpticStudio manual (types Standard, Even Asphere, Odd Asphere, Extended
//! Asphere, Extended Odd Asphere, Toroidal, Biconic, Extended Polynomial, Zernike Standard Sag, Zernike Fringe Sag, Q-Type).

use std::collections::BTreeMap;
use std::path::Path;

use regrind_core::geometry::Aperture;

use super::super::error::{FormatError, excerpt};
use super::build::{Base, Built, polynomial_order, sum, zernike};
use super::model::{LensModel, LensSurface};

/// Surface as the file has it.
#[derive(Default)]
struct Block {
    number: usize,
    kind: String,
    comment: String,
    curvature: f64,
    conic: f64,
    semi_diameter: f64,
    parameters: BTreeMap<u32, f64>,
    extra: BTreeMap<u32, f64>,
    /// Clear aperture: least and largest radius.
    circle: Option<[f64; 2]>,
    /// Half-widths of a rectangular aperture.
    rectangle: Option<[f64; 2]>,
    centre: [f64; 2],
}

/// Reads the surfaces of a lens.
///
/// # Errors
/// Text that is not a lens file; a unit that is not known; a value that is not a number.
pub(super) fn parse_zemax(path: &Path, text: &str) -> Result<LensModel, FormatError> {
    let mut blocks: Vec<Block> = Vec::new();
    let mut unit_mm = 1.0;
    let mut is_in_block = false;
    for (i, line) in text.split(['\n', '\r']).enumerate() {
        let mut words = line.split_whitespace();
        let Some(keyword) = words.next() else { continue };
        let rest: Vec<&str> = words.collect();
        let wrong = |expected: &str| unexpected(path, &format!("line {}", i + 1), expected, line);
        let number = |at: usize| -> Result<f64, FormatError> {
            let value = rest.get(at).and_then(|word| word.parse::<f64>().ok()).filter(|value| value.is_finite());
            value.ok_or_else(|| wrong("a number"))
        };
        if keyword == "SURF" {
            let number =
                rest.first().and_then(|word| word.parse().ok()).ok_or_else(|| wrong("the number of a surface"))?;
            blocks.push(Block { number, kind: "STANDARD".to_owned(), ..Block::default() });
            is_in_block = true;
            continue;
        }
        is_in_block &= line.starts_with([' ', '\t']);
        if keyword == "UNIT" && !is_in_block {
            unit_mm = match rest.first().copied().unwrap_or_default() {
                "MM" => 1.0,
                "CM" => 10.0,
                "IN" | "INCH" | "INCHES" => 25.4,
                "M" | "METER" | "METERS" => 1e3,
                _ => return Err(wrong("the unit MM, CM, IN or METER")),
            };
        }
        let (true, Some(block)) = (is_in_block, blocks.last_mut()) else { continue };
        // A value with an index, such as `PARM 1 0.5`.
        let indexed = || -> Result<(u32, f64), FormatError> {
            let index =
                rest.first().and_then(|word| word.parse().ok()).ok_or_else(|| wrong("an index and a number"))?;
            Ok((index, number(1)?))
        };
        match keyword {
            "TYPE" => block.kind = rest.first().copied().unwrap_or("STANDARD").to_owned(),
            "COMM" => block.comment = rest.join(" "),
            "CURV" => block.curvature = number(0)?,
            "CONI" => block.conic = number(0)?,
            "DIAM" => block.semi_diameter = number(0)?,
            "PARM" => drop(indexed().map(|(index, value)| block.parameters.insert(index, value))?),
            "XDAT" => drop(indexed().map(|(index, value)| block.extra.insert(index, value))?),
            "CLAP" => block.circle = Some([number(0)?, number(1)?]),
            "SQAP" => block.rectangle = Some([number(0)?, number(1)?]),
            "OBDC" => block.centre = [number(0)?, number(1)?],
            _ => {}
        }
    }
    if blocks.is_empty() {
        return Err(FormatError::NoData { path: path.to_owned(), expected: "surface" });
    }
    Ok(LensModel { surfaces: blocks.iter().map(|block| block.surface(unit_mm)).collect() })
}

fn unexpected(path: &Path, place: &str, expected: &str, found: &str) -> FormatError {
    FormatError::Unexpected {
        path: path.to_owned(),
        place: place.to_owned(),
        expected: expected.to_owned(),
        found: excerpt(found.trim().as_bytes()),
    }
}

impl Block {
    fn surface(&self, unit_mm: f64) -> LensSurface {
        let has_terms = self.parameters.values().chain(self.extra.values()).any(|value| *value != 0.0);
        LensSurface {
            number: self.number,
            name: self.comment.clone(),
            kind: self.kind.clone(),
            is_curved: self.kind != "COORDBRK" && (self.curvature != 0.0 || (self.kind != "STANDARD" && has_terms)),
            aperture: self.aperture(unit_mm),
            surface: self.built(unit_mm),
        }
    }

    /// Returns the aperture that is stated, else the disc of the semi-diameter.
    fn aperture(&self, unit_mm: f64) -> Option<Aperture> {
        let centre_mm = self.centre.map(|c| c * unit_mm);
        let aperture = match (self.rectangle, self.circle) {
            (Some([x, y]), _) => {
                Aperture::Rectangle { centre_mm, width_mm: 2.0 * x * unit_mm, height_mm: 2.0 * y * unit_mm }
            }
            (None, Some([inner, outer])) if inner > 0.0 => {
                Aperture::Annulus { centre_mm, inner_radius_mm: inner * unit_mm, outer_radius_mm: outer * unit_mm }
            }
            (None, Some([_, outer])) => Aperture::Circle { centre_mm, radius_mm: outer * unit_mm },
            (None, None) => Aperture::Circle { centre_mm: [0.0; 2], radius_mm: self.semi_diameter * unit_mm },
        };
        aperture.validate().is_ok().then_some(aperture)
    }

    fn parameter(&self, index: u32) -> f64 {
        self.parameters.get(&index).copied().unwrap_or(0.0)
    }

    fn extra(&self, index: u32) -> f64 {
        // Newer files can count the extra data on behind the twelve parameters.
        self.extra.get(&index).or_else(|| self.parameters.get(&(index + 12))).copied().unwrap_or(0.0)
    }

    /// Returns `count` extra data from the index `first` on.
    fn extras(&self, first: u32, count: f64) -> Result<Vec<f64>, String> {
        if !(0.0..=300.0).contains(&count) || count.fract() != 0.0 {
            return Err(format!("its number of terms is {count}; it must be a whole number up to 300"));
        }
        Ok((0..count as u32).map(|k| self.extra(first + k)).collect())
    }

    /// Returns the surface in millimetres: a coefficient of r^p is divided by the unit to the power p - 1.
    fn built(&self, unit_mm: f64) -> Built {
        let base = Base { curvature_per_mm: self.curvature / unit_mm, conic: self.conic };
        let coefficient = |power: u32, a: f64| (power, a * unit_mm.powi(1 - power as i32));
        let powers =
            |step: u32| -> Vec<(u32, f64)> { (1..=8).map(|i| coefficient(step * i, self.parameter(i))).collect() };
        // A normalised term has the unit of a length.
        let normalised = |step: u32| -> Result<Vec<(u32, f64)>, String> {
            let radius = self.radius(self.extra(2))?;
            let terms = (1..).zip(self.extras(3, self.extra(1))?);
            Ok(terms.map(|(i, a)| coefficient(step * i, a / radius.powi((step * i) as i32))).collect())
        };
        match self.kind.as_str() {
            "STANDARD" => base.conic(),
            "EVENASPH" => base.asphere(&powers(2)),
            "ODDASPHE" => base.asphere(&powers(1)),
            "XASPHERE" => base.asphere(&normalised(2)?),
            "XOSPHERE" => base.asphere(&normalised(1)?),
            "TOROIDAL" => {
                let radius = self.parameter(1) * unit_mm;
                let terms: Vec<(u32, f64)> = (2..=8).map(|i| coefficient(2 * (i - 1), self.parameter(i))).collect();
                let toroid = base.toroid(if radius == 0.0 { f64::INFINITY } else { radius }, &terms);
                self.with_zernike(toroid, false, unit_mm)
            }
            "BICONICX" => {
                let radius = self.parameter(1) * unit_mm;
                base.biconic(if radius == 0.0 { f64::INFINITY } else { radius }, self.parameter(2))
            }
            "XPOLYNOM" => {
                let values = self.extras(3, self.extra(1))?;
                let terms = polynomial_order().zip(values).map(|((i, j), a)| (i, j, a * unit_mm)).collect();
                base.xy_polynomial(self.radius(self.extra(2))? * unit_mm, terms)
            }
            kind @ ("SZERNSAG" | "FZERNSAG") => {
                self.with_zernike(base.asphere(&powers(2)), kind == "FZERNSAG", unit_mm)
            }
            "QED_TYPE" => {
                let is_qcon = match self.extra(1) {
                    0.0 => false,
                    1.0 => true,
                    other => {
                        return Err(format!("its kind of polynomials is {other}; it must be 0 (Qbfs) or 1 (Qcon)"));
                    }
                };
                let values = self.extras(4, self.extra(2) + 1.0)?;
                let values = values.iter().map(|a| a * unit_mm).collect();
                base.forbes(is_qcon, self.radius(self.extra(3))? * unit_mm, values)
            }
            "COORDBRK" => Err("it is a coordinate break, which has no shape; choose the surface behind it".to_owned()),
            other => Err(format!(
                "surfaces of the type {other} are not read; sample the sag as points, or write its equation into a definition"
            )),
        }
    }

    /// Adds the Zernike terms of the extra data: their number, the normalisation radius, and the coefficients.
    fn with_zernike(&self, base: Built, is_fringe: bool, unit_mm: f64) -> Built {
        let values = self.extras(3, self.extra(1))?;
        if values.iter().all(|a| *a == 0.0) {
            return base;
        }
        let radius_mm = self.radius(self.extra(2))? * unit_mm;
        // A toroid has no decentre of its terms: its parameters 9 and 10 are not used.
        let shift = if self.kind == "TOROIDAL" { [0.0; 2] } else { [self.parameter(9), self.parameter(10)] };
        let shift = shift.map(|s| s * unit_mm);
        let reach_mm = self.semi_diameter * unit_mm + shift[0].hypot(shift[1]);
        // Without extrapolation the terms end at the normalisation radius: there the surface would have a step.
        if self.parameter(0) == 0.0 && reach_mm > radius_mm * (1.0 + 1e-9) {
            return Err(format!(
                "its Zernike terms end at the normalisation radius of {radius_mm} mm, within the surface of {reach_mm} mm"
            ));
        }
        let coefficients: Vec<f64> = values.iter().map(|a| a * unit_mm).collect();
        sum(base, zernike(is_fringe, radius_mm, &coefficients), shift)
    }

    fn radius(&self, value: f64) -> Result<f64, String> {
        if value > 0.0 { Ok(value) } else { Err(format!("its normalisation radius is {value}; it must be above 0")) }
    }
}
