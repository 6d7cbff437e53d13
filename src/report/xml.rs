//! XML writer, element by element. Texts are escaped, so the document is always well formed.

use std::fmt::Write;

use regrind_formats::escaped;

/// Document that is being written.
pub(super) struct Xml {
    text: String,
    open: Vec<&'static str>,
}

impl Xml {
    pub(super) fn new() -> Self {
        Self { text: "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n".to_owned(), open: Vec::new() }
    }

    /// Writes an element with the name `name` that contains child elements. `inner` writes the children.
    pub(super) fn within(&mut self, name: &'static str, attributes: &[(&str, &str)], inner: impl FnOnce(&mut Self)) {
        self.begin(name, attributes);
        self.text.push_str(">\n");
        self.open.push(name);
        inner(self);
        self.open.pop();
        self.indent();
        let _ = writeln!(self.text, "</{name}>");
    }

    /// Writes an element with the name `name` that contains only a text and has no attributes.
    pub(super) fn text(&mut self, name: &'static str, text: &str) {
        self.text_with(name, &[], text);
    }

    /// Writes an element with attributes that contains only a text. `attributes` are pairs of a name and a value.
    pub(super) fn text_with(&mut self, name: &'static str, attributes: &[(&str, &str)], text: &str) {
        self.begin(name, attributes);
        let _ = writeln!(self.text, ">{}</{name}>", escaped(text));
    }

    /// Writes an element that has attributes and no content. `attributes` are pairs of a name and a value.
    pub(super) fn empty(&mut self, name: &'static str, attributes: &[(&str, &str)]) {
        self.begin(name, attributes);
        self.text.push_str("/>\n");
    }

    pub(super) fn end(self) -> String {
        debug_assert!(self.open.is_empty());
        self.text
    }

    fn begin(&mut self, name: &str, attributes: &[(&str, &str)]) {
        self.indent();
        let _ = write!(self.text, "<{name}");
        for (key, value) in attributes {
            let value = escaped(value).replace('"', "&quot;").replace('\n', "&#10;");
            let _ = write!(self.text, " {key}=\"{value}\"");
        }
    }

    fn indent(&mut self) {
        self.text.extend(std::iter::repeat_n("  ", self.open.len()));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn xml_escapes_any_text() {
        let hostile = "a<b> & \"c\" 'd' \u{0}\u{7}\u{ffff} ]]> <!-- \n \u{e9}";
        let mut xml = Xml::new();
        xml.within("a", &[("of", hostile)], |xml| {
            xml.text("b", hostile);
            xml.empty("c", &[("n", "1")]);
        });
        let text = xml.end();
        let document = roxmltree::Document::parse(&text).unwrap();
        let root = document.root_element();
        let kept = hostile.replace(['\u{0}', '\u{7}', '\u{ffff}'], "\u{fffd}");
        assert_eq!(root.attribute("of"), Some(kept.as_str()));
        assert_eq!(root.children().find(|node| node.has_tag_name("b")).unwrap().text(), Some(kept.as_str()));
    }
}
