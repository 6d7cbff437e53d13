//! Files of reference points: YAML as written by tracker software, or any point file, with or without names.
//!
//! YAML is read event by event, so that aliases are not expanded and deep nesting is not followed. The file must
//! contain one group: a list of points, or a mapping from names to points. A point is three numbers or a list that
//! begins with them.

use std::path::{Path, PathBuf};

use saphyr_parser::{Event, Parser};

use super::FormatError;
use super::number::{Decimal, coordinate};
use super::result::{Content, parse_result};
use super::whole;
use regrind_core::geometry::Point;

/// Largest file of reference points.
const MAX_BYTES: u64 = 1 << 20;
/// Deepest nesting that is followed.
const DEEPEST: usize = 32;

/// Reference point.
#[derive(Clone, Debug, PartialEq)]
pub struct Reference {
    /// Name, if the file gives one.
    pub name: Option<String>,
    /// Position, in millimetres.
    pub at: Point,
}

/// Reference points of one file.
#[derive(Clone, Debug, PartialEq)]
pub struct References {
    /// Path of the file.
    pub path: PathBuf,
    /// The points, in the order of the file.
    pub points: Vec<Reference>,
}

impl References {
    /// Returns the name of the reference point with the index `index` (from 0). If the point has no name, returns its
    /// number from 1, such as `number 1`.
    pub fn name(&self, index: usize) -> String {
        self.points.get(index).and_then(|p| p.name.clone()).unwrap_or_else(|| format!("number {}", index + 1))
    }
}

/// Reads reference points from a YAML file (`.yaml`, `.yml`) or from any point file.
///
/// A YAML file can have several named lists of points; `group` names the one to read. If `group` is `None`, the file
/// must have exactly one list.
///
/// # Errors
/// A file that cannot be read; a list that does not exist; a point whose coordinates are not finite numbers in
/// millimetres; a name that occurs twice.
pub fn read_references(path: &Path, group: Option<&str>) -> Result<References, FormatError> {
    let bytes = whole::open(path)?.read_all(path, MAX_BYTES)?;
    parse_references(path, &bytes, group)
}

/// Reads reference points, in millimetres, from `bytes`, the content of a file. The file is YAML if the extension of
/// `path` is `.yaml` or `.yml`; otherwise it is any point file. `group` names the list of points to read in a YAML
/// file; if it is `None`, the file must have exactly one list. `path` also names the file in messages.
///
/// # Errors
/// The same as for [`read_references`].
pub fn parse_references(path: &Path, bytes: &[u8], group: Option<&str>) -> Result<References, FormatError> {
    let extension = path.extension().and_then(|e| e.to_str()).unwrap_or_default().to_ascii_lowercase();
    let points = if ["yaml", "yml"].contains(&extension.as_str()) {
        from_yaml(path, bytes, group)?
    } else {
        let file = parse_result(path, bytes, &Content::default())?;
        let names = file.names.unwrap_or_default();
        let named = |(k, at)| Reference { name: names.get(k).cloned(), at };
        file.points.into_iter().enumerate().map(named).collect()
    };
    if let Some(twice) =
        (1..points.len()).find(|&k| points[k].name.is_some() && points[..k].iter().any(|p| p.name == points[k].name))
    {
        let found = format!("`{}` again", points[twice].name.as_deref().unwrap_or_default());
        return Err(reference(path, twice + 1, "each name once", found));
    }
    Ok(References { path: path.to_owned(), points })
}

fn reference(path: &Path, line: usize, expected: &'static str, found: impl Into<String>) -> FormatError {
    FormatError::Reference { path: path.to_owned(), line, expected, found: found.into() }
}

/// Node of a YAML file.
#[derive(Debug)]
struct Node {
    line: usize,
    content: Tree,
}

#[derive(Debug)]
enum Tree {
    Scalar(String),
    List(Vec<Node>),
    /// Keys and values, alternating.
    Mapping(Vec<Node>),
}

