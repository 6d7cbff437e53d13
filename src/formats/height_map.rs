//! Maps of heights over a regular grid, from interferometers and profilometers.

use std::path::Path;

use super::error::FormatError;
use super::number::{LIMIT_MM, is_believable};
use super::whole::{MAX_BYTES, open};
use regrind_core::geometry::{Grid, GridMap, Point};
use regrind_figures::statistics::rms;

/// Maximum number of samples of a map that is read: 450 MB of them.
pub(super) const MAX_SAMPLES: u64 = 50_000_000;

/// Heights over a regular grid in x and y; some samples can be missing.
///
/// Frame: that of the instrument, right-handed: x to the right, y upwards, z towards the instrument. Units:
/// millimetres.
#[derive(Clone, Debug, PartialEq)]
pub struct HeightMap {
    /// Heights of the samples; finite everywhere. A sample is valid if it was measured; the height of the others is 0.
    pub heights: GridMap,
    /// Notes on ambiguous content of the file and how it was read, in words.
    pub notes: Vec<String>,
}

impl HeightMap {
    /// Creates a map from `samples`, the heights in millimetres on `grid`, row by row with x fastest. `None` is a
    /// sample that was not measured. `path` only names the file in messages.
    ///
    /// # Errors
    /// An axis without samples; more than 50 million samples, or a number of samples that differs from the grid; a
    /// spacing that is not above 0; a position or a height that is NaN, infinite or beyond 1e7 mm; no measured sample
    /// at all.
    pub fn new(path: &Path, grid: Grid, samples: impl IntoIterator<Item = Option<f64>>) -> Result<Self, FormatError> {
        let Grid { columns, rows, first_mm, spacing_mm } = grid;
        let unexpected = |place: String, expected: &str, found: String| FormatError::Unexpected {
            path: path.to_owned(),
            place,
            expected: expected.to_owned(),
            found,
        };
        check_size(path, columns as u64, rows as u64)?;
        for (k, axis) in ["x", "y"].into_iter().enumerate() {
            if !(spacing_mm[k] > 0.0 && is_believable(spacing_mm[k] * (columns.max(rows) as f64))) {
                let found = format!("{} mm", spacing_mm[k]);
                return Err(unexpected(format!("spacing along {axis}"), "a plausible length above 0", found));
            }
            if !is_believable(first_mm[k]) {
                let found = format!("{} mm", first_mm[k]);
                return Err(unexpected(format!("offset along {axis}"), "a plausible place", found));
            }
        }
        let count = columns * rows;
        let (mut heights_mm, mut valid) = (Vec::with_capacity(count), Vec::with_capacity(count));
        for sample in samples.into_iter().take(count + 1) {
            if let Some(height) = sample.filter(|h| !is_believable(*h)) {
                let k = heights_mm.len();
                return Err(unexpected(
                    format!("sample {} of row {}", k % columns + 1, k / columns + 1),
                    &format!("a height of at most {LIMIT_MM:e} mm"),
                    format!("{height} mm"),
                ));
            }
            heights_mm.push(sample.unwrap_or(0.0));
            valid.push(sample.is_some());
        }
        if heights_mm.len() != count {
            let found = if heights_mm.len() > count { "more".to_owned() } else { heights_mm.len().to_string() };
            return Err(unexpected("samples".to_owned(), &format!("{columns} times {rows}"), found));
        }
        if !valid.contains(&true) {
            return Err(FormatError::NoData { path: path.to_owned(), expected: "sample that was measured" });
        }
        Ok(Self { heights: GridMap { grid, values_mm: heights_mm, valid }, notes: Vec::new() })
    }

    /// Returns the measured samples as points (x, y, height), in the order of the map.
    pub fn points(&self) -> Vec<Point> {
        self.heights.samples_mm().map(Point::from).collect()
    }

    /// Returns the number of measured samples.
    pub fn measured_count(&self) -> usize {
        self.heights.valid_count()
    }

    /// Returns the maximum minus the minimum of the measured heights, in millimetres.
    pub fn pv_mm(&self) -> f64 {
        let (low, high) = self.measured_mm().fold((f64::MAX, f64::MIN), |(l, h), z| (l.min(z), h.max(z)));
        high - low
    }

    /// Returns the root mean square of the measured heights minus their mean (the standard deviation), in millimetres.
    pub fn rms_mm(&self) -> f64 {
        let mean = self.measured_mm().sum::<f64>() / self.measured_count() as f64;
        rms(self.measured_mm().map(|z| z - mean))
    }

    fn measured_mm(&self) -> impl Iterator<Item = f64> {
        self.heights.valid_values_mm().map(|(_, height)| height)
    }
}

/// Parser of the bytes of a map; see [`MapFormat::parse`].
type MapParser = fn(&Path, &[u8], Option<f64>) -> Result<MapPoints, FormatError>;

