//! Detection of the columns that are coordinates, by their names in the header: names are understood completely or
//! rejected.
//!
//! A name consists of an axis and of words that say which points it belongs to: `X_act`, `Measured X`, `x (nominal)
//! [mm]`. Most machines write measured and nominal points in the same table. If the nominal points were read as
//! measured ones, every part would appear good. So a header with two groups of coordinates is ambiguous and requires a
//! choice, and a header that names no group at all is not read in the usual order.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::fmt;
use std::ops::Range;
use std::path::Path;
use std::str::FromStr;

use regrind_core::geometry::{Point, Vector};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::error::{FormatError, excerpt};
use super::unit::Unit;

/// Columns and units of a table of points, or the distance of the samples of a map, given by a person because the file
/// does not state them clearly.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Table {
    /// Columns of x, y and z; `None` for those that the header names.
    pub columns: Option<Columns>,
    /// Unit of the coordinates. `None` means millimetres; a table that states another unit is then rejected.
    pub unit: Option<Unit>,
    /// Unit of z, if it differs from that of x and y.
    pub height_unit: Option<Unit>,
    /// Distance of the samples of a map along x and y, in mm, if the map does not state it.
    pub sample_spacing_mm: Option<f64>,
}

impl Table {
    /// Returns the units of x, y and z, in this order. x and y have the unit [`Self::unit`]; if it is `None`, they are
    /// in millimetres. z has the unit [`Self::height_unit`]; if it is `None`, z has the unit of x and y.
    pub(super) fn units(&self) -> [Unit; 3] {
        let unit = self.unit.unwrap_or_default();
        [unit, unit, self.height_unit.unwrap_or(unit)]
    }

    /// Converts `points` from the units of this table to millimetres, in place.
    pub(super) fn to_mm(&self, points: &mut [Point]) {
        let units_mm = self.units().map(Unit::in_mm);
        if units_mm != [1.0; 3] {
            let units_mm = Vector::from(units_mm);
            points.iter_mut().for_each(|point| point.coords.component_mul_assign(&units_mm));
        }
    }
}

/// Columns of a table that hold x, y and z: `x=X_act,y=Y_act,z=Z_act` by their names, or `x=4,y=5,z=6` by their numbers
/// from 1.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(try_from = "String", into = "String")]
#[schemars(with = "String")]
pub struct Columns([Column; 3]);

#[derive(Clone, Debug, PartialEq, Eq)]
enum Column {
    /// Name of the column in the header, in lower case.
    Named(String),
    /// Index of the column, from 0.
    Numbered(usize),
}

impl FromStr for Columns {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let expected = || format!("expected x=NAME,y=NAME,z=NAME, each a name or a number from 1, found `{text}`");
        let mut found: [Option<Column>; 3] = [None, None, None];
        for part in text.split(',') {
            let (axis, column) = part.split_once('=').ok_or_else(expected)?;
            let axis =
                ["x", "y", "z"].iter().position(|of| axis.trim().eq_ignore_ascii_case(of)).ok_or_else(expected)?;
            let column = match (column.trim(), column.trim().parse::<usize>()) {
                ("", _) | (_, Ok(0)) => return Err(expected()),
                (_, Ok(number)) => Column::Numbered(number - 1),
                (name, Err(_)) => Column::Named(name.to_lowercase()),
            };
            if found[axis].replace(column).is_some() {
                return Err(expected());
            }
        }
        let [Some(x), Some(y), Some(z)] = found else { return Err(expected()) };
        if x == y || y == z || x == z {
            return Err(format!("`{text}` gives one column to two axes"));
        }
        Ok(Self([x, y, z]))
    }
}

impl TryFrom<String> for Columns {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        text.parse()
    }
}

impl From<Columns> for String {
    fn from(columns: Columns) -> Self {
        columns.to_string()
    }
}

impl fmt::Display for Columns {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (k, (axis, column)) in ["x", "y", "z"].into_iter().zip(&self.0).enumerate() {
            f.write_str(if k > 0 { "," } else { "" })?;
            match column {
                Column::Named(name) => write!(f, "{axis}={name}")?,
                Column::Numbered(number) => write!(f, "{axis}={}", number + 1)?,
            }
        }
        Ok(())
    }
}