fn from_yaml(path: &Path, bytes: &[u8], group: Option<&str>) -> Result<Vec<Reference>, FormatError> {
    let text = std::str::from_utf8(bytes).map_err(|error| {
        reference(path, 1, "UTF-8 text", format!("another encoding at byte {}", error.valid_up_to()))
    })?;
    let root = tree(path, text)?;
    let list = group_of(path, &root, group)?;
    let point = |node: &Node, name: Option<&Node>| -> Result<Reference, FormatError> {
        let name = name.and_then(|n| if let Tree::Scalar(text) = &n.content { Some(text.clone()) } else { None });
        Ok(Reference { name, at: position(path, node)? })
    };
    match &list.content {
        Tree::List(nodes) => nodes.iter().map(|node| point(node, None)).collect(),
        Tree::Mapping(pairs) => pairs.chunks_exact(2).map(|pair| point(&pair[1], Some(&pair[0]))).collect(),
        Tree::Scalar(text) => Err(reference(path, list.line, "a list of points", format!("`{text}`"))),
    }
}

/// Returns a list of points from `root`, the tree of a YAML file. If `root` is a mapping (names with values), returns
/// the list with the name `group`. If `group` is `None`, the mapping must have exactly one list, and this list is
/// returned. If `root` is not a mapping, returns `root` itself, whatever `group` is. `path` only names the file in
/// messages.
///
/// # Errors
/// No list with this name; no list, or several lists, if `group` is `None`.
fn group_of<'n>(path: &Path, root: &'n Node, group: Option<&str>) -> Result<&'n Node, FormatError> {
    let Tree::Mapping(pairs) = &root.content else { return Ok(root) };
    let named: Vec<(&str, &Node)> = pairs
        .chunks_exact(2)
        .filter_map(|pair| match (&pair[0].content, &pair[1].content) {
            (Tree::Scalar(_), Tree::Scalar(_)) => None,
            (Tree::Scalar(key), _) => Some((key.as_str(), &pair[1])),
            _ => None,
        })
        .collect();
    let fits: Vec<&(&str, &Node)> = named.iter().filter(|(key, _)| group.is_none_or(|wanted| wanted == *key)).collect();
    match fits[..] {
        [(_, node)] => Ok(node),
        _ => Err(FormatError::Group {
            path: path.to_owned(),
            wanted: group.unwrap_or("any").to_owned(),
            there: named.iter().map(|(key, _)| *key).collect::<Vec<_>>().join(", "),
        }),
    }
}

/// Returns the position, in millimetres, that a node of a YAML file contains. The node is a list of three numbers, or a
/// list whose first entry is such a list: `[1, 2, 3]` or `[[1, 2, 3], [CODE14]]`.
///
/// # Errors
/// A node without three finite numbers at this position.
fn position(path: &Path, node: &Node) -> Result<Point, FormatError> {
    let mut inner = node;
    while let Tree::List(nodes) = &inner.content
        && let [first, ..] = &nodes[..]
        && matches!(first.content, Tree::List(_))
    {
        inner = first;
    }
    let wrong = |found: String| reference(path, inner.line, "three finite numbers in mm", found);
    let Tree::List(nodes) = &inner.content else { return Err(wrong("something else".to_owned())) };
    let [x, y, z] = &nodes[..] else { return Err(wrong(format!("{} entries", nodes.len()))) };
    let number = |node: &Node| match &node.content {
        Tree::Scalar(text) => coordinate(text.as_bytes(), Decimal::Point).map_err(|_| wrong(format!("`{text}`"))),
        _ => Err(wrong("a list".to_owned())),
    };
    Ok(Point::new(number(x)?, number(y)?, number(z)?))
}

