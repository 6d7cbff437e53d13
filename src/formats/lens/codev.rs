//! Surfaces of a sequence file of Code V (`.seq`).
//!
//! Statements end at the end of a line or at `;`; `&` continues a line, `!` begins a comment. `SO`, `S` and `SI` begin a
//! surface, with radius or curvature, thickness and glass; other statements belong to the surface above, or name one
//! (`K S2 -1`). `DIM M` is millimetre. `RDM` says that the number of `S` is a radius.

use std::collections::BTreeMap;
use std::iter::Peekable;
use std::path::Path;
use std::str::Chars;

use regrind_core::geometry::Aperture;

use super::super::error::{FormatError, excerpt};
use super::build::{Base, Built, polynomial_order, sum, zernike};
use super::model::{LensModel, LensSurface, TermsDisc};

/// Letters of the coefficients of r^4 to r^20. Code V has no I.
const LETTERS: [&str; 9] = ["A", "B", "C", "D", "E", "F", "G", "H", "J"];

/// Types of `SPS` that are read.
const SPECIAL: [&str; 4] = ["XYP", "ZFR", "QBF", "QCN"];

/// Index of the last coefficient of a polynomial XYP: y^10.
const LAST_OF_XYP: u32 = 66;

/// Name under which the number behind the type of `SPS` is kept. No coefficient of a file has it, for it has a blank.
const SIZE: &str = "number of SPS";

/// Largest number of surfaces that are read, so that they need no more memory than fits the file.
const MAX_SURFACES: usize = 10_000;

/// Keywords of the statements about a surface that are read, besides the letters.
const OF_SURFACES: [&str; 27] = [
    "SPH", "CON", "ASP", "YTO", "XTO", "CYL", "AAS", "DIF", "GRX", "UDS", "CUF", "SPS", "SCO", "K", "RDY", "CUY",
    "RDX", "CUX", "SLB", "CIR", "REX", "REY", "ADX", "ADY", "ARO", "ELX", "ELY",
];

/// Statements that change earlier surfaces. Their effect is not read, so they are refused.
const CHANGES: [&str; 9] = ["SCA", "DEL", "INS", "FLY", "COP", "MOV", "INT", "IN", "RES"];

/// Surface as the file has it.
#[derive(Clone, Default)]
struct Block {
    label: String,
    /// Whether the number of its `S` statement is a radius. `None` if the file did not say so before it.
    has_radii: Option<bool>,
    /// True for the image surface, and for a surface behind which another one stands.
    is_complete: bool,
    /// Word of the type: SPH, CON, ASP, YTO and so on; `XYP` and its like of a special surface.
    kind: String,
    /// Number of the `S` statement: a radius or a curvature.
    value: f64,
    /// Curvature that the last statement `CUY` or `RDY` gives, and that of `CUX` or `RDX`.
    curvature: Option<f64>,
    curvature_x: f64,
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
    let mut statements = Statements::new(text);
    while let Some((line, words)) = statements.next() {
        if words[0].keyword() == "PRV" {
            // Data of glasses, whose names can be any word.
            if !statements.any(|(_, words)| words[0].keyword() == "END") {
                return Err(Statement { path, line, words: &words }.wrong("END behind the private glasses (PRV)"));
            }
            continue;
        }
        reader.take_statement(line, &words)?;
    }
    let Reader { blocks, unit_mm, .. } = reader;
    if blocks.is_empty() {
        return Err(FormatError::NoData { path: path.to_owned(), expected: "surface" });
    }
    let surfaces = (0..).zip(&blocks).map(|(number, block)| block.surface(number, unit_mm)).collect();
    Ok(LensModel { surfaces })
}

/// Word of a statement. A text in quotes is one word, and neither a keyword nor a number.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct StatementWord {
    text: String,
    is_quoted: bool,
}

impl StatementWord {
    /// Returns the word in upper case; empty for a text in quotes.
    pub(super) fn keyword(&self) -> String {
        if self.is_quoted { String::new() } else { self.text.to_uppercase() }
    }
}