impl Columns {
    /// Returns true if the header contains all columns that `self` gives by name. `self` gives the name or the number
    /// of each of the columns x, y and z. `names` are the names in the header, in lower case. Each name in `self` must
    /// occur in `names` exactly once. Columns given by number are not checked.
    pub(super) fn are_in(&self, names: &[String]) -> bool {
        self.0.iter().all(|column| match column {
            Column::Named(_) => column.among(names).len() == 1,
            Column::Numbered(_) => true,
        })
    }

    /// Returns true if x, y and z are all given by the number of their column, so that no header is needed.
    pub(super) fn are_numbers(&self) -> bool {
        self.0.iter().all(|column| matches!(column, Column::Numbered(_)))
    }

    /// Returns the indices of the columns x, y and z in a table, counted from 0. `names` are the names in the header of
    /// the table, and `count` is the number of its columns.
    ///
    /// # Errors
    /// A column number above `count`; a column name that does not occur exactly once in `names`; the same column for
    /// two axes. The error text continues a sentence that begins with "the header", such as "has 3 columns, and no
    /// column 5". It is used as the `reason` of [`FormatError::HeaderNames`].
    pub(super) fn places(&self, names: &[String], count: usize) -> Result<[usize; 3], String> {
        let mut places = [0; 3];
        for (place, column) in places.iter_mut().zip(&self.0) {
            *place = match (column, &column.among(names)[..]) {
                (Column::Numbered(number), _) if *number < count => *number,
                (Column::Numbered(number), _) => {
                    return Err(format!("has {count} columns, and no column {}", number + 1));
                }
                (Column::Named(_), [place]) => *place,
                (Column::Named(name), found) => return Err(format!("names {} columns `{name}`", found.len())),
            };
        }
        if places[0] == places[1] || places[1] == places[2] || places[0] == places[2] {
            return Err("gives one column to two axes".to_owned());
        }
        Ok(places)
    }
}

impl Column {
    /// Returns the indices of all entries of `names` that are equal to the name of this column. A unit in an entry is
    /// ignored: the column `x` also finds `x [mm]`. Returns an empty list if this column is given by its number.
    fn among(&self, names: &[String]) -> Vec<usize> {
        let Self::Named(wanted) = self else { return Vec::new() };
        let is = |name: &String| name.trim() == wanted || split_unit(name).0 == wanted;
        (0..names.len()).filter(|&column| is(&names[column])).collect()
    }
}

/// Points that a column belongs to: measured, nominal or not stated.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Group {
    /// The name does not state the group.
    Plain,
    Measured,
    Nominal,
}

impl Group {
    const ALL: [Self; 3] = [Self::Plain, Self::Measured, Self::Nominal];

    /// Returns the words that assign a column to this group of points, in several languages and in lower case. For
    /// example, `act` in a column name means measured points, and `soll` means nominal points.
    fn words(self) -> &'static [&'static str] {
        match self {
            Self::Plain => &["coord", "coordinate", "coordinates", "pos", "position", "koordinate", "koord"],
            Self::Measured => &[
                "act",
                "actual",
                "actuals",
                "meas",
                "measured",
                "measurement",
                "ist",
                "istwert",
                "gemessen",
                "mes",
                "mesure",
                "mesuré",
                "mesurée",
                "mis",
                "misurato",
                "med",
                "medido",
                "real",
                "reel",
                "réel",
            ],
            Self::Nominal => &[
                "nom",
                "nominal",
                "nominals",
                "soll",
                "sollwert",
                "theo",
                "theor",
                "theoretical",
                "theorique",
                "théorique",
                "target",
                "ref",
                "reference",
                "design",
                "cad",
                "nominale",
                "teorico",
            ],
        }
    }
}

impl fmt::Display for Group {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Plain => "plain",
            Self::Measured => "measured",
            Self::Nominal => "nominal",
        })
    }
}