/// Format of maps.
pub(super) struct MapFormat {
    /// Returns true if the first bytes of a file are those of this format.
    pub(super) begins: fn(&[u8]) -> bool,
    /// Parses the bytes of a file; the path names the file in messages. The number is the distance of the samples in mm
    /// that a person gives for a file that states none.
    pub(super) parse: MapParser,
}

impl MapFormat {
    /// Reads the measured points of the map in the file `path`. `given_mm` is the distance of its samples, if a person
    /// gives it because the file does not state it.
    ///
    /// # Errors
    /// A file that cannot be read; the same as for [`Self::parse_points`].
    pub(super) fn read_points(&self, path: &Path, given_mm: Option<f64>) -> Result<MapPoints, FormatError> {
        self.parse_points(path, &open(path)?.read_all(path, MAX_BYTES)?, given_mm)
    }

    /// Reads the measured points of a map from the bytes of its file; `path` only names the file in messages. `given_mm`
    /// is the same as for [`Self::read_points`].
    ///
    /// # Errors
    /// Bytes that are not valid; heights that look like marks of missing samples ([`check_marks`]); a distance of the
    /// samples that is neither stated nor given, or both ([`sample_spacing_mm`]).
    pub(super) fn parse_points(
        &self,
        path: &Path,
        bytes: &[u8],
        given_mm: Option<f64>,
    ) -> Result<MapPoints, FormatError> {
        let map = (self.parse)(path, bytes, given_mm)?;
        check_marks(path, map.points.iter().map(|point| point.z)).map(|()| map)
    }
}

/// Rejects a map in which one height is probably a mark for samples that were not measured, such as -9999. Some
/// programs write such marks.
///
/// # Errors
/// The lowest or the highest height occurs more than once, and its distance from all other heights is more than 10
/// times their range. A real surface that far away would have different heights.
fn check_marks(path: &Path, heights_mm: impl Iterator<Item = f64> + Clone) -> Result<(), FormatError> {
    const FAR: f64 = 10.0;
    let (low, high) = heights_mm.clone().fold((f64::MAX, f64::MIN), |(low, high), z| (low.min(z), high.max(z)));
    for mark in [low, high] {
        let others = heights_mm.clone().filter(|z| *z != mark);
        let (least, most) = others.fold((f64::MAX, f64::MIN), |(low, high), z| (low.min(z), high.max(z)));
        let apart_mm = (least - mark).max(mark - most);
        let count = heights_mm.clone().filter(|z| *z == mark).count();
        if count > 1 && least < most && apart_mm > FAR * (most - least) {
            return Err(FormatError::Unexpected {
                path: path.to_owned(),
                place: "heights".to_owned(),
                expected: "samples that were not measured to have the mark of the format".to_owned(),
                found: format!("{count} samples of exactly {mark} mm, {apart_mm} mm from all others"),
            });
        }
    }
    Ok(())
}

/// Returns the distances of the samples of a map along x and y, in mm: `stated_mm`, those of the file, or `given_mm` for
/// both if the file states none, which is 0 or not a number. `path` only names the file in messages.
///
/// # Errors
/// Distances that are neither stated nor given, or both.
pub(super) fn sample_spacing_mm(
    path: &Path,
    stated_mm: [f64; 2],
    given_mm: Option<f64>,
) -> Result<[f64; 2], FormatError> {
    let unstated = stated_mm.into_iter().find(|stated| !(*stated > 0.0 && stated.is_finite()));
    let is_any_stated = stated_mm.into_iter().any(|stated| stated > 0.0 && stated.is_finite());
    match (unstated, given_mm) {
        (None, None) => Ok(stated_mm),
        (_, Some(given)) if is_any_stated => {
            Err(FormatError::LateralScaleStated { path: path.to_owned(), stated_mm, given })
        }
        (_, Some(given)) if given > 0.0 && given.is_finite() => Ok([given; 2]),
        (found, _) => {
            let found = 1e-3 * found.unwrap_or(0.0);
            Err(FormatError::NoLateralScale { path: path.to_owned(), found })
        }
    }
}

/// Measured points of a map, and notes on how ambiguous content was read.
pub(super) struct MapPoints {
    pub(super) points: Vec<Point>,
    pub(super) notes: Vec<String>,
}

impl From<HeightMap> for MapPoints {
    fn from(map: HeightMap) -> Self {
        Self { points: map.points(), notes: map.notes }
    }
}

