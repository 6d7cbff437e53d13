//! Reads a file and checks it against its schema.

use std::fs::File;
use std::io::Read;
use std::ops::Range;
use std::path::Path;

use serde::de::DeserializeOwned;
use serde_json::Value as Schema;
use sha2::{Digest, Sha256};
use toml::Spanned;
use toml::de::{DeTable, DeValue};

use super::schema::choices;
use super::shown::{countable, misleading};
use super::{Problem, Problems, RenamedKey, line_and_column};

/// Maximum size of a file: far more than a person writes.
const MAX_BYTES: usize = 256 << 10;

/// Maximum number of reported problems: more than a person reads at once.
const MAX_PROBLEMS: usize = 200;

/// One step from a table to a value in it.
#[derive(Clone, Debug)]
enum Step {
    Key(String),
    Index(usize),
}

/// File while it is read and checked.
pub struct Document<'t> {
    file: &'t Path,
    text: &'t str,
    places: DeTable<'t>,
    values: toml::Table,
    problems: Vec<Problem>,
}

/// Reads a recipe or another file of settings as text.
///
/// # Errors
/// The file cannot be read, is too large, or is not UTF-8.
pub fn read_text(path: &Path) -> Result<String, Problems> {
    let failed = |found: String, remedy: &str| Problems::whole(path, "", found, remedy);
    let mut bytes = Vec::new();
    let read = open(path).and_then(|file| file.take(MAX_BYTES as u64 + 1).read_to_end(&mut bytes));
    read.map_err(|e| failed(format!("the file cannot be read: {e}"), "check the path and the permissions"))?;
    if bytes.len() > MAX_BYTES {
        return Err(too_large(path));
    }
    String::from_utf8(bytes).map_err(|e| {
        let line = 1 + e.as_bytes()[..e.utf8_error().valid_up_to()].iter().filter(|&&b| b == b'\n').count();
        failed(format!("the file is not text: line {line} is not UTF-8"), "save it as UTF-8 text")
    })
}

/// Opens a file for reading.
///
/// # Errors
/// The file is a named pipe, which could block, or a device, which may have no end. Pipes and devices below `/dev` and
/// `/proc` are accepted, because a shell can pass the output of a program as a file there. Any error of the operating
/// system is returned too.
fn open(path: &Path) -> std::io::Result<File> {
    let found = std::fs::metadata(path)?;
    if !found.is_file() && !found.is_dir() && !path.starts_with("/dev") && !path.starts_with("/proc") {
        return Err(std::io::Error::new(std::io::ErrorKind::InvalidInput, "it is a pipe or a device, not a file"));
    }
    File::open(path)
}

fn too_large(path: &Path) -> Problems {
    let found = format!("the file is larger than {} KiB", MAX_BYTES >> 10);
    Problems::whole(path, "", found, "check that it is a recipe or a cell file; put large data into separate files")
}

/// Returns the SHA-256 of a text.
pub fn sha256(text: &str) -> [u8; 32] {
    Sha256::digest(text.as_bytes()).into()
}

impl<'t> Document<'t> {
    /// Parses a text as TOML. `file` is the path of the file in messages. The values are not checked yet.
    ///
    /// # Errors
    /// Returns one problem for each place where the text is not valid TOML. Also fails if the text is larger than 256
    /// KiB.
    pub fn parse(file: &'t Path, text: &'t str) -> Result<Self, Problems> {
        if text.len() > MAX_BYTES {
            return Err(too_large(file));
        }
        let (places, errors) = DeTable::parse_recoverable(text);
        let mut document =
            Self { file, text, places: places.into_inner(), values: toml::Table::new(), problems: Vec::new() };
        for error in &errors {
            document.syntax(error);
        }
        if errors.is_empty() {
            match toml::from_str(text) {
                Ok(values) => document.values = values,
                Err(error) => document.syntax(&error),
            }
        }
        if document.problems.is_empty() { Ok(document) } else { Err(document.into_problems()) }
    }

