//! Functions of a source file and their lengths.

/// Returns the name of each function in `code` and its number of lines, from the line with `fn` to the closing brace.
/// `code` must be formatted by rustfmt: the last line of a function is indented like its first line. A function
/// without a body, such as one of a trait, counts too.
pub fn functions(code: &str) -> Vec<(&str, usize)> {
    let lines: Vec<&str> = code.lines().collect();
    let begins = lines.iter().enumerate().filter_map(|(at, line)| Some((at, name(line)?)));
    begins.filter_map(|(at, name)| Some((name, last(&lines[at..])? + 1))).collect()
}

/// Returns the name of the function that begins in `line`. Returns `None` if no function begins there.
fn name(line: &str) -> Option<&str> {
    let (before, after) = line.split_once("fn ")?;
    // Visibility and qualifiers, such as `pub(super) const unsafe extern "C"`.
    let begins = before.is_empty() || before.ends_with(' ');
    let are_qualifiers = before.chars().all(|c| c.is_alphanumeric() || " (:_)\"".contains(c));
    let end = after.find(|c: char| !c.is_alphanumeric() && c != '_')?;
    (begins && are_qualifiers && end > 0).then_some(&after[..end])
}

/// Returns the index of the last line of the function that begins in the first line of `lines`.
fn last(lines: &[&str]) -> Option<usize> {
    let indent = |line: &str| line.len() - line.trim_start().len();
    let own = indent(lines.first()?);
    lines.iter().position(|line| indent(line) == own && line.trim_end().ends_with(['}', ';']))
}
