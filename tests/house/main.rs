//! Architecture rules: which module ("room") may depend on which, and what each must not contain.
//!
//! The compiler enforces the dependencies between crates. These tests enforce the rest.

mod circles;
mod functions;

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

/// Every room, its folder or file, and the rooms that it may name. A dependency that is not in a line here points in
/// the wrong direction.
const ARROWS: [(&str, &str, &[&str]); 30] = [
    ("figures", "src/figures", &[]),
    ("geometry", "src/core/geometry", &[]),
    ("surface", "src/core/surface", &["geometry"]),
    ("measuring", "src/core/measuring", &["geometry", "surface"]),
    ("registration", "src/core/registration", &["geometry", "surface"]),
    ("stitching", "src/core/stitching", &["geometry", "registration", "surface"]),
    ("compensation", "src/core/compensation", &["geometry", "sparse", "surface", "registration", "model"]),
    ("model", "src/core/model", &["form", "geometry", "registration", "sparse"]),
    ("sparse", "src/core/sparse.rs", &[]),
    ("form", "src/core/form", &["geometry", "surface"]),
    ("cell", "src/cell", &[]),
    ("document", "src/document", &[]),
    ("windows", "src/windows", &[]),
    ("journal", "src/journal", &[]),
    ("formats", "src/formats", &CORE),
    ("control", "src/control", &["cell", "document", "formats"]),
    ("recipe", "src/recipe", &["document", "cell", "measuring", "geometry", "surface", "registration", "compensation"]),
    ("device", "src/device", &["document", "formats", "geometry"]),
    ("config", "src/config", &["device", "document", "formats", "geometry", "model"]),
    ("trust", "src/trust", &["formats"]),
    ("live", "src/live", &["cell", "control", "document", "formats", "trust"]),
    ("notify", "src/notify", &["document", "formats", "trust"]),
    ("plant", "src/plant", &["document", "formats", "journal", "language", "page", "report", "trust"]),
    ("record", "src/record", &["cell", "formats", "journal"]),
    ("language", "src/language", &["cell"]),
    (
        "report",
        "src/report",
        &["cell", "document", "journal", "formats", "geometry", "language", "record", "registration"],
    ),
    (
        "python",
        "src/python",
        &["figures", "formats", "geometry", "surface", "registration", "compensation", "form", "model"],
    ),
    ("page", "src/page", &["cell", "control", "document", "formats", "language", "report"]),
    (
        "drive",
        "src/drive",
        &[
            CORE[0], CORE[1], CORE[2], CORE[3], CORE[4], CORE[5], CORE[6], "cell", "control", "device", "figures",
            "formats", "journal", "record", "report",
        ],
    ),
    (
        "setup",
        "src/setup",
        &[CORE[0], CORE[1], CORE[2], CORE[3], CORE[4], "cell", "config", "device", "drive", "formats", "recipe"],
    ),
];

/// The rooms of the numerical core.
const CORE: [&str; 8] =
    ["geometry", "surface", "measuring", "registration", "compensation", "form", "model", "stitching"];

/// Files that may name an operating system, with the code that is specific to it: twins with the same functions, and
/// the code that chooses between them.
const SYSTEMS: [&str; 17] = [
    "sim/wire/mod.rs",
    "sim/wire/pty.rs",
    "src/cli/outside/mod.rs",
    "src/cli/outside/unix.rs",
    "src/cli/outside/windows.rs",
    "src/control/endpoint/mod.rs",
    "src/control/endpoint/unix.rs",
    "src/control/endpoint/windows.rs",
    "src/device/modbus/serial_port/mod.rs",
    "src/device/modbus/serial_port/unix.rs",
    "src/formats/system/mod.rs",
    "src/formats/system/unix.rs",
    "src/formats/system/windows.rs",
    "src/journal/system/mod.rs",
    "src/journal/system/unix.rs",
    "src/journal/system/windows.rs",
    "src/windows",
];

