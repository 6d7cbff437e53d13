//! Surfaces of a lens file of Zemax OpticStudio (`.zmx`).
//!
//! A line has a keyword and its values. A block `SURF n` has the lines of a surface, set in by blanks, in any order; some
//! programs remove the blanks of all lines.
//! Lengths are in the unit of `UNIT`. Extra data of a surface stand in lines `XDAT n`, parameters in lines `PARM n`. What
//! the parameters of each type mean is in the OpticStudio manual (types Standard, Even Asphere, Odd Asphere, Extended
//! Asphere, Extended Odd Asphere, Toroidal, Biconic, Extended Polynomial, Zernike Standard Sag, Zernike Fringe Sag, Q-Type).

use std::collections::{BTreeMap, HashSet};
use std::path::Path;

use regrind_core::geometry::Aperture;

use super::super::error::{FormatError, excerpt};
use super::build::{Base, Built, polynomial_order, sum, zernike};
use super::model::{LensModel, LensSurface, TermsDisc};

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
    outline: Outline,
    centre: [f64; 2],
    /// Keyword, and index of a parameter, of each line that was taken: a value is stated once.
    taken: HashSet<(String, Option<u32>)>,
    /// True if no surface follows: the file can be cut in it.
    is_last: bool,
}

/// Aperture of a surface as the file has it.
#[derive(Default)]
enum Outline {
    /// None: that of the semi-diameter.
    #[default]
    SemiDiameter,
    /// Least and largest radius.
    Circle([f64; 2]),
    /// Half-widths.
    Rectangle([f64; 2]),
    /// Half-widths.
    Ellipse([f64; 2]),
    /// An outline that the user drew, in a file of its own.
    Unknown,
}

/// Largest number of surfaces that are read, so that they need no more memory than fits the file.
const MAX_SURFACES: usize = 10_000;

/// Keywords of the lines of a surface that are read.
const OF_SURFACES: [&str; 12] =
    ["TYPE", "COMM", "CURV", "CONI", "DIAM", "PARM", "XDAT", "CLAP", "SQAP", "ELAP", "USAP", "OBDC"];

/// Types of surfaces that are read.
const KINDS: [&str; 12] = [
    "STANDARD", "EVENASPH", "ODDASPHE", "XASPHERE", "XOSPHERE", "TOROIDAL", "BICONICX", "XPOLYNOM", "SZERNSAG",
    "FZERNSAG", "QED_TYPE", "COORDBRK",
];

/// Index of the parameter from which on newer files have the extra data.
const FIRST_OF_EXTRA: u32 = 13;

/// Reads the surfaces of a lens.
///
/// # Errors
/// Text that is not a lens file; a unit that is not known; a value that is not a number.
pub(super) fn parse_zemax(path: &Path, text: &str) -> Result<LensModel, FormatError> {
    let mut blocks: Vec<Block> = Vec::new();
    let mut unit_mm = None;
    let mut is_in_block = false;
    let is_set_in = has_lines_set_in(text);
    for (i, line) in text.split(['\n', '\r']).enumerate() {
        let mut words = line.split_whitespace();
        let Some(keyword) = words.next().filter(|keyword| !keyword.starts_with('!')) else { continue };
        let line = Line { path, number: i + 1, text: line, values: words.collect() };
        if keyword == "SURF" {
            let number = line.whole(0, "the number of a surface")? as usize;
            if blocks.len() == MAX_SURFACES {
                return Err(line.wrong(&format!("at most {MAX_SURFACES} surfaces")));
            }
            blocks.push(Block { number, kind: "STANDARD".to_owned(), ..Block::default() });
            is_in_block = true;
            continue;
        }
        let belongs = !is_set_in || line.text.starts_with([' ', '\t']);
        is_in_block &= belongs;
        if keyword == "UNIT" && (blocks.is_empty() || !belongs) {
            unit_mm = match line.values.first().copied().unwrap_or_default() {
                "MM" => Some(1.0),
                "CM" => Some(10.0),
                "IN" | "INCH" | "INCHES" => Some(25.4),
                "M" | "METER" | "METERS" => Some(1e3),
                _ => return Err(line.wrong("the unit MM, CM, IN or METER")),
            };
        }
        let Some(block) = blocks.last_mut() else { continue };
        if is_in_block {
            block.take_line(keyword, &line)?;
        } else if OF_SURFACES.contains(&keyword) {
            return Err(line.wrong("a line of a surface to be set in by blanks, as the others are"));
        }
    }
    if blocks.is_empty() {
        return Err(FormatError::NoData { path: path.to_owned(), expected: "surface" });
    }
    if let Some(last) = blocks.last_mut() {
        last.is_last = true;
    }
    Ok(LensModel { surfaces: blocks.iter().map(|block| block.surface(unit_mm)).collect() })
}

