//! Comparison of a repeated decision or computation with the recorded one. Texts for people and the version of the
//! program may differ: a record of a program with other wording can continue. Every number, name, code and identity
//! must be equal.

use serde_json::Value;

/// Keys of texts for people in the top level of a command.
const COMMAND_TEXTS: [&str; 5] = ["reason", "why", "what", "consequence", "remedy"];
/// Keys of texts for people in events and documents.
const TEXTS: [&str; 16] = [
    "alike",
    "asks",
    "cut_off",
    "direction",
    "filter",
    "made",
    "message",
    "motion",
    "notes",
    "places",
    "reason",
    "removed",
    "warnings",
    "weak_directions",
    "why",
    "words",
];

/// Returns true if two commands in JSON are equal. Ignores the keys of texts for people ([`COMMAND_TEXTS`]), such as
/// the reason and the remedy.
pub(super) fn is_same_decision(one: &Value, other: &Value) -> bool {
    let decision = |command: &Value| {
        let mut command = command.clone();
        if let Some(fields) = command.as_object_mut() {
            COMMAND_TEXTS.iter().for_each(|key| drop(fields.remove(*key)));
        }
        command
    };
    decision(one) == decision(other)
}

/// Returns true if two JSON values are equal. Two different strings also count as equal if both contain a space and
/// both are the value of a key of [`TEXTS`] or elements of its array. Such strings are sentences for people.
pub(super) fn is_same_result(one: &Value, other: &Value) -> bool {
    are_equal(one, other, false)
}

fn are_equal(one: &Value, other: &Value, is_text: bool) -> bool {
    match (one, other) {
        (Value::String(one), Value::String(other)) => {
            one == other || is_text && one.contains(' ') && other.contains(' ')
        }
        (Value::Array(one), Value::Array(other)) => {
            one.len() == other.len() && one.iter().zip(other).all(|(one, other)| are_equal(one, other, is_text))
        }
        (Value::Object(one), Value::Object(other)) => {
            one.len() == other.len()
                && one.iter().all(|(key, one)| {
                    other.get(key).is_some_and(|other| are_equal(one, other, TEXTS.contains(&key.as_str())))
                })
        }
        _ => one == other,
    }
}

/// Returns true if the contents `one` and `other` of two files are equal, apart from texts for people and the version
/// of the program. `name` is the name of both files. The name selects the comparison: JSON values for `.json`, and lines
/// of text for every other file. Returns false if the contents differ and one of them is not UTF-8.
pub(super) fn is_same_file(name: &str, one: &[u8], other: &[u8]) -> bool {
    if one == other {
        return true;
    }
    let [Ok(one), Ok(other)] = [one, other].map(std::str::from_utf8) else { return false };
    if name.ends_with(".json") {
        let [one, other] = [one, other].map(|text| {
            let mut document = serde_json::from_str::<Value>(text).ok()?;
            if let Some(version) = document.pointer_mut("/program/version") {
                *version = Value::Null;
            }
            Some(document)
        });
        return one.zip(other).is_some_and(|(one, other)| is_same_result(&one, &other));
    }
    let [one, other] = [one, other].map(|text| text.lines().map(without_version).collect::<Vec<_>>());
    one.len() == other.len()
        && one.iter().zip(&other).all(|(one, other)| one == other || is_remark(one) && is_remark(other))
}

/// Returns a line of a tool path without the version of the program. Changes only lines such as `Regrind 1.2.3 tool
/// path`.
fn without_version(line: &str) -> String {
    let version = line.split_once("Regrind ").and_then(|(before, after)| {
        let (version, rest) = after.split_once(" tool path")?;
        (!version.contains(' ')).then(|| format!("{before}Regrind tool path{rest}"))
    });
    version.unwrap_or_else(|| line.to_owned())
}

