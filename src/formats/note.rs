//! Ambiguities of a file of points that do not prevent reading it; they are reported with the points and never cause a
//! rejection.

use std::fmt;
use std::path::PathBuf;

use regrind_core::geometry::Point;

use super::result_content::Coordinates;

/// Points, with notes on how they were read.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct NotedPoints {
    /// In millimetres, in the order of the file.
    pub points: Vec<Point>,
    /// Notes; empty if there are none.
    pub notes: Vec<PointNote>,
}

impl From<Vec<Point>> for NotedPoints {
    fn from(points: Vec<Point>) -> Self {
        Self { points, notes: Vec::new() }
    }
}

/// Note on how points were read; lines count from 1.
#[derive(Clone, Debug, PartialEq)]
pub enum PointNote {
    /// The last line has no line end: many programs write files like this, but a copy that was cut looks the same.
    NoLineEnd {
        /// The file.
        path: PathBuf,
        /// The last line.
        line: u64,
        /// The last number in the line, as written.
        found: String,
        /// Value that was read from the line.
        point: Point,
        /// Number of digits of `found` after the decimal mark, or in the exponent, and the minimum of this number in
        /// the lines above; `None` if the last line does not have fewer digits.
        fewer_digits: Option<[usize; 2]>,
    },
    /// Exactly one number of the file has a separator between its thousands.
    OneThousandsMark {
        /// The file.
        path: PathBuf,
        /// Line of the number.
        line: u64,
        /// Number as written.
        found: String,
        /// Value that was read.
        value_mm: f64,
    },
    /// The file says whether its points are centres of the probe or points of the surface.
    Coordinates {
        /// The file.
        path: PathBuf,
        /// Meaning of the points.
        coordinates: Coordinates,
        /// Radius of the probe, if the file states it.
        probe_radius_mm: Option<f64>,
    },
    /// A map has content that can be read in more than one way, or a cloud of points has coarse coordinates.
    Map {
        /// The file.
        path: PathBuf,
        /// How it was read.
        note: String,
    },
}

impl fmt::Display for PointNote {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NoLineEnd { path, line, found, point, fewer_digits } => {
                let [x, y, z] = [point.x, point.y, point.z];
                write!(f, "{}, line {line}: the last line has no line end, ", path.display())?;
                match fewer_digits {
                    Some([here, above]) => write!(
                        f,
                        "and its last number `{found}` has {here} digits; the lines above have {above} or more: the \
                         file is probably cut there, and the point ({x}, {y}, {z}) mm wrong; copy or export it \
                         again",
                    ),
                    None => write!(
                        f,
                        "so its last number `{found}` may be cut; it was read as the point ({x}, {y}, {z}) mm; check \
                         that the file is complete"
                    ),
                }
            }
            Self::Coordinates { path, coordinates, probe_radius_mm } => {
                let points = match coordinates {
                    Coordinates::Centres => "centres of the probe",
                    Coordinates::Contacts => "points of the surface",
                };
                write!(f, "{}: the file says that its points are {points}", path.display())?;
                if let Some(radius_mm) = probe_radius_mm {
                    write!(f, " with the probe radius {radius_mm} mm")?;
                }
                write!(f, "; check that the method and the probe radius of the registration agree")
            }
            Self::Map { path, note } => write!(f, "{}: {note}", path.display()),
            Self::OneThousandsMark { path, line, found, value_mm } => write!(
                f,
                "{}, line {line}: `{found}` was read as {value_mm} mm, and no other number of the file has a \
                 thousands separator; check that this is intended",
                path.display(),
            ),
        }
    }
}
