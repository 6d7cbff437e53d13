//! Limits of an XML document, checked before it is parsed: content for which a parser needs time quadratic in its
//! length is rejected.

/// Maximum number of attributes of an element, of namespace declarations in a document, and of nested elements.
const MAX_ATTRIBUTES: usize = 256;
const MAX_NAMESPACES: usize = 64;
const MAX_DEPTH: usize = 128;

/// Exceeded limit of a document: the line, the limit and the value found.
#[derive(Debug, PartialEq)]
pub(super) struct Beyond {
    pub(super) line: usize,
    pub(super) allowed: String,
    pub(super) found: String,
}

/// Checks the size limits for XML documents: the number of attributes of an element, the number of namespace
/// declarations, and the depth of nested elements. Returns the first exceeded limit, with the line and the value found.
/// Returns `None` if `text` exceeds no limit. `text` need not be valid XML.
pub(super) fn beyond_bounds(text: &str) -> Option<Beyond> {
    let bytes = text.as_bytes();
    let (mut at, mut depth, mut namespaces) = (0, 0_usize, 0);
    let beyond = |at: usize, allowed: usize, what: &str, found: usize| {
        let line = 1 + bytes[..at].iter().filter(|byte| **byte == b'\n').count();
        Some(Beyond { line, allowed: format!("at most {allowed} {what}"), found: format!("{found} or more") })
    };
    while let Some(next) = find(bytes, at, b"<") {
        let skip = |begin: &[u8], end: &[u8]| {
            bytes[next..].starts_with(begin).then(|| find(bytes, next, end).map_or(bytes.len(), |at| at + end.len()))
        };
        if let Some(behind) =
            skip(b"<!--", b"-->").or_else(|| skip(b"<![CDATA[", b"]]>")).or_else(|| skip(b"<?", b"?>"))
        {
            at = behind;
            continue;
        }
        if bytes[next..].starts_with(b"</") {
            depth = depth.saturating_sub(1);
            at = next + 2;
            continue;
        }
        let Tag { end, attributes, declarations, is_empty } = tag(bytes, next);
        namespaces += declarations;
        depth += usize::from(!is_empty);
        let found = [
            (attributes, MAX_ATTRIBUTES, "attributes of an element"),
            (namespaces, MAX_NAMESPACES, "declarations of namespaces"),
            (depth, MAX_DEPTH, "elements within each other"),
        ];
        if let Some((found, most, what)) = found.into_iter().find(|(found, most, _)| found > most) {
            return beyond(next, most, what, found);
        }
        at = end;
    }
    None
}

/// Returns true if a text exceeds none of the limits for XML documents that are read here: 256 attributes of an element,
/// 64 declarations of namespaces, 128 elements within each other. The text need not be valid XML.
pub fn is_bounded_xml(text: &str) -> bool {
    beyond_bounds(text).is_none()
}

/// Start tag of an element.
struct Tag {
    /// Position of its end.
    end: usize,
    attributes: usize,
    declarations: usize,
    is_empty: bool,
}

fn tag(bytes: &[u8], from: usize) -> Tag {
    let (mut quote, mut tag) = (None, Tag { end: bytes.len(), attributes: 0, declarations: 0, is_empty: false });
    for (k, &byte) in bytes.iter().enumerate().skip(from + 1) {
        match (quote, byte) {
            (Some(open), _) if byte == open => quote = None,
            (Some(_), _) => {}
            (None, b'"' | b'\'') => quote = Some(byte),
            (None, b'=') => {
                tag.attributes += 1;
                let name = bytes[from..k].trim_ascii_end();
                let begin = name.iter().rposition(u8::is_ascii_whitespace).map_or(0, |at| at + 1);
                tag.declarations += usize::from(name[begin..].starts_with(b"xmlns"));
            }
            (None, b'>') => {
                tag.is_empty = bytes[k - 1] == b'/';
                tag.end = k + 1;
                break;
            }
            (None, _) => {}
        }
        // An element that is rejected need not be counted to its end.
        if tag.attributes > MAX_ATTRIBUTES {
            break;
        }
    }
    tag
}

fn find(bytes: &[u8], from: usize, what: &[u8]) -> Option<usize> {
    bytes.get(from..)?.windows(what.len()).position(|window| window == what).map(|at| from + at)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn beyond_bounds_refuses_costly_xml() {
        let attributes = |count: usize| (0..count).map(|k| format!(" a{k}='>'")).collect::<String>();
        let namespaces = |count: usize| (0..count).map(|k| format!("<e xmlns:n{k} = \"x\"/>")).collect::<String>();
        let nested = |count: usize| "<e>".repeat(count) + &"</e>".repeat(count);
        for sound in [
            format!("<r{}/>", attributes(256)),
            format!("<r>{}</r>", namespaces(64)),
            nested(128),
            "<r><!-- <e><e> a=\"\" --><![CDATA[<e><e>]]><?p <e> ?>x = y</r>".repeat(9),
            "no document, a = b, < and >".to_owned(),
            String::new(),
        ] {
            assert_eq!(beyond_bounds(&sound), None, "{sound:.80}");
        }
        for (text, line, allowed) in [
            (format!("<r>\n<e{}/></r>", attributes(200_000)), 2, "at most 256 attributes of an element"),
            (format!("<r>{}</r>", namespaces(65)), 1, "at most 64 declarations of namespaces"),
            (nested(129), 1, "at most 128 elements within each other"),
        ] {
            let found = beyond_bounds(&text).unwrap_or_else(|| panic!("nothing is beyond: {allowed}"));
            assert_eq!((found.line, &*found.allowed), (line, allowed));
        }
    }
}