    fn syntax(&mut self, error: &toml::de::Error) {
        let start = error.span().map_or(0, |span| span.start).min(self.text.len());
        let end = error.span().map_or(0, |span| span.end).clamp(start, self.text.len());
        let (before, rest) = (&self.text.as_bytes()[..start], self.text.as_bytes().get(start..).unwrap_or_default());
        let after_digit = before.last().is_some_and(u8::is_ascii_digit);
        let remedy = match rest.first() {
            Some(0) => "the file has NUL bytes: save it as plain text",
            Some(b',') if after_digit => "is it a decimal comma? write a decimal point",
            _ => "correct the TOML here",
        };
        self.push(start..end, String::new(), format!("invalid TOML: {}", error.message().trim()), "", remedy);
    }

    /// Moves the value of each old key to its present name; `renamed` lists the pairs of names. Returns one note with
    /// the line number for each value that was moved.
    ///
    /// If the file has both names, reports the old key as a problem and removes its value. A table that becomes empty
    /// is removed.
    pub fn rename_keys(&mut self, renamed: &[RenamedKey]) -> Vec<String> {
        let mut notes = Vec::new();
        for RenamedKey { old, new } in renamed {
            if !self.contains_key(old) {
                continue;
            }
            let (old_steps, new_steps) = (steps(old), steps(new));
            let span = span_of_name(&self.places, &old_steps);
            if self.contains_key(new) {
                let found = format!("is the old name of `{new}`, and the file has both");
                self.push(span, (*old).to_owned(), found, "", "delete the old key");
                take_value(&mut self.values, &names(&old_steps).collect::<Vec<_>>());
                continue;
            }
            let line = line_and_column(self.text, span.start).0;
            notes.push(format!("line {line}: `{old}` is called `{new}` now; this version still reads the old name"));
            move_place(&mut self.places, &old_steps, &new_steps);
            move_value(&mut self.values, &old_steps, &new_steps);
        }
        notes
    }

    /// Checks all values of the file against a JSON schema. Reports each value that does not fit as a problem, and
    /// removes it from the values. Also reports missing and unknown keys.
    pub fn check_schema(&mut self, schema: &Schema) {
        let mut values = toml::Value::Table(std::mem::take(&mut self.values));
        Shape { document: self, root: schema, path: Vec::new() }.fits(schema, &mut values);
        if let toml::Value::Table(values) = values {
            self.values = values;
        }
    }

    /// Deserializes the values that passed the checks into `File`. If this fails, adds a problem and returns `None`.
    pub fn deserialize<File: DeserializeOwned>(&mut self) -> Option<File> {
        match self.values.clone().try_into() {
            Ok(written) => Some(written),
            Err(error) => {
                let message = error.message().trim().to_owned();
                self.push(0..0, String::new(), message, "", "compare the file with the shipped ones");
                None
            }
        }
    }

    /// Returns true if a problem was reported for the value of `key`, or for a value within it.
    pub fn has_problem(&self, key: &str) -> bool {
        let within =
            |found: &str| found.strip_prefix(key).is_some_and(|rest| rest.is_empty() || rest.starts_with(['.', '[']));
        self.problems.iter().any(|problem| within(&problem.key))
    }

    /// Returns true if the file has `key`, such as `measure.probe_radius_mm`, even if its value was removed because it
    /// is wrong. Returns false for a key within a list.
    pub fn contains_key(&self, key: &str) -> bool {
        let steps = steps(key);
        let Some((Step::Key(last), before)) = steps.split_last() else { return false };
        let mut table = Some(&self.places);
        for step in before {
            table = match (step, table) {
                (Step::Key(name), Some(inside)) => {
                    inside.get(name.as_str()).and_then(|value| value.get_ref().as_table())
                }
                _ => None,
            };
        }
        table.is_some_and(|table| table.contains_key(last.as_str()))
    }

    /// Reports a problem at the position of `key` in the file. `found` describes the value that was found, `allowed`
    /// the allowed values, and `remedy` how to solve the problem. If the file does not have the key, the position is
    /// that of the innermost existing table around it.
    pub fn report(&mut self, key: &str, found: impl Into<String>, allowed: &str, remedy: &str) {
        let span = span_of(&self.places, &steps(key));
        self.push(span, key.to_owned(), found.into(), allowed, remedy);
    }

