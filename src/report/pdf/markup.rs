//! Translation of the HTML of a report into the markup of Typst, which lays the pages out.

use std::fmt::Write;

use base64::Engine;
use base64::engine::general_purpose::STANDARD as BASE64;
use roxmltree::{Document, Node, ParsingOptions};

use super::super::chart::PAPER;

/// Report in the markup of Typst.
pub(super) struct Markup {
    /// Body of the document. It calls the functions of `report.typ`.
    pub(super) text: String,
    /// Pictures that the text names, each with its path.
    pub(super) pictures: Vec<(String, Vec<u8>)>,
    name_of_bars: &'static str,
}

impl Markup {
    /// Translates the HTML of a report. `html` is as [`run_report`](crate::run_report) returns it. `name_of_bars` is the
    /// alternative text of the bars of the judged figures.
    ///
    /// # Errors
    /// Fails if the HTML is not well-formed.
    pub(super) fn from_html(html: &str, name_of_bars: &'static str) -> Result<Self, roxmltree::Error> {
        let options = ParsingOptions { allow_dtd: true, ..ParsingOptions::default() };
        let document = Document::parse_with_options(html, options)?;
        let mut markup = Self { text: String::new(), pictures: Vec::new(), name_of_bars };
        if let Some(body) = document.descendants().find(|node| node.has_tag_name("body")) {
            markup.text = markup.children(body);
        }
        Ok(markup)
    }

    fn children(&mut self, node: Node) -> String {
        node.children().map(|child| self.node(child)).collect()
    }

    /// Translates a node. An element that is not listed gives its content.
    fn node(&mut self, node: Node) -> String {
        if let Some(text) = node.text().filter(|_| node.is_text()) {
            return words(text);
        }
        let class = node.attribute("class").unwrap_or_default();
        match node.tag_name().name() {
            "article" => format!("{}#pagebreak()\n", self.children(node)),
            "h1" => self.call("heading(level: 1)", node),
            "h2" => self.call("heading(level: 2)", node),
            "h3" => self.call("heading(level: 3)", node),
            "p" if class == "caption" => self.call("caption", node),
            "p" => self.call("par", node),
            "ul" => self.call_with_elements("list", node),
            "table" if class == "facts" => self.facts(node),
            "table" => self.table(node),
            "figure" => self.figure(node),
            "svg" => self.interval_bar(node),
            "img" => self.logo(node),
            "br" => "#linebreak()".to_owned(),
            "small" => self.call_inline("small", node),
            "strong" => self.call_inline("strong", node),
            "code" if class == "whole" => self.call_inline("whole", node),
            "span" if class == "whole" => self.call_inline("box", node),
            "code" => self.call_inline("mono", node),
            "span" if class == "mark" => self.call_inline("mark", node),
            "footer" => self.call("closing", node),
            "div" => match class.split(' ').next().unwrap_or_default() {
                "two" => self.call_with_elements("two", node),
                "head" => self.call_with_elements("head", node),
                "shop" => self.call_with_elements("shop", node),
                "signatures" => self.call_with_elements("signatures", node),
                "verdict" => {
                    let kind = class.split(' ').nth(1).unwrap_or_default();
                    self.call(&format!("verdict({})", quoted(kind)), node)
                }
                _ => self.children(node),
            },
            _ => self.children(node),
        }
    }

    /// Calls a function of Typst with the content of `node`.
    fn call(&mut self, function: &str, node: Node) -> String {
        self.call_inline(function, node) + "\n"
    }

    /// Calls a function of Typst with the content of `node`, within a line of text. The semicolon ends the call, so that
    /// what follows is text.
    fn call_inline(&mut self, function: &str, node: Node) -> String {
        format!("#{function}[{}];", self.children(node).trim())
    }

