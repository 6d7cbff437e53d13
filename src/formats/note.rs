//! What a file of points leaves open, although it can be read: said beside the points, and nothing is refused for it.

use std::fmt;
use std::path::PathBuf;

use regrind_core::geometry::Point;

/// Points with what a person should know of how they were read.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct NotedPoints {
    /// In millimetres, in the order of the file.
    pub points: Vec<Point>,
    /// Empty when there is nothing to say.
    pub notes: Vec<PointNote>,
}

impl From<Vec<Point>> for NotedPoints {
    fn from(points: Vec<Point>) -> Self {
        Self { points, notes: Vec::new() }
    }
}

/// What a person should know of how points were read; lines count from 1.
#[derive(Clone, Debug, PartialEq)]
pub enum PointNote {
    /// The last line has no end: many programs write it so, and a copy that was cut ends so too.
    NoLineEnd {
        /// The file.
        path: PathBuf,
        /// The last line.
        line: u64,
        /// The last number in it, as it stands there.
        found: String,
        /// What the line was read as.
        point: Point,
        /// Digits behind the mark, or in the exponent, of that number and the fewest of the lines above, if these are more.
        fewer_digits: Option<[usize; 2]>,
    },
    /// One number of the file has a mark between its thousands, and no other has.
    OneThousandsMark {
        /// The file.
        path: PathBuf,
        /// Where it stands.
        line: u64,
        /// As it stands there.
        found: String,
        /// What it was read as.
        value_mm: f64,
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
                        "and its last number `{found}` has {here} digits where the lines above have {above} or more: the file is cut there, \
                         most likely, and the point ({x}, {y}, {z}) mm wrong; copy or export it again",
                    ),
                    None => write!(
                        f,
                        "so that a cut in its last number `{found}` would not show; it was read as the point ({x}, {y}, {z}) mm; see that \
                         the file is whole"
                    ),
                }
            }
            Self::OneThousandsMark { path, line, found, value_mm } => write!(
                f,
                "{}, line {line}: `{found}` was read as {value_mm} mm, and no other number of the file has a mark between its thousands; \
                 see that it is meant so",
                path.display(),
            ),
        }
    }
}
