//! Results of a stitching: `stitching.json`, the stitched points, and the registration of the whole.

use std::path::{Path, PathBuf};

use regrind_core::geometry::Point;
use regrind_core::registration::Deviation;
use regrind_core::stitching::{Seam, Stitching};
use serde::Serialize;

use super::document::{ProgramVersion, RegistrationDocument, StandardUncertainty, save_registration};
use super::error::FormatError;
use super::registration::{write_json_atomic, write_rows};

/// Name of the file with the stitched points.
pub const STITCHED_POINTS: &str = "stitched.csv";

/// Name of the file with the poses and the seams.
const DOCUMENT: &str = "stitching.json";

/// Columns of the stitched points. The map counts from 1.
const HEADER: &str = "x_mm,y_mm,z_mm,map";

/// Content of `stitching.json`. Lengths are in millimetres, angles in radians. Maps and their numbers are in the order of
/// the files.
#[derive(Serialize)]
pub struct StitchingDocument<'a> {
    program: ProgramVersion,
    maps: Vec<StitchedMap<'a>>,
    /// Covariance of small twists of the maps relative to the whole, six rows and columns for each map: translation,
    /// rotation, in the model frame about its origin.
    covariance: Vec<Vec<f64>>,
    seams: Vec<SeamDocument>,
    rounds: usize,
}

#[derive(Serialize)]
struct StitchedMap<'a> {
    file: &'a Path,
    points: usize,
    common_from_map: [[f64; 4]; 4],
    standard_uncertainty: StandardUncertainty,
    /// Standard deviation of the noise of one point, from the overlaps.
    noise_sigma_mm: f64,
    /// Factor of the variance of means over areas, because the noise of neighbouring points is correlated.
    correlation_factor: f64,
}

#[derive(Serialize)]
struct SeamDocument {
    /// Numbers of the two maps, from 1.
    maps: [usize; 2],
    places: usize,
    left_out: usize,
    /// Middle of the overlap in the model frame.
    middle_mm: [f64; 3],
    /// Mean of the deviation of the first map minus that of the second.
    step_mm: f64,
    /// 95 % interval of the true step in the middle, because of the poses of the maps.
    true_step_mm: [f64; 2],
    /// Largest standard uncertainty of the true step anywhere in the overlap.
    max_sigma_mm: f64,
    rms_mm: f64,
    /// Variance of means over blocks of the overlap, as a multiple of that of independent noise.
    correlation_factor: f64,
}

/// Half width of a 95 % interval in standard uncertainties.
const EXPANSION: f64 = 1.96;

impl From<&Seam> for SeamDocument {
    fn from(seam: &Seam) -> Self {
        let half_mm = EXPANSION * seam.sigma_mm;
        Self {
            maps: seam.maps.map(|map| map + 1),
            places: seam.places,
            left_out: seam.left_out,
            middle_mm: seam.middle.into(),
            step_mm: seam.step_mm,
            true_step_mm: [-half_mm, half_mm],
            max_sigma_mm: seam.max_sigma_mm,
            rms_mm: seam.rms_mm,
            correlation_factor: seam.correlation_factor,
        }
    }
}

impl<'a> StitchingDocument<'a> {
    /// Returns the document of a stitching. `files` are the measured files, with their numbers of points.
    pub fn new(stitching: &Stitching, files: &'a [(PathBuf, usize)]) -> Self {
        let covariance = &stitching.covariance;
        let map = |(k, (file, points)): (usize, &'a (PathBuf, usize))| {
            let sigma = |i: usize| covariance[(6 * k + i, 6 * k + i)].max(0.0).sqrt();
            let [x_mm, y_mm, z_mm, rx_rad, ry_rad, rz_rad] = std::array::from_fn(sigma);
            StitchedMap {
                file,
                points: *points,
                common_from_map: stitching.common_from_map[k].to_rows(),
                standard_uncertainty: StandardUncertainty { x_mm, y_mm, z_mm, rx_rad, ry_rad, rz_rad },
                noise_sigma_mm: stitching.noise_sigmas_mm[k],
                correlation_factor: stitching.correlation_factors[k],
            }
        };
        Self {
            program: ProgramVersion::this(),
            maps: files.iter().enumerate().map(map).collect(),
            covariance: covariance.row_iter().map(|row| row.iter().copied().collect()).collect(),
            seams: stitching.seams.iter().map(SeamDocument::from).collect(),
            rounds: stitching.rounds,
        }
    }

