//! Points coloured by their deviation, for programs that show point clouds and meshes.

use std::path::Path;

use super::ReportError;
use super::colour::Tones;
use regrind_formats::write_atomic;

/// Returns a binary PLY file with points, their colours and their deviations, and optional triangles between the
/// points.
///
/// `rows_mm` has one row for each point: x, y, z and the deviation, all in millimetres. Each of the `triangles` has
/// three indices into `rows_mm`, counted from 0. `title` and each of the `remarks` become a comment in the file.
///
/// The file gives the deviation of each point in micrometres, as the PLY property `scalar_deviation_um`. The colours
/// are those of [`HeatMap`](crate::HeatMap), symmetric about zero. With a `tolerance_mm`, points with a deviation from
/// `-tolerance_mm` to `tolerance_mm` get only pale colours.
///
/// # Errors
/// Fails if there is no point, if a number is not finite, if the tolerance is not finite and above 0, or if a triangle
/// refers to a point that does not exist.
pub fn coloured_ply(
    title: &str,
    rows_mm: &[[f64; 4]],
    triangles: &[[u32; 3]],
    tolerance_mm: Option<f64>,
    remarks: &[&str],
) -> Result<Vec<u8>, ReportError> {
    let figure = || title.to_owned();
    if rows_mm.is_empty() {
        return Err(ReportError::TooFewPoints { figure: figure(), found: 0, least: 1 });
    }
    for (index, row) in rows_mm.iter().enumerate() {
        if let Some(k) = row.iter().position(|value| !value.is_finite()) {
            let what = ["x", "y", "z", "deviation"][k];
            return Err(ReportError::NotFinite { figure: figure(), index, what, value: row[k] });
        }
    }
    let points = rows_mm.len();
    if let Some(&corner) = triangles.iter().flatten().find(|corner| **corner as usize >= points) {
        return Err(ReportError::Corner { figure: figure(), corner, points });
    }
    if let Some(limit) = tolerance_mm.filter(|t| !(*t > 0.0 && t.is_finite())) {
        return Err(ReportError::ColourLimit { figure: figure(), limit });
    }
    let tones = Tones::symmetric(rows_mm.iter().fold(0.0, |most: f64, row| most.max(row[3].abs())), tolerance_mm);
    let mut bytes = header(title, points, triangles.len(), &tones, remarks).into_bytes();
    for [x, y, z, deviation] in rows_mm {
        [x, y, z].iter().for_each(|value| bytes.extend(value.to_le_bytes()));
        bytes.extend(tones.at(*deviation));
        bytes.extend((1e3 * deviation).to_le_bytes());
    }
    for corners in triangles {
        bytes.push(3);
        corners.iter().for_each(|corner| bytes.extend(corner.to_le_bytes()));
    }
    Ok(bytes)
}

/// Writes a binary PLY file to `path` with points, their colours and their deviations, and the triangles between the
/// points. `rows_mm` has x, y, z and the deviation of each point in millimetres. Each triangle has three indices into
/// `rows_mm`, counted from 0. `title` and each of the `remarks` become a comment. With a `tolerance_mm`, points with a
/// deviation from `-tolerance_mm` to `tolerance_mm` get only pale colours. [`coloured_ply`] returns the same content
/// without a file.
///
/// # Errors
/// Fails if there is no point, if a number is not finite, if the tolerance is not finite and above 0, if a triangle
/// refers to a point that does not exist, or if the file cannot be written.
pub fn save_coloured_ply(
    path: &Path,
    title: &str,
    rows_mm: &[[f64; 4]],
    triangles: &[[u32; 3]],
    tolerance_mm: Option<f64>,
    remarks: &[&str],
) -> Result<(), ReportError> {
    Ok(write_atomic(path, &coloured_ply(title, rows_mm, triangles, tolerance_mm, remarks)?)?)
}

fn header(title: &str, points: usize, triangles: usize, tones: &Tones, remarks: &[&str]) -> String {
    let mut text = "ply\nformat binary_little_endian 1.0\n".to_owned();
    let mut comment = |words: &str| {
        let line: String = words.chars().map(|c| if c.is_control() { ' ' } else { c }).collect();
        text.push_str(&format!("comment {line}\n"));
    };
    comment(title);
    comment("units: mm");
    remarks.iter().for_each(|remark| comment(remark));
    comment(&format!(
        "colours of the deviation: from {} um (blue) to {} um (red)",
        1e3 * tones.range[0],
        1e3 * tones.range[1]
    ));
    if let Some(band) = tones.tolerance {
        comment(&format!(
            "pale colours: deviations of at most {} um to either side of zero, which are in tolerance",
            1e3 * band
        ));
    }
    text.push_str(&format!(
        "element vertex {points}\nproperty double x\nproperty double y\nproperty double z\nproperty uchar red\nproperty uchar \
         green\nproperty uchar blue\nproperty double scalar_deviation_um\n"
    ));
    if triangles > 0 {
        text.push_str(&format!("element face {triangles}\nproperty list uchar uint vertex_indices\n"));
    }
    text.push_str("end_header\n");
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    const ROWS: [[f64; 4]; 3] = [[0.0, 1.0, 2.0, 1e-3], [3.0, 4.0, 5.5, -2e-3], [6.0, 7.0, 8.0, 0.0]];

    #[test]
    fn coloured_ply_round_trip() {
        let bytes = coloured_ply("part\n7", &ROWS, &[[0, 1, 2]], Some(1.5e-3), &["SIMULATION"]).unwrap();
        let read = regrind_formats::parse_ply(Path::new("p.ply"), &bytes).unwrap();
        assert_eq!((read.points[1], &read.triangles[..]), ([3.0, 4.0, 5.5].into(), &[[0, 1, 2]][..]));
        let begin = bytes.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
        let head = std::str::from_utf8(&bytes[..begin]).unwrap();
        assert!(head.contains("comment part 7\n") && head.contains("comment SIMULATION\n"), "{head}");
        let row = |k: usize| &bytes[begin + 35 * k + 24..][..11];
        assert_eq!(row(1)[..3], [0x05, 0x30, 0x61]);
        assert_eq!(row(2)[..3], [0xf7; 3]);
        assert!(row(0)[..3].iter().all(|c| *c > 0xe0), "in tolerance: {:?}", row(0));
        assert_eq!(f64::from_le_bytes(row(1)[3..].try_into().unwrap()), -2.0);
    }

    #[test]
    fn coloured_ply_refuses_bad_input() {
        let made = |rows: &[[f64; 4]], triangles: &[[u32; 3]], band| coloured_ply("p", rows, triangles, band, &[]);
        assert!(matches!(made(&[], &[], None), Err(ReportError::TooFewPoints { .. })));
        assert!(matches!(made(&ROWS, &[[0, 1, 3]], None), Err(ReportError::Corner { corner: 3, points: 3, .. })));
        assert!(matches!(made(&ROWS, &[], Some(0.0)), Err(ReportError::ColourLimit { .. })));
        let mut bad = ROWS;
        bad[1][3] = f64::NAN;
        assert!(matches!(made(&bad, &[], None), Err(ReportError::NotFinite { index: 1, what: "deviation", .. })));
        // A flat part has one colour.
        assert!(made(&[[0.0; 4]], &[], None).is_ok());
    }
}