/// Returns the meaning of a column name: the axis (0 for x, 1 for y, 2 for z) and the group of points (measured,
/// nominal or not stated). For example, `x_act` is the axis 0 of the measured points. `name` must be in lower case and
/// without a unit.
///
/// Returns `None` if `name` contains no axis, more than one axis, words of two groups, or any other word.
fn axis_of(name: &str) -> Option<(usize, Group)> {
    let mut axis = None;
    let mut group = Group::Plain;
    let mut take = |word: &str| -> bool {
        if let Some(found) = ["x", "y", "z"].iter().position(|of| *of == word) {
            return axis.replace(found).is_none();
        }
        let Some(of) = Group::ALL.into_iter().find(|of| of.words().contains(&word)) else { return false };
        let is_new = of == Group::Plain || group == Group::Plain || of == group;
        group = if of == Group::Plain { group } else { of };
        is_new
    };
    for word in name.split(|c: char| !c.is_alphanumeric()).filter(|word| !word.is_empty()) {
        let is_known = take(word) || {
            // Names without a separator: xact, actx.
            let after = word.strip_prefix(['x', 'y', 'z']).map(|rest| (&word[..1], rest));
            let before = word.strip_suffix(['x', 'y', 'z']).map(|rest| (&word[rest.len()..], rest));
            let is_group = |rest: &str| Group::ALL.iter().any(|of| of.words().contains(&rest));
            let split = [after, before].into_iter().flatten().find(|(_, rest)| is_group(rest));
            split.is_some_and(|(axis, rest)| take(axis) && take(rest))
        };
        if !is_known {
            return None;
        }
    }
    axis.map(|axis| (axis, group))
}

/// Columns that hold coordinates: their indices, from 0, by group and axis.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Axes {
    groups: [[Vec<usize>; 3]; 3],
    /// A word that occurs in the names of all three axes and that belongs to none of the known groups.
    unknown: Option<String>,
}

/// Words in the name of a column which show that it is not a coordinate, but for example a deviation, a direction, a
/// tolerance or an uncertainty.
#[rustfmt::skip]
const NON_COORDINATE_WORDS: [&str; 41] = [
    "d", "dev", "devs", "deviation", "delta", "diff", "difference", "err", "error", "off", "offset", "abw", "abweichung", "ecart", "écart", "n", "norm", "normal", "normale", "normalvector", "dir", "direction",
    "vec", "vector", "cos", "i", "tol", "tolerance", "upper", "lower", "u", "unc", "uncertainty", "sigma", "std", "rms", "res", "resolution", "scatter", "weight", "quality",
];

/// Splits a column name into its axis and the rest. Returns the axis (0 for x, 1 for y, 2 for z) and the rest of the
/// name: `x probe` gives 0 and `probe`. If `name` is one word, its first or last letter must be the axis: `xprobe`
/// gives the same result. `name` must be in lower case.
///
/// Returns `None` if `name` contains no axis, or if nothing remains without the axis.
fn axis_in_name(name: &str) -> Option<(usize, String)> {
    let axis_of = |word: &str| ["x", "y", "z"].iter().position(|of| *of == word);
    let words: Vec<&str> = name.split(|c: char| !c.is_alphanumeric()).filter(|word| !word.is_empty()).collect();
    match words[..] {
        [word] => {
            let (first, last) = (word.chars().next()?, word.chars().next_back()?);
            let (before, behind) = (&word[..word.len() - last.len_utf8()], &word[first.len_utf8()..]);
            let found = axis_of(&first.to_string()).map(|axis| (axis, behind));
            let (axis, rest) = found.or_else(|| Some((axis_of(&last.to_string())?, before)))?;
            Some((axis, rest.to_owned())).filter(|(_, rest)| !rest.is_empty())
        }
        _ => {
            let at = words.iter().position(|word| axis_of(word).is_some())?;
            let rest: Vec<&str> = (0..words.len()).filter(|k| *k != at).map(|k| words[k]).collect();
            Some((axis_of(words[at])?, rest.join(" "))).filter(|(_, rest)| !rest.is_empty())
        }
    }
}

impl Axes {
    pub(super) fn from_names(names: &[String]) -> Self {
        let mut axes = Self::default();
        let mut beside: BTreeMap<String, [bool; 3]> = BTreeMap::new();
        for (column, name) in names.iter().enumerate() {
            let name = split_unit(name).0;
            if let Some((axis, group)) = axis_of(name) {
                axes.groups[group as usize][axis].push(column);
            } else if let Some((axis, rest)) = axis_in_name(name)
                && !rest.split(' ').any(|word| NON_COORDINATE_WORDS.contains(&word))
            {
                beside.entry(rest).or_default()[axis] = true;
            }
        }
        axes.unknown = beside.into_iter().find(|(_, there)| *there == [true; 3]).map(|(rest, _)| rest);
        axes
    }

    fn group(&self, group: Group) -> &[Vec<usize>; 3] {
        &self.groups[group as usize]
    }