    fn push(&mut self, span: Range<usize>, key: String, found: String, allowed: &str, remedy: &str) {
        let found = countable(&found);
        self.problems.push(Problem { span, key, found, allowed: allowed.to_owned(), remedy: remedy.to_owned() });
    }

    /// Returns `Ok` if no problem was reported.
    ///
    /// # Errors
    /// Returns the reported problems, sorted by their position in the text. Repeated problems are removed. If there are
    /// more than 200, the last entry of the list gives the number of the problems that are not listed.
    pub fn finish(self) -> Result<(), Problems> {
        if self.problems.is_empty() { Ok(()) } else { Err(self.into_problems()) }
    }

    fn into_problems(self) -> Problems {
        let mut problems = self.problems;
        problems.sort_by_key(|problem| problem.span.start);
        problems.dedup();
        if let Some(more) = problems.len().checked_sub(MAX_PROBLEMS).filter(|&more| more > 0) {
            problems.truncate(MAX_PROBLEMS);
            let last = problems[MAX_PROBLEMS - 1].span.end;
            problems.push(Problem {
                span: last..last,
                key: String::new(),
                found: format!("there are {more} more problems after this one"),
                allowed: String::new(),
                remedy: "correct these first".into(),
            });
        }
        Problems { file: self.file.to_owned(), text: self.text.to_owned(), problems }
    }
}

/// Returns one problem at the position of `key` in `text`, the content of `file`. Use it if a check after reading the
/// file finds the problem. `key` is the present name of the key. If the text has the old name, the position is found
/// via `renamed`. The last argument contains the value that was found, the allowed values, and the remedy.
pub fn problem_at(
    file: &Path,
    text: &str,
    renamed: &[RenamedKey],
    key: &str,
    [found, allowed, remedy]: [&str; 3],
) -> Problems {
    let (places, _) = DeTable::parse_recoverable(text);
    let mut places = places.into_inner();
    renamed.iter().for_each(|RenamedKey { old, new }| move_place(&mut places, &steps(old), &steps(new)));
    let span = span_of(&places, &steps(key));
    let [found, allowed, remedy] = [found, allowed, remedy].map(str::to_owned);
    let problem = Problem { span, key: key.to_owned(), found, allowed, remedy };
    Problems { file: file.to_owned(), text: text.to_owned(), problems: vec![problem] }
}

/// Returns the names in the steps of a key, without the indices of list entries.
fn names(steps: &[Step]) -> impl DoubleEndedIterator<Item = &str> {
    steps.iter().filter_map(|step| match step {
        Step::Key(name) => Some(name.as_str()),
        Step::Index(_) => None,
    })
}

/// Moves a value from the path `old` to the path `new` in `root`, the parsed file with text positions. The value and
/// its key keep their positions in the text. Does nothing if the path `old` does not exist.
fn move_place(root: &mut DeTable, old: &[Step], new: &[Step]) {
    let Some(taken) = take_place(root, &names(old).collect::<Vec<_>>()) else { return };
    let mut inside = root;
    let Some((last, before)) = new.split_last() else { return };
    for name in names(before) {
        if !inside.contains_key(name) {
            let table = Spanned::new(taken.0.clone(), DeValue::Table(DeTable::new()));
            inside.insert(Spanned::new(taken.0.clone(), name.to_owned().into()), table);
        }
        let Some(DeValue::Table(table)) = inside.get_mut(name).map(Spanned::get_mut) else { return };
        inside = table;
    }
    for name in names(std::slice::from_ref(last)) {
        inside.insert(Spanned::new(taken.0.clone(), name.to_owned().into()), taken.1.clone());
    }
}

