//! Results of a stitching: `stitching.json`, the stitched points, and the registration of the whole.

use std::path::{Path, PathBuf};

use regrind_core::geometry::Point;
use regrind_core::registration::{Deviation, RegistrationOptions};
use regrind_core::stitching::{Seam, Stitching};
use serde::Serialize;

use super::document::{NominalInput, ProgramVersion, RegistrationDocument, StandardUncertainty, save_registration};
use super::error::FormatError;
use super::registration::{write_json_atomic, write_rows};

/// Name of the file with the stitched points.
const POINTS: &str = "stitched.csv";

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

/// Writes the results of a stitching into `folder`: `stitched.csv` with the points in the common frame and the number of
/// their map, `stitching.json` with the poses and the seams, and the files of [`save_registration`] for the whole, whose
/// uncertainties include those of the poses of the maps. `files` are the measured files, with their numbers of points, and
/// `options` those of the registration of the whole. Returns the content of `stitching.json`.
///
/// # Errors
/// A file that cannot be written; a number that is not finite.
pub fn save_stitching<'a>(
    folder: &Path,
    stitching: &Stitching,
    files: &'a [(PathBuf, usize)],
    nominal: NominalInput,
    options: &RegistrationOptions,
) -> Result<StitchingDocument<'a>, FormatError> {
    let numbers = (1u32..).zip(files).flat_map(|(number, (_, points))| std::iter::repeat_n(number, *points));
    let rows: Vec<(Point, u32)> = stitching.common_points.iter().copied().zip(numbers).collect();
    write_rows(&folder.join(POINTS), HEADER, &rows, |(p, number)| ([p.x, p.y, p.z, f64::from(*number)], None))?;
    let placed = stitching.whole.deviations.iter().zip(&stitching.placement_sigmas_mm);
    let with_placement = placed.map(|(deviation, sigma_mm)| Deviation {
        uncertainty_mm: deviation.uncertainty_mm.hypot(*sigma_mm),
        ..*deviation
    });
    let deviations: Vec<Deviation> = with_placement.collect();
    let document = document(stitching, files);
    write_json_atomic(folder.join(DOCUMENT), &document)?;
    let whole = RegistrationDocument::new(&stitching.whole, options, nominal, Path::new(POINTS));
    save_registration(folder, &whole, &deviations)?;
    Ok(document)
}

fn document<'a>(stitching: &Stitching, files: &'a [(PathBuf, usize)]) -> StitchingDocument<'a> {
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
    StitchingDocument {
        program: ProgramVersion::this(),
        maps: files.iter().enumerate().map(map).collect(),
        covariance: covariance.row_iter().map(|row| row.iter().copied().collect()).collect(),
        seams: stitching.seams.iter().map(SeamDocument::from).collect(),
        rounds: stitching.rounds,
    }
}
