//! Circles of files: two or more files of one crate of which each uses a name that another one defines.
//!
//! Finds the file in which a name is defined, also through re-exports and glob imports. Methods are not followed.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use crate::Source;

/// Keywords that stand before the name of an item.
const KINDS_OF_ITEMS: [&str; 9] = ["struct", "enum", "trait", "type", "const", "static", "fn", "mod", "macro_rules"];

/// Path of a module or of a name, from the root of its crate.
type ModulePath = Vec<String>;

/// Module with its own file.
struct Module {
    file: PathBuf,
    /// Names that the file defines outside of any braces.
    defined: BTreeSet<String>,
    /// Imports of the file: the name in this file, and the path that stands for it.
    imported: Vec<(String, ModulePath)>,
    /// Paths in the code, outside of imports.
    paths: Vec<ModulePath>,
}

/// Crate: its modules by their paths. The path of the root is empty.
struct Crate(BTreeMap<ModulePath, Module>);

/// Returns each circle in the crate with the root file `root`, such as `src/lib.rs`. `sources` are all files of its
/// folder. A circle is a list of files, and each file has the names that tie it to other files of the circle.
pub fn circles(root: &Path, sources: &[Source]) -> Vec<Vec<String>> {
    let modules = Crate::read(root, sources);
    let arrows = modules.arrows();
    let files: Vec<&PathBuf> = arrows.keys().collect();
    let mut left: BTreeSet<&PathBuf> = files.iter().copied().collect();
    let mut found = Vec::new();
    for file in files {
        if !left.remove(file) {
            continue;
        }
        let below = reached(file, &arrows);
        let circle: Vec<&PathBuf> =
            below.iter().filter(|other| reached(other, &arrows).contains(file)).copied().collect();
        if circle.is_empty() {
            continue;
        }
        let words = circle.iter().map(|from| {
            let ties = arrows[*from].iter().filter(|(to, _)| circle.contains(to));
            let ties: Vec<String> = ties.map(|(to, names)| format!("{}: {names:?}", to.display())).collect();
            format!("{} -> {}", from.display(), ties.join("; "))
        });
        found.push(words.collect());
        left.retain(|file| !circle.contains(file));
    }
    found
}

/// Returns all files that `from` reaches over one or more arrows. Contains `from` only if it is in a circle.
fn reached<'a>(
    from: &Path,
    arrows: &'a BTreeMap<PathBuf, BTreeMap<PathBuf, BTreeSet<String>>>,
) -> BTreeSet<&'a PathBuf> {
    let mut found = BTreeSet::new();
    let mut open = vec![from];
    while let Some(file) = open.pop() {
        for to in arrows.get(file).into_iter().flat_map(BTreeMap::keys) {
            if found.insert(to) {
                open.push(to);
            }
        }
    }
    found
}

impl Crate {
    fn read(root: &Path, sources: &[Source]) -> Self {
        let folder = root.parent().unwrap();
        let mut modules = BTreeMap::new();
        let mut open = vec![(ModulePath::new(), root.to_owned())];
        while let Some((path, file)) = open.pop() {
            let Some(source) = sources.iter().find(|source| source.path == file) else { continue };
            let module = Module::read(&file, &source.code);
            let is_folder = path.is_empty() || file.ends_with("mod.rs");
            let below = if is_folder { file.parent().unwrap_or(folder).to_owned() } else { file.with_extension("") };
            for name in words_after(&source.code, "mod").filter(|name| module.defined.contains(name)) {
                let places = [below.join(format!("{name}.rs")), below.join(&name).join("mod.rs")];
                for place in places {
                    open.push((path.iter().cloned().chain([name.clone()]).collect(), place));
                }
            }
            modules.insert(path, module);
        }
        Self(modules)
    }