    /// Returns true if the header names x, y and z for at least one group of points: measured, nominal, or not stated.
    /// A group with an unknown word also counts if all three axes have this word, such as `x probe`, `y probe` and `z
    /// probe`.
    pub(super) fn are_named(&self) -> bool {
        self.unknown.is_some() || self.groups.iter().any(|group| group.iter().all(|columns| !columns.is_empty()))
    }

    /// Returns the indices, from 0, of the columns x, y and z of the one group of points that the header names. If
    /// `of_nominal` is true, the nominal points may be this group. If it is false, columns of nominal points are
    /// rejected.
    ///
    /// # Errors
    /// A header that names no group, more than one group, a group with an unknown word, or not exactly one column for
    /// each axis. The error text gives the reason and continues a sentence that begins with "the header".
    pub(super) fn chosen(&self, of_nominal: bool) -> Result<[usize; 3], String> {
        let there: Vec<Group> = Group::ALL
            .into_iter()
            .filter(|group| self.group(*group).iter().any(|columns| !columns.is_empty()))
            .collect();
        let group = match there[..] {
            [] if self.unknown.is_some() => {
                let word = self.unknown.as_deref().unwrap_or_default();
                return Err(format!("names x, y and z of `{word}`, which may be measured or nominal"));
            }
            [] => return Err("names none of x, y and z".to_owned()),
            [group] => group,
            [first, second, ..] => {
                return Err(format!("names {first} and {second} columns and does not show which to read"));
            }
        };
        for (axis, columns) in ["x", "y", "z"].iter().zip(self.group(group)) {
            if columns.len() != 1 {
                return Err(format!("names {} columns {axis}", columns.len()));
            }
        }
        if let Some(word) = &self.unknown {
            return Err(format!("names {group} columns and others of `{word}` and does not show which to read"));
        }
        if group == Group::Nominal && !of_nominal {
            return Err("names only nominal columns, which are not measured".to_owned());
        }
        Ok(self.group(group).each_ref().map(|columns| columns[0]))
    }
}

/// Decodes `bytes` as UTF-8, or as Latin-1 if they are not valid UTF-8: many instruments write the micro sign in
/// Latin-1.
pub(super) fn text_of(bytes: &[u8]) -> Cow<'_, str> {
    match std::str::from_utf8(bytes) {
        Ok(text) => Cow::Borrowed(text),
        Err(_) => Cow::Owned(bytes.iter().map(|&byte| char::from(byte)).collect()),
    }
}

/// Splits a column name into the name without the unit, and the unit: `x [mm]` gives `x` and `mm`. `name` must be in
/// lower case. The unit can be in square brackets, in round brackets, or after `_`, `/` or a blank; an inch mark (`"`)
/// is understood too. Any text in square brackets is returned as the unit, even if it is no known unit.
///
/// Returns the complete name and `None` if `name` states no unit.
pub(super) fn split_unit(name: &str) -> (&str, Option<String>) {
    let name = name.trim();
    for (open, close) in [('[', ']'), ('(', ')')] {
        if let (Some(at), true) = (name.rfind(open), name.ends_with(close)) {
            let unit = name[at + 1..name.len() - 1].trim();
            // By convention square brackets hold units; round brackets can hold anything.
            let is_mark = !unit.is_empty() && !unit.chars().any(char::is_alphanumeric);
            let states = open == '[' || is_mark || is_unit(unit);
            return if states { (base_of(&name[..at]), Some(unit.to_owned())) } else { (name, None) };
        }
    }
    if let Some(base) = INCH_MARKS.iter().find_map(|mark| name.strip_suffix(mark)) {
        return (base_of(base), Some("inch".to_owned()));
    }
    match name.rfind(['_', '/', ' ']) {
        Some(at) if is_unit(&name[at + 1..]) => (base_of(&name[..at]), Some(name[at + 1..].to_owned())),
        _ => (name, None),
    }
}

fn base_of(name: &str) -> &str {
    name.trim_end_matches([' ', '_', '-', '.', '/'])
}

fn is_millimetre(unit: &str) -> bool {
    Unit::Millimetre.is(unit)
}

/// Returns true if `word` names a unit of length. `word` must be in lower case.
pub(super) fn is_unit(word: &str) -> bool {
    is_millimetre(word) || OTHER_UNITS.contains(&word)
}