/// Removes the value with the path `names` from `table`, the parsed file with text positions. Also removes each table
/// that becomes empty. Returns the position of the key in the text (range of bytes) and the value. Returns `None` if
/// there is no such value.
fn take_place<'t>(table: &mut DeTable<'t>, names: &[&str]) -> Option<(Range<usize>, Spanned<DeValue<'t>>)> {
    let (first, rest) = names.split_first()?;
    if rest.is_empty() {
        let span = table.get_key_value(*first)?.0.span();
        return table.remove(*first).map(|value| (span, value));
    }
    let DeValue::Table(inside) = table.get_mut(*first)?.get_mut() else { return None };
    let taken = take_place(inside, rest);
    if inside.is_empty() {
        table.remove(*first);
    }
    taken
}

/// Removes and returns the value with the path `names`, and removes the tables that become empty by that. Returns
/// `None` if there is no such value.
fn take_value(table: &mut toml::Table, names: &[&str]) -> Option<toml::Value> {
    let (first, rest) = names.split_first()?;
    if rest.is_empty() {
        return table.remove(*first);
    }
    let inside = table.get_mut(*first)?.as_table_mut()?;
    let taken = take_value(inside, rest);
    if inside.is_empty() {
        table.remove(*first);
    }
    taken
}

/// Moves a value from an old key to a new key. Does nothing if the old key does not exist.
fn move_value(root: &mut toml::Table, old: &[Step], new: &[Step]) {
    let Some(value) = take_value(root, &names(old).collect::<Vec<_>>()) else { return };
    let new: Vec<&str> = names(new).collect();
    let Some((last, before)) = new.split_last() else { return };
    let mut inside = root;
    for name in before {
        let next = inside.entry(*name).or_insert_with(|| toml::Table::new().into());
        let Some(table) = next.as_table_mut() else { return };
        inside = table;
    }
    inside.insert((*last).to_owned(), value);
}

/// Splits a key, such as `cmm.signals[0].address`, into names and indices.
fn steps(key: &str) -> Vec<Step> {
    let mut steps = Vec::new();
    for part in key.split('.') {
        let mut pieces = part.split('[');
        steps.extend(pieces.next().map(|name| Step::Key(name.to_owned())));
        steps.extend(pieces.filter_map(|index| index.trim_end_matches(']').parse().ok().map(Step::Index)));
    }
    steps
}

/// Joins names and indices to a key, such as `cmm.signals[0].address`.
fn key_of(steps: &[Step]) -> String {
    let mut key = String::new();
    for step in steps {
        match step {
            Step::Index(index) => key.push_str(&format!("[{index}]")),
            Step::Key(name) => {
                if !key.is_empty() {
                    key.push('.');
                }
                key.push_str(name);
            }
        }
    }
    key
}

/// Returns the position in the text, as a range of bytes, of the value with the path `steps`. For a table, returns the
/// position of its name. If the value does not exist, returns the position of the innermost existing table or list
/// entry around it, or `0..0` if there is none.
fn span_of(root: &DeTable, steps: &[Step]) -> Range<usize> {
    let mut found = 0..0;
    let mut inside: Option<&DeValue> = None;
    for step in steps {
        match (step, inside) {
            (Step::Key(name), _) => {
                let table = match inside {
                    None => Some(root),
                    Some(value) => value.as_table(),
                };
                let Some((key, value)) = table.and_then(|table| table.get_key_value(name.as_str())) else { break };
                found = if value.get_ref().is_table() { key.span() } else { value.span() };
                inside = Some(value.get_ref());
            }
            (Step::Index(index), Some(DeValue::Array(items))) => {
                let Some(item) = items.get(*index) else { break };
                found = item.span();
                inside = Some(item.get_ref());
            }
            (Step::Index(_), _) => break,
        }
    }
    found
}

