//! Runs the pages. A block `sh` runs unchanged, in a folder with the shipped files; `sh second` runs in a second
//! terminal in parallel. A block `text` after it is the expected screen, in which `...` matches anything. A command
//! that is still running then continues, until the page types into its terminal again. A block `toml` that begins with
//! the name of a file is that file. Any other one replaces the same tables of a recipe or a cell file, and is checked.
//! Blocks `console` need something that a test does not have, and are not run.

use std::collections::BTreeMap;
use std::fs;
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU32, Ordering};

use super::terminal::Terminal;
use super::{blocks, root, text_of};

/// Ports of machines and pages in the book. The test replaces them with free ports.
const PORTS: [&str; 2] = ["15021", "15022"];

/// Port on which nothing listens, which the system does not assign by itself, and which is reserved against other
/// tests.
struct FreePort {
    port: u16,
    _kept: fs::File,
}

impl FreePort {
    fn find() -> Self {
        static NEXT: AtomicU32 = AtomicU32::new(0);
        loop {
            let k = std::process::id().wrapping_mul(31).wrapping_add(NEXT.fetch_add(1, Ordering::Relaxed));
            let port = 10_000 + u16::try_from(k % 20_000).unwrap();
            let kept = fs::File::create(std::env::temp_dir().join(format!("regrind-book-port-{port}"))).unwrap();
            if kept.try_lock().is_ok() && TcpListener::bind(("127.0.0.1", port)).is_ok() {
                return Self { port, _kept: kept };
            }
        }
    }
}

/// Returns a folder with the shipped recipes and cells.
fn shop() -> tempfile::TempDir {
    let home = tempfile::tempdir().unwrap();
    for folder in ["config", "recipes"] {
        fs::create_dir(home.path().join(folder)).unwrap();
        let entries = fs::read_dir(root().join(folder)).unwrap().map(Result::unwrap);
        for entry in entries.filter(|entry| entry.path().is_file()) {
            fs::copy(entry.path(), home.path().join(folder).join(entry.file_name())).unwrap();
        }
    }
    home
}

/// Returns the file name at the top of a block.
fn file_name(block: &str) -> Option<&str> {
    let name = block.lines().next()?.strip_prefix("# ")?;
    (name.ends_with(".toml") && !name.contains(' ')).then_some(name)
}

/// Replaces tables of a file by those of a fragment: the keys of a table replace all of its keys.
fn put(into: &mut toml::Table, from: toml::Table) {
    if from.contains_key("file") {
        into.clear();
    } else if from.values().any(|value| !value.is_table()) {
        into.retain(|_, value| value.is_table());
    }
    for (name, value) in from {
        match (value, into.get_mut(&name)) {
            (toml::Value::Table(table), Some(toml::Value::Table(there))) => put(there, table),
            (value, _) => drop(into.insert(name, value)),
        }
    }
}

/// Writes the shipped file to which a fragment belongs, with the fragment's tables.
fn whole(fragment: &str, home: &Path) -> PathBuf {
    let tables: toml::Table = fragment.parse().unwrap_or_else(|e| panic!("{e}\n{fragment}"));
    let is_cell = tables.keys().all(|name| ["cell", "cmm", "grinder"].contains(&name.as_str()));
    let wire = tables.get("cmm").and_then(|cmm| cmm.get("wire")?.get("kind")?.as_str());
    let shipped = home.join(match wire {
        Some("manual") => "config/manual.toml",
        _ if is_cell => "config/modbus-tcp.toml",
        _ => "recipes/freeform-mirror.toml",
    });
    let mut file: toml::Table = fs::read_to_string(&shipped).unwrap().parse().unwrap();
    if tables.contains_key("nominal") {
        // The truth of the shipped part is not that of another one.
        file.remove("simulation");
    }
    put(&mut file, tables);
    let path = shipped.with_file_name("fragment.toml");
    fs::write(&path, toml::to_string(&file).unwrap()).unwrap();
    path
}

fn type_page(page: &str) {
    let home = shop();
    let mut text = text_of(page);
    let free: Vec<(&str, FreePort)> =
        PORTS.into_iter().filter(|port| text.contains(port)).map(|port| (port, FreePort::find())).collect();
    for (port, FreePort { port: free, .. }) in &free {
        text = text.replace(port, &free.to_string());
    }
    let mut terminals: BTreeMap<String, Terminal> = BTreeMap::new();
    let mut last = String::new();
    for block in blocks(&text) {
        let which = block.info.get(1).cloned();
        if block.is("sh") {
            last = which.unwrap_or_else(|| "first".into());
            terminals.entry(last.clone()).or_insert_with(|| Terminal::new(home.path())).types(&block.text);
        } else if block.is("text") {
            let which = which.unwrap_or_else(|| last.clone());
            let terminal = terminals.get_mut(&which).unwrap_or_else(|| panic!("{page}:{}: no terminal", block.line));
            terminal.shows(&block.text);
        } else if block.is("toml") {
            match file_name(&block.text) {
                Some(name) => {
                    let path = home.path().join(name);
                    fs::create_dir_all(path.parent().unwrap()).unwrap();
                    fs::write(path, &block.text).unwrap();
                }
                None => {
                    let path = whole(&block.text, home.path()).display().to_string();
                    let (code, out, err) = crate::program::run(&["check", &path], home.path());
                    assert_eq!(code, 0, "{page}:{}: {out}{err}", block.line);
                }
            }
        }
    }
    terminals.values_mut().for_each(Terminal::until_it_ends);
    // End what is still running, and keep the generated files for the checks.
    drop(terminals);
    regrind_testutils::keep::keep(home.path());
}

macro_rules! typed {
    ($($name:ident: $page:literal)+) => {
        /// Pages that are typed in this test.
        pub(super) const TYPED: &[&str] = &[$($page),+];

        $(
            #[test]
            fn $name() {
                type_page($page);
            }
        )+
    };
}

typed! {
    the_introduction_is_typed: "introduction.md"
    the_first_part_is_made: "first-part.md"
    own_part_is_made: "own-part.md"
    recipes_are_written: "recipes.md"
    a_cell_is_commissioned: "commissioning.md"
    a_person_serves_the_machines: "manual.md"
    alarms_are_met: "alarms.md"
    files_are_read: "formats.md"
    other_controls_are_written_for: "dialects.md"
    results_are_written_for_others: "results.md"
    the_method_is_followed: "method.md"
}
