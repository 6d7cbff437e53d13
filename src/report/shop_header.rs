//! Header of a shop for its reports: name, address, logo, and fields such as the number of an order.

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use regrind_document::misleading;
use serde::{Deserialize, Serialize};

use regrind_formats::{escaped, is_bounded_xml};

/// Maximum size of the picture of a logo, in bytes.
pub const MAX_LOGO_BYTES: usize = 512 << 10;
/// Maximum number of lines of an address, and of fields.
const MAX_LINES: usize = 12;
/// Maximum number of characters of a text.
const MAX_TEXT: usize = 200;

/// Header of a shop, as its file has it.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ShopHeader {
    /// Name of the shop.
    pub name: String,
    /// Lines of its address.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub address: Vec<String>,
    /// Picture of its logo as a data URI. In the file it is the path of a PNG, JPEG or SVG.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub logo: Option<String>,
    /// Further fields, in the order of the file: name and text.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub fields: Vec<ShopField>,
}

/// Field of a header.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ShopField {
    /// Name, such as "Order".
    pub name: String,
    /// Text.
    pub text: String,
}

impl ShopHeader {
    /// Checks the texts of the header, and its logo.
    ///
    /// # Errors
    /// Returns the name of the key and the reason: a text that is empty, longer than 200 characters, or has characters
    /// that are invisible or change the direction of the text; more than 12 lines or fields; a logo that is no picture.
    pub fn check(&self) -> Result<(), String> {
        let texts = std::iter::once(("name", &self.name))
            .chain(self.address.iter().map(|line| ("address", line)))
            .chain(self.fields.iter().flat_map(|field| [("fields.name", &field.name), ("fields.text", &field.text)]));
        for (key, text) in texts {
            let count = text.chars().count();
            if !(1..=MAX_TEXT).contains(&count) {
                return Err(format!("`{key}` has {count} characters; a text must have 1 to {MAX_TEXT}"));
            }
            if let Some(found) = misleading(text) {
                return Err(format!(
                    "`{key}` contains a character that is not visible or changes the direction of the text: {found}; remove it"
                ));
            }
        }
        for (key, count) in [("address", self.address.len()), ("fields", self.fields.len())] {
            if count > MAX_LINES {
                return Err(format!("`{key}` has {count} entries; at most {MAX_LINES} are allowed"));
            }
        }
        match &self.logo {
            Some(logo) if !is_picture_uri(logo) => Err("`logo` is not a picture in PNG, JPEG or SVG".to_owned()),
            _ => Ok(()),
        }
    }

    /// Returns the header as HTML.
    pub(super) fn html(&self) -> String {
        let logo = self
            .logo
            .as_ref()
            .map_or(String::new(), |uri| format!("<img class=\"logo\" alt=\"\" src=\"{}\"/>\n", escaped(uri)));
        let address: Vec<String> = self.address.iter().map(|line| escaped(line)).collect();
        let row = |field: &ShopField| {
            format!("<tr><th>{}</th><td>{}</td></tr>\n", escaped(&field.name), escaped(&field.text))
        };
        let rows: String = self.fields.iter().map(row).collect();
        let fields = if rows.is_empty() { rows } else { format!("<table class=\"facts\">\n{rows}</table>\n") };
        format!(
            "<div class=\"shop\">\n{logo}<p><strong>{}</strong><br/>{}</p>\n{fields}</div>\n",
            escaped(&self.name),
            address.join("<br/>")
        )
    }
}

/// Returns the data URI of a logo, from the bytes of its file. Returns `None` if they are no PNG, JPEG or SVG, or too
/// many.
pub fn logo_uri(bytes: &[u8]) -> Option<String> {
    let is_svg = || {
        let text = std::str::from_utf8(bytes).ok()?;
        let text = text.trim_start_matches('\u{feff}').trim_start();
        (text.starts_with("<svg") || text.starts_with("<?xml") && text.contains("<svg")).then_some(())
    };
    let kind = match bytes {
        [0x89, b'P', b'N', b'G', 0x0d, 0x0a, 0x1a, 0x0a, ..] => "png",
        [0xff, 0xd8, 0xff, ..] => "jpeg",
        _ => is_svg().map(|()| "svg+xml")?,
    };
    (bytes.len() <= MAX_LOGO_BYTES && (kind != "svg+xml" || is_flat(bytes)))
        .then(|| format!("data:image/{kind};base64,{}", STANDARD.encode(bytes)))
}

fn is_picture_uri(uri: &str) -> bool {
    let kinds = ["png", "jpeg", "svg+xml"].map(|kind| format!("data:image/{kind};base64,"));
    let bytes = kinds.iter().find_map(|head| STANDARD.decode(uri.strip_prefix(head)?).ok());
    bytes.is_some_and(|bytes| bytes.len() <= MAX_LOGO_BYTES && (!uri.contains("svg+xml") || is_flat(&bytes)))
}

