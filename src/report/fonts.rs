//! Fonts of reports and pictures that this program draws itself.

/// Name of the family.
pub(super) const FAMILY: &str = "Inter";

/// Inter, regular and semi-bold, reduced to the characters of a report. `fonts/README.md` says how they were made.
pub(super) const FILES: [&[u8]; 2] =
    [include_bytes!("fonts/Inter-Regular.otf"), include_bytes!("fonts/Inter-SemiBold.otf")];

/// Ranges of the characters that the fonts have: Latin, Greek, Cyrillic, and signs.
const CHARACTERS: [[u32; 2]; 9] = [
    [0x20, 0x7e],
    [0xa0, 0x148],
    [0x14a, 0x17f],
    [0x391, 0x3a1],
    [0x3a3, 0x3c9],
    [0x400, 0x45f],
    [0x2010, 0x2015],
    [0x2018, 0x201e],
    [0x2212, 0x2212],
];
/// Signs outside these ranges that the fonts have.
const SIGNS: &str = "\u{2020}\u{2021}\u{2022}\u{2026}\u{2030}\u{20ac}\u{2190}\u{2191}\u{2192}\u{2193}\u{221a}\u{221e}\u{2248}\u{2260}\u{2264}\u{2265}\u{2713}";

/// Returns true if the fonts have every character of a text. Control characters are not drawn.
pub(super) fn have_all(text: &str) -> bool {
    let is_known = |c: char| {
        let code = u32::from(c);
        c.is_control() || CHARACTERS.iter().any(|[low, high]| (*low..=*high).contains(&code)) || SIGNS.contains(c)
    };
    text.chars().all(is_known)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fonts_have_their_characters() {
        for file in FILES {
            let face = ttf_parser::Face::parse(file, 0).unwrap();
            let ranges = CHARACTERS.iter().flat_map(|[low, high]| *low..=*high).filter_map(char::from_u32);
            for c in ranges.chain(SIGNS.chars()) {
                assert!(face.glyph_index(c).is_some(), "{c:?}");
            }
        }
        assert!(have_all("Linse Ø40, 3/335(4579/309) RMSt<554; −2.25 µm ≤ 7.00 → ok\n") && !have_all("合格"));
    }
}
