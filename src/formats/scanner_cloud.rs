//! Clouds of points of scanners: E57 (ASTM E2807) and LAS (ASPRS).
//!
//! E57 is in metres. Each scan has a pose, which is applied; points that the file calls invalid are left out. LAS states
//! no unit, so it must be given; points that the file withholds or calls noise are left out.

use std::io::Cursor;
use std::path::Path;

use e57::RecordDataType;
use regrind_core::geometry::Point;

use super::error::{FormatError, excerpt};
use super::note::{NotedPoints, PointNote};
use super::number::is_believable;
use super::unit::Unit;

/// Maximum number of points that are read.
const MAX_POINTS: u64 = 50_000_000;

/// Format of a cloud, detected by its first bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum CloudFormat {
    E57,
    Las,
}

/// Returns the format of a cloud from its first bytes; `None` for another file.
pub(super) fn cloud_format(head: &[u8]) -> Option<CloudFormat> {
    if head.starts_with(b"ASTM-E57") {
        return Some(CloudFormat::E57);
    }
    head.starts_with(b"LASF").then_some(CloudFormat::Las)
}

/// Parses the content of a cloud. Returns its points in millimetres, and for LAS a note on the steps of the coordinates.
/// `unit` is that of a LAS file. `path` only names the file in messages.
///
/// # Errors
/// Bytes that are not valid in their format; a LAS file without a given unit, or an E57 file with one; a coordinate beyond
/// 1e7 mm; no valid point.
pub(super) fn parse_cloud(
    path: &Path,
    bytes: &[u8],
    format: CloudFormat,
    unit: Option<Unit>,
) -> Result<NotedPoints, FormatError> {
    let mut notes = Vec::new();
    let unexpected = |place: &str, expected: &str, found: &str| FormatError::Unexpected {
        path: path.to_owned(),
        place: place.to_owned(),
        expected: expected.to_owned(),
        found: excerpt(found.as_bytes()),
    };
    let points = match (format, unit) {
        (CloudFormat::E57, None) => e57_points(bytes).map_err(|error| unexpected("file", "E57", &error))?,
        (CloudFormat::E57, Some(_)) => return Err(unexpected("unit", "no unit, because E57 is in metres", "one")),
        (CloudFormat::Las, Some(unit)) => {
            let wrong = |error: String| unexpected("file", "LAS", &error);
            let [x, y, z] = las_steps(bytes).map_err(wrong)?;
            let note =
                format!("its coordinates have steps of {x:e} {unit} in x, {y:e} {unit} in y and {z:e} {unit} in z");
            notes.push(PointNote::Map { path: path.to_owned(), note });
            let points = las_points(bytes).map_err(wrong)?;
            points.into_iter().map(|p| p * unit.in_mm()).collect()
        }
        (CloudFormat::Las, None) => {
            return Err(unexpected("unit", "a unit, such as --unit m, because LAS states none", "none"));
        }
    };
    if points.is_empty() {
        return Err(FormatError::NoData { path: path.to_owned(), expected: "valid point" });
    }
    if let Some(at) = points.iter().position(|p| !p.iter().all(|c| is_believable(*c))) {
        return Err(unexpected(
            &format!("point {}", at + 1),
            "coordinates of at most 1e7 mm",
            &format!("{}", points[at]),
        ));
    }
    Ok(NotedPoints { points, notes })
}

/// Largest difference of the length of a quaternion from 1. Writers round its parts to seven digits and fewer.
const MAX_QUATERNION_ERROR: f64 = 1e-3;

/// Returns the factor by which the library scales the points of a scan when it turns them, and the point in metres that
/// stays where it is. The factor is the square of the length of the quaternion, which rounding makes differ from 1.
fn scale_of_pose(pose: Option<&e57::Transform>) -> Result<(f64, Point), String> {
    let Some(pose) = pose else { return Ok((1.0, Point::origin())) };
    let q = &pose.rotation;
    let scale = q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z;
    let length = scale.sqrt();
    if length.is_nan() || (length - 1.0).abs() > MAX_QUATERNION_ERROR {
        return Err(format!("a pose whose quaternion has the length {length} instead of 1"));
    }
    Ok((scale, Point::new(pose.translation.x, pose.translation.y, pose.translation.z)))
}

/// Checks the records of a scan: their types, and that the file has enough bytes for them. A value that can be one number
/// only has no bits; if no value has bits, the library makes values without end.
fn check_prototype(scan: &e57::PointCloud, file_bytes: usize) -> Result<(), String> {
    let mut bits = 0u64;
    for record in &scan.prototype {
        let name = &record.name;
        bits += match record.data_type {
            RecordDataType::Single { .. } => 32,
            RecordDataType::Double { .. } => 64,
            RecordDataType::ScaledInteger { min, max, .. } | RecordDataType::Integer { min, max } if min > max => {
                return Err(format!("values {name:?} from {min} to {max}"));
            }
            RecordDataType::ScaledInteger { scale, .. } if scale == 0.0 || !scale.is_finite() => {
                return Err(format!("values {name:?} with the scale {scale}"));
            }
            RecordDataType::ScaledInteger { min, max, .. } | RecordDataType::Integer { min, max } => {
                (i128::from(max) - i128::from(min)).checked_ilog2().map_or(0, |log| u64::from(log) + 1)
            }
        };
    }
    if bits == 0 {
        return Err("points whose values have no bits".to_owned());
    }
    if scan.records.saturating_mul(bits) / 8 > file_bytes as u64 {
        return Err(format!("{} points of {bits} bits in {file_bytes} bytes", scan.records));
    }
    Ok(())
}