/// Rejects a grid without samples, or with more than [`MAX_SAMPLES`], before memory is reserved for it.
pub(super) fn check_size(path: &Path, columns: u64, rows: u64) -> Result<(), FormatError> {
    let samples = columns.saturating_mul(rows);
    match samples {
        0 => Err(FormatError::NoData { path: path.to_owned(), expected: "samples (a side of the map is 0)" }),
        1..=MAX_SAMPLES => Ok(()),
        found => {
            Err(FormatError::TooLarge { path: path.to_owned(), found, limit: MAX_SAMPLES, unit: "samples of a map" })
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn map(samples: &[Option<f64>]) -> Result<HeightMap, FormatError> {
        HeightMap::new(
            Path::new("m"),
            Grid { columns: 3, rows: 2, first_mm: [-1.0, 4.0], spacing_mm: [0.5, 2.0] },
            samples.iter().copied(),
        )
    }

    #[test]
    fn height_map_skips_unmeasured() {
        let some = |k: i32| (k != 4).then(|| f64::from(k));
        let map = map(&(0..6).map(some).collect::<Vec<_>>()).unwrap();
        let points = map.points();
        assert_eq!((points.len(), map.measured_count()), (5, 5));
        assert_eq!((points[1], points[4]), (Point::new(-0.5, 4.0, 1.0), Point::new(0.0, 6.0, 5.0)));
        assert_eq!((map.pv_mm(), map.heights.values_mm[4]), (5.0, 0.0));
        // 0 1 2 3 5: mean 2.2, squared deviations from it 4.84 1.44 0.04 0.64 7.84.
        assert!((map.rms_mm() - (14.8f64 / 5.0).sqrt()).abs() < 1e-15);
    }

    #[test]
    fn sample_spacing_is_stated_or_given() {
        let of = |stated_mm, given_mm| sample_spacing_mm(Path::new("m"), stated_mm, given_mm);
        assert_eq!(of([0.1, 0.2], None).unwrap(), [0.1, 0.2]);
        for half in [[0.1, 0.0], [f64::NAN, 0.1]] {
            assert!(matches!(of(half, None), Err(FormatError::NoLateralScale { .. })));
            assert!(matches!(of(half, Some(0.3)), Err(FormatError::LateralScaleStated { .. })));
        }
        for unstated in [[0.0; 2], [f64::NAN; 2], [f64::INFINITY; 2], [-1.0; 2]] {
            assert!(matches!(of(unstated, None), Err(FormatError::NoLateralScale { .. })));
            assert_eq!(of(unstated, Some(0.3)).unwrap(), [0.3; 2]);
            for wrong in [0.0, -0.1, f64::NAN, f64::INFINITY] {
                assert!(matches!(of(unstated, Some(wrong)), Err(FormatError::NoLateralScale { .. })));
            }
        }
        let both = of([0.1, 0.2], Some(0.1));
        assert!(matches!(both, Err(FormatError::LateralScaleStated { stated_mm: [0.1, 0.2], given: 0.1, .. })));
    }

    #[test]
    fn check_marks_refuses_fill_values() {
        let told = |heights: &[f64]| check_marks(Path::new("m"), heights.iter().copied()).map_err(|e| e.to_string());
        let form = [0.0, 1e-3, 2e-3, 0.5e-3, 1e-3];
        for mark in [-9.999, 9.999, -0.05] {
            let refused = told(&[&form[..], &[mark, mark]].concat()).unwrap_err();
            assert!(refused.contains("2 samples of exactly"), "{refused}");
            assert_eq!(told(&[&form[..], &[mark]].concat()), Ok(()), "a lone one may be a spike");
            assert_eq!(told(&[&form[..], &[mark, mark * 1.0001]].concat()), Ok(()), "a pit has a form");
        }
        for heights in [&form[..], &[1.0, 1.0, 1.0], &[0.0, 1e-3, 1e-2, 1e-2], &[0.0, 0.0, 5.0, 5.0], &[]] {
            assert_eq!(told(heights), Ok(()), "{heights:?}");
        }
    }

    #[test]
    fn height_map_refuses_bad_input() {
        let full = [Some(0.0); 6];
        assert!(map(&full).is_ok());
        let told = |made: Result<HeightMap, FormatError>| made.unwrap_err().to_string();
        assert!(told(map(&full[..5])).contains("expected 3 times 2, found `5`"));
        assert!(told(map(&[Some(0.0); 9])).contains("found `more`"));
        assert!(told(map(&[None; 6])).contains("sample that was measured"));
        for bad in [f64::NAN, f64::INFINITY, -1e8] {
            let mut samples = full;
            samples[4] = Some(bad);
            assert!(told(map(&samples)).contains("sample 2 of row 2"), "{bad}");
        }
        let of = |[columns, rows]: [usize; 2], first_mm, spacing_mm| {
            let grid = Grid { columns, rows, first_mm, spacing_mm };
            HeightMap::new(Path::new("m"), grid, full.iter().copied())
        };
        for spacing in [0.0, -1.0, f64::NAN, f64::INFINITY, 1e9] {
            assert!(told(of([3, 2], [0.0; 2], [1.0, spacing])).contains("spacing along y"), "{spacing}");
        }
        assert!(told(of([3, 2], [f64::NAN, 0.0], [1.0; 2])).contains("offset along x"));
        assert!(matches!(of([0, 2], [0.0; 2], [1.0; 2]), Err(FormatError::NoData { .. })));
        assert!(matches!(of([usize::MAX, 2], [0.0; 2], [1.0; 2]), Err(FormatError::TooLarge { .. })));
    }
}