/// Words that name one operating system.
const OF_ONE_SYSTEM: [&str; 17] = [
    "(unix)",
    "(windows)",
    "(not(unix))",
    "(not(windows))",
    "target_os",
    "target_family",
    "os::unix",
    "os::linux",
    "os::windows",
    "os::fd",
    "rustix",
    "regrind_windows",
    "windows_sys",
    "signal::unix",
    "signal::windows",
    "\"/proc/",
    "\"/etc/",
];

/// Words that must not occur in the numerical core and in the decision code of the machine.
const IMPURE: [&str; 13] = [
    "tokio",
    "async ",
    ".await",
    "std::fs",
    "std::net",
    "std::io",
    "Instant",
    "SystemTime",
    "rand::",
    "println!",
    "tracing",
    "log::",
    "std::process",
];

/// Source file and its code, without comments and without its tests.
struct Source {
    path: PathBuf,
    code: String,
}

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// Returns the sources of a room, without the tests, benches and examples of its crate.
fn sources(room: &str) -> Vec<Source> {
    let files = rust_files(room, &["tests", "benches", "examples"]);
    let read = |path: PathBuf| Source { code: code_of(&fs::read_to_string(&path).unwrap()), path };
    files.into_iter().map(read).collect()
}

/// Returns the Rust files below a folder, except those in folders with these names.
fn rust_files(folder: &str, left_out: &[&str]) -> Vec<PathBuf> {
    let mut found = Vec::new();
    let mut open = vec![root().join(folder)];
    while let Some(path) = open.pop() {
        if left_out.iter().any(|name| path.ends_with(name)) {
            continue;
        } else if path.is_dir() {
            open.extend(fs::read_dir(&path).unwrap().map(|entry| entry.unwrap().path()));
        } else if path.extension().is_some_and(|e| e == "rs") {
            found.push(path);
        }
    }
    assert!(!found.is_empty(), "no Rust file in {folder}");
    found
}

/// Removes comments, and the tests at the end of a file.
fn code_of(text: &str) -> String {
    let tests =
        ["mod ", "pub(super) mod ", "pub(crate) mod "].map(|begin| text.find(&format!("#[cfg(test)]\n{begin}")));
    let before_tests = &text[..tests.into_iter().flatten().min().unwrap_or(text.len())];
    before_tests.lines().map(|line| line.split("//").next().unwrap_or(line)).fold(String::new(), |mut code, line| {
        code.push_str(line);
        code.push('\n');
        code
    })
}

/// Returns the first path segments after one of our crates: `a` and `b` of `use crate::{a::X, b}`.
fn named<'a>(code: &'a str, crates: &[&str]) -> Vec<&'a str> {
    let mut names = Vec::new();
    for name in crates {
        let begins = format!("{name}::");
        for (at, _) in code.match_indices(&begins) {
            let rest = &code[at + begins.len()..];
            match rest.strip_prefix('{') {
                Some(list) => names.extend(top_level(list)),
                None => names.extend(rest.split(|c: char| !c.is_alphanumeric() && c != '_').next()),
            }
        }
    }
    names
}

/// Returns the first names in a list in braces. Skips nested braces.
fn top_level(list: &str) -> Vec<&str> {
    let (mut depth, mut begins, mut names) = (0, 0, Vec::new());
    for (at, c) in list.char_indices() {
        match c {
            '{' => depth += 1,
            '}' if depth > 0 => depth -= 1,
            '}' | ',' if depth == 0 => {
                names.extend(list[begins..at].split("::").next().map(str::trim));
                begins = at + 1;
                if c == '}' {
                    break;
                }
            }
            _ => {}
        }
    }
    names
}

fn assert_absent<'a>(sources: impl IntoIterator<Item = &'a Source>, words: &[&str]) {
    for Source { path, code } in sources {
        for word in words {
            let line = code.lines().find(|line| line.contains(word));
            assert!(line.is_none(), "{} must not say `{word}`: {}", path.display(), line.unwrap_or_default().trim());
        }
    }
}

fn is_in(source: &Source, room: &str) -> bool {
    source.path.starts_with(root().join(room))
}