/// Returns the valid points of all scans, in millimetres.
fn e57_points(bytes: &[u8]) -> Result<Vec<Point>, String> {
    let words = |error: e57::Error| error.to_string();
    let mut file = e57::E57Reader::new(Cursor::new(bytes)).map_err(words)?;
    let mut points = Vec::new();
    for scan in file.pointclouds() {
        if scan.records.saturating_add(points.len() as u64) > MAX_POINTS {
            return Err(format!("more than {MAX_POINTS} points"));
        }
        check_prototype(&scan, bytes.len())?;
        let (scale, origin) = scale_of_pose(scan.transform.as_ref())?;
        for point in file.pointcloud_simple(&scan).map_err(words)? {
            if let e57::CartesianCoordinate::Valid { x, y, z } = point.map_err(words)?.cartesian {
                points.push((origin + (Point::new(x, y, z) - origin) / scale) * 1e3);
            }
        }
    }
    Ok(points)
}

/// Returns the steps of x, y and z in the unit of the file. LAS stores each coordinate as a whole number of steps.
fn las_steps(bytes: &[u8]) -> Result<[f64; 3], String> {
    let header = las::raw::Header::read_from(bytes).map_err(|error| error.to_string())?;
    let steps = [header.x_scale_factor, header.y_scale_factor, header.z_scale_factor];
    match steps.iter().find(|step| !(**step > 0.0 && step.is_finite())) {
        Some(step) => Err(format!("the scale {step} of a coordinate, which must be finite and above 0")),
        None => Ok(steps),
    }
}

/// Checks that the points and the extended records that a LAS file states lie within it. The library reserves memory for
/// them before it reads them.
fn check_las_lengths(bytes: &[u8]) -> Result<(), String> {
    /// Bytes of an extended record before its content, and the place of its length in them.
    const RECORD: u64 = 60;
    const LENGTH: usize = 20;
    /// Bit of the number of the point format.
    const COMPRESSED: u8 = 0x80;
    let header = las::raw::Header::read_from(bytes).map_err(|error| error.to_string())?;
    if header.point_data_record_format & COMPRESSED != 0 {
        return Err("compressed points (LAZ); unpack them".to_owned());
    }
    let file_bytes = bytes.len() as u64;
    let large = header.large_file.map_or(0, |large| large.number_of_point_records);
    let count = if header.number_of_point_records > 0 { header.number_of_point_records.into() } else { large };
    let points = count.saturating_mul(header.point_data_record_length.into());
    if count > MAX_POINTS || points.saturating_add(header.offset_to_point_data.into()) > file_bytes {
        return Err(format!("{count} points in {file_bytes} bytes"));
    }
    let Some(extended) = header.evlr else { return Ok(()) };
    let start = extended.start_of_first_evlr;
    let length = usize::try_from(start).ok().and_then(|start| bytes.get(start.checked_add(LENGTH)?..)?.first_chunk());
    let length = length.map_or(u64::MAX, |length| u64::from_le_bytes(*length));
    if start.saturating_add(RECORD).saturating_add(length) > file_bytes {
        return Err(format!("an extended record from byte {start} on, beyond the end of {file_bytes} bytes"));
    }
    Ok(())
}

/// Returns the points that are neither withheld nor noise, in the unit of the file.
fn las_points(bytes: &[u8]) -> Result<Vec<Point>, String> {
    let words = |error: las::Error| error.to_string();
    check_las_lengths(bytes)?;
    let mut file = las::Reader::new(Cursor::new(bytes.to_vec())).map_err(words)?;
    let all = file.read_all().map_err(words)?;
    let mut points = Vec::new();
    for point in all.points() {
        let point = point.map_err(words)?;
        let is_noise = matches!(u8::from(point.classification), 7 | 18);
        if !point.is_withheld && !is_noise {
            points.push(Point::new(point.x, point.y, point.z));
        }
    }
    Ok(points)
}

