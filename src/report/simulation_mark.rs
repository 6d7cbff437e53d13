//! Pictures marked with a word, so that nobody mistakes a picture of a simulated part for one of a real part.

/// Word on everything that comes from a simulated cell.
const WORD: &str = "SIMULATION";
/// Letters of the word in 5 by 7 pixels. Rows run from the top; the leftmost pixel is the highest of five bits.
const LETTERS: [(char, [u8; 7]); 9] = [
    ('S', [0b01111, 0b10000, 0b10000, 0b01110, 0b00001, 0b00001, 0b11110]),
    ('I', [0b01110, 0b00100, 0b00100, 0b00100, 0b00100, 0b00100, 0b01110]),
    ('M', [0b10001, 0b11011, 0b10101, 0b10101, 0b10001, 0b10001, 0b10001]),
    ('U', [0b10001, 0b10001, 0b10001, 0b10001, 0b10001, 0b10001, 0b01110]),
    ('L', [0b10000, 0b10000, 0b10000, 0b10000, 0b10000, 0b10000, 0b11111]),
    ('A', [0b01110, 0b10001, 0b10001, 0b11111, 0b10001, 0b10001, 0b10001]),
    ('T', [0b11111, 0b00100, 0b00100, 0b00100, 0b00100, 0b00100, 0b00100]),
    ('O', [0b01110, 0b10001, 0b10001, 0b10001, 0b10001, 0b10001, 0b01110]),
    ('N', [0b10001, 0b11001, 0b10101, 0b10011, 0b10001, 0b10001, 0b10001]),
];
/// Distance from one letter to the next, and height of the band, in pixels.
const ADVANCE: usize = 6;
const BAND: usize = 11;
/// Minimum width of a picture with the word on it, in pixels.
const MIN_WIDTH: usize = 120;
const INK: [u8; 4] = [0, 0, 0, 255];
const GROUND: [u8; 4] = [0xff, 0xc8, 0x00, 255];

/// Picture in red, green, blue and opacity, rows from the top.
pub(super) struct MarkedPicture {
    pub width: usize,
    pub height: usize,
    pub rgba: Vec<u8>,
}

/// Returns a copy of a picture with the word SIMULATION in a band above it. `pixels` are the pixels of the picture
/// (red, green, blue, opacity), row by row from the top. `columns` is the number of pixels in a row. If the picture is
/// too narrow for the word, the copy is enlarged: each pixel becomes a square of several pixels.
pub(super) fn mark_simulation(pixels: &[[u8; 4]], columns: usize) -> MarkedPicture {
    let rows = pixels.len() / columns;
    let enlarged = MIN_WIDTH.div_ceil(columns);
    let width = columns * enlarged;
    let scale = width / MIN_WIDTH;
    let band = BAND * scale;
    let mut rgba = Vec::with_capacity(4 * width * (band + rows * enlarged));
    let left = (width - (WORD.len() * ADVANCE - 1) * scale) / 2;
    for y in 0..band {
        for x in 0..width {
            let is_ink = x.checked_sub(left).is_some_and(|x| is_inked(x / scale, y / scale));
            rgba.extend(if is_ink { INK } else { GROUND });
        }
    }
    for row in pixels.chunks(columns) {
        let line: Vec<u8> = row.iter().flat_map(|pixel| pixel.repeat(enlarged)).collect();
        (0..enlarged).for_each(|_| rgba.extend_from_slice(&line));
    }
    MarkedPicture { width, height: band + rows * enlarged, rgba }
}

/// Returns true if a point of the band above a picture belongs to a letter of the word SIMULATION. The letters are
/// drawn on a grid of 5 by 7 cells each. `x` and `y` are cell indices: `x` counts from the left edge of the first
/// letter, `y` from the top of the band.
fn is_inked(x: usize, y: usize) -> bool {
    const ABOVE: usize = 2;
    const WIDE: usize = 5;
    let letter = WORD.chars().nth(x / ADVANCE).and_then(|c| LETTERS.iter().find(|(of, _)| *of == c));
    let bits = letter.and_then(|(_, rows)| rows.get(y.checked_sub(ABOVE)?));
    let column = x % ADVANCE;
    column < WIDE && bits.is_some_and(|bits| bits >> (WIDE - 1 - column) & 1 == 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn simulation_mark_above_pixels() {
        for (columns, rows) in [(1, 1), (7, 5), (103, 63), (500, 300)] {
            let pixels: Vec<[u8; 4]> = (0..columns * rows).map(|k| [k as u8, (k >> 8) as u8, 7, 255]).collect();
            let picture = mark_simulation(&pixels, columns);
            assert_eq!(picture.rgba.len(), 4 * picture.width * picture.height);
            let enlarged = picture.width / columns;
            let band = picture.height - rows * enlarged;
            let at = |x: usize, y: usize| -> [u8; 4] {
                let begin = 4 * (y * picture.width + x);
                std::array::from_fn(|k| picture.rgba[begin + k])
            };
            let inked =
                (0..band).flat_map(|y| (0..picture.width).map(move |x| (x, y))).filter(|(x, y)| at(*x, *y) == INK);
            let scale = band / BAND;
            let of_letters: u32 = WORD
                .chars()
                .map(|c| {
                    LETTERS.iter().find(|(of, _)| *of == c).unwrap().1.iter().map(|row| row.count_ones()).sum::<u32>()
                })
                .sum();
            assert_eq!(inked.count(), of_letters as usize * scale * scale);
            for k in [0, columns * rows / 2, columns * rows - 1] {
                let place = (k % columns * enlarged, band + k / columns * enlarged);
                assert_eq!(at(place.0, place.1), pixels[k]);
            }
        }
    }
}