#[test]
fn room_dependencies_follow_arrows() {
    let rooms = || ARROWS.iter().map(|(room, ..)| *room).chain(["cli"]);
    for (room, place, may) in ARROWS {
        // Rooms that are crates name their own files by `crate`.
        let apart = [
            "cell", "control", "journal", "figures", "formats", "document", "device", "live", "notify", "page",
            "plant", "python", "record", "report", "windows",
        ];
        let crates = if apart.contains(&room) { &["regrind_core"][..] } else { &["crate", "regrind_core"] };
        for source in sources(place) {
            for name in named(&source.code, crates) {
                let fine = name == room || may.contains(&name) || !rooms().any(|other| other == name);
                assert!(fine, "{}: `{room}` must not know `{name}`", source.path.display());
            }
        }
    }
}

#[test]
fn every_source_folder_is_a_room() {
    for folder in ["src", "src/core"] {
        for entry in fs::read_dir(root().join(folder)).unwrap().map(|entry| entry.unwrap().path()) {
            let name = entry.file_stem().unwrap().to_string_lossy().into_owned();
            let known = ARROWS.iter().any(|(room, ..)| *room == name);
            let no_room = ["cli", "core", "lib", "main", "tests", "Cargo"].contains(&name.as_str());
            assert!(known || no_room, "{} stands in no line of the arrows", entry.display());
        }
    }
}

#[test]
fn named_reads_use_lists_and_paths() {
    let code = "use crate::{a::{self, X}, b, c::Y};\nlet d = crate::d::e(regrind_core::f::G);";
    assert_eq!(named(code, &["crate", "regrind_core"]), ["a", "b", "c", "d", "f"]);
}

#[test]
fn core_cell_and_figures_are_pure() {
    for room in ["src/core", "src/cell", "src/figures"] {
        assert_absent(&sources(room), &IMPURE);
    }
}

/// Returns the crates that the manifest of one of our crates depends on, for every system or for one.
fn dependencies(manifest: &str) -> Vec<String> {
    names_in(manifest, "dependencies")
}

/// Returns the crates in one kind of list of a manifest, such as `dev-dependencies`, for every system or for one.
fn names_in(manifest: &str, kind: &str) -> Vec<String> {
    let text = fs::read_to_string(root().join(manifest)).unwrap();
    let table: toml::Table = text.parse().unwrap();
    let systems = table.get("target").and_then(toml::Value::as_table).into_iter().flat_map(toml::Table::values);
    let lists = table.get(kind).into_iter().chain(systems.filter_map(|system| system.get(kind)));
    lists.flat_map(|list| list.as_table().unwrap().keys().cloned()).collect()
}

/// Returns the folders of the crates of this workspace.
fn members() -> Vec<String> {
    let workspace: toml::Table = fs::read_to_string(root().join("Cargo.toml")).unwrap().parse().unwrap();
    let members = workspace["workspace"]["members"].as_array().unwrap().iter();
    members.map(|member| member.as_str().unwrap().to_owned()).chain([".".to_owned()]).collect()
}