/// Statements of a text, each with the number of its line.
pub(super) struct Statements<'a> {
    rest: Peekable<Chars<'a>>,
    line: usize,
}

impl<'a> Statements<'a> {
    pub(super) fn new(text: &'a str) -> Self {
        Self { rest: text.chars().peekable(), line: 1 }
    }

    /// Reads a text up to its closing `mark`; a doubled mark is one of the text. It ends with its line, whatever quotes
    /// say.
    fn quoted(&mut self, mark: char) -> StatementWord {
        let mut text = String::new();
        while let Some(c) = self.rest.next_if(|c| !is_line_end(*c)) {
            if c == mark && self.rest.next_if_eq(&mark).is_none() {
                break;
            }
            text.push(c);
        }
        StatementWord { text, is_quoted: true }
    }

    /// Returns true if nothing, or a comment, stands in the rest of the line.
    fn is_at_end_of_line(&self) -> bool {
        let mut rest = self.rest.clone().take_while(|c| !is_line_end(*c));
        rest.find(|c| !c.is_whitespace()).is_none_or(|c| c == '!')
    }

    fn skip_line(&mut self) {
        while self.rest.next_if(|c| !is_line_end(*c)).is_some() {}
    }
}

fn is_line_end(c: char) -> bool {
    matches!(c, '\n' | '\r')
}

impl Iterator for Statements<'_> {
    type Item = (usize, Vec<StatementWord>);

    fn next(&mut self) -> Option<Self::Item> {
        let (mut words, mut word, mut begin) = (Vec::new(), String::new(), self.line);
        let close = |word: &mut String, words: &mut Vec<StatementWord>| {
            if !word.is_empty() {
                words.push(StatementWord { text: std::mem::take(word), is_quoted: false });
            }
        };
        while let Some(c) = self.rest.next() {
            match c {
                '!' => self.skip_line(),
                '&' if self.is_at_end_of_line() => {
                    close(&mut word, &mut words);
                    self.skip_line();
                    self.rest.next_if_eq(&'\r');
                    self.rest.next_if_eq(&'\n');
                    self.line += 1;
                }
                '\'' | '"' => {
                    close(&mut word, &mut words);
                    words.push(self.quoted(c));
                }
                ';' | '\n' | '\r' => {
                    close(&mut word, &mut words);
                    // Lines end with LF, CR LF or CR.
                    let is_first_of_two = c == '\r' && self.rest.peek() == Some(&'\n');
                    self.line += usize::from(is_line_end(c) && !is_first_of_two);
                    if !words.is_empty() {
                        return Some((begin, words));
                    }
                    begin = self.line;
                }
                c if c.is_whitespace() => close(&mut word, &mut words),
                c => word.push(c),
            }
        }
        close(&mut word, &mut words);
        (!words.is_empty()).then_some((begin, words))
    }
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
    words: &'a [StatementWord],
}

impl Statement<'_> {
    fn wrong(&self, expected: &str) -> FormatError {
        FormatError::Unexpected {
            path: self.path.to_owned(),
            place: format!("line {}", self.line),
            expected: expected.to_owned(),
            found: excerpt(self.words.iter().map(|word| &word.text[..]).collect::<Vec<_>>().join(" ").as_bytes()),
        }
    }

    /// Returns a word in upper case; empty if there is none, or a text in quotes.
    fn word(&self, at: usize) -> String {
        self.words.get(at).map(StatementWord::keyword).unwrap_or_default()
    }

    fn value(&self, at: usize) -> Result<f64, FormatError> {
        self.number(at).filter(|value| value.is_finite()).ok_or_else(|| self.wrong("a number"))
    }

    fn is_number(&self, at: usize) -> bool {
        self.number(at).is_some()
    }

    fn number(&self, at: usize) -> Option<f64> {
        self.words.get(at).filter(|word| !word.is_quoted).and_then(|word| word.text.parse().ok())
    }
}

