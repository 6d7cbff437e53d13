//! Parts of the book that are generated from the program: the text between `<!-- made: WHAT -->` and `<!-- end -->`.
//! `REGRIND_REWRITE=1 cargo test --workspace --test cli made` writes them again.

use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::fs;
use std::path::Path;
use std::sync::LazyLock;

use regrind::cell::{AlarmId, Role};
use serde_json::Value;

use super::pages::TYPED;
use super::{path_of, text_of};

const BEGINS: &str = "<!-- made: ";
const ENDS: &str = "<!-- end -->";

fn schema(kind: &str) -> &'static Value {
    // The program adds the keys of the simulator.
    static RECIPE: LazyLock<Value> = LazyLock::new(|| {
        let (code, out, err) = crate::program::run(&["schema", "recipe"], Path::new("."));
        assert_eq!(code, 0, "{err}");
        serde_json::from_str(&out).unwrap()
    });
    match kind {
        "recipe" => &RECIPE,
        "cell" => regrind::config::json_schema(),
        "dialect" => regrind::config::dialect_schema(),
        _ => panic!("no schema of a {kind}"),
    }
}

/// Returns the forms of a table: one, or one for each value of its key `kind` or `shape`.
fn forms(table: &Value) -> Vec<&Value> {
    match table.get("oneOf").and_then(Value::as_array) {
        Some(forms) => forms.iter().collect(),
        None => vec![table],
    }
}

/// Returns the table of a schema at a path such as `cmm.wire.stations`.
fn table_at<'a>(root: &'a Value, path: &str) -> &'a Value {
    path.split('.').fold(root, |table, name| {
        let found = forms(table).into_iter().find_map(|form| form["properties"].get(name));
        let found = found.unwrap_or_else(|| panic!("no table {path}"));
        found.get("items").filter(|items| items.get("properties").is_some()).unwrap_or(found)
    })
}

/// Returns true if a key is a table with its own list of keys.
fn is_table(value: &Value) -> bool {
    let of = value.get("items").unwrap_or(value);
    forms(of).iter().any(|form| form.get("properties").is_some())
}

/// Collects the paths of all tables of a schema, except those of a parent surface, which are the same as of any
/// surface.
fn tables(table: &Value, path: &str, found: &mut BTreeSet<String>) {
    for form in forms(table) {
        for (name, value) in form["properties"].as_object().into_iter().flatten() {
            let path = if path.is_empty() { name.clone() } else { format!("{path}.{name}") };
            if is_table(value) && name != "parent" {
                let of = value.get("items").unwrap_or(value);
                // Tables with nothing but tables in them have no keys.
                let has_keys = forms(of).iter().any(|form| keys(form).next().is_some());
                if has_keys {
                    found.insert(path.clone());
                }
                tables(of, &path, found);
            }
        }
    }
}

fn keys(form: &Value) -> impl Iterator<Item = (&String, &Value)> {
    form["properties"].as_object().into_iter().flatten().filter(|(name, value)| !is_table(value) || *name == "parent")
}

fn unit(key: &str) -> &'static str {
    const UNITS: [(&str, &str); 13] = [
        ("_mm_s2", "mm/s²"),
        ("_mm_min", "mm/min"),
        ("_mm_s", "mm/s"),
        ("_mm", "mm"),
        ("_um", "µm"),
        ("_nm", "nm"),
        ("_deg", "degrees"),
        ("_urad", "µrad"),
        ("_ppm", "ppm"),
        ("_ms", "ms"),
        ("_for_s", "s"),
        ("_c", "°C"),
        ("_s", "s"),
    ];
    UNITS.iter().find(|(ending, _)| key.ends_with(ending)).map_or("", |(_, unit)| unit)
}

/// Returns a number as a person writes it.
fn number(value: &Value) -> String {
    let text = value.to_string();
    text.strip_suffix(".0").map_or(text.clone(), str::to_owned)
}