/// Returns the unit that `text`, a title or a comment, states, as in "units: inch", "units/inch" or "all dimensions in
/// inches". `text` must be in lower case. Returns `None` if no unit is found.
///
/// The unit after the word "unit" or "units" is searched first. If there is none, the result is the first word of
/// `text` that names a unit other than millimetres and has at least four letters. A shorter word can have another
/// meaning.
fn stated_unit(text: &str) -> Option<String> {
    const SHORTEST: usize = 4;
    unit_statement(text).or_else(|| {
        let words = text.split(|c: char| !c.is_alphanumeric());
        let mut long = words.filter(|word| word.chars().count() >= SHORTEST);
        long.find(|word| is_unit(word) && !is_millimetre(word)).map(str::to_owned)
    })
}

/// Units that a title or a comment states: for the heights alone ("height in um", "z: nm", "Heights (waves)"), and for
/// everything.
#[derive(Debug, Default, PartialEq)]
pub(super) struct StatedUnits {
    pub(super) of_heights: Option<String>,
    pub(super) of_all: Option<String>,
}

impl StatedUnits {
    /// Finds the units that `text`, a title or a comment, states: the unit of the heights alone, and the unit of all
    /// coordinates. A unit that `text` does not state is `None` in the result.
    pub(super) fn found_in(text: &str) -> Self {
        let text = text.to_lowercase();
        match height_unit(&text) {
            Some(word) => {
                let rest = format!("{}{}", &text[..word.start], &text[word.end..]);
                Self { of_heights: Some(text[word].to_owned()), of_all: stated_unit(&rest) }
            }
            None => Self { of_heights: None, of_all: stated_unit(&text) },
        }
    }
}

/// Returns the byte range, in `text`, of the unit of the heights: of "um" in "heights in um". Returns `None` if the
/// text states no unit for the heights. `text` must be in lower case.
fn height_unit(text: &str) -> Option<Range<usize>> {
    const HEIGHTS: [&str; 10] =
        ["z", "height", "heights", "höhe", "höhen", "hoehe", "sag", "hauteur", "hauteurs", "altura"];
    const NO_LENGTHS: [&str; 6] = ["wave", "waves", "fringe", "fringes", "lambda", "radians"];
    const BETWEEN: [&str; 6] = ["is", "are", "in", "en", "given", "unit"];
    /// Words before a word for height that show that it is not the height of the points, as in "step height".
    const OTHER: [&str; 14] = [
        "step",
        "peak",
        "safe",
        "clearance",
        "mean",
        "max",
        "maximum",
        "min",
        "minimum",
        "largest",
        "least",
        "range",
        "noise",
        "tolerances",
    ];
    /// Minimum number of letters of a unit directly after a word for height: a single letter can belong to another
    /// name.
    const SHORTEST: usize = 2;
    let mut words: Vec<Range<usize>> = Vec::new();
    for (at, c) in text.char_indices().filter(|(_, c)| c.is_alphanumeric()) {
        match words.last_mut().filter(|word| word.end == at) {
            Some(word) => word.end += c.len_utf8(),
            None => words.push(at..at + c.len_utf8()),
        }
    }
    let word = |k: usize| words.get(k).map_or("", |word| &text[word.clone()]);
    let is_other =
        |word: &str| OTHER.contains(&word) || (NON_COORDINATE_WORDS.contains(&word) && word.chars().count() > 1);
    let unit_behind = |height: usize| {
        let mut at = height + 1;
        // "heights are in um"; a lone "in" at the end is the inch.
        while BETWEEN.contains(&word(at)) && at + 1 < words.len() {
            at += 1;
        }
        let unit = word(at);
        let is_one = is_unit(unit) || NO_LENGTHS.contains(&unit);
        let is_long = unit.chars().count() >= SHORTEST && (unit != "in" || at > height + 1);
        // "mil-spec" does not name a unit, and "M coordinates" does not name the metre.
        let goes_on = text[words.get(at)?.end..].starts_with('-');
        let is_last = at + 1 == words.len();
        (is_one && !goes_on && (is_long || (at > height + 1 && is_last))).then(|| words[at].clone())
    };
    let heights = (0..words.len()).filter(|&k| HEIGHTS.contains(&word(k)));
    heights.filter(|&k| !(k.saturating_sub(2)..k).any(|before| is_other(word(before)))).find_map(unit_behind)
}