impl Reader<'_> {
    fn take_statement(&mut self, line: usize, words: &[StatementWord]) -> Result<(), FormatError> {
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
        let is_of_surface = |keyword: &str| {
            OF_SURFACES.contains(&keyword) || LETTERS.contains(&keyword) || begun_surface(keyword).is_some()
        };
        // The zoom and the pickup of other values, such as of a field or a thickness, change no shape.
        let changes_shape = matches!(&keyword[..], "ZOO" | "PIK") && is_of_surface(&statement.word(1));
        if changes_shape || CHANGES.contains(&&keyword[..]) {
            return Err(statement.wrong(
                "no statement that changes surfaces afterwards; save the lens again as it is then, and read that file",
            ));
        }
        if is_coefficient(&keyword) {
            return Err(statement.wrong(&format!("SCO before the coefficient {keyword}")));
        }
        if !OF_SURFACES.contains(&keyword.as_str()) && !LETTERS.contains(&keyword.as_str()) {
            return Ok(());
        }
        // `K S2 -1` and `K -1`.
        let named = match statement.word(1).strip_prefix('S') {
            Some(name) if name.starts_with(|c: char| c.is_ascii_digit()) => {
                Some(name.parse::<usize>().map_err(|_| statement.wrong("the number of one surface"))?)
            }
            _ => None,
        };
        let at = if named.is_some() { 2 } else { 1 };
        let index = named.or(self.blocks.len().checked_sub(1));
        match index.and_then(|index| self.blocks.get_mut(index)) {
            Some(block) => block.take_statement(&keyword, at, &statement),
            None => Err(statement.wrong("a statement about a surface that is already there")),
        }
    }

    /// Begins a surface, or gives a numbered one its radius or curvature.
    fn begin_surface(&mut self, number: Option<usize>, statement: &Statement<'_>) -> Result<(), FormatError> {
        let value = if statement.words.len() > 1 { statement.value(1)? } else { 0.0 };
        let is_complete = statement.word(0) == "SI";
        let block = Block { value, has_radii: self.has_radii, is_complete, ..Block::default() };
        match number {
            // A numbered surface that is not there yet is the next one.
            Some(number) if number < self.blocks.len() => {
                let known = &mut self.blocks[number];
                (known.value, known.has_radii, known.curvature) = (value, self.has_radii, None);
                return Ok(());
            }
            Some(1) if self.blocks.is_empty() => self.blocks.extend([Block::default(), block]),
            Some(number) if number > self.blocks.len() => {
                return Err(statement.wrong(&format!("surface {} before this one", self.blocks.len())));
            }
            _ if self.blocks.len() >= MAX_SURFACES => {
                return Err(statement.wrong(&format!("at most {MAX_SURFACES} surfaces")));
            }
            _ => self.blocks.push(block),
        }
        if let Some((_, before)) = self.blocks.split_last_mut() {
            before.iter_mut().rev().take(1).for_each(|block| block.is_complete = true);
        }
        Ok(())
    }
}

/// Returns true for the name of a coefficient, such as C4 or QB6, which is a statement only behind SCO.
fn is_coefficient(keyword: &str) -> bool {
    let is_number = |digits: &str| !digits.is_empty() && digits.bytes().all(|b| b.is_ascii_digit());
    ["C", "QB", "QC"].iter().any(|prefix| keyword.strip_prefix(prefix).is_some_and(is_number))
}