/// Returns the position in the text, as a range of bytes, of the name of the key with the path `steps`, not of the
/// value. For a list entry, which has no name, returns the position of the entry. If the key does not exist, returns
/// the position of the innermost existing table or list entry around it, or `0..0` if there is none.
fn span_of_name(root: &DeTable, steps: &[Step]) -> Range<usize> {
    let Some((Step::Key(last), before)) = steps.split_last() else { return span_of(root, steps) };
    let mut inside: Option<&DeValue> = None;
    for step in before {
        inside = match (step, inside) {
            (Step::Key(name), None) => root.get(name.as_str()).map(|value| value.get_ref()),
            (Step::Key(name), Some(value)) => value.get(name.as_str()).map(|value| value.get_ref()),
            (Step::Index(index), Some(value)) => value.get(*index).map(|value| value.get_ref()),
            (Step::Index(_), None) => None,
        };
        if inside.is_none() {
            return span_of(root, steps);
        }
    }
    let table = inside.map_or(Some(root), DeValue::as_table);
    table
        .and_then(|table| table.get_key_value(last.as_str()))
        .map_or_else(|| span_of(root, steps), |(key, _)| key.span())
}

/// Check of values against their schema. `path` leads to the value that is being checked.
struct Shape<'d, 't> {
    document: &'d mut Document<'t>,
    root: &'d Schema,
    path: Vec<Step>,
}

impl Shape<'_, '_> {
    /// Checks `value` against `schema` and reports all problems. Removes those values within `value` that do not fit.
    /// Returns false if `value` itself does not fit; then the caller must remove it.
    fn fits(&mut self, schema: &Schema, value: &mut toml::Value) -> bool {
        if let Some(words) = choices(schema) {
            return self.is_one_of(&words, value);
        }
        if let Some(variants) = schema.get("oneOf").and_then(Schema::as_array) {
            return self.fits_variant(variants, value);
        }
        match schema.get("type").and_then(Schema::as_str) {
            Some("object") => self.table(schema, value),
            Some("array") => self.array(schema, value),
            Some(kind @ ("number" | "integer")) => self.number(schema, kind, value),
            Some("string") => self.text(schema, value),
            Some("boolean") if !value.is_bool() => self.wrong(value, "true or false", "write it without quotes"),
            _ => true,
        }
    }

    fn table(&mut self, schema: &Schema, value: &mut toml::Value) -> bool {
        let name = key_of(&self.path);
        let toml::Value::Table(table) = value else {
            return self.wrong(value, "a table", &format!("write [{name}] and its keys below"));
        };
        let empty = serde_json::Map::new();
        let properties = schema.get("properties").and_then(Schema::as_object).unwrap_or(&empty);
        for key in schema.get("required").and_then(Schema::as_array).into_iter().flatten().filter_map(Schema::as_str) {
            // A misspelled key is reported as misspelled, and not also as missing.
            let meant = |other: &str| nearest(other, properties.keys().map(String::as_str)) == Some(key);
            let misspelt = |other: &str| !properties.contains_key(other) && meant(other);
            if !table.contains_key(key) && !table.keys().take(MAX_PROBLEMS).any(|other| misspelt(other.as_ref())) {
                self.missing(key, &properties[key]);
            }
        }
        let others = schema.get("additionalProperties");
        table.retain(|key, value| {
            self.path.push(Step::Key(key.to_string()));
            let stays = match (properties.get(key), others) {
                (Some(schema), _) => self.fits(schema, value),
                (None, Some(Schema::Bool(false))) => self.unknown(key, properties),
                (None, Some(schema @ Schema::Object(_))) => self.fits(schema, value),
                (None, _) => true,
            };
            self.path.pop();
            stays
        });
        true
    }

    fn fits_variant(&mut self, variants: &[Schema], value: &mut toml::Value) -> bool {
        let tag = variants[0].get("properties").and_then(Schema::as_object).and_then(|properties| {
            properties.iter().find(|(_, schema)| schema.get("const").is_some()).map(|(key, _)| key.as_str())
        });
        let Some(tag) = tag else { return true };
        let word_of = |variant: &Schema| variant["properties"][tag]["const"].as_str().unwrap_or_default().to_owned();
        let words: Vec<String> = variants.iter().map(word_of).collect();
        let words: Vec<&str> = words.iter().map(String::as_str).collect();
        let name = key_of(&self.path);
        let Some(table) = value.as_table_mut() else {
            return self.wrong(value, "a table", &format!("write [{name}] and its keys below"));
        };
        let Some(kind) = table.get_mut(tag) else {
            let allowed = format!("one of {}", in_words(&words));
            self.report_missing(tag, &allowed, &format!("add `{tag} = \"{}\"`", words[0]));
            return false;
        };
        self.path.push(Step::Key(tag.to_owned()));
        let known = self.is_one_of(&words, kind);
        self.path.pop();
        let variant = variants.iter().find(|variant| kind.as_str() == Some(word_of(variant).as_str()));
        known && variant.is_some_and(|variant| self.table(variant, value))
    }

