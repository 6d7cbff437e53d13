//! Names of the files that the journal writes into a run folder, and names that lead nowhere else on any system.

/// Name of the database file in a run folder.
pub const DATABASE: &str = "journal.sqlite";
/// Name of the anchor file in a run folder.
pub const ANCHOR: &str = "journal.anchor";
/// Name of the lock file in a run folder.
pub const LOCK: &str = ".lock";

/// Names of devices that Windows finds in every folder, with any ending.
const DEVICES: [&str; 4] = ["con", "prn", "aux", "nul"];
const NUMBERED_DEVICES: [&str; 2] = ["com", "lpt"];

/// Returns true if `name`, which came from another computer, can be the name of one file or folder here. Returns false
/// for a name that can lead to another place on any system: an empty name, a name with a separator or a control
/// character, `.` and `..`, a name that begins with the letter of a drive, a name whose end Windows leaves out, and the
/// name of a device of Windows.
pub fn is_plain_name(name: &str) -> bool {
    let leads_elsewhere = |c: char| c.is_control() || matches!(c, '/' | '\\') || is_direction_mark(c);
    !name.is_empty()
        && !name.chars().any(leads_elsewhere)
        && !name.ends_with(['.', ' '])
        && name.chars().nth(1) != Some(':')
        && !is_device(name)
}

/// Returns true if `c` changes the direction in which a name is shown, so that another name is read.
fn is_direction_mark(c: char) -> bool {
    matches!(c, '\u{200e}' | '\u{200f}' | '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}')
}

fn is_device(name: &str) -> bool {
    let stem = name.split('.').next().unwrap_or_default().trim_end().to_ascii_lowercase();
    let is_numbered = |device: &str| {
        stem.strip_prefix(device).is_some_and(|number| number.len() == 1 && number.chars().all(|c| c.is_ascii_digit()))
    };
    DEVICES.contains(&&*stem) || NUMBERED_DEVICES.into_iter().any(is_numbered)
}

/// Returns true if the name of a file, which can have `/` between its parts, is plain in each part and is none of the
/// journal's own files on a system that does not distinguish capital letters. A colon names another content of a file on
/// Windows.
pub fn is_plain_path(name: &str) -> bool {
    let first = name.split('/').next().unwrap_or_default().to_lowercase();
    !name.contains(':')
        && name.split('/').all(is_plain_name)
        && !first.starts_with(DATABASE)
        && ![ANCHOR, LOCK].contains(&&*first)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn plain_names_lead_nowhere_else() {
        for name in ["run-1", "Spiegel \u{e4}\u{6f22} (2)", ".lock", "console", "com10", "a..b", "comma.csv"] {
            assert!(is_plain_name(name), "{name:?}");
        }
        let bad = [
            "",
            ".",
            "..",
            "a/b",
            "/a",
            "a\\b",
            "C:a",
            "c:",
            "a\n",
            "\u{1b}a",
            "\u{9b}a",
            "a\u{202e}b",
            "a.",
            "a ",
            "NUL",
            "con.txt",
            "Com1",
            "lpt9.a.b",
            "aux .c",
        ];
        for name in bad {
            assert!(!is_plain_name(name), "{name:?}");
        }
    }

    #[test]
    fn plain_paths_are_none_of_the_journal() {
        for name in ["recipe.toml", "cycle-1/measured.csv", "cycle-1/journal.sqlite"] {
            assert!(is_plain_path(name), "{name:?}");
        }
        for name in [
            "a//b",
            "a/",
            "/a",
            "a/../b",
            "./a",
            "journal.sqlite",
            "JOURNAL.sqlite-wal",
            "Journal.Anchor",
            ".lock",
            "a/nul",
            "journal.anchor::$DATA",
        ] {
            assert!(!is_plain_path(name), "{name:?}");
        }
    }
}