    /// Returns an error if a number of the document is not finite. The error is the name of the number.
    pub fn check(&self) -> Result<(), &'static str> {
        let finite = |numbers: &[f64]| numbers.iter().all(|v| v.is_finite());
        let map = |map: &StitchedMap| {
            finite(map.common_from_map.as_flattened()) && finite(&[map.noise_sigma_mm, map.correlation_factor])
        };
        let seam = |seam: &SeamDocument| {
            let figures = [seam.step_mm, seam.max_sigma_mm, seam.rms_mm, seam.correlation_factor];
            finite(&seam.middle_mm) && finite(&seam.true_step_mm) && finite(&figures)
        };
        let checks = [
            ("the pose or the noise of a map", self.maps.iter().all(map)),
            ("the covariance of the poses", self.covariance.iter().all(|row| finite(row))),
            ("a figure of a seam", self.seams.iter().all(seam)),
        ];
        checks.into_iter().find(|(_, finite)| !finite).map_or(Ok(()), |(what, _)| Err(what))
    }
}

/// Writes the results of a stitching into `folder`: `stitched.csv` with the points in the common frame and the number of
/// their map, the files of [`save_registration`] for the whole, whose uncertainties include those of the poses of the maps,
/// and last `stitching.json` with the poses and the seams. If `stitching.json` exists, the other files are complete.
///
/// # Errors
/// A file that cannot be written; a coordinate or a deviation that is not finite.
pub fn save_stitching(
    folder: &Path,
    stitching: &Stitching,
    document: &StitchingDocument,
    whole: &RegistrationDocument,
) -> Result<(), FormatError> {
    let numbers = (1u32..).zip(&document.maps).flat_map(|(number, map)| std::iter::repeat_n(number, map.points));
    let rows: Vec<(Point, u32)> = stitching.common_points.iter().copied().zip(numbers).collect();
    write_rows(&folder.join(STITCHED_POINTS), HEADER, &rows, |(p, number)| {
        ([p.x, p.y, p.z, f64::from(*number)], None)
    })?;
    let placed = stitching.whole.deviations.iter().zip(&stitching.placement_sigmas_mm);
    let with_placement = placed.map(|(deviation, sigma_mm)| Deviation {
        uncertainty_mm: deviation.uncertainty_mm.hypot(*sigma_mm),
        ..*deviation
    });
    let deviations: Vec<Deviation> = with_placement.collect();
    save_registration(folder, whole, &deviations)?;
    write_json_atomic(folder.join(DOCUMENT), document)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_that_are_not_finite_are_named() {
        let seam = |rms_mm: f64| SeamDocument {
            maps: [1, 2],
            places: 9,
            left_out: 0,
            middle_mm: [0.0; 3],
            step_mm: 0.0,
            true_step_mm: [-1e-6, 1e-6],
            max_sigma_mm: 1e-6,
            rms_mm,
            correlation_factor: 1.0,
        };
        let document = |variance: f64, rms_mm: f64| StitchingDocument {
            program: ProgramVersion::this(),
            maps: Vec::new(),
            covariance: vec![vec![variance]],
            seams: vec![seam(rms_mm)],
            rounds: 1,
        };
        assert_eq!(document(1.0, 1e-6).check(), Ok(()));
        assert_eq!(document(f64::NAN, 1e-6).check(), Err("the covariance of the poses"));
        assert_eq!(document(1.0, f64::INFINITY).check(), Err("a figure of a seam"));
    }
}