    fn is_one_of(&mut self, words: &[&str], value: &toml::Value) -> bool {
        let allowed = match words {
            [only] => format!("\"{only}\""),
            _ => format!("one of {}", in_words(words)),
        };
        let Some(found) = value.as_str() else {
            return self.wrong(value, &allowed, "write the word in quotes");
        };
        if words.contains(&found) {
            return true;
        }
        let remedy = match nearest(found, words.iter().copied()) {
            Some(word) => format!("did you mean \"{word}\"?"),
            None => "choose one of them".into(),
        };
        self.wrong(value, &allowed, &remedy)
    }

    fn array(&mut self, schema: &Schema, value: &mut toml::Value) -> bool {
        let toml::Value::Array(items) = value else {
            return self.wrong(value, "a list", "write it in square brackets: [ ... ]");
        };
        let limit = |key: &str| schema.get(key).and_then(Schema::as_u64).map(|n| n as usize);
        let (least, most) = (limit("minItems").unwrap_or(0), limit("maxItems").unwrap_or(usize::MAX));
        if !(least..=most).contains(&items.len()) {
            let found = format!("has {} entries", items.len());
            let allowed = match (least, most) {
                (least, usize::MAX) => format!("there must be at least {least}"),
                (least, most) if least == most => format!("there must be {least}"),
                (least, most) => format!("there must be {least} to {most}"),
            };
            self.report_problem(found, &allowed, "add or remove entries");
            return false;
        }
        let mut all = true;
        for (k, item) in items.iter_mut().enumerate() {
            let each = schema.get("prefixItems").and_then(|each| each.get(k)).or_else(|| schema.get("items"));
            if let Some(each) = each {
                self.path.push(Step::Index(k));
                all &= self.fits(each, item);
                self.path.pop();
            }
        }
        all
    }

    fn number(&mut self, schema: &Schema, kind: &str, value: &toml::Value) -> bool {
        let allowed = self.allowed_numbers(schema, kind);
        let number = match value {
            toml::Value::Integer(number) => *number as f64,
            toml::Value::Float(number) if kind == "number" => *number,
            toml::Value::Float(_) => return self.wrong(value, &allowed, "write it without a decimal point"),
            toml::Value::String(text) if text.trim().parse::<f64>().is_ok() => {
                return self.wrong(value, &allowed, &format!("remove the quotes: {}", text.trim()));
            }
            toml::Value::String(text) if text.replace(',', ".").trim().parse::<f64>().is_ok() => {
                return self.wrong(value, &allowed, "write it with a decimal point and without quotes");
            }
            _ => return self.wrong(value, &allowed, "write a number, without its unit"),
        };
        let [least, most] = limits(schema);
        let finite = number.is_finite() || (schema.get("x-infinite").is_some() && !number.is_nan());
        if finite && (least..=most).contains(&number) {
            return true;
        }
        let remedy = self.remedy_for(schema, number, [least, most]);
        self.wrong(value, &allowed, &remedy)
    }

    fn allowed_numbers(&self, schema: &Schema, kind: &str) -> String {
        let noun = if kind == "integer" { "a whole number" } else { "a finite number" };
        let key = self.path.iter().rev().find_map(|step| match step {
            Step::Key(name) => Some(name.as_str()),
            Step::Index(_) => None,
        });
        let unit = key.and_then(unit_of).map_or(String::new(), |unit| format!(" {unit}"));
        match limits(schema) {
            [f64::NEG_INFINITY, f64::INFINITY] => noun.to_owned(),
            [least, f64::INFINITY] => format!("{noun}, at least {least}{unit}"),
            [f64::NEG_INFINITY, most] => format!("{noun}, at most {most}{unit}"),
            [least, most] => format!("{noun} from {least} to {most}{unit}"),
        }
    }

