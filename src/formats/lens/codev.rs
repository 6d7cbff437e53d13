//! Surfaces of a sequence file of Code V (`.seq`).
//!
//! Statements end at the end of a line or at `;`; `&` continues a line, `!` begins a comment. `SO`, `S` and `SI` begin a
//! surface, with radius or curvature, thickness and glass; other statements belong to the surface above, or name one
//! (`K S2 -1`). `DIM M` is millimetre. `RDM` says that the number of `S` is a radius.

use std::collections::BTreeMap;
use std::path::Path;

use regrind_core::geometry::Aperture;

use super::super::error::{FormatError, excerpt};
use super::build::{Base, Built, polynomial_order, sum, zernike};
use super::model::{LensModel, LensSurface, TermsDisc};

/// Letters of the coefficients of r^4 to r^20. Code V has no I.
const LETTERS: [&str; 9] = ["A", "B", "C", "D", "E", "F", "G", "H", "J"];

/// Surface as the file has it.
#[derive(Clone, Default)]
struct Block {
    label: String,
    /// Word of the type: SPH, CON, ASP, YTO and so on; `XYP` and its like of a special surface.
    kind: String,
    /// Number of the `S` statement: a radius or a curvature.
    value: f64,
    /// Curvature or radius that a statement `CUY` or `RDY` gives.
    curvature: Option<f64>,
    radius: Option<f64>,
    radius_x: f64,
    curvature_x: Option<f64>,
    conic: f64,
    letters: BTreeMap<usize, f64>,
    special: BTreeMap<String, f64>,
    circle: Option<f64>,
    rectangle: [Option<f64>; 2],
    aperture_centre: [f64; 2],
    /// Keyword of an aperture that is an ellipse, or turned.
    unknown_aperture: Option<String>,
}

/// Reads the surfaces of a lens.
///
/// # Errors
/// Text that is not a sequence file; a unit that is not known; a value that is not a number.
pub(super) fn parse_codev(path: &Path, text: &str) -> Result<LensModel, FormatError> {
    let mut reader = Reader { path, blocks: Vec::new(), unit_mm: None, has_radii: None };
    for (line, statement) in statements(text) {
        reader.take_statement(line, &statement)?;
    }
    let Reader { blocks, unit_mm, has_radii, .. } = reader;
    if blocks.is_empty() {
        return Err(FormatError::NoData { path: path.to_owned(), expected: "surface" });
    }
    let surfaces = (0..).zip(&blocks).map(|(number, block)| block.surface(number, unit_mm, has_radii)).collect();
    Ok(LensModel { surfaces })
}

/// Divides a text into statements of words, each with the number of its line. A text in quotes is one word.
fn statements(text: &str) -> Vec<(usize, Vec<String>)> {
    let mut statements = Vec::new();
    let (mut words, mut word, mut begin, mut line) = (Vec::new(), String::new(), 1, 1);
    let mut quote: Option<char> = None;
    let mut chars = text.chars().peekable();
    while let Some(c) = chars.next() {
        if let Some(mark) = quote {
            // A text ends with its line, whatever quotes say.
            if c == mark || c == '\n' {
                quote = None;
                words.push(std::mem::take(&mut word));
            } else {
                word.push(c);
            }
            if c != '\n' {
                continue;
            }
        }
        let is_end = matches!(c, ';' | '\n' | '\r');
        if (c.is_whitespace() || is_end || c == '!' || c == '&' || c == '\'' || c == '"') && !word.is_empty() {
            words.push(std::mem::take(&mut word));
        }
        match c {
            '!' => while chars.next_if(|c| *c != '\n').is_some() {},
            // The statement goes on in the next line.
            '&' => {
                while chars.next_if(|c| *c != '\n').is_some() {}
                chars.next();
                line += 1;
            }
            '\'' | '"' => quote = Some(c),
            _ if is_end => {
                if !words.is_empty() {
                    statements.push((begin, std::mem::take(&mut words)));
                }
                line += usize::from(c == '\n');
                begin = line;
            }
            c if c.is_whitespace() => {}
            c => word.push(c),
        }
    }
    if !word.is_empty() {
        words.push(word);
    }
    if !words.is_empty() {
        statements.push((begin, words));
    }
    statements
}