/// Returns the unit that follows the word "unit" or "units" in `text`. `text` must be in lower case.
///
/// After a colon, `=` or `/`, the word is clearly meant as a unit. There, an unknown word is returned too. After a
/// blank or an opening bracket, only a known unit at the end of `text` is returned.
///
/// Returns `None` if no such unit follows.
fn unit_statement(text: &str) -> Option<String> {
    let behind = text.match_indices("unit").map(|(at, word)| &text[at + word.len()..]);
    behind
        .filter_map(|after| {
            let after = after.strip_prefix(['s', 'e']).unwrap_or(after);
            let states = after.trim_start().strip_prefix([':', '=']).or_else(|| after.strip_prefix('/')).map(str::trim);
            // "unit in use" does not name the inch.
            let rest = states.or_else(|| after.strip_prefix([' ', '(', '[']))?;
            let end = rest.find(|c: char| !c.is_alphabetic()).unwrap_or(rest.len());
            let word = &rest[..end];
            let is_meant = states.is_some() || rest[end..].trim_matches([' ', ')', ']']).is_empty();
            let unknown = || states.filter(|rest| !rest.is_empty()).map(|rest| excerpt(rest.as_bytes()));
            if is_meant && is_unit(word) { Some(word.to_owned()) } else { unknown() }
        })
        .next()
}

/// Checks the unit that a file states in `header`, the text of its line number `line`. `unit` is the expected unit of
/// all coordinates, and `height_unit` the expected unit of z. `path` only names the file in the error.
///
/// # Errors
/// A header that states another unit than `unit` for all coordinates, or another unit than `height_unit` for z. A
/// header without a unit is accepted.
pub(super) fn check_stated_unit(
    path: &Path,
    line: u64,
    header: &[u8],
    [unit, height_unit]: [Unit; 2],
) -> Result<(), FormatError> {
    let StatedUnits { of_heights, of_all } = StatedUnits::found_in(&text_of(header));
    let other = |found: Option<String>, unit: Unit| found.filter(|found| !unit.is(found)).map(|found| (found, unit));
    match other(of_all, unit).or(other(of_heights, height_unit)) {
        Some((found, unit)) => Err(FormatError::Unit { path: path.to_owned(), line, found, unit }),
        None => Ok(()),
    }
}

/// Symbols of the inch.
const INCH_MARKS: [&str; 3] = ["\"", "''", "\u{2033}"];