/// Returns true if a line behind the first `SURF` is set in by blanks. In a file without any, blanks were removed, and a
/// surface ends at the next `SURF`.
fn has_lines_set_in(text: &str) -> bool {
    let mut lines = text.split(['\n', '\r']).skip_while(|line| !line.trim_start().starts_with("SURF"));
    lines.any(|line| line.starts_with([' ', '\t']) && !line.trim().is_empty() && !line.trim().starts_with("SURF"))
}

/// Line of the file: its values behind the keyword.
struct Line<'a> {
    path: &'a Path,
    number: usize,
    text: &'a str,
    values: Vec<&'a str>,
}

impl Line<'_> {
    fn wrong(&self, expected: &str) -> FormatError {
        FormatError::Unexpected {
            path: self.path.to_owned(),
            place: format!("line {}", self.number),
            expected: expected.to_owned(),
            found: excerpt(self.text.trim().as_bytes()),
        }
    }

    fn whole(&self, at: usize, expected: &str) -> Result<u32, FormatError> {
        self.values.get(at).and_then(|word| word.parse().ok()).ok_or_else(|| self.wrong(expected))
    }

    fn number(&self, at: usize) -> Result<f64, FormatError> {
        let value = self.values.get(at).and_then(|word| word.parse::<f64>().ok()).filter(|value| value.is_finite());
        value.ok_or_else(|| self.wrong("a number"))
    }

    /// Returns a value with its index, such as those of `PARM 1 0.5`.
    fn indexed(&self) -> Result<(u32, f64), FormatError> {
        Ok((self.whole(0, "an index and a number")?, self.number(1)?))
    }
}

impl Block {
    /// Takes a line of this surface.
    fn take_line(&mut self, keyword: &str, line: &Line<'_>) -> Result<(), FormatError> {
        let pair = || -> Result<[f64; 2], FormatError> { Ok([line.number(0)?, line.number(1)?]) };
        if OF_SURFACES.contains(&keyword) {
            let index = if matches!(keyword, "PARM" | "XDAT") { Some(line.indexed()?.0) } else { None };
            if !self.taken.insert((keyword.to_owned(), index)) {
                return Err(line.wrong("each value of a surface once"));
            }
        }
        match keyword {
            "TYPE" => self.kind = line.values.first().copied().unwrap_or("STANDARD").to_owned(),
            "COMM" => self.comment = line.values.join(" "),
            "CURV" => self.curvature = line.number(0)?,
            "CONI" => self.conic = line.number(0)?,
            "DIAM" => self.semi_diameter = line.number(0)?,
            "PARM" => drop(line.indexed().map(|(index, value)| self.parameters.insert(index, value))?),
            "XDAT" => drop(line.indexed().map(|(index, value)| self.extra.insert(index, value))?),
            "CLAP" => self.outline = Outline::Circle(pair()?),
            "SQAP" => self.outline = Outline::Rectangle(pair()?),
            "ELAP" => self.outline = Outline::Ellipse(pair()?),
            "USAP" => self.outline = Outline::Unknown,
            "OBDC" => self.centre = pair()?,
            // OpticStudio writes the curvature. A person who edits a file by hand may write the radius.
            "RADI" | "RADIUS" => return Err(line.wrong("CURV, the curvature")),
            _ => {}
        }
        Ok(())
    }

    fn surface(&self, unit_mm: Option<f64>) -> LensSurface {
        let has_terms = self.parameters.values().chain(self.extra.values()).any(|value| *value != 0.0);
        let is_known = KINDS.contains(&&self.kind[..]);
        let is_curved =
            self.kind != "COORDBRK" && (self.curvature != 0.0 || !is_known || (self.kind != "STANDARD" && has_terms));
        let surface = match unit_mm {
            None => Err("the file has no unit; add a line UNIT MM, or the unit that it has".to_owned()),
            Some(_) if self.is_last && is_curved => {
                Err("the file ends with it, and can be cut in it: a lens ends with \
                its image surface; export the file again, or add the line SURF of a plane behind it"
                    .to_owned())
            }
            Some(unit_mm) => self.check_parameters().and_then(|()| self.built(unit_mm)),
        };
        let unit_mm = unit_mm.unwrap_or(1.0);
        LensSurface {
            number: self.number,
            name: self.comment.clone(),
            kind: self.kind.clone(),
            is_curved,
            aperture: self.aperture(unit_mm),
            disc: self.terms_disc(unit_mm),
            surface,
        }
    }