struct Reader<'a> {
    path: &'a Path,
    blocks: Vec<Block>,
    unit_mm: Option<f64>,
    /// Whether the number of an `S` statement is a radius. `None` if the file does not say.
    has_radii: Option<bool>,
}

/// Statement of the file.
struct Statement<'a> {
    path: &'a Path,
    line: usize,
    words: &'a [String],
}

impl Statement<'_> {
    fn wrong(&self, expected: &str) -> FormatError {
        FormatError::Unexpected {
            path: self.path.to_owned(),
            place: format!("line {}", self.line),
            expected: expected.to_owned(),
            found: excerpt(self.words.join(" ").as_bytes()),
        }
    }

    /// Returns a word in upper case; empty if there is none.
    fn word(&self, at: usize) -> String {
        self.words.get(at).map(|word| word.to_uppercase()).unwrap_or_default()
    }

    fn value(&self, at: usize) -> Result<f64, FormatError> {
        let value = self.words.get(at).and_then(|word| word.parse::<f64>().ok()).filter(|value| value.is_finite());
        value.ok_or_else(|| self.wrong("a number"))
    }

    fn is_number(&self, at: usize) -> bool {
        self.words.get(at).is_some_and(|word| word.parse::<f64>().is_ok())
    }
}

impl Reader<'_> {
    fn take_statement(&mut self, line: usize, words: &[String]) -> Result<(), FormatError> {
        let statement = Statement { path: self.path, line, words };
        let keyword = statement.word(0);
        match keyword.as_str() {
            "DIM" => {
                self.unit_mm = match statement.word(1).as_str() {
                    "M" | "MM" => Some(1.0),
                    "C" | "CM" => Some(10.0),
                    "I" | "IN" => Some(25.4),
                    _ => return Err(statement.wrong("the unit M (millimetre), C or I")),
                };
                return Ok(());
            }
            "RDM" => {
                self.has_radii = match statement.word(1).as_str() {
                    "" | "Y" | "YES" => Some(true),
                    "N" | "NO" => Some(false),
                    _ => return Err(statement.wrong("RDM, RDM YES or RDM NO")),
                };
                return Ok(());
            }
            _ => {}
        }
        if let Some(number) = begun_surface(&keyword) {
            return self.begin_surface(number, &statement);
        }
        // `K S2 -1` and `K -1`.
        let named = statement.word(1).strip_prefix('S').and_then(|digits| digits.parse::<usize>().ok());
        let at = if named.is_some() { 2 } else { 1 };
        let count = self.blocks.len();
        match named.or(count.checked_sub(1)).filter(|index| *index < count) {
            Some(index) => self.blocks[index].take_statement(&keyword, at, &statement),
            None => Ok(()),
        }
    }

    /// Begins a surface, or gives a numbered one its radius or curvature.
    fn begin_surface(&mut self, number: Option<usize>, statement: &Statement<'_>) -> Result<(), FormatError> {
        let value = if statement.words.len() > 1 { statement.value(1)? } else { 0.0 };
        let block = Block { value, ..Block::default() };
        match number {
            // A numbered surface that is not there yet is the next one.
            Some(number) if number < self.blocks.len() => self.blocks[number].value = value,
            Some(number) if number > self.blocks.len() + 1 => return Err(statement.wrong("surfaces in order")),
            Some(1) if self.blocks.is_empty() => self.blocks.extend([Block::default(), block]),
            _ => self.blocks.push(block),
        }
        Ok(())
    }
}

/// Returns whether a keyword begins a surface, and the number that it names.
fn begun_surface(keyword: &str) -> Option<Option<usize>> {
    match keyword {
        "SO" => Some(Some(0)),
        "S" | "SI" => Some(None),
        _ => {
            let digits = keyword.strip_prefix('S')?;
            digits.parse().ok().map(Some)
        }
    }
}