    /// Calls a function of Typst with the content of each element in `node`.
    fn call_with_elements(&mut self, function: &str, node: Node) -> String {
        let parts: String = node
            .children()
            .filter(Node::is_element)
            .map(|child| format!("[{}],", self.element_or_content(child)))
            .collect();
        format!("#{function}({parts})\n")
    }

    /// Translates a part of a list or a grid. A paragraph, a list item or a division gives its content.
    fn element_or_content(&mut self, node: Node) -> String {
        match node.tag_name().name() {
            "table" | "figure" | "img" => self.node(node),
            "div" if node.attribute("class").is_some() => self.node(node),
            _ => self.children(node),
        }
    }

    /// Translates a table of names and values without lines.
    fn facts(&mut self, table: Node) -> String {
        let mut text = "#facts(".to_owned();
        for cell in rows(table).flat_map(cells) {
            let content = self.children(cell);
            match cell.tag_name().name() {
                "th" => text.push_str(&format!("key[{content}],")),
                _ => text.push_str(&format!("[{content}],")),
            }
        }
        text + ")\n"
    }

    /// Translates a table. A column of numbers or short texts is as wide as its widest cell. The other columns share the
    /// rest of the width by their longest texts.
    fn table(&mut self, table: Node) -> String {
        let rows: Vec<Vec<Node>> = rows(table).map(|row| cells(row).collect()).collect();
        let is_head = |row: &Vec<Node>| row.first().and_then(Node::parent).is_some_and(is_of_head);
        let count = rows.iter().map(Vec::len).max().unwrap_or(0);
        let mut longest = vec![0; count];
        for row in rows.iter().filter(|row| !is_head(row)) {
            for (column, cell) in row.iter().enumerate() {
                let is_free = !is_short(*cell) && cell.attribute("colspan").is_none();
                longest[column] = longest[column].max(if is_free { letters(*cell) } else { 0 });
            }
        }
        let is_number = |column: usize| {
            rows.first().and_then(|row| row.get(column)).is_some_and(|cell| class_of(*cell).contains(&"n"))
        };
        let list = |each: &dyn Fn(usize) -> String| (0..count).map(|column| each(column) + ",").collect::<String>();
        // A short text is never broken, so only long texts share what is left.
        const LONG: usize = 24;
        let has_long = longest.iter().any(|letters| *letters > LONG);
        // Without a long text, the last column of words takes the rest.
        let is_narrow = class_of(table).contains(&"narrow");
        let rest = (0..count).rev().find(|column| !is_number(*column)).unwrap_or(count);
        let columns = list(&|column| match longest[column] {
            letters if letters > LONG => format!("{letters}fr"),
            _ if !has_long && !is_narrow && column == rest => "1fr".to_owned(),
            _ => "auto".to_owned(),
        });
        let has_large = rows.iter().flatten().any(|cell| class_of(*cell).contains(&"big"));
        let height = if has_large { "horizon" } else { "top" };
        let align = list(&|column| format!("{} + {height}", if is_number(column) { "right" } else { "left" }));
        let mut text = format!(
            "#table(columns: ({columns}), align: ({align}), stroke: none, inset: (x, y) => (left: 0pt, right: if x + 1 < {count} {{ .9em }} else {{ 0pt }}, y: .3em),\n"
        );
        for row in &rows {
            let content: String = row.iter().map(|cell| self.cell(*cell)).collect();
            let row_class = row.first().and_then(Node::parent).map(class_of).unwrap_or_default();
            if is_head(row) {
                let _ = writeln!(text, "table.header({content}), table.hline(stroke: rule),");
            } else {
                let line = if row_class.contains(&"of") { "" } else { "table.hline(stroke: rule)," };
                let _ = writeln!(text, "{content}{line}");
            }
        }
        text + ")\n"
    }

