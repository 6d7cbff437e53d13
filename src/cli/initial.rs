//! Initial pose of `--initial`: sixteen numbers as JSON or text, or the result of an earlier registration.

use std::fs::File;
use std::io::Read;
use std::path::Path;

use regrind::geometry::Pose;
use serde::Deserialize;

use super::failure::Failure;

/// Maximum size of the file in bytes, far above the size of registration.json.
const MAX_BYTES: u64 = 64 << 20;

type Rows = [[f64; 4]; 4];

/// The only key that is read from the registration.json of an earlier registration.
#[derive(Deserialize)]
struct Earlier {
    cmm_from_model: Rows,
}

/// Reads the pose `cmm_from_model` from the file `path`. The pose transforms model coordinates to coordinates of the
/// measuring machine, in mm. The file contains sixteen numbers (a 4 x 4 matrix, row by row) as text or JSON, or is the
/// `registration.json` of an earlier registration.
///
/// # Errors
/// Returns an error if the file cannot be read, is larger than 64 MiB, is neither JSON nor sixteen numbers, or does not
/// contain a rigid pose.
pub(super) fn read_pose(path: &Path) -> Result<Pose, Failure> {
    let failed = |reason: String| Failure::Initial { path: path.to_owned(), reason };
    let mut bytes = Vec::new();
    let read = File::open(path).and_then(|file| file.take(MAX_BYTES + 1).read_to_end(&mut bytes));
    read.map_err(|e| failed(format!("cannot be read: {e}")))?;
    if bytes.len() as u64 > MAX_BYTES {
        return Err(failed(format!("the file is larger than {MAX_BYTES} bytes")));
    }
    let text = String::from_utf8(bytes).map_err(|_| failed("the file is not text".into()))?;
    let rows = parse(&text).map_err(failed)?;
    Pose::from_rows(rows).map_err(|e| failed(e.to_string()))
}

fn parse(text: &str) -> Result<Rows, String> {
    let text = text.trim_start_matches('\u{feff}').trim();
    let json = |e: serde_json::Error| format!("as JSON: {e}");
    match text.chars().next() {
        None => Err("the file is empty".into()),
        Some('{') => serde_json::from_str::<Earlier>(text).map(|e| e.cmm_from_model).map_err(json),
        Some('[') => serde_json::from_str(text).map_err(json),
        Some(_) => sixteen_numbers(text),
    }
}

fn sixteen_numbers(text: &str) -> Result<Rows, String> {
    let without_comments = text.lines().filter(|line| !line.trim_start().starts_with('#'));
    let words: Vec<&str> = without_comments
        .flat_map(|line| line.split(|c: char| c.is_whitespace() || c == ',' || c == ';'))
        .filter(|word| !word.is_empty())
        .take(17)
        .collect();
    let mut rows = Rows::default();
    for (k, word) in words.iter().enumerate().take(16) {
        rows[k / 4][k % 4] = word.parse().map_err(|_| {
            format!("number {} reads `{}`", k + 1, word.chars().take(24).collect::<String>().escape_default())
        })?;
    }
    match words.len() {
        16 => Ok(rows),
        17 => Err("there are more than 16 numbers".into()),
        found => Err(format!("there are {found} numbers")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pose_parse_accepts_every_form() {
        let rows = [[0.0, -1.0, 0.0, 5.0], [1.0, 0.0, 0.0, 6.0], [0.0, 0.0, 1.0, 7.0], [0.0, 0.0, 0.0, 1.0]];
        let array = serde_json::to_string(&rows).unwrap();
        assert_eq!(parse(&array), Ok(rows));
        assert_eq!(parse(&format!("{{\"used\": 3, \"cmm_from_model\": {array}}}")), Ok(rows));
        assert_eq!(parse("# a pose\n0 -1 0 5\n1,0,0,6\n0;0;1;7\n0\t0\t0\t1\n"), Ok(rows));
    }

    #[test]
    fn pose_parse_refuses_malformed() {
        let wrong = |text: &str| parse(text).unwrap_err();
        assert_eq!(wrong(""), "the file is empty");
        assert_eq!(wrong("1 2 3"), "there are 3 numbers");
        assert_eq!(wrong(&"1 ".repeat(20)), "there are more than 16 numbers");
        assert_eq!(wrong("1 x 3"), "number 2 reads `x`");
        assert!(wrong("{}").contains("cmm_from_model"));
        assert!(wrong("[[1, 2], [3, 4]]").contains("JSON"));
        assert!(wrong("{\"cmm_from_model\": [[").contains("JSON"));
    }
}