#[test]
fn crates_depend_downwards_only() {
    for (manifest, may) in [
        ("src/figures/Cargo.toml", &[][..]),
        ("src/core/Cargo.toml", &["regrind-figures"]),
        ("src/cell/Cargo.toml", &["regrind-figures"]),
        ("src/windows/Cargo.toml", &[]),
        ("src/journal/Cargo.toml", &["regrind-windows"]),
        ("src/document/Cargo.toml", &[]),
        ("src/formats/Cargo.toml", &["regrind-core", "regrind-figures", "regrind-windows"]),
        ("src/device/Cargo.toml", &["regrind-core", "regrind-document", "regrind-figures", "regrind-formats"]),
        ("src/control/Cargo.toml", &["regrind-cell", "regrind-document", "regrind-formats", "regrind-windows"]),
        (
            "src/page/Cargo.toml",
            &[
                "regrind-cell",
                "regrind-control",
                "regrind-document",
                "regrind-formats",
                "regrind-language",
                "regrind-report",
            ],
        ),
        ("src/language/Cargo.toml", &["regrind-cell"]),
        ("src/trust/Cargo.toml", &["regrind-formats"]),
        (
            "src/live/Cargo.toml",
            &["regrind-cell", "regrind-control", "regrind-document", "regrind-formats", "regrind-trust"],
        ),
        ("src/notify/Cargo.toml", &["regrind-document", "regrind-formats", "regrind-trust"]),
        (
            "src/plant/Cargo.toml",
            &[
                "regrind-document",
                "regrind-figures",
                "regrind-formats",
                "regrind-journal",
                "regrind-language",
                "regrind-page",
                "regrind-report",
                "regrind-trust",
            ],
        ),
        ("src/record/Cargo.toml", &["regrind-cell", "regrind-formats", "regrind-journal"]),
        (
            "src/report/Cargo.toml",
            &[
                "regrind-cell",
                "regrind-core",
                "regrind-document",
                "regrind-figures",
                "regrind-formats",
                "regrind-journal",
                "regrind-language",
                "regrind-record",
            ],
        ),
        ("sim/Cargo.toml", &[]),
        ("tests/testutils/Cargo.toml", &[]),
        ("tests/testsim/Cargo.toml", &["regrind-sim"]),
        ("tests/testcell/Cargo.toml", &["regrind", "regrind-sim", "regrind-testsim", "regrind-testutils"]),
        ("tests/testparsers/Cargo.toml", &["regrind", "regrind-sim", "regrind-testcell", "regrind-testutils"]),
    ] {
        let ours: Vec<_> = dependencies(manifest).into_iter().filter(|name| name.starts_with("regrind")).collect();
        assert!(ours.iter().all(|name| may.contains(&name.as_str())), "{manifest}: {ours:?}");
    }
    for manifest in ["src/core/Cargo.toml", "src/cell/Cargo.toml", "src/figures/Cargo.toml"] {
        let heavy = ["tokio", "tokio-modbus", "tokio-serial", "rusqlite", "clap", "serialport", "miette", "rand"];
        let found: Vec<_> = dependencies(manifest).into_iter().filter(|name| heavy.contains(&name.as_str())).collect();
        assert!(found.is_empty(), "{manifest}: {found:?}");
    }
}

#[test]
fn unsafe_only_in_disk_python_and_windows() {
    const APART: [&str; 3] = ["src/journal/tests/disk", "src/python", "src/windows"];
    let workspace: toml::Table = fs::read_to_string(root().join("Cargo.toml")).unwrap().parse().unwrap();
    assert_eq!(workspace["workspace"]["lints"]["rust"]["unsafe_code"].as_str(), Some("forbid"));
    for member in members() {
        let manifest = format!("{member}/Cargo.toml");
        let table: toml::Table = fs::read_to_string(root().join(&manifest)).unwrap().parse().unwrap();
        let inherits = table["lints"].get("workspace").and_then(toml::Value::as_bool) == Some(true);
        assert_eq!(inherits, !APART.contains(&member.as_str()), "{manifest} keeps the lints of the house");
        assert!(!dependencies(&manifest).iter().any(|name| name == "regrind-disk"), "{manifest}");
        let everywhere = table.get("dependencies").is_some_and(|list| list.get("regrind-windows").is_some());
        assert!(!everywhere, "{manifest} needs regrind-windows on Windows alone");
    }
}

/// The tests of a crate below the package `regrind` use only `regrind-testutils`, and those of `sim` also
/// `regrind-testsim`: the other test crates would build all of `regrind` before them.
#[test]
fn test_crates_only_in_tests() {
    for member in members() {
        let manifest = format!("{member}/Cargo.toml");
        let in_list = |kind| names_in(&manifest, kind).into_iter().filter(|name| name.starts_with("regrind-test"));
        let is_for_tests = member.starts_with("tests/");
        assert!(is_for_tests || in_list("dependencies").next().is_none(), "{manifest}: a program needs no test crate");
        let is_low = |name: String| name == "regrind-testutils" || member == "sim" && name == "regrind-testsim";
        let is_low = in_list("dev-dependencies").all(is_low);
        assert!(is_low || member == ".", "{manifest} builds all of regrind for its tests");
    }
}