    fn cell(&mut self, cell: Node) -> String {
        let class = class_of(cell);
        let mut content = self.children(cell);
        if is_short(cell) {
            content = format!("#box[{content}]");
        }
        if class.contains(&"big") {
            content = format!("#text(size: 1.5em, weight: 600)[{content}]");
        }
        if cell.has_tag_name("th") {
            content = format!("#key[#strong[{content}]]");
        }
        match cell.attribute("colspan").and_then(|count| count.parse::<usize>().ok()) {
            Some(count) => format!("table.cell(colspan: {count})[{content}],"),
            None => format!("[{content}],"),
        }
    }

    /// Translates a figure: a picture with its caption.
    fn figure(&mut self, figure: Node) -> String {
        let Some(svg) = figure.children().find(|node| node.has_tag_name("svg")) else { return self.children(figure) };
        let caption = figure.children().find(|node| node.has_tag_name("figcaption"));
        let alt = svg.attribute("aria-label").map(str::to_owned).or_else(|| caption.map(plain)).unwrap_or_default();
        let path = self.picture(svg);
        let is_map = class_of(figure).contains(&"map");
        let width = if is_map { width_of_map(svg) } else { 100.0 };
        let below = caption.map_or("none".to_owned(), |caption| format!("[{}]", self.children(caption)));
        format!("#picture({}, {}, {below}, {width:.1}%)\n", quoted(&path), quoted(alt.trim()))
    }

    fn interval_bar(&mut self, svg: Node) -> String {
        let path = self.picture(svg);
        format!("#bar({}, {})", quoted(&path), quoted(self.name_of_bars))
    }

    /// Adds a picture with the style that its page gives it, and returns its path.
    fn picture(&mut self, svg: Node) -> String {
        let source = &svg.document().input_text()[svg.range()];
        let (tag, rest) = source.split_once('>').unwrap_or((source, ""));
        let namespace = if tag.contains("xmlns=") { "" } else { " xmlns=\"http://www.w3.org/2000/svg\"" };
        let bars: String = super::super::run::STYLE.lines().filter(|line| line.starts_with(".interval")).collect();
        let text = format!("{tag}{namespace}><style>{PAPER}{bars}</style>{rest}");
        let text = text.replace("Helvetica,Arial,sans-serif", "Inter").replace("Helvetica, Arial, sans-serif", "Inter");
        self.add(text.into_bytes(), "svg")
    }

    fn logo(&mut self, image: Node) -> String {
        let source = image.attribute("src").unwrap_or_default();
        let Some((kind, data)) = source.strip_prefix("data:image/").and_then(|rest| rest.split_once(";base64,")) else {
            return String::new();
        };
        let Ok(bytes) = BASE64.decode(data) else { return String::new() };
        let extension = kind.split('+').next().unwrap_or(kind).to_owned();
        format!("#logo({})", quoted(&self.add(bytes, &extension)))
    }

    fn add(&mut self, bytes: Vec<u8>, extension: &str) -> String {
        let path = format!("/{}.{extension}", self.pictures.len() + 1);
        self.pictures.push((path.clone(), bytes));
        path
    }
}

/// Returns the width of a map as a share of its column, in per cent: a map that is tall at the full width would leave no
/// room for the rest of its page.
fn width_of_map(svg: Node) -> f64 {
    /// Largest height of a map, as a share of the width of its column.
    const MAX_HEIGHT: f64 = 0.5;
    let length = |key: &str| svg.attribute(key).and_then(|value| value.parse::<f64>().ok()).unwrap_or(1.0);
    (100.0 * MAX_HEIGHT * length("width") / length("height")).min(100.0)
}

fn rows<'a, 'd: 'a>(table: Node<'a, 'd>) -> impl Iterator<Item = Node<'a, 'd>> {
    table.descendants().filter(|node| node.has_tag_name("tr"))
}

fn cells<'a, 'd: 'a>(row: Node<'a, 'd>) -> impl Iterator<Item = Node<'a, 'd>> {
    row.children().filter(|node| node.has_tag_name("td") || node.has_tag_name("th"))
}

fn is_of_head(row: Node) -> bool {
    row.parent().is_some_and(|parent| parent.has_tag_name("thead"))
}

