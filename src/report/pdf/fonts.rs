//! Fonts of a PDF report.

use typst::foundations::Bytes;
use typst::text::{Font, FontBook};
use typst_kit::fonts::{FontSearcher, FontSlot};

use super::super::fonts::{FAMILY, FILES, have_all};

/// Families of fonts for other characters, the preferred ones first.
const OTHERS: [&str; 7] = [
    "Noto Sans CJK SC",
    "Noto Sans SC",
    "Source Han Sans SC",
    "Microsoft YaHei",
    "PingFang SC",
    "WenQuanYi Micro Hei",
    "DejaVu Sans",
];

/// Fonts of this program, and those of the computer if they are needed.
pub(super) struct Fonts {
    /// Names and characters of all fonts. The index of a font is its place there.
    pub(super) book: FontBook,
    own: Vec<Font>,
    of_computer: Vec<FontSlot>,
}

impl Fonts {
    /// Returns the fonts for a text. The fonts of the computer are read only if the fonts of this program lack one of the
    /// characters.
    pub(super) fn with_characters_of(text: &str) -> Self {
        let own: Vec<Font> = FILES.iter().filter_map(|bytes| Font::new(Bytes::new(*bytes), 0)).collect();
        let mut book = FontBook::from_fonts(&own);
        let mut of_computer = Vec::new();
        if !have_all(text) {
            let found = FontSearcher::new().search();
            for k in 0..found.fonts.len() {
                if let Some(info) = found.book.info(k) {
                    book.push(info.clone());
                }
            }
            of_computer = found.fonts;
        }
        Self { book, own, of_computer }
    }

    /// Returns the names of the families, the preferred ones first.
    pub(super) fn families(&self) -> Vec<&'static str> {
        let others = OTHERS.iter().copied().filter(|name| self.book.contains_family(&name.to_lowercase()));
        std::iter::once(FAMILY).chain(others).collect()
    }

    /// Returns the font with an index.
    pub(super) fn font(&self, index: usize) -> Option<Font> {
        self.own.get(index).cloned().or_else(|| self.of_computer.get(index - self.own.len())?.get())
    }
}