/// A file is compiled in one crate. What several tests share is in a crate of its own, such as `tests/testutils`.
#[test]
fn only_twins_included_by_path() {
    for folder in ["src", "sim", "tests", "benches", "examples", "fuzz/fuzz_targets"] {
        for file in rust_files(folder, &[]) {
            let is_twin = SYSTEMS.iter().any(|place| file.starts_with(root().join(place)));
            let text = fs::read_to_string(&file).unwrap();
            let line = text.lines().find(|line| line.trim_start().starts_with("#[path"));
            assert!(is_twin || line.is_none(), "{}: {}", file.display(), line.unwrap_or_default());
        }
    }
}

#[test]
fn only_cli_prints_or_exits() {
    let words =
        ["println!", "print!", "eprint", "io::stdout", "io::stderr", "process::exit", "ExitCode::", "anyhow", "miette"];
    assert_absent(sources("src").iter().filter(|s| !is_in(s, "src/cli") && !is_in(s, "src/main.rs")), &words);
}

#[test]
fn only_four_rooms_write_files() {
    let words = ["File::create", "OpenOptions", "fs::write", "fs::rename", "fs::remove", "fs::create_dir"];
    let may = ["src/formats", "src/report", "src/journal", "src/device/file_exchange"];
    assert_absent(sources("src").iter().filter(|s| !may.iter().any(|room| is_in(s, room))), &words);
}

#[test]
fn platform_code_in_listed_files() {
    let found: Vec<_> = sources("src").into_iter().chain(sources("sim")).collect();
    let (twins, others): (Vec<_>, _) = found.iter().partition(|s| SYSTEMS.iter().any(|place| is_in(s, place)));
    assert_absent(others, &OF_ONE_SYSTEM);
    for place in SYSTEMS {
        let of_it = twins.iter().filter(|source| is_in(source, place));
        let says = of_it.flat_map(|source| OF_ONE_SYSTEM.map(|word| source.code.contains(word))).any(|says| says);
        assert!(says, "{place} says nothing of a system: it belongs in no list");
    }
}

#[test]
fn library_does_not_use_cli() {
    let found = sources("src");
    let others = found.iter().filter(|s| !is_in(s, "src/cli") && !is_in(s, "src/main.rs"));
    assert_absent(others, &["clap", "crate::cli", "mod cli"]);
}

#[test]
fn functions_have_at_most_70_lines() {
    for source in sources("src").into_iter().chain(sources("sim")) {
        for (name, lines) in functions::functions(&source.code) {
            // The transition table of the cell is one flat match.
            let is_table = name == "transition" && is_in(&source, "src/cell/state_machine.rs");
            assert!(lines <= 70 || is_table, "{}: `{name}` has {lines} lines", source.path.display());
        }
    }
}

#[test]
fn functions_read_names_and_lines() {
    let code = "trait A {\n    fn a(\n        &self,\n    ) -> fn (u8);\n    fn b() {}\n}\n\
                pub(super) const unsafe fn c() {\n    let d = 1;\n\n    if d == 1 {\n    }\n}\nconst E: fn (u8) = f;\n";
    assert_eq!(functions::functions(code), [("a", 3), ("b", 1), ("c", 6)]);
}

/// Root files of the crates.
const CRATES: [&str; 24] = [
    "sim/lib.rs",
    "src/cell/lib.rs",
    "src/control/lib.rs",
    "src/core/lib.rs",
    "src/device/lib.rs",
    "src/document/lib.rs",
    "src/figures/lib.rs",
    "src/formats/lib.rs",
    "src/journal/lib.rs",
    "src/language/lib.rs",
    "src/lib.rs",
    "src/live/lib.rs",
    "src/main.rs",
    "src/notify/lib.rs",
    "src/page/lib.rs",
    "src/plant/lib.rs",
    "src/record/lib.rs",
    "src/report/lib.rs",
    "src/trust/lib.rs",
    "src/windows/lib.rs",
    "tests/testcell/lib.rs",
    "tests/testsim/lib.rs",
    "tests/testparsers/lib.rs",
    "tests/testutils/lib.rs",
];