    /// Returns for each file the files whose names it uses, with these names.
    fn arrows(&self) -> BTreeMap<PathBuf, BTreeMap<PathBuf, BTreeSet<String>>> {
        let mut arrows: BTreeMap<PathBuf, BTreeMap<PathBuf, BTreeSet<String>>> = BTreeMap::new();
        for (at, module) in &self.0 {
            let used = module.imported.iter().filter(|(name, _)| !module.is_reexport(name)).map(|(_, path)| path);
            let to = arrows.entry(module.file.clone()).or_default();
            for path in used.chain(&module.paths) {
                if let Some((file, name)) = self.definition(at, path, 0).filter(|(file, _)| *file != module.file) {
                    to.entry(file).or_default().insert(name);
                }
            }
        }
        arrows
    }

    /// Returns the file that defines the name at `path`, and this name. `path` is relative to the module `at`.
    fn definition(&self, at: &ModulePath, path: &[String], depth: usize) -> Option<(PathBuf, String)> {
        let mut module = at.clone();
        for (k, step) in path.iter().enumerate() {
            match step.as_str() {
                "crate" => module.clear(),
                "self" => {}
                "super" => drop(module.pop()?),
                name => {
                    let child: ModulePath = module.iter().cloned().chain([name.to_owned()]).collect();
                    if self.0.contains_key(&child) {
                        module = child;
                        continue;
                    }
                    let here = self.0.get(&module)?;
                    if here.defined.contains(name) {
                        return Some((here.file.clone(), name.to_owned()));
                    }
                    if depth == 8 {
                        return None;
                    }
                    return here.imported.iter().filter(|(known, _)| known == name || known == "*").find_map(
                        |(known, from)| {
                            let own = (known == "*").then(|| name.to_owned());
                            let path: Vec<_> = from.iter().cloned().chain(own).chain(path[k + 1..].to_vec()).collect();
                            (from.first().is_some_and(|first| first != name) || known == "*")
                                .then(|| self.definition(&module, &path, depth + 1))?
                        },
                    );
                }
            }
        }
        None
    }
}

impl Module {
    fn read(file: &Path, code: &str) -> Self {
        let code = without_texts(code);
        let mut defined = BTreeSet::new();
        for line in code.lines().filter(|line| !line.starts_with([' ', '}', ')', '#'])) {
            let words: Vec<&str> =
                line.split(|c: char| !c.is_alphanumeric() && c != '_').filter(|word| !word.is_empty()).collect();
            let is_item = |word: &str| KINDS_OF_ITEMS.contains(&word);
            let head = words.split(|word| matches!(*word, "use" | "impl")).next().unwrap_or(&[]);
            let name = head.windows(2).find(|pair| is_item(pair[0]) && !is_item(pair[1]) && pair[1] != "unsafe");
            defined.extend(name.map(|pair| pair[1].to_owned()));
        }
        let (mut imported, mut rest, mut code) = (Vec::new(), String::new(), code.as_str());
        while let Some(at) = find_word(code, "use ") {
            let end = at + code[at..].find(';').unwrap_or(code.len() - at - 1);
            rest.push_str(&code[..at]);
            let mut list = Vec::new();
            expand(&code[at + 4..end], &[], &mut list);
            imported.extend(list);
            code = &code[end + 1..];
        }
        rest.push_str(code);
        Self { file: file.to_owned(), defined, imported, paths: paths(&rest) }
    }

    /// Returns true if this file imports `name` only to export it: its code does not use the name.
    fn is_reexport(&self, name: &str) -> bool {
        name == "*" || !self.paths.iter().any(|path| path[0] == name)
    }
}

