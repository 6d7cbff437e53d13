//! Headers that are drawn: names, orders, groups, languages, units, comments. Who draws one knows which numbers were
//! measured and in which unit; a table is read so, or it is refused.

use std::path::Path;

use regrind_core::geometry::Point;
use regrind_formats::parse_points;

/// A small deterministic generator.
struct Draw(u64);

impl Draw {
    fn below(&mut self, count: usize) -> usize {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) as usize % count
    }

    fn one<'a>(&mut self, of: &[&'a str]) -> &'a str {
        of[self.below(of.len())]
    }

    fn chance(&mut self, of_100: usize) -> bool {
        self.below(100) < of_100
    }
}

const MEASURED: [&str; 18] = [
    "act",
    "Actual",
    "MEAS",
    "measured",
    "Ist",
    "gemessen",
    "mesure",
    "mesuré",
    "misurato",
    "medido",
    "mis",
    "real",
    "ACT.",
    "probed",
    "Messwert",
    "实测",
    "measurement",
    "Istwert",
];
const NOMINAL: [&str; 14] = [
    "nom",
    "Nominal",
    "Soll",
    "theo",
    "théorique",
    "ref",
    "CAD",
    "target",
    "design",
    "Sollwert",
    "teorico",
    "理论",
    "model",
    "basic",
];
const OTHERS: [&str; 16] = [
    "ID",
    "Nr",
    "index",
    "dev",
    "Deviation",
    "nx",
    "I",
    "J",
    "K",
    "T",
    "tol+",
    "Name",
    "Error [um]",
    "Quality",
    "dX",
    "Abw. Z",
];
const INCHES: [&str; 8] = ["inch", "in", "INCH", "inches", "Zoll", "pouces", "\"", "inch."];
const MICROMETRES: [&str; 4] = ["um", "µm", "micron", "\u{3bc}m"];

/// A table, what was measured in it, and whether everything about it is plain: three measured columns, named, in mm.
struct GeneratedTable {
    text: Vec<u8>,
    measured: Vec<Point>,
    is_plain: bool,
}

fn name(draw: &mut Draw, axis: &str, group: &str) -> String {
    let axis = if draw.chance(50) { axis.to_uppercase() } else { axis.to_owned() };
    if group.is_empty() {
        let word = draw.one(&["", "", "", "-coordinate", " Pos", "_coord"]);
        return format!("{axis}{word}");
    }
    match draw.below(6) {
        0 => format!("{axis}_{group}"),
        1 => format!("{group} {axis}"),
        2 => format!("{axis} ({group})"),
        3 => format!("{group}.{axis}"),
        4 => format!("{axis}{group}"),
        _ => format!("{axis}-{group}"),
    }
}