impl Block {
    /// Takes a statement about this surface. Its values begin with the word `at`.
    fn take_statement(&mut self, keyword: &str, at: usize, statement: &Statement<'_>) -> Result<(), FormatError> {
        match keyword {
            "SPH" | "CON" | "ASP" | "YTO" | "XTO" | "CYL" | "AAS" | "DIF" | "GRX" | "UDS" => {
                self.kind = keyword.to_owned();
            }
            // The base of a Fresnel surface; 0 says that there is none.
            "CUF" if statement.is_number(at) && statement.value(at)? != 0.0 => self.kind = keyword.to_owned(),
            "SPS" => {
                self.kind = statement.word(at);
                if statement.is_number(at + 1) {
                    self.special.insert("SIZE".to_owned(), statement.value(at + 1)?);
                }
            }
            "SCO" => drop(self.special.insert(statement.word(at), statement.value(at + 1)?)),
            "K" => self.conic = statement.value(at)?,
            "RDY" => self.radius = Some(statement.value(at)?),
            "CUY" => self.curvature = Some(statement.value(at)?),
            "RDX" => self.radius_x = statement.value(at)?,
            "CUX" => self.curvature_x = Some(statement.value(at)?),
            "SLB" => self.label = statement.words.get(at).cloned().unwrap_or_default(),
            "CIR" if statement.is_number(at) => self.circle = Some(statement.value(at)?),
            "REX" if statement.is_number(at) => self.rectangle[0] = Some(statement.value(at)?),
            "REY" if statement.is_number(at) => self.rectangle[1] = Some(statement.value(at)?),
            "ADX" if statement.is_number(at) => self.aperture_centre[0] = statement.value(at)?,
            "ADY" if statement.is_number(at) => self.aperture_centre[1] = statement.value(at)?,
            "ARO" if !statement.is_number(at) || statement.value(at)? == 0.0 => {}
            // No outline of ours is an ellipse or turned.
            "ELX" | "ELY" | "ARO" => self.unknown_aperture = Some(keyword.to_owned()),
            letter => {
                if let Some(k) = LETTERS.iter().position(|known| *known == letter) {
                    self.letters.insert(k, statement.value(at)?);
                }
            }
        }
        Ok(())
    }

    fn surface(&self, number: usize, unit_mm: Option<f64>, has_radii: Option<bool>) -> LensSurface {
        let unit = unit_mm.unwrap_or(1.0);
        let kind = if self.kind.is_empty() { "SPH" } else { &self.kind };
        let has_terms = self.letters.values().chain(self.special.values()).any(|value| *value != 0.0);
        let curvature = self.curvature(has_radii);
        LensSurface {
            number,
            name: self.label.clone(),
            kind: kind.to_owned(),
            is_curved: curvature.as_ref().map_or(true, |curvature| *curvature != 0.0) || has_terms,
            aperture: self.aperture(unit),
            disc: self.terms_disc(unit),
            surface: match (unit_mm, curvature) {
                (None, _) => Err("the file has no unit; add a statement DIM".to_owned()),
                (_, Err(reason)) => Err(reason),
                (Some(unit), Ok(curvature)) => match &self.unknown_aperture {
                    Some(keyword) => Err(format!(
                        "its aperture ({keyword}) is an ellipse or turned; remove the statement and give --aperture"
                    )),
                    None => self.built(curvature, unit),
                },
            },
        }
    }

    /// Returns the disc of the Zernike terms: what Code V makes of them outside is not known.
    fn terms_disc(&self, unit: f64) -> Option<TermsDisc> {
        let radius_mm = (self.kind == "ZFR").then(|| self.normalisation("C3").ok())?? * unit;
        Some(TermsDisc { centre_mm: [0.0; 2], radius_mm })
    }

    /// Returns the curvature in 1/unit.
    fn curvature(&self, has_radii: Option<bool>) -> Result<f64, String> {
        let of_radius = |radius: f64| if radius == 0.0 { 0.0 } else { 1.0 / radius };
        match (self.curvature, self.radius, has_radii) {
            (Some(curvature), ..) => Ok(curvature),
            (None, Some(radius), _) => Ok(of_radius(radius)),
            (None, None, _) if self.value == 0.0 => Ok(0.0),
            (None, None, Some(true)) => Ok(of_radius(self.value)),
            (None, None, Some(false)) => Ok(self.value),
            (None, None, None) => {
                Err("the file does not say whether the number of S is a radius or a curvature; add RDM or RDM NO"
                    .to_owned())
            }
        }
    }

    fn aperture(&self, unit: f64) -> Option<Aperture> {
        let centre_mm = self.aperture_centre.map(|coordinate| coordinate * unit);
        let aperture = match (self.rectangle, self.circle) {
            ([Some(x), Some(y)], _) => {
                Aperture::Rectangle { centre_mm, width_mm: 2.0 * x * unit, height_mm: 2.0 * y * unit }
            }
            (_, Some(radius)) => Aperture::Circle { centre_mm, radius_mm: radius * unit },
            _ => return None,
        };
        aperture.validate().is_ok().then_some(aperture)
    }

