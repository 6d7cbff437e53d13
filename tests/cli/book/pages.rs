//! The pages, typed. A block `sh` is typed as it stands, in a folder with what ships; `sh second` in a second terminal beside it. A block
//! `text` behind one is what its screen shows, where `...` stands for anything; a command that goes on is left to itself once that was seen,
//! until its terminal is typed in again. A block `toml` that begins with the name of a file is that file; any other one takes the place of the
//! same tables of a recipe or a cell file, and is checked. Blocks `console` need what a test has not, and are not typed.

use std::collections::BTreeMap;
use std::fs;
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU32, Ordering};

use super::terminal::Terminal;
use super::{blocks, root, text_of};

/// The ports of machines and pages in the book, which are some that are free where it is typed.
const PORTS: [&str; 2] = ["15021", "15022"];

/// A port at which nothing listens, that the system gives to nobody by itself, and that is kept from other tests meanwhile.
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

/// A folder with the recipes and the cells that ship.
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

/// The name that stands above a file.
fn file_name(block: &str) -> Option<&str> {
    let name = block.lines().next()?.strip_prefix("# ")?;
    (name.ends_with(".toml") && !name.contains(' ')).then_some(name)
}

/// Puts the tables of a fragment into the place of those of a file: the keys of a table replace all of its keys.
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

/// Writes the shipped file that a fragment is one of, with its tables.
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
    // What is still under way is ended, and what was made is kept for who proves it.
    drop(terminals);
    crate::keep::keep(home.path());
}

macro_rules! typed {
    ($($name:ident: $page:literal)+) => {
        /// The pages that are typed here.
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
    recipes_are_written: "recipes.md"
    a_cell_is_commissioned: "commissioning.md"
    a_person_serves_the_machines: "manual.md"
    alarms_are_met: "alarms.md"
    files_are_read: "formats.md"
    other_controls_are_written_for: "dialects.md"
    results_are_written_for_others: "results.md"
    the_method_is_followed: "method.md"
}