fn shown(value: &Value) -> String {
    match value {
        Value::Array(items) => format!("[{}]", items.iter().map(shown).collect::<Vec<_>>().join(", ")),
        Value::Number(_) => number(value),
        other => other.to_string(),
    }
}

/// Returns the allowed words of a key, if it is a choice among words.
fn choices(value: &Value) -> Option<Vec<&str>> {
    if let Some(words) = value.get("enum").and_then(Value::as_array) {
        return words.iter().map(Value::as_str).collect();
    }
    value.get("oneOf")?.as_array()?.iter().map(|one| one["const"].as_str()).collect()
}

/// Returns the allowed values of a key, as text.
fn limits(value: &Value) -> String {
    if let Some(words) = choices(value) {
        return words.iter().map(|word| format!("`\"{word}\"`")).collect::<Vec<_>>().join(", ");
    }
    let bounds = |least: &str, most: &str| match (value.get(least), value.get(most)) {
        (Some(least), Some(most)) => format!("{} ... {}", number(least), number(most)),
        (Some(least), None) => format!("from {}", number(least)),
        (None, Some(most)) => format!("to {}", number(most)),
        (None, None) => String::new(),
    };
    match value["type"].as_str() {
        Some("boolean") => "`true`, `false`".into(),
        Some("string") => format!("text of {} characters", bounds("minLength", "maxLength")),
        Some("array") => {
            let items = value.get("minItems").and_then(Value::as_u64);
            if items.is_some() && value.get("minItems") == value.get("maxItems") {
                let of = value.get("items").map(limits).filter(|of| of != "number");
                return format!(
                    "[{} numbers]{}",
                    items.unwrap_or(0),
                    of.map_or(String::new(), |of| format!(" of {of}"))
                );
            }
            let of = format!("list of {}", limits(&value["items"]).replace("number", "numbers"));
            match (items, value.get("maxItems")) {
                (Some(least), None) => format!("{of}, {least} or more"),
                (_, Some(most)) => format!("{of}, {most} at most"),
                _ => of,
            }
            .replace("numberss", "numbers")
        }
        Some(kind @ ("number" | "integer")) => {
            let limits = bounds("minimum", "maximum");
            match (kind, limits.is_empty()) {
                (_, true) if value.get("x-infinite").is_some() => "number or `inf`".into(),
                ("number", false) => limits,
                (kind, true) => kind.into(),
                (_, false) => format!("{limits}, whole"),
            }
        }
        _ => "a table".into(),
    }
}

fn words(value: &Value) -> String {
    let said = value["description"].as_str().unwrap_or("").to_owned();
    let chosen = value.get("oneOf").and_then(Value::as_array).into_iter().flatten();
    let of = |one: &Value| Some(format!("`\"{}\"`: {}", one["const"].as_str()?, one["description"].as_str()?));
    let chosen: Vec<String> = chosen.filter_map(of).map(|words| words.trim_end_matches('.').to_owned()).collect();
    let all = if chosen.is_empty() { said } else { format!("{said} {}.", chosen.join("; ")) };
    // A bar would end the cell of the table.
    all.replace('\n', " ").replace('|', "\\|")
}

/// Returns the list of the keys of a table, or of each of its forms.
fn list_of(table: &Value) -> String {
    let mut text = String::new();
    let forms = forms(table);
    for form in &forms {
        let required = form.get("required").and_then(Value::as_array).cloned().unwrap_or_default();
        let name = form["properties"]
            .as_object()
            .into_iter()
            .flatten()
            .find_map(|(key, value)| value.get("const").map(|word| format!("`{key} = {word}`")));
        if let Some(name) = name.filter(|_| forms.len() > 1) {
            let _ = writeln!(text, "{}{name}: {}\n", if text.is_empty() { "" } else { "\n" }, words(form));
        }
        let rows: Vec<_> = keys(form).filter(|(_, value)| value.get("const").is_none()).collect();
        if rows.is_empty() {
            text.push_str("It has no further key.\n");
            continue;
        }
        text.push_str("| key | unit | values | default | meaning |\n|---|---|---|---|---|\n");
        for (key, value) in rows {
            let left_out = match value.get("default") {
                _ if required.iter().any(|name| name == key) => "**required**".into(),
                Some(default) => format!("`{}`", shown(default)),
                None => "-".into(),
            };
            let _ = writeln!(text, "| `{key}` | {} | {} | {left_out} | {} |", unit(key), limits(value), words(value));
        }
    }
    text
}