/// Parses `text`, the content of a YAML file, and returns its first document as a tree of nodes. Later documents in the
/// file are ignored. `path` only names the file in messages. Returns an error if the YAML is empty or not valid,
/// contains an alias, or has lists that are nested too deep.
fn tree(path: &Path, text: &str) -> Result<Node, FormatError> {
    let mut open: Vec<Node> = Vec::new();
    for event in Parser::new_from_str(text) {
        let (event, span) = event.map_err(|e| reference(path, e.marker().line(), "YAML", e.info().to_owned()))?;
        let line = span.start.line();
        let closed = match event {
            Event::SequenceStart(..) | Event::MappingStart(..) if open.len() == DEEPEST => {
                return Err(reference(path, line, "a list of points", "lists nested too deep"));
            }
            Event::SequenceStart(..) => {
                open.push(Node { line, content: Tree::List(Vec::new()) });
                continue;
            }
            Event::MappingStart(..) => {
                open.push(Node { line, content: Tree::Mapping(Vec::new()) });
                continue;
            }
            Event::Scalar(text, ..) => Node { line, content: Tree::Scalar(text.into_owned()) },
            Event::SequenceEnd | Event::MappingEnd => match open.pop() {
                Some(node) => node,
                None => continue,
            },
            Event::Alias(_) => return Err(reference(path, line, "numbers", "an alias")),
            _ => continue,
        };
        match open.last_mut().map(|node| &mut node.content) {
            Some(Tree::List(nodes) | Tree::Mapping(nodes)) => nodes.push(closed),
            _ => return Ok(closed),
        }
    }
    Err(reference(path, 1, "a list of points", "nothing"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn yaml(text: &str, group: Option<&str>) -> Result<Vec<Reference>, FormatError> {
        parse_references(Path::new("ref.yaml"), text.as_bytes(), group).map(|r| r.points)
    }

    #[test]
    fn references_from_nested_yaml() {
        let bare =
            yaml("primary:\n- - 2401.1\n  - -2698.6\n  - 4819.4\n- - -2397.5\n  - 1\n  - 2e3\n", Some("primary"))
                .unwrap();
        assert_eq!(bare.len(), 2);
        assert_eq!((bare[1].name.as_ref(), bare[1].at), (None, Point::new(-2397.5, 1.0, 2000.0)));
        let text = "coords: opt_global\nprimary:\n  a: [[2400.94, -2698.56, 4819.33], [['CODE14', [ 1, 2, 3]]]] # lower\n  b: [1, 2, 3]\n\
                    bearing:\n  # - [[1, 2, 3]]\n  c: [[4, 5, 6]]\n";
        let named = yaml(text, Some("primary")).unwrap();
        assert_eq!(named[0], Reference { name: Some("a".into()), at: Point::new(2400.94, -2698.56, 4819.33) });
        assert_eq!(named[1].name.as_deref(), Some("b"));
        let refused = yaml(text, None).unwrap_err();
        assert!(matches!(&refused, FormatError::Group { there, .. } if there == "primary, bearing"), "{refused}");
        assert_eq!(yaml("[[1,2,3],[4,5,6]]", None).unwrap().len(), 2);
    }

    #[test]
    fn references_errors_name_their_line() {
        // Text, its faulty line if that is compared, and what was expected or found there.
        for (text, at_line, what) in [
            ("p:\n- [1, 2]\n", Some(2), "2 entries"),
            ("p:\n- [1, 2, 3]\n- [1, .nan, 3]\n", Some(3), "`.nan`"),
            ("p:\n- [1, 2, x]\n", None, "`x`"),
            ("p: &a [1, 2, 3]\nq: [*a, *a]\n", None, "an alias"),
            ("p: [1, 2\n", None, "YAML"),
            ("", None, "nothing"),
            ("p: {a: [1, 2, 3], a: [1, 2, 3]}", None, "`a` again"),
        ] {
            let refused = yaml(text, None).unwrap_err();
            let FormatError::Reference { line, expected, found, .. } = &refused else { panic!("{text:?}: {refused}") };
            assert!(
                at_line.is_none_or(|at| at == *line) && [*expected, found.as_str()].contains(&what),
                "{text:?}: {refused}"
            );
        }
        let deep = "[".repeat(5000);
        assert!(yaml(&deep, None).is_err());
        let deep: String = (0..5000).map(|k| format!("{}-\n", " ".repeat(k % 200))).collect();
        assert!(yaml(&deep, None).is_err());
    }

    #[test]
    fn references_names_from_column() {
        let file = parse_references(Path::new("r.csv"), b"name,x,y,z\nleft,1,2,3\nright,4,5,6\n", None).unwrap();
        assert_eq!(file.name(1), "right");
        let file = parse_references(Path::new("r.txt"), b"1 2 3\n4 5 6\n", None).unwrap();
        assert_eq!((file.name(1), file.points.len()), ("number 2".to_owned(), 2));
    }
}