/// Units of length that are not the millimetre, in lower case.
#[rustfmt::skip]
const OTHER_UNITS: [&str; 38] = [
    "m", "metre", "metres", "meter", "meters", "dm", "cm", "centimetre", "centimetres", "centimeter", "centimeters", "km", "um", "\u{b5}m", "\u{3bc}m", "micron", "microns",
    "micrometre", "micrometres", "micrometer", "micrometers", "nm", "nanometre", "nanometres", "nanometer", "nanometers", "in", "inch", "inches", "ft", "feet", "mil", "mils", "thou",
    "zoll", "pouce", "pouces", "pulgadas",
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn comment_states_unit() {
        let cases = [
            ("Units : Inch, made by hand", Some("inch")),
            ("unit = mm", Some("mm")),
            ("UNITS/INCH", Some("inch")),
            ("all dimensions in inches", Some("inches")),
            ("Einheit: Zoll", Some("zoll")),
            ("units: mm, converted from inches", Some("mm")),
            ("unit in", Some("in")),
            ("unit in use since May", None),
            ("unity", None),
            ("x in mm", None),
            ("x y z m", None),
            ("heights from the sphere", None),
            ("z is in the direction of the normal", None),
            ("Z in M coordinates", None),
            ("x, y, z, mil-spec", None),
            ("step height in um: 12", None),
            ("uncertainty of z in um: 0.3", None),
            ("z 5 mm", None),
        ];
        for (text, unit) in cases {
            let of_all = unit.map(str::to_owned);
            assert_eq!(StatedUnits::found_in(text), StatedUnits { of_heights: None, of_all }, "{text}");
        }
    }

    #[test]
    fn comment_states_height_unit() {
        for (text, of_heights, of_all) in [
            ("height in um", "um", None),
            ("Heights: microns", "microns", None),
            ("Z (\u{b5}m)", "\u{b5}m", None),
            ("x, y in inches, z in um", "um", Some("inches")),
            ("units: mm, height in waves", "waves", Some("mm")),
            ("Höhe [nm]", "nm", None),
            ("sag is m", "m", None),
            ("z is in mm", "mm", None),
            ("heights are in nm", "nm", None),
            ("sag is in waves", "waves", None),
        ] {
            let stated = StatedUnits { of_heights: Some(of_heights.to_owned()), of_all: of_all.map(str::to_owned) };
            assert_eq!(StatedUnits::found_in(text), stated, "{text}");
        }
    }

    #[test]
    fn columns_display_round_trip() {
        for text in ["x=x act,y=y act,z=z act", "x=4,y=5,z=6", "x=2,y=b,z=1"] {
            assert_eq!(text.parse::<Columns>().unwrap().to_string(), text);
        }
    }

    fn axes(header: &str) -> Axes {
        let names: Vec<String> = header.split(',').map(str::to_lowercase).collect();
        Axes::from_names(&names)
    }

    #[test]
    fn axis_of_recognizes_groups() {
        for (name, axis, group) in [
            ("x", 0, Group::Plain),
            ("z coordinate", 2, Group::Plain),
            ("y_act", 1, Group::Measured),
            ("measured x", 0, Group::Measured),
            ("xact", 0, Group::Measured),
            ("actz", 2, Group::Measured),
            ("x (actual)", 0, Group::Measured),
            ("y ist", 1, Group::Measured),
            ("x_nom", 0, Group::Nominal),
            ("z.soll", 2, Group::Nominal),
            ("nominal y", 1, Group::Nominal),
        ] {
            assert_eq!(axis_of(name), Some((axis, group)), "{name}");
        }
        for name in ["nx", "dx", "x_res", "xy", "x y", "index", "", "x_nom_act", "deviation z", "ix", "max"] {
            assert_eq!(axis_of(name), None, "{name}");
        }
    }

    #[test]
    fn chosen_axes_require_one_group() {
        assert_eq!(axes("x,y,z").chosen(false), Ok([0, 1, 2]));
        assert_eq!(axes("Y_act,X_act,Z_act").chosen(false), Ok([1, 0, 2]));
        assert_eq!(axes("Nr,X_nom,Y_nom,Z_nom").chosen(true), Ok([1, 2, 3]));
        assert_eq!(axes("id,Z_mm,Y [mm],X(mm),x_res").chosen(false), Ok([3, 2, 1]));
        for header in [
            "X_nom,Y_nom,Z_nom",
            "X_nom,Y_nom,Z_nom,X_act,Y_act,Z_act",
            "x,y,z,x_act,y_act,z_act",
            "a,b,c",
            "x,y",
            "x,y,height",
            "x,y,z,z",
            "x,y,z,z_act",
        ] {
            assert!(axes(header).chosen(false).is_err(), "{header}");
        }
    }

    #[test]
    fn columns_by_name_or_number() {
        let names = ["nr", "x_nom", "x_act [mm]", "y_act", "z_act", "y_act"].map(str::to_owned);
        let places = |text: &str| text.parse::<Columns>().unwrap().places(&names, 6);
        assert_eq!(places("z=Z_act,x=X_act,y=4"), Ok([2, 3, 4]));
        assert_eq!(places("x=2,y=3,z=1"), Ok([1, 2, 0]));
        for wrong in ["x=X_act,y=Y_act,z=Z_act", "x=X_act,y=4,z=7", "x=none,y=4,z=5", "x=X_act,y=3,z=5"] {
            assert!(places(wrong).is_err(), "{wrong}");
        }
        for wrong in
            ["", "x=1,y=2", "x=1,y=2,z=2", "x=0,y=1,z=2", "x=1,y=2,z=3,z=4", "a=1,y=2,z=3", "x,y,z", "x=,y=2,z=3"]
        {
            assert!(wrong.parse::<Columns>().is_err(), "{wrong}");
        }
    }

    #[test]
    fn unit_parses_synonyms() {
        for (word, in_mm) in
            [("mm", 1.0), ("Inch", 25.4), ("zoll", 25.4), ("\u{b5}m", 1e-3), ("microns", 1e-3), ("m", 1000.0)]
        {
            assert_eq!(word.parse::<Unit>().map(Unit::in_mm), Ok(in_mm), "{word}");
        }
        assert!("waves".parse::<Unit>().is_err());
    }

    #[test]
    fn split_unit_from_column_name() {
        assert_eq!(split_unit("x_inch"), ("x", Some("inch".to_owned())));
        assert_eq!(split_unit("x (nominal)"), ("x (nominal)", None));
    }
}
