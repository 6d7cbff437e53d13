//! Readings that a map is computed from.

use crate::geometry::DeviationSample;

/// Inlier readings: their places and values in separate vectors.
pub(super) struct InlierReadings {
    pub places: Vec<[f64; 2]>,
    pub values: Vec<f64>,
}

impl InlierReadings {
    pub fn from_all(readings: &[DeviationSample]) -> Self {
        Self {
            places: readings.iter().map(|r| r.place_mm).collect(),
            values: readings.iter().map(|r| r.deviation_mm).collect(),
        }
    }

    pub fn without_outliers(readings: &[DeviationSample], outliers: &[usize]) -> Self {
        let mut left_out = vec![false; readings.len()];
        outliers.iter().for_each(|&k| left_out[k] = true);
        let used: Vec<DeviationSample> = (0..readings.len()).filter(|&k| !left_out[k]).map(|k| readings[k]).collect();
        Self::from_all(&used)
    }
}