/// Returns true if a program can draw an SVG within its stack: its elements are not nested deeply, no entity hides others,
/// and at most 64 references lead from one element to another.
fn is_flat(svg: &[u8]) -> bool {
    const MAX_REFERENCES: usize = 64;
    let Ok(text) = std::str::from_utf8(svg) else { return false };
    let text = text.to_ascii_lowercase();
    // A character can be written by its number, so each number counts as well.
    let references: usize = ["url(", "href", "&#"].iter().map(|mark| text.matches(mark).count()).sum();
    !text.contains("<!entity") && references <= MAX_REFERENCES && is_bounded_xml(&text)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn header() -> ShopHeader {
        let field = ShopField { name: "Order".into(), text: "4711 <A>".into() };
        ShopHeader { name: "Optics & Co".into(), address: vec!["1 Lens Lane".into()], logo: None, fields: vec![field] }
    }

    #[test]
    fn header_is_checked_and_escaped() {
        assert_eq!(header().check(), Ok(()));
        let html = header().html();
        assert!(html.contains("Optics &amp; Co") && html.contains("4711 &lt;A&gt;"), "{html}");
        roxmltree::Document::parse(&html).unwrap();
        for (bad, words) in [
            (ShopHeader { name: String::new(), ..header() }, "`name` has 0 characters"),
            (ShopHeader { name: "x".repeat(201), ..header() }, "`name` has 201 characters"),
            (ShopHeader { address: vec!["a\u{202e}b".into()], ..header() }, "direction of the text"),
            (ShopHeader { address: vec!["a".into(); 13], ..header() }, "13 entries"),
            (ShopHeader { logo: Some("https://example.com/logo.png".into()), ..header() }, "not a picture"),
        ] {
            let reason = bad.check().unwrap_err();
            assert!(reason.contains(words), "{words}: {reason}");
        }
    }

    #[test]
    fn logo_is_known_by_its_bytes() {
        let png = [0x89, b'P', b'N', b'G', 0x0d, 0x0a, 0x1a, 0x0a, 1, 2, 3];
        assert!(logo_uri(&png).unwrap().starts_with("data:image/png;base64,iVBORw0KGgo"));
        assert!(logo_uri(b"<svg xmlns='a'/>").unwrap().starts_with("data:image/svg+xml;base64,"));
        assert!(logo_uri(&[0xff, 0xd8, 0xff, 0xe0]).unwrap().starts_with("data:image/jpeg"));
        let nested = |depth: usize| format!("<svg>{}{}</svg>", "<g>".repeat(depth), "</g>".repeat(depth)).into_bytes();
        assert!(logo_uri(&nested(90)).is_some() && logo_uri(&nested(200)).is_none());
        assert!(logo_uri(format!("<svg>{}</svg>", "<g a='>'/><g></g><!-- <g> -->".repeat(1000)).as_bytes()).is_some());
        let hidden =
            format!("<!DOCTYPE svg [<!ENTITY a \"{}{}\">]><svg>&a;</svg>", "<g>".repeat(200), "</g>".repeat(200));
        assert_eq!(logo_uri(format!("<?xml version=\"1.0\"?>{hidden}").as_bytes()), None);
        let chain =
            |count: usize| format!("<svg>{}</svg>", "<use href='#a'/><g fill='url(#b)'/>".repeat(count)).into_bytes();
        assert!(logo_uri(&chain(32)).is_some() && logo_uri(&chain(33)).is_none());
        assert_eq!(logo_uri(format!("<svg>{}</svg>", "<g fill='u&#114;l(#b)'/>".repeat(65)).as_bytes()), None);
        // Tags in comments and strokes in attributes close nothing.
        for opened in ["<g><!--</g>-->", "<g a=\"/>\">", "<g><![CDATA[</g>]]>"] {
            let svg = format!("<svg>{}{}</svg>", opened.repeat(150), "</g>".repeat(150));
            assert!(logo_uri(svg.as_bytes()).is_none(), "{opened}");
        }
        let uri = format!("data:image/svg+xml;base64,{}", STANDARD.encode(nested(20_000)));
        assert!(ShopHeader { logo: Some(uri), ..header() }.check().is_err());
        assert_eq!([logo_uri(b""), logo_uri(b"GIF89a"), logo_uri(b"<html/>")], [None, None, None]);
        let mut large = png.to_vec();
        large.resize(MAX_LOGO_BYTES + 1, 0);
        assert_eq!(logo_uri(&large), None);
        let with_logo = ShopHeader { logo: logo_uri(&png), ..header() };
        assert_eq!(with_logo.check(), Ok(()));
    }
}
