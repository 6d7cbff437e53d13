//! Figures as pixels: an SVG that this crate wrote, drawn with the fonts of this program.

use std::sync::{Arc, LazyLock};

use resvg::tiny_skia::{Pixmap, Transform};
use resvg::usvg::{Options, Tree, fontdb};

use super::fonts;

/// Pixels of a drawn figure for each pixel of its SVG, so that its letters are sharp in a document.
const SCALE: f32 = 1.5;

/// Families of fonts in the SVG of a figure, in the order in which a reader of SVG tries them.
pub(super) const FONTS_OF_FIGURES: &str = "Helvetica, Arial, sans-serif";

/// Draws an SVG on a white ground, and returns it as PNG. A character that the fonts of this program lack is drawn with
/// a font of the computer; it is left out if there is none.
///
/// # Errors
/// Returns the reason if the SVG has a mistake, no size, or a size that no memory holds.
pub(super) fn drawn(svg: &str) -> Result<Vec<u8>, String> {
    let options = Options { font_family: fonts::FAMILY.to_owned(), fontdb: fonts_for(svg), ..Options::default() };
    let tree =
        Tree::from_str(&svg.replace(FONTS_OF_FIGURES, fonts::FAMILY), &options).map_err(|error| error.to_string())?;
    let [width, height] = [tree.size().width(), tree.size().height()].map(|length| (length * SCALE).ceil() as u32);
    let mut pixmap = Pixmap::new(width, height).ok_or_else(|| format!("no room for {width} x {height} pixels"))?;
    resvg::render(&tree, Transform::from_scale(SCALE, SCALE), &mut pixmap.as_mut());
    encoded(&pixmap).map_err(|error| error.to_string())
}

/// Returns the fonts for a text. The fonts of the computer are searched only if the fonts of this program lack one of its
/// characters.
fn fonts_for(text: &str) -> Arc<fontdb::Database> {
    static OWN: LazyLock<Arc<fontdb::Database>> = LazyLock::new(|| Arc::new(own_fonts()));
    static ALL: LazyLock<Arc<fontdb::Database>> = LazyLock::new(|| Arc::new(all_fonts()));
    if fonts::have_all(text) {
        return Arc::clone(&OWN);
    }
    Arc::clone(&ALL)
}

/// Returns the fonts of this program and of the computer.
fn all_fonts() -> fontdb::Database {
    let mut all = own_fonts();
    all.load_system_fonts();
    // The fonts of the computer come with families of their own.
    all.set_sans_serif_family(fonts::FAMILY);
    all
}

fn own_fonts() -> fontdb::Database {
    let mut database = fontdb::Database::new();
    for file in fonts::FILES {
        database.load_font_data(file.to_vec());
    }
    database.set_sans_serif_family(fonts::FAMILY);
    database
}

/// Encodes a picture. The ground of a figure is opaque, so its colours are not multiplied by an opacity.
fn encoded(pixmap: &Pixmap) -> Result<Vec<u8>, png::EncodingError> {
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, pixmap.width(), pixmap.height());
    encoder.set_color(png::ColorType::Rgba);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.set_compression(png::Compression::Balanced);
    encoder.set_filter(png::Filter::Up);
    let mut writer = encoder.write_header()?;
    writer.write_image_data(pixmap.data())?;
    writer.finish()?;
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn decoded(bytes: &[u8]) -> (u32, Vec<u8>) {
        let mut reader = png::Decoder::new(std::io::Cursor::new(bytes)).read_info().unwrap();
        let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
        let info = reader.next_frame(&mut pixels).unwrap();
        (info.width, pixels)
    }

    #[test]
    fn text_and_shapes_are_drawn() {
        let svg = "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"60\" height=\"20\"><rect width=\"100%\" height=\"100%\" fill=\"#fff\"/>\
                   <rect width=\"5\" height=\"5\" fill=\"#f00\"/><text x=\"10\" y=\"15\" font-size=\"12\">\u{2212}2.25</text></svg>";
        let (width, pixels) = decoded(&drawn(svg).unwrap());
        assert_eq!((width, pixels.len()), (90, 90 * 30 * 4));
        let at = |x: usize, y: usize| <[u8; 3]>::try_from(&pixels[4 * (90 * y + x)..][..3]).unwrap();
        assert_eq!((at(0, 0), at(89, 29)), ([255, 0, 0], [255, 255, 255]));
        let inked = (15..75).flat_map(|x| (0..30).map(move |y| (x, y))).filter(|&(x, y)| at(x, y)[0] < 128).count();
        assert!(inked > 50, "{inked} dark pixels of a text");
    }

    /// A character that the fonts lack does not change the others.
    #[test]
    fn unknown_character_leaves_other_text() {
        let text = |content: &str| {
            format!(
                "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"120\" height=\"20\" font-family=\"{FONTS_OF_FIGURES}\">\
                 <rect width=\"100%\" height=\"100%\" fill=\"#fff\"/><text x=\"2\" y=\"15\">SIMULATION</text><text x=\"100\" y=\"15\">{content}</text></svg>"
            )
        };
        let left = |content: &str| {
            let (width, pixels) = decoded(&drawn(&text(content)).unwrap());
            let row = |row: &[u8]| row[..4 * 140].to_vec();
            pixels.chunks(4 * width as usize).flat_map(row).collect::<Vec<u8>>()
        };
        assert!(left("") == left("\u{9554}"), "the mark is drawn alike");
        assert!(left("").iter().filter(|value| **value < 128).count() > 300);
    }

    #[test]
    fn broken_svg_is_refused() {
        assert!(drawn("<svg").is_err() && drawn("<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"0\"/>").is_err());
    }
}