#[test]
fn no_circles_within_crates() {
    let found = CRATES.iter().flat_map(|file| {
        let file = root().join(file);
        let folder = file.parent().unwrap().strip_prefix(root()).unwrap().to_str().unwrap().to_owned();
        circles::circles(&file, &sources(&folder))
    });
    let found: Vec<Vec<String>> = found.collect();
    let words: Vec<String> = found.iter().map(|circle| circle.join("\n  ")).collect();
    assert!(found.is_empty(), "circles of files:\n{}", words.join("\n"));
}

#[test]
fn circles_found_through_reexports() {
    let source = |(path, code): &(&str, &str)| Source { path: PathBuf::from(path), code: (*code).to_owned() };
    let found = |files: &[(&str, &str)]| {
        let sources: Vec<Source> = files.iter().map(source).collect();
        circles::circles(Path::new("house/lib.rs"), &sources)
    };
    let root = ("house/lib.rs", "mod a;\nmod b;\npub use a::First;\npub use b::{Second as Other, *};\n");
    let first = ("house/a.rs", "use crate::Other;\npub struct First(Other);\n");
    let second = ("house/b.rs", "pub struct Second;\nimpl Second {\n    fn of(_: super::First) {}\n}\n");
    let told = found(&[root, first, second]);
    assert_eq!(told, [[r#"house/a.rs -> house/b.rs: {"Second"}"#, r#"house/b.rs -> house/a.rs: {"First"}"#]]);
    // An import of the own name, a text and a field are no use of it.
    let second = ("house/b.rs", "pub struct Second;\nconst fn text() -> &'static str {\n    \"super::First\"\n}\n");
    assert!(found(&[root, first, second]).is_empty());
    // A parent that uses what its child defines, while the child uses the parent.
    let root = ("house/lib.rs", "mod a;\nuse a::First;\npub const fn root(_: First) {}\n");
    let child = ("house/a.rs", "pub struct First;\nfn child() {\n    crate::root(First)\n}\n");
    assert_eq!(found(&[root, child]).len(), 1);
}

/// Returns the names of the test binaries of the workspace: each file or folder with `main.rs` in a folder `tests` of a
/// crate.
fn test_binaries() -> BTreeSet<String> {
    let mut crates = vec![root().to_owned(), root().join("sim")];
    crates.extend(fs::read_dir(root().join("src")).unwrap().map(|entry| entry.unwrap().path()));
    let crates = crates.into_iter().filter(|folder| folder.join("Cargo.toml").is_file());
    let tests = crates.flat_map(|folder| fs::read_dir(folder.join("tests")).into_iter().flatten());
    let is_binary = |path: &PathBuf| path.join("main.rs").is_file() || path.extension().is_some_and(|e| e == "rs");
    let name = |path: PathBuf| path.file_stem().unwrap().to_string_lossy().into_owned();
    tests.map(|entry| entry.unwrap().path()).filter(is_binary).map(name).collect()
}

#[test]
fn ci_runs_every_test_binary_once() {
    let script = fs::read_to_string(root().join(".ci/run")).unwrap();
    let lists = ["computing=(", "waiting=("].map(|begin| {
        let list = &script[script.find(begin).expect(begin)..];
        list[..list.find(')').unwrap()].to_owned()
    });
    let named = lists.iter().flat_map(|list| list.split("--test ").skip(1));
    let named: Vec<&str> = named.map(|rest| rest.split_whitespace().next().unwrap()).collect();
    let all: BTreeSet<String> = named.iter().map(|name| (*name).to_owned()).collect();
    assert_eq!(all, test_binaries());
    assert_eq!(all.len(), named.len(), "a binary is in both lists: {named:?}");
}