fn class_of<'a>(node: Node<'a, '_>) -> Vec<&'a str> {
    node.attribute("class").unwrap_or_default().split(' ').collect()
}

/// Returns true if the text of a cell stays on one line.
fn is_short(cell: Node) -> bool {
    /// A longer text would leave no room for the other columns.
    const MAX_LETTERS: usize = 40;
    class_of(cell).iter().any(|class| ["n", "t"].contains(class)) && letters(cell) <= MAX_LETTERS
}

fn plain(node: Node) -> String {
    node.descendants().filter(Node::is_text).filter_map(|text| text.text()).collect()
}

fn letters(cell: Node) -> usize {
    plain(cell).chars().count()
}

/// Writes a text in strings, in which Typst sees no markup. White space in a row becomes one blank. A long word can be
/// broken between its strings, which adds no character to the text of the PDF.
fn words(text: &str) -> String {
    let mut one_blank = String::new();
    for c in text.chars() {
        let c = if c.is_whitespace() && c != '\u{a0}' { ' ' } else { c };
        if !(c == ' ' && one_blank.ends_with(' ')) {
            one_blank.push(c);
        }
    }
    match one_blank.as_str() {
        "" => String::new(),
        // Between elements.
        " " => " ".to_owned(),
        text => text.split_inclusive(' ').map(word).collect(),
    }
}

/// Writes a word with the blank after it. A long one is written in pieces, between which it can be broken. Letters of
/// scripts whose signs join or need no blanks stay together.
fn word(word: &str) -> String {
    /// Letters of the longest word in one piece, and of a piece of a longer one.
    const WHOLE: usize = 20;
    const PIECE: usize = 4;
    // A unit is not broken at its stroke.
    if let Some(after) = word.strip_prefix("mm/s") {
        return format!(
            "#box({});{}",
            quoted("mm/s"),
            if after.is_empty() { String::new() } else { plain_word(after) }
        );
    }
    if word.chars().count() <= WHOLE {
        return plain_word(word);
    }
    let mut pieces = vec![String::new()];
    let mut before = None;
    for c in word.chars() {
        let piece = pieces.last().map_or(0, |piece| piece.chars().count());
        if piece >= PIECE && c.is_ascii() && before.is_some_and(|before: char| before.is_ascii()) {
            pieces.push(String::new());
        }
        pieces.last_mut().expect("there is a piece").push(c);
        before = Some(c);
    }
    pieces.iter().map(|piece| plain_word(piece)).collect::<Vec<_>>().join("#h(0.01pt);")
}

fn plain_word(word: &str) -> String {
    format!("#{};", quoted(word))
}

/// Writes a text as a string of Typst.
pub(super) fn quoted(text: &str) -> String {
    let mut quoted = String::from("\"");
    for c in text.chars() {
        match c {
            '"' | '\\' => quoted.extend(['\\', c]),
            c if c.is_control() => {}
            c => quoted.push(c),
        }
    }
    quoted + "\""
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texts_are_strings_without_markup() {
        assert_eq!(words("a #b\\ \"c\"\n  d"), "#\"a \";#\"#b\\\\ \";#\"\\\"c\\\" \";#\"d\";");
        assert_eq!((words(""), words(" \n ")), (String::new(), " ".to_owned()));
        assert_eq!(words("5 mm/s; 2"), "#\"5 \";#box(\"mm/s\");#\"; \";#\"2\";");
    }

    /// A word of 24 letters has six pieces of four. No sign of a joining script is cut from its neighbour.
    #[test]
    fn long_words_have_places_to_break() {
        assert_eq!(words(&"abcd".repeat(5)).matches("#h").count(), 0);
        assert_eq!(words(&"abcd".repeat(6)).matches("#h").count(), 5);
        assert_eq!(words(&"\u{628}".repeat(30)).matches("#h").count(), 0);
    }
}