/// Parses the content of a cloud of any format, LAS in metres. Returns its points in millimetres. `path` only names the
/// file in messages.
///
/// # Errors
/// The same as for reading such a file.
pub fn parse_scanner_cloud(path: &Path, bytes: &[u8]) -> Result<Vec<Point>, FormatError> {
    let Some(format) = cloud_format(bytes) else {
        return Err(FormatError::NoData { path: path.to_owned(), expected: "cloud of a known format" });
    };
    let unit = (format == CloudFormat::Las).then_some(Unit::Metre);
    parse_cloud(path, bytes, format, unit).map(|read| read.points)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// First byte of the step of z in the header of LAS.
    const Z_STEP: usize = 147;

    /// Returns a file of ten points at 5 m, whose x is said to be an integer from 5 to `most`. y and z can be 0 only.
    fn e57_of_integers(most: i64) -> Vec<u8> {
        let mut bytes = Cursor::new(Vec::new());
        let mut file = e57::E57Writer::new(&mut bytes, "file").unwrap();
        let kind = |min, max| RecordDataType::ScaledInteger { min, max, scale: 0.001, offset: 0.0 };
        let record = |name, data_type| e57::Record { name, data_type };
        let prototype = vec![
            record(e57::RecordName::CartesianX, kind(5, 6)),
            record(e57::RecordName::CartesianY, kind(0, 0)),
            record(e57::RecordName::CartesianZ, kind(0, 0)),
        ];
        let mut scan = file.add_pointcloud("scan", prototype).unwrap();
        for _ in 0..10 {
            scan.add_point([5, 0, 0].map(e57::RecordValue::ScaledInteger).to_vec()).unwrap();
        }
        scan.finalize().unwrap();
        let stated = format!("maximum=\"{most}\"");
        file.finalize_customized_xml(|xml| Ok(xml.replace("maximum=\"6\"", &stated))).unwrap();
        drop(file);
        bytes.into_inner()
    }

    /// LAS 1.4: the place of the first extended record is in bytes 235 to 242, their number behind it.
    #[test]
    fn las_lengths_beyond_file_are_refused() {
        let plain = include_bytes!("tests/fixtures/scanner/laspy-14-withheld.las");
        let with_record = |start: u64, length: u64| {
            let mut bytes = plain.to_vec();
            bytes[235..243].copy_from_slice(&start.to_le_bytes());
            bytes[243..247].copy_from_slice(&1u32.to_le_bytes());
            bytes.extend([&[0; 20][..], &length.to_le_bytes(), &[0; 32], b"content"].concat());
            bytes
        };
        let end = plain.len() as u64;
        assert_eq!(las_points(&with_record(end, 7)).unwrap(), las_points(plain).unwrap());
        for (start, length) in [(end, 8), (end, 1 << 40), (end, u64::MAX), (end + 60, 7), (u64::MAX, 7)] {
            assert!(las_points(&with_record(start, length)).is_err(), "{length} bytes at {start}");
        }
        // The number of points of a file without the older number.
        let mut bytes = plain.to_vec();
        bytes[107..111].copy_from_slice(&0u32.to_le_bytes());
        assert_eq!(las_points(&bytes).unwrap(), las_points(plain).unwrap());
        for count in [34, u64::MAX, u64::MAX / 30] {
            bytes[247..255].copy_from_slice(&count.to_le_bytes());
            assert!(las_points(&bytes).is_err(), "{count} points");
        }
    }

    /// A coarse step makes all heights of a fine surface alike; the note tells the step.
    #[test]
    fn las_steps_are_noted() {
        let path = Path::new("a.las");
        let plain = include_bytes!("tests/fixtures/scanner/laspy.las");
        assert_eq!(las_steps(plain).unwrap(), [1e-7, 1e-7, 1e-10]);
        let read = parse_cloud(path, plain, CloudFormat::Las, Some(Unit::Metre)).unwrap();
        let [PointNote::Map { note, .. }] = &read.notes[..] else { panic!("{:?}", read.notes) };
        assert!(note.contains("1e-10 m in z"), "{note}");
        for wrong in [0.0, -1e-10, f64::NAN, f64::INFINITY] {
            let mut bytes = plain.to_vec();
            bytes[Z_STEP..Z_STEP + 8].copy_from_slice(&f64::to_le_bytes(wrong));
            let refused = parse_cloud(path, &bytes, CloudFormat::Las, Some(Unit::Metre));
            assert!(matches!(refused, Err(FormatError::Unexpected { .. })), "{wrong}");
        }
    }

    #[test]
    fn e57_without_bits_is_refused() {
        assert_eq!(e57_points(&e57_of_integers(6)).unwrap(), [Point::new(5.0, 0.0, 0.0); 10]);
        for most in [5, 4] {
            assert!(e57_points(&e57_of_integers(most)).is_err(), "5 to {most}");
        }
    }

    /// A part that is rounded by 2e-8 makes a scale of 1 + 2 * 0.6 * 2e-8. A length of 1.2 is no rounding.
    #[test]
    fn scale_of_rounded_quaternion_is_square_of_length() {
        let pose = |w: f64| e57::Transform {
            rotation: e57::Quaternion { w, x: 0.0, y: 0.0, z: 0.8 },
            translation: e57::Translation { x: 1.0, y: 2.0, z: 3.0 },
        };
        let (scale, origin) = scale_of_pose(Some(&pose(0.600_000_02))).unwrap();
        assert!((scale - 1.000_000_024).abs() < 1e-14, "{scale}");
        assert_eq!(origin, Point::new(1.0, 2.0, 3.0));
        assert_eq!(scale_of_pose(None).unwrap().0, 1.0);
        assert!(scale_of_pose(Some(&pose(0.9))).is_err());
        assert!(scale_of_pose(Some(&pose(f64::NAN))).is_err());
    }
}