    /// Checks that the surface has no parameter and no extra data that its type does not use, because their meaning is not
    /// known. Checks that the last of its extra data is there.
    fn check_parameters(&self) -> Result<(), String> {
        let kind = &self.kind[..];
        let is_used = |index: u32| match kind {
            "EVENASPH" | "ODDASPHE" => (1..=8).contains(&index),
            "TOROIDAL" => index <= 8,
            "BICONICX" => (1..=2).contains(&index),
            "SZERNSAG" | "FZERNSAG" => index <= 10,
            "COORDBRK" => true,
            _ => false,
        };
        let count = |index: u32, first: u32| (self.extra(index) != 0.0).then(|| first + self.extra(index) as u32);
        let end = match kind {
            "XASPHERE" | "XOSPHERE" | "XPOLYNOM" | "TOROIDAL" | "SZERNSAG" | "FZERNSAG" => count(1, 3).or(Some(3)),
            "QED_TYPE" => count(2, 4).or(Some(4)),
            _ => None,
        };
        let is_zero = |value: &f64| *value == 0.0;
        let surplus = |(index, value): &(&u32, &f64)| {
            !(is_zero(value) || is_used(**index) || (end.is_some() && **index >= FIRST_OF_EXTRA))
        };
        if let Some((index, value)) = self.parameters.iter().find(surplus) {
            return Err(format!(
                "its parameter {index} is {value}, but surfaces of the type {kind} have none; remove it"
            ));
        }
        let extras = self.parameters.iter().filter_map(|(index, value)| {
            Some((index.checked_sub(FIRST_OF_EXTRA - 1).filter(|index| *index > 0)?, value))
        });
        let extras = self.extra.iter().map(|(index, value)| (*index, value)).chain(extras);
        // OpticStudio uses no terms beyond their number, whatever the file has.
        if end.is_none()
            && kind != "COORDBRK"
            && let Some((index, value)) = extras.clone().find(|(_, value)| !is_zero(value))
        {
            return Err(format!(
                "its extra data {index} is {value}, but surfaces of the type {kind} have none; remove it"
            ));
        }
        match end {
            Some(end) if end > 4 && !extras.map(|(index, _)| index).any(|index| index + 1 == end) => Err(format!(
                "its number of terms asks for the extra data {}, which are missing; export the file again",
                end - 1
            )),
            _ => Ok(()),
        }
    }

    /// Returns the disc of the Zernike terms, if they are not extrapolated: outside they are left out, with a step.
    fn terms_disc(&self, unit_mm: f64) -> Option<TermsDisc> {
        let has_terms = matches!(&self.kind[..], "TOROIDAL" | "SZERNSAG" | "FZERNSAG")
            && self.extras(3, self.extra(1)).is_ok_and(|values| values.iter().any(|value| *value != 0.0));
        let is_extrapolated = self.parameter(0) != 0.0;
        (has_terms && !is_extrapolated)
            .then(|| TermsDisc { centre_mm: self.terms_shift_mm(unit_mm), radius_mm: self.extra(2) * unit_mm })
    }

    /// Returns the place in mm of the centre of the Zernike terms.
    fn terms_shift_mm(&self, unit_mm: f64) -> [f64; 2] {
        // A toroid has no decentre of its terms: its parameters 9 and 10 are not used.
        let shift = if self.kind == "TOROIDAL" { [0.0; 2] } else { [self.parameter(9), self.parameter(10)] };
        shift.map(|s| s * unit_mm)
    }

    /// Returns the aperture that is stated, else the disc of the semi-diameter.
    fn aperture(&self, unit_mm: f64) -> Option<Aperture> {
        let centre_mm = self.centre.map(|c| c * unit_mm);
        let aperture = match self.outline {
            Outline::Rectangle([x, y]) => {
                Aperture::Rectangle { centre_mm, width_mm: 2.0 * x * unit_mm, height_mm: 2.0 * y * unit_mm }
            }
            Outline::Ellipse(semi_axes) => {
                Aperture::Ellipse { centre_mm, semi_axes_mm: semi_axes.map(|semi_axis| semi_axis * unit_mm) }
            }
            Outline::Circle([inner, outer]) if inner > 0.0 => {
                Aperture::Annulus { centre_mm, inner_radius_mm: inner * unit_mm, outer_radius_mm: outer * unit_mm }
            }
            Outline::Circle([_, outer]) => Aperture::Circle { centre_mm, radius_mm: outer * unit_mm },
            Outline::SemiDiameter => Aperture::Circle { centre_mm: [0.0; 2], radius_mm: self.semi_diameter * unit_mm },
            Outline::Unknown => return None,
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
        let coefficients: Vec<f64> = values.iter().map(|a| a * unit_mm).collect();
        sum(base, zernike(is_fringe, radius_mm, &coefficients), self.terms_shift_mm(unit_mm))
    }

    fn radius(&self, value: f64) -> Result<f64, String> {
        if value > 0.0 { Ok(value) } else { Err(format!("its normalisation radius is {value}; it must be above 0")) }
    }
}