/// Returns true if a line of a file is a comment about a compensated machine parameter. Such a line begins with a
/// comment sign (`#`, `(` or `;`), followed by `parameter: `.
///
/// The comparison of two files ignores differences between two such comments. The correction contains the same number,
/// and the correction is compared too.
fn is_remark(line: &str) -> bool {
    let comment = line.trim_start().trim_start_matches(['#', '(', ';']).trim_start();
    comment.len() < line.len() && comment.starts_with("parameter: ")
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn decisions_differ_only_in_texts() {
        let raised = |id: &str, text: &str| json!({ "command": "raise", "id": id, "what": text, "consequence": text, "remedy": [text], "clears": "operator" });
        let announced = |verdict: &str, text: &str| json!({ "command": "announce", "cycle": 1, "verdict": verdict, "reason": text });
        let refused = |value: Value, text: &str| json!({ "command": "refuse", "event": { "event": "qualified", "radius_error_mm": value, "why": "a b" }, "why": text });
        let decisions: [&dyn Fn(&str) -> Value; 7] = [
            &|text| raised("unreachable", text),
            &|text| raised("word_order", text),
            &|text| announced("accept", text),
            &|text| announced("continue", text),
            &|text| refused(json!("NaN"), text),
            &|text| refused(json!(1.0), text),
            &|text| json!({ "command": "announce", "cycle": 1, "verdict": "accept", "reason": text, "new": 1 }),
        ];
        for (k, one) in decisions.iter().enumerate() {
            for (l, other) in decisions.iter().enumerate() {
                assert_eq!(is_same_decision(&one("a b"), &other("c d")), k == l, "{} {}", one("a b"), other("c d"));
            }
        }
    }

    #[test]
    fn results_differ_only_in_texts() {
        let one = json!({ "weak_directions": ["y shift: found again to 6.7 um only"], "rms_mm": 0.1, "kind": "a pass",
            "file": "my part.csv", "n": null });
        let with = |key: &str, value: Value| {
            let mut other = one.clone();
            other[key] = value;
            other
        };
        for (other, is_same) in [
            (with("weak_directions", json!(["y position repeats only to 6.7 µm"])), true),
            (with("weak_directions", json!(["y"])), false),
            (with("weak_directions", json!([])), false),
            (with("weak_directions", json!("y position repeats only to 6.7 µm")), false),
            (with("rms_mm", json!(0.100_000_000_000_000_02)), false),
            (with("kind", json!("another pass")), false),
            (with("file", json!("your part.csv")), false),
            (with("n", json!(0)), false),
            (with("more", json!(0)), false),
            (one.clone(), true),
        ] {
            assert_eq!(is_same_result(&one, &other), is_same, "{other}");
            assert_eq!(is_same_result(&other, &one), is_same, "{other}");
        }
    }

    #[test]
    fn files_differ_only_in_texts_and_version() {
        for (name, one, other, is_same) in [
            ("c/toolpath.ngc", "(Regrind 0.1.0 tool path)\nG1 X1\n", "(Regrind 0.2.0-rc.1 tool path)\nG1 X1\n", true),
            ("c/toolpath.ngc", "(Regrind 0.1.0 tool path)\nG1 X1\n", "(Regrind 0.2.0 tool path)\nG1 X2\n", false),
            ("c/toolpath.ngc", "(part: Regrind 7)\n", "(part: Regrind 8)\n", false),
            ("c/toolpath.ngc", "(map: sha256 1)\n", "(map: sha256 2)\n", false),
            (
                "c/correction.csv",
                "# parameter: z: off by 1 um; a b\n1,2\n",
                "# parameter: z: off by 1 um; c\n1,2\n",
                true,
            ),
            ("c/correction.csv", "# part: a b\n1,2\n", "# part: a c\n1,2\n", false),
            ("c/correction.csv", "1,2\n", "1,2\n1,2\n", false),
            ("c/form.csv", "1,2,0.1,a b\n", "1,2,0.1,a c\n", false),
            ("c/f.json", r#"{"program":{"version":"0.1.0"},"a":1}"#, r#"{"program":{"version":"0.2.0"},"a":1}"#, true),
            ("c/f.json", r#"{"version":"0.1.0"}"#, r#"{"version":"0.2.0"}"#, false),
            ("c/f.json", "{", "}", false),
        ] {
            assert_eq!(is_same_file(name, one.as_bytes(), other.as_bytes()), is_same, "{one}{other}");
        }
        assert!(!is_same_file("c/map.png", &[0xff, 1], &[0xff, 2]));
    }
}