    fn remedy_for(&self, schema: &Schema, number: f64, [least, most]: [f64; 2]) -> String {
        let key = key_of(&self.path);
        let fits = |scaled: f64| scaled.is_finite() && (least..=most).contains(&scaled);
        if key.ends_with("_mm") && number > most && fits(number * 1e-3) {
            return format!("if the value is in µm, write {} (mm)", number * 1e-3);
        }
        if key.ends_with("_um") && number > 0.0 && number < least && fits(number * 1e3) {
            return format!("if the value is in mm, write {} (µm)", number * 1e3);
        }
        let usual = schema.get("default").or_else(|| schema.get("examples").and_then(|examples| examples.get(0)));
        match usual {
            Some(usual) => format!("the usual value is {usual}"),
            None => "correct it".into(),
        }
    }

    fn text(&mut self, schema: &Schema, value: &toml::Value) -> bool {
        let Some(text) = value.as_str() else {
            return self.wrong(value, "text", "write it in quotes");
        };
        let limit = |key: &str, otherwise| schema.get(key).and_then(Schema::as_u64).map_or(otherwise, |n| n as usize);
        let (least, most) = (limit("minLength", 0), limit("maxLength", 4096));
        let length = text.chars().count();
        if text.chars().any(char::is_control) {
            return self.wrong(value, "text of one line", "remove line breaks and control characters");
        }
        if let Some(hidden) = misleading(text) {
            let found = format!(
                "has the character U+{:04X}, which is invisible or changes the direction of the text",
                u32::from(hidden)
            );
            self.report_problem(found, "it must be text of visible characters", "remove it, or type the text again");
            return false;
        }
        if (least..=most).contains(&length) {
            return true;
        }
        let found = format!("has {length} characters");
        self.report_problem(found, &format!("it must have {least} to {most}"), "write a shorter or longer text");
        false
    }

    fn wrong(&mut self, value: &toml::Value, allowed: &str, remedy: &str) -> bool {
        self.report_problem(format!("is {}", shown(value)), &format!("it must be {allowed}"), remedy);
        false
    }

    fn report_problem(&mut self, found: String, allowed: &str, remedy: &str) {
        let span = span_of(&self.document.places, &self.path);
        self.document.push(span, key_of(&self.path), found, allowed, remedy);
    }

    fn missing(&mut self, key: &str, schema: &Schema) {
        let is_table =
            schema.get("properties").is_some() || schema.get("oneOf").is_some_and(|_| choices(schema).is_none());
        if is_table {
            let mut path = self.path.clone();
            path.push(Step::Key(key.to_owned()));
            return self.report_missing(key, "", &format!("add the table [{}]", key_of(&path)));
        }
        let allowed = match schema.get("type").and_then(Schema::as_str) {
            _ if choices(schema).is_some() => format!("one of {}", in_words(&choices(schema).unwrap_or_default())),
            Some(kind @ ("number" | "integer")) => {
                self.path.push(Step::Key(key.to_owned()));
                let allowed = self.allowed_numbers(schema, kind);
                self.path.pop();
                allowed
            }
            Some("string") => "text".to_owned(),
            Some("array") => "a list".to_owned(),
            _ => String::new(),
        };
        let example = schema.get("examples").and_then(|examples| examples.get(0)).map(ToString::to_string);
        let remedy = example.map_or(format!("add `{key}`"), |example| format!("add `{key} = {example}`"));
        self.report_missing(key, &allowed, &remedy);
    }

    fn report_missing(&mut self, key: &str, allowed: &str, remedy: &str) {
        let span = span_of(&self.document.places, &self.path);
        self.path.push(Step::Key(key.to_owned()));
        let allowed = if allowed.is_empty() { String::new() } else { format!("it must be {allowed}") };
        self.document.push(span, key_of(&self.path), "is missing".into(), &allowed, remedy);
        self.path.pop();
    }