/// Removes the content of text and character literals.
fn without_texts(code: &str) -> String {
    let mut found = String::new();
    let mut chars = code.char_indices();
    while let Some((at, c)) = chars.next() {
        let rest = &code[at..];
        let marks = rest.strip_prefix('r').map_or(0, |after| after.chars().take_while(|c| *c == '#').count());
        let ends = if marks > 0 && rest[1 + marks..].starts_with('"') {
            let end = format!("\"{}", "#".repeat(marks));
            rest[2 + marks..].find(&end).map(|length| 2 + marks + length + end.len())
        } else if c == '"' {
            let mut escaped = false;
            let is_end = |c: char| {
                let ends = c == '"' && !escaped;
                escaped = c == '\\' && !escaped;
                ends
            };
            rest[1..].find(is_end).map(|length| length + 2)
        } else if c == '\'' {
            // A lifetime has no second mark after one character.
            let inner = rest[1..].chars().next().map_or(0, char::len_utf8);
            let escape = rest[1..].starts_with('\\').then(|| rest[3..].find('\'').map(|length| length + 4)).flatten();
            escape.or_else(|| rest[1 + inner..].starts_with('\'').then_some(2 + inner))
        } else {
            None
        };
        match ends {
            Some(length) => {
                found.push_str("\"\"");
                while chars.clone().next().is_some_and(|(next, _)| next < at + length) {
                    chars.next();
                }
            }
            None => found.push(c),
        }
    }
    found
}

/// Returns the byte index of `word` in `code` where it begins a statement.
fn find_word(code: &str, word: &str) -> Option<usize> {
    let begins = |at: usize| code[..at].chars().next_back().is_none_or(|c| c.is_whitespace());
    code.match_indices(word).map(|(at, _)| at).find(|at| begins(*at))
}

/// Returns the words that follow the keyword `keyword` in `code`.
fn words_after(code: &str, keyword: &str) -> impl Iterator<Item = String> {
    let words: Vec<&str> = code.split(|c: char| !c.is_alphanumeric() && c != '_').filter(|w| !w.is_empty()).collect();
    let found: BTreeSet<String> =
        words.windows(2).filter(|pair| pair[0] == keyword).map(|pair| pair[1].to_owned()).collect();
    found.into_iter()
}

/// Expands the tree of an import, such as `a::{self, b as c}`, into a list of names with their paths.
fn expand(tree: &str, above: &[String], list: &mut Vec<(String, ModulePath)>) {
    let tree = tree.trim();
    if let Some(at) = tree.find('{') {
        let above: Vec<String> = above
            .iter()
            .cloned()
            .chain(tree[..at].split("::").map(|s| s.trim().to_owned()).filter(|s| !s.is_empty()))
            .collect();
        let inner = &tree[at + 1..tree.rfind('}').unwrap_or(tree.len())];
        let (mut depth, mut begins) = (0, 0);
        for (k, c) in inner.char_indices().chain([(inner.len(), ',')]) {
            match c {
                '{' => depth += 1,
                '}' => depth -= 1,
                ',' if depth == 0 => {
                    expand(&inner[begins..k], &above, list);
                    begins = k + 1;
                }
                _ => {}
            }
        }
        return;
    }
    if tree.is_empty() {
        return;
    }
    let (path, name) = tree.split_once(" as ").map_or((tree, None), |(path, name)| (path, Some(name.trim())));
    let mut path: Vec<String> = above.iter().cloned().chain(path.split("::").map(|s| s.trim().to_owned())).collect();
    if path.last().is_some_and(|last| last == "self") {
        path.pop();
    }
    let name = name.map_or_else(|| path.last().cloned().unwrap_or_default(), str::to_owned);
    if name == "*" {
        path.pop();
    }
    list.push((name, path));
}

/// Returns all paths in `code`: each name with the names that follow it after `::`.
fn paths(code: &str) -> Vec<ModulePath> {
    let mut found = BTreeSet::new();
    let is_name = |c: char| c.is_alphanumeric() || c == '_';
    let mut rest = code;
    while let Some(at) = rest.find(is_name) {
        let is_field = rest[..at].ends_with('.') && !rest[..at].ends_with("..");
        let mut path = Vec::new();
        rest = &rest[at..];
        loop {
            let end = rest.find(|c| !is_name(c)).unwrap_or(rest.len());
            path.push(rest[..end].to_owned());
            rest = &rest[end..];
            match rest.strip_prefix("::").filter(|after| after.starts_with(is_name)) {
                Some(after) => rest = after,
                None => break,
            }
        }
        if !is_field {
            found.insert(path);
        }
    }
    found.into_iter().collect()
}