/// Returns the curvature of a radius, of which 0 is a plane.
fn curvature_of(radius: f64) -> f64 {
    if radius == 0.0 { 0.0 } else { 1.0 / radius }
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
        // A statement has one value; what stands behind it would be lost.
        let values = match keyword {
            "SCO" | "SPS" => 2,
            "SLB" | "CIR" | "REX" | "REY" | "ELX" | "ELY" | "ADX" | "ADY" | "ARO" | "DIF" | "GRX" | "UDS" => usize::MAX,
            _ => 1,
        };
        if statement.words.len().saturating_sub(at) > values {
            return Err(statement.wrong(&format!("nothing behind the value of {keyword}; begin another statement")));
        }
        match keyword {
            "SPH" | "CON" | "ASP" | "YTO" | "XTO" | "CYL" | "AAS" | "DIF" | "GRX" | "UDS" => {
                self.kind = keyword.to_owned();
            }
            // The base of a Fresnel surface; 0 says that there is none.
            "CUF" if statement.is_number(at) && statement.value(at)? != 0.0 => self.kind = keyword.to_owned(),
            "SPS" => {
                self.kind = statement.word(at);
                if statement.is_number(at + 1) {
                    self.special.insert(SIZE.to_owned(), statement.value(at + 1)?);
                }
            }
            "SCO" => drop(self.special.insert(statement.word(at), statement.value(at + 1)?)),
            "K" => self.conic = statement.value(at)?,
            "RDY" => self.curvature = Some(curvature_of(statement.value(at)?)),
            "CUY" => self.curvature = Some(statement.value(at)?),
            "RDX" => self.curvature_x = curvature_of(statement.value(at)?),
            "CUX" => self.curvature_x = statement.value(at)?,
            "SLB" => self.label = statement.words.get(at).map(|word| word.text.clone()).unwrap_or_default(),
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

    fn surface(&self, number: usize, unit_mm: Option<f64>) -> LensSurface {
        let unit = unit_mm.unwrap_or(1.0);
        let kind = if self.kind.is_empty() { "SPH" } else { &self.kind };
        let has_terms = self.letters.values().chain(self.special.values()).any(|value| *value != 0.0);
        let curvature = self.curvature(self.has_radii);
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
                _ if !self.is_complete => {
                    Err("the file ends with it, and can be cut in it; a lens ends with its image \
                    surface (SI): save it again"
                        .to_owned())
                }
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
        let radius_mm = (self.kind == "ZFR").then(|| self.needed_normalisation("C3").ok())?? * unit;
        Some(TermsDisc { centre_mm: [0.0; 2], radius_mm })
    }

    /// Returns the curvature in 1/unit.
    fn curvature(&self, has_radii: Option<bool>) -> Result<f64, String> {
        match (self.curvature, has_radii) {
            (Some(curvature), _) => Ok(curvature),
            (None, _) if self.value == 0.0 => Ok(0.0),
            (None, Some(true)) => Ok(curvature_of(self.value)),
            (None, Some(false)) => Ok(self.value),
            (None, None) => {
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

    /// Returns the normalisation radius in the unit of the file, of which `alias` is another name; `None` if the file
    /// states none.
    fn normalisation(&self, alias: &str) -> Result<Option<f64>, String> {
        let stated = ["NRADIUS", alias].map(|name| (name, self.special.get(name).copied()));
        if let Some((name, radius)) = stated.iter().find_map(|(name, radius)| Some((name, (*radius)?)))
            && radius <= 0.0
        {
            return Err(format!("its normalisation radius ({name}) is {radius}; it must be above 0"));
        }
        let radius = only(&stated.map(|(name, radius)| (name, radius.unwrap_or(0.0))))?;
        // The number behind the type repeats the radius in the files that are known.
        match (self.coefficient(SIZE), radius) {
            (0.0, radius) => Ok(radius),
            (size, Some(radius)) if size == radius => Ok(Some(radius)),
            (size, _) => Err(format!(
                "the number of its SPS is {size}, which is not its normalisation radius; state the radius as SCO NRADIUS"
            )),
        }
    }

    fn needed_normalisation(&self, alias: &str) -> Result<f64, String> {
        self.normalisation(alias)?.ok_or_else(|| "it has no normalisation radius (NRADIUS)".to_owned())
    }

    /// Returns the conic constant, of which `alias` is another name.
    fn conic(&self, alias: &str) -> Result<f64, String> {
        let stated = [("K", self.conic), ("SCO K", self.coefficient("K")), (alias, self.coefficient(alias))];
        Ok(only(&stated)?.unwrap_or(0.0))
    }

    /// Checks that the surface has no coefficient that its type does not use.
    fn check_coefficients(&self) -> Result<(), String> {
        let kind = &self.kind[..];
        let is_special = SPECIAL.contains(&kind);
        let unknown =
            |name: &str| format!("its coefficient {name} is not known for surfaces of the type {kind}; remove it");
        if let Some((name, _)) = self.special.iter().find(|(name, value)| **value != 0.0 && !is_known(kind, name)) {
            return Err(unknown(name));
        }
        match self.letters.iter().find(|(_, value)| **value != 0.0) {
            Some((letter, _)) if is_special => Err(unknown(LETTERS[*letter])),
            _ => Ok(()),
        }
    }

    fn built(&self, curvature: f64, unit: f64) -> Built {
        let curvature_per_mm = curvature / unit;
        let letters: Vec<(u32, f64)> =
            (self.letters.iter()).map(|(k, a)| (2 * *k as u32 + 4, a * unit.powi(1 - (2 * *k as i32 + 4)))).collect();
        let is_conic = letters.iter().all(|(_, a)| *a == 0.0);
        let base = Base { curvature_per_mm, conic: self.conic };
        match self.kind.as_str() {
            kind if SPECIAL.contains(&kind) => {
                self.check_coefficients()?;
                self.special(curvature_per_mm, unit)
            }
            "" | "SPH" | "CON" if is_conic => self.check_coefficients().and_then(|()| base.conic()),
            "ASP" => self.check_coefficients().and_then(|()| base.asphere(&letters)),
            "YTO" => {
                self.check_coefficients()?;
                let radius_x_mm = if self.curvature_x == 0.0 { f64::INFINITY } else { unit / self.curvature_x };
                base.toroid(radius_x_mm, &letters)
            }
            other => Err(format!(
                "surfaces of the type {other} are not read; sample the sag as points, or write its equation into a definition"
            )),
        }
    }

    /// Returns a surface of the types of `SPS`.
    fn special(&self, curvature_per_mm: f64, unit: f64) -> Built {
        let base = |alias: &str| Ok::<_, String>(Base { curvature_per_mm, conic: self.conic(alias)? });
        let value = |k: u32| self.coefficient(&format!("C{k}"));
        match self.kind.as_str() {
            "XYP" => {
                let radius = self.normalisation("NRADIUS")?.unwrap_or(1.0);
                let terms = (2..=LAST_OF_XYP).zip(polynomial_order());
                let terms = terms.map(|(k, (i, j))| (i, j, value(k) * unit)).collect();
                base("C1")?.xy_polynomial(radius * unit, terms)
            }
            "ZFR" => {
                let radius_mm = self.needed_normalisation("C3")? * unit;
                let values: Vec<f64> = (4..=40).map(|k| value(k) * unit).collect();
                sum(base("C1")?.conic(), zernike(true, radius_mm, &values), [0.0; 2])
            }
            kind => {
                let is_qcon = kind == "QCN";
                let (first, last, alias) = if is_qcon { (4, 16, "C17") } else { (3, 20, "K") };
                // Listings name the coefficients of Qbfs by the power too: QB4 is C3.
                let named = |k: u32| {
                    let (index, power) = (format!("C{k}"), format!("QB{}", 2 * k - 2));
                    only(&[(&index, self.coefficient(&index)), (&power, self.coefficient(&power))])
                };
                let value = |k: u32| if is_qcon { Ok(value(k)) } else { named(k).map(Option::unwrap_or_default) };
                let values = (first..=last).map(|k| value(k).map(|value| value * unit));
                let mut values: Vec<f64> = values.collect::<Result<_, _>>()?;
                while values.len() > 1 && values.last() == Some(&0.0) {
                    values.pop();
                }
                base(alias)?.forbes(is_qcon, self.needed_normalisation("C1")? * unit, values)
            }
        }
    }
}

/// Returns the value that is not 0, of names for one coefficient; `None` if all are 0.
fn only(stated: &[(&str, f64)]) -> Result<Option<f64>, String> {
    let mut found: Option<(&str, f64)> = None;
    for &(name, value) in stated.iter().filter(|(_, value)| *value != 0.0) {
        match found {
            Some((other, first)) if first != value => {
                return Err(format!(
                    "its {other} is {first} and its {name} is {value}, but both are one coefficient; remove one"
                ));
            }
            _ => found = Some((name, value)),
        }
    }
    Ok(found.map(|(_, value)| value))
}

/// Returns true if a coefficient of `SCO` has a known meaning for a type of surface.
fn is_known(kind: &str, name: &str) -> bool {
    let index = |prefix: &str| {
        let index = name.strip_prefix(prefix)?.parse::<u32>().ok()?;
        (format!("{prefix}{index}") == name).then_some(index)
    };
    let numbered = |known: fn(u32) -> bool| index("C").is_some_and(known);
    let is_general = matches!(name, "K" | "NRADIUS" | SIZE);
    match kind {
        "XYP" => is_general || numbered(|k| (1..=LAST_OF_XYP).contains(&k)),
        "ZFR" => is_general || numbered(|k| matches!(k, 1 | 3..=40)),
        "QBF" => {
            let is_power = index("QB").is_some_and(|power| power % 2 == 0 && (4..=38).contains(&power));
            is_general || is_power || numbered(|k| matches!(k, 1 | 3..=20))
        }
        "QCN" => is_general || numbered(|k| matches!(k, 1 | 4..=17)),
        _ => false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn statements(text: &str) -> Vec<(usize, Vec<String>)> {
        // Marks texts in quotes.
        let shown = |word: &StatementWord| if word.is_quoted { format!("<{}>", word.text) } else { word.text.clone() };
        Statements::new(text).map(|(line, words)| (line, words.iter().map(shown).collect())).collect()
    }

    #[test]
    fn statements_by_hand() {
        let text = "rdm;len\ntitle 'one; two' ! a comment; more\ns 85.0 5 \"N;BK7\"\nasp; k -0.7; b 1 &\nc 2\n";
        let expected: [(usize, &[&str]); 7] = [
            (1, &["rdm"]),
            (1, &["len"]),
            (2, &["title", "<one; two>"]),
            (3, &["s", "85.0", "5", "<N;BK7>"]),
            (4, &["asp"]),
            (4, &["k", "-0.7"]),
            (4, &["b", "1", "c", "2"]),
        ];
        let expected: Vec<(usize, Vec<String>)> =
            expected.map(|(line, words)| (line, words.iter().map(ToString::to_string).collect())).to_vec();
        assert_eq!(statements(text), expected);
    }

    #[test]
    fn quotes_and_continuations_by_hand() {
        let words = |text: &str| -> Vec<Vec<String>> { statements(text).into_iter().map(|(_, words)| words).collect() };
        assert_eq!(words("slb 'it''s; one' 2"), [["slb", "<it's; one>", "2"]]);
        assert_eq!(words("gla \"a 'b' ! c & d\""), [["gla", "<a 'b' ! c & d>"]]);
        assert_eq!(words("slb ''\r\nk 1"), [vec!["slb", "<>"], vec!["k", "1"]]);
        // A text that is not closed ends with its line.
        assert_eq!(words("tit 'open; s 1\r\nk 1"), [vec!["tit", "<open; s 1>"], vec!["k", "1"]]);
        // A mark of continuation is the last one of its line.
        assert_eq!(words("tit a & b\nk 1"), [vec!["tit", "a", "&", "b"], vec!["k", "1"]]);
        assert_eq!(words("a 1& ! more\r\n2; b"), [vec!["a", "1", "2"], vec!["b"]]);
        for end in ["\n", "\r\n", "\r"] {
            let text = ["! s 1", "a &", "1", "", "b"].join(end);
            let found: Vec<usize> = statements(&text).into_iter().map(|(line, _)| line).collect();
            assert_eq!(found, [2, 5], "{end:?}");
        }
    }
}