    fn unknown(&mut self, key: &str, properties: &serde_json::Map<String, Schema>) -> bool {
        let span = span_of_name(&self.document.places, &self.path);
        let list = || {
            format!("this table has the keys {}", properties.keys().map(String::as_str).collect::<Vec<_>>().join(", "))
        };
        let (allowed, remedy) = if let Some(near) = nearest(key, properties.keys().map(String::as_str)) {
            ("this table has no key with that name".into(), format!("did you mean `{near}`?"))
        } else if let Some(table) = home_of(self.root, key, &mut Vec::new()) {
            (list(), format!("move it to {table}"))
        } else {
            (list(), "remove it".into())
        };
        self.document.push(span, key_of(&self.path), "is unknown".into(), &allowed, &remedy);
        false
    }
}

fn limits(schema: &Schema) -> [f64; 2] {
    let limit = |key: &str| schema.get(key).and_then(Schema::as_f64);
    [limit("minimum").unwrap_or(f64::NEG_INFINITY), limit("maximum").unwrap_or(f64::INFINITY)]
}

/// Returns the word that is most similar to `found`, ignoring capital letters; `None` if no word is similar enough.
fn nearest<'w>(found: &str, words: impl Iterator<Item = &'w str>) -> Option<&'w str> {
    let found: String = found.chars().take(64).collect::<String>().to_lowercase().replace('-', "_");
    let likeness = |word: &str| strsim::normalized_damerau_levenshtein(&found, &word.replace('-', "_"));
    words
        .map(|word| (likeness(word), word))
        .filter(|(alike, _)| *alike >= 0.6)
        .max_by(|a, b| a.0.total_cmp(&b.0))
        .map(|(_, word)| word)
}

/// Searches `schema` for a table that has `key`. Returns the name of the table for a message, such as `[cmm.wire]`, or
/// `the top of the file`. Returns `None` if no table has the key. `path` collects the names of the tables during the
/// search; pass an empty list.
fn home_of(schema: &Schema, key: &str, path: &mut Vec<String>) -> Option<String> {
    let variants = schema.get("oneOf").and_then(Schema::as_array).into_iter().flatten();
    for schema in std::iter::once(schema).chain(variants) {
        let Some(properties) = schema.get("properties").and_then(Schema::as_object) else { continue };
        if properties.contains_key(key) {
            return Some(if path.is_empty() { "the top of the file".into() } else { format!("[{}]", path.join(".")) });
        }
        for (name, schema) in properties {
            path.push(name.clone());
            let found = home_of(schema, key, path);
            path.pop();
            if found.is_some() {
                return found;
            }
        }
    }
    None
}

fn in_words(words: &[&str]) -> String {
    words.iter().map(|word| format!("\"{word}\"")).collect::<Vec<_>>().join(", ")
}

/// Returns the unit at the end of a key, such as mm for `probe_radius_mm`; `None` if the key states no unit.
fn unit_of(key: &str) -> Option<&'static str> {
    const UNITS: [(&str, &str); 8] = [
        ("_mm_min", "mm/min"),
        ("_mm_s", "mm/s"),
        ("_mm", "mm"),
        ("_um", "µm"),
        ("_nm", "nm"),
        ("_deg", "°"),
        ("_ms", "ms"),
        ("_s", "s"),
    ];
    UNITS.iter().find(|(suffix, _)| key.ends_with(suffix)).map(|(_, unit)| *unit)
}

/// Returns a value as text for a message, shortened if it is long.
fn shown(value: &toml::Value) -> String {
    match value {
        toml::Value::String(text) => {
            let short: String = text.chars().take(40).collect();
            format!("{short:?}")
        }
        toml::Value::Integer(number) => number.to_string(),
        toml::Value::Float(number) => number.to_string(),
        toml::Value::Boolean(value) => value.to_string(),
        toml::Value::Datetime(_) => "a date".into(),
        toml::Value::Array(items) => format!("a list of {}", items.len()),
        toml::Value::Table(_) => "a table".into(),
    }
}