    fn coefficient(&self, name: &str) -> f64 {
        self.special.get(name).copied().unwrap_or(0.0)
    }

    fn normalisation(&self, other: &str) -> Result<f64, String> {
        let radius = self.special.get("NRADIUS").or_else(|| self.special.get(other)).copied().unwrap_or(0.0);
        if radius > 0.0 { Ok(radius) } else { Err("it has no normalisation radius (NRADIUS)".to_owned()) }
    }

    fn built(&self, curvature: f64, unit: f64) -> Built {
        let conic = if self.conic != 0.0 { self.conic } else { self.coefficient("K") };
        let base = Base { curvature_per_mm: curvature / unit, conic };
        let letters: Vec<(u32, f64)> =
            (self.letters.iter()).map(|(k, a)| (2 * *k as u32 + 4, a * unit.powi(1 - (2 * *k as i32 + 4)))).collect();
        match self.kind.as_str() {
            "" | "SPH" if self.letters.is_empty() && conic == 0.0 => base.conic(),
            "" | "SPH" | "CON" if self.letters.is_empty() => base.conic(),
            "ASP" => base.asphere(&letters),
            "YTO" => {
                let of_curvature = |c: f64| if c == 0.0 { f64::INFINITY } else { unit / c };
                let of_radius = if self.radius_x == 0.0 { f64::INFINITY } else { self.radius_x * unit };
                base.toroid(self.curvature_x.map_or(of_radius, of_curvature), &letters)
            }
            "XYP" => {
                let radius = self.special.get("NRADIUS").copied().unwrap_or(1.0);
                if radius <= 0.0 {
                    return Err(format!("its normalisation radius is {radius}; it must be above 0"));
                }
                let base = Base { conic: conic + self.coefficient("C1"), ..base };
                let terms = (2..).zip(polynomial_order()).take(300);
                let terms = terms.map(|(k, (i, j))| (i, j, self.coefficient(&format!("C{k}")) * unit)).collect();
                base.xy_polynomial(radius * unit, terms)
            }
            "ZFR" => {
                let base = Base { conic: conic + self.coefficient("C1"), ..base };
                let radius_mm = self.normalisation("C3")? * unit;
                let values: Vec<f64> = (4..=40).map(|k| self.coefficient(&format!("C{k}")) * unit).collect();
                sum(base.conic(), zernike(true, radius_mm, &values), [0.0; 2])
            }
            kind @ ("QBF" | "QCN") => {
                let is_qcon = kind == "QCN";
                let (first, last, conic) = if is_qcon { (4, 16, self.coefficient("C17")) } else { (3, 20, 0.0) };
                let base = Base { conic: base.conic + conic, ..base };
                // Listings name the coefficients of Qbfs by the power too: QB4 is C3.
                let named = |k: i32| self.coefficient(&format!("C{k}")) + self.coefficient(&format!("QB{}", 2 * k - 2));
                let value = |k: i32| if is_qcon { self.coefficient(&format!("C{k}")) } else { named(k) };
                let mut values: Vec<f64> = (first..=last).map(|k| value(k) * unit).collect();
                while values.len() > 1 && values.last() == Some(&0.0) {
                    values.pop();
                }
                base.forbes(is_qcon, self.normalisation("C1")? * unit, values)
            }
            other => Err(format!(
                "surfaces of the type {other} are not read; sample the sag as points, or write its equation into a definition"
            )),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn statements_by_hand() {
        let text = "rdm;len\ntitle 'one; two' ! a comment; more\ns 85.0 5 \"N;BK7\"\nasp; k -0.7; b 1 &\nc 2\n";
        let found = statements(text);
        let words: Vec<Vec<&str>> = found.iter().map(|(_, words)| words.iter().map(String::as_str).collect()).collect();
        let expected: [&[&str]; 7] = [
            &["rdm"],
            &["len"],
            &["title", "one; two"],
            &["s", "85.0", "5", "N;BK7"],
            &["asp"],
            &["k", "-0.7"],
            &["b", "1", "c", "2"],
        ];
        assert_eq!(words, expected);
        assert_eq!(found[3].0, 3);
    }
}