fn who(role: Role) -> &'static str {
    match role {
        Role::Nobody => "it goes away by itself",
        Role::Operator => "the operator",
        Role::ProcessEngineer => "the process engineer",
        _ => panic!("a role that the book does not know"),
    }
}

fn alarms() -> String {
    let mut text = String::new();
    for (k, id) in AlarmId::ALL.iter().enumerate() {
        let alarm = id.generic_alarm();
        let name = serde_json::to_value(id).unwrap();
        let _ = writeln!(text, "{}### {}\n", if k == 0 { "" } else { "\n" }, alarm.event.trim_end_matches('.'));
        let _ = writeln!(text, "{}\n", alarm.consequence);
        for (k, line) in alarm.remedy.iter().enumerate() {
            let _ = writeln!(text, "{}. {line}", k + 1);
        }
        let _ = writeln!(text, "\nCleared by: {}. In the record: `{}`.", who(alarm.cleared_by), name.as_str().unwrap());
    }
    text
}

/// Generates the text between two markers.
fn make(what: &str) -> String {
    match what.split_once(' ') {
        None if what == "alarms" => alarms(),
        Some((kind, paths)) => {
            let lists: BTreeSet<String> = paths.split(", ").map(|path| list_of(table_at(schema(kind), path))).collect();
            assert_eq!(lists.len(), 1, "{what}: the tables differ");
            lists.into_iter().next().unwrap()
        }
        None => panic!("nothing is made of {what}"),
    }
}

/// Returns a page with all generated parts updated, and the names of these parts.
fn made_anew(text: &str) -> (String, Vec<String>) {
    let (mut anew, mut found) = (String::new(), Vec::new());
    let mut rest = text;
    while let Some((before, after)) = rest.split_once(BEGINS) {
        let (what, after) = after.split_once(" -->").expect("the end of a marker");
        let (_, after) = after.split_once(ENDS).unwrap_or_else(|| panic!("no end of {what}"));
        let _ = write!(anew, "{before}{BEGINS}{what} -->\n\n{}\n{ENDS}", make(what));
        found.push(what.to_owned());
        rest = after;
    }
    anew.push_str(rest);
    (anew, found)
}

#[test]
fn generated_text_is_current() {
    for page in TYPED {
        let text = text_of(page);
        let (anew, _) = made_anew(&text);
        if anew == text {
            continue;
        }
        assert!(
            std::env::var_os("REGRIND_REWRITE").is_some(),
            "docs/{page} is not as the program has it; REGRIND_REWRITE=1 cargo test --workspace --test cli made"
        );
        fs::write(path_of(page), anew).unwrap();
    }
}

#[test]
fn generated_lists_are_complete() {
    for (page, kind) in [("recipes.md", "recipe"), ("commissioning.md", "cell"), ("dialects.md", "dialect")] {
        let (_, found) = made_anew(&text_of(page));
        let listed: BTreeSet<String> = found
            .iter()
            .filter_map(|what| what.strip_prefix(&format!("{kind} ")))
            .flat_map(|paths| paths.split(", "))
            .map(str::to_owned)
            .collect();
        let mut all = BTreeSet::new();
        tables(schema(kind), "", &mut all);
        assert_eq!(listed, all, "{page}");
    }
    assert!(made_anew(&text_of("alarms.md")).1.contains(&"alarms".to_owned()));
}