fn drawn(seed: u64) -> GeneratedTable {
    let mut draw = Draw(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ 0x5bd1_e995);
    // What stands in the table: each a column with its name and five values.
    let groups = draw.below(10);
    let (has_plain, has_measured, has_nominal) = match groups {
        0..=2 => (true, false, false),
        3..=5 => (false, true, false),
        6 => (false, false, true),
        7 => (true, true, false),
        _ => (false, true, true),
    };
    let mut columns: Vec<(String, Vec<f64>)> = Vec::new();
    let value =
        |axis: usize, row: usize, of: f64| (10.0 * row as f64 + 3.0 * axis as f64 + of).round() + 0.125 * axis as f64;
    let measured_of = if has_measured { 0.25 } else { 0.5 };
    let (measured_word, nominal_word) = (draw.one(&MEASURED), draw.one(&NOMINAL));
    for (there, group, of) in
        [(has_plain, "", 0.5), (has_measured, measured_word, 0.25), (has_nominal, nominal_word, 300.0)]
    {
        for (k, axis) in ["x", "y", "z"].into_iter().enumerate().filter(|_| there) {
            columns.push((name(&mut draw, axis, group), (0..5).map(|row| value(k, row, of) + of).collect()));
        }
    }
    let mut measured: Vec<Point> =
        (0..5).map(|row| Point::from([0, 1, 2].map(|k| value(k, row, measured_of) + measured_of))).collect();
    for _ in 0..draw.below(4) {
        columns.push((draw.one(&OTHERS).to_owned(), (0..5).map(|row| row as f64 - 1.5).collect()));
    }
    for k in (1..columns.len()).rev() {
        columns.swap(k, draw.below(k + 1));
    }
    // Of no group at all nothing was measured.
    let mut is_plain = (has_plain != has_measured) && !has_nominal;
    // The unit, and where it stands.
    let (word, scale) = match draw.below(10) {
        0..=5 => ("mm", 1.0),
        6 | 7 => (draw.one(&INCHES), 25.4),
        _ => (draw.one(&MICROMETRES), 1e-3),
    };
    let place = draw.below(7);
    let stated = place > 0;
    if stated {
        measured.iter_mut().for_each(|point| point.coords *= scale);
        is_plain &= scale == 1.0;
    }
    let mut above = String::new();
    match place {
        1 => columns.iter_mut().for_each(|column| column.0 += &format!(" [{word}]")),
        2 => columns.iter_mut().for_each(|column| column.0 += &format!("({word})")),
        3 => above += &format!("# units: {word}\n"),
        4 => above += &format!("# UNITS/{}\n", word.to_uppercase()),
        // Short words in a sentence are nothing that anybody could know.
        5 if word.chars().count() > 3 => above += &format!("# all dimensions in {word}\n"),
        5 => above += &format!("# unit = {word}\n"),
        _ => {}
    }
    let separator = draw.one(&[",", ";", "\t", ", "]);
    let join = |fields: Vec<String>| fields.join(separator);
    let mut text = above;
    if draw.chance(30) {
        text += &format!("Part {} of the lot\n", seed % 97);
        is_plain = false;
    }
    let header = join(columns.iter().map(|column| column.0.clone()).collect());
    if draw.chance(25) {
        text += &format!("# {header}\n");
    } else {
        text += &format!("{header}\n");
    }
    if place == 6 {
        text += &format!("{}\n", join(columns.iter().map(|_| word.to_owned()).collect()));
    }
    for row in 0..5 {
        text += &join(columns.iter().map(|column| column.1[row].to_string()).collect());
        text += "\n";
    }
    // Latin-1, as many machines write it.
    let latin = draw.chance(20) && text.chars().all(|c| (c as u32) < 256);
    let text = if latin { text.chars().map(|c| c as u32 as u8).collect() } else { text.into_bytes() };
    let known_measured = ["act", "Actual", "MEAS", "measured", "Ist", "gemessen", "misurato", "medido", "measurement"];
    is_plain &= !has_measured || known_measured.contains(&measured_word);
    // Nobody says that three nominal columns were measured.
    if has_nominal && !has_measured {
        measured.clear();
    }
    GeneratedTable { text, measured, is_plain }
}

#[test]
fn random_headers_read_or_refused() {
    let (mut read, mut plain, mut plain_read) = (0, 0, 0);
    for seed in 0..2000 {
        let drawn = drawn(seed);
        plain += usize::from(drawn.is_plain);
        let shown = || String::from_utf8_lossy(&drawn.text).into_owned();
        match parse_points(Path::new("t.csv"), &drawn.text[..]) {
            Ok(points) => {
                let right = points.len() == drawn.measured.len()
                    && points
                        .iter()
                        .zip(&drawn.measured)
                        .all(|(a, b)| (a - b).norm() <= 1e-9 * (1.0 + b.coords.norm()));
                assert!(right, "seed {seed}: {points:?}, measured {:?}\n{}", drawn.measured, shown());
                (read, plain_read) = (read + 1, plain_read + usize::from(drawn.is_plain));
            }
            Err(error) => {
                assert!(!drawn.is_plain || error.to_string().contains("line"), "seed {seed}: {error}\n{}", shown());
            }
        }
    }
    println!("{read} read, {plain_read} of {plain} plain ones");
    assert!(plain > 300 && plain_read * 10 >= plain * 9, "{plain_read} of {plain}");
}
