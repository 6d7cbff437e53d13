//! Readings that a map is computed from.

use crate::geometry::Sample;

/// Inlier readings: their places and values in separate vectors.
pub(super) struct Kept {
    pub places: Vec<[f64; 2]>,
    pub values: Vec<f64>,
}

impl Kept {
    pub fn from_all(readings: &[Sample]) -> Self {
        Self {
            places: readings.iter().map(|r| r.place_mm).collect(),
            values: readings.iter().map(|r| r.deviation_mm).collect(),
        }
    }

    pub fn without_outliers(readings: &[Sample], outliers: &[usize]) -> Self {
        let mut left_out = vec![false; readings.len()];
        outliers.iter().for_each(|&k| left_out[k] = true);
        let used: Vec<Sample> = (0..readings.len()).filter(|&k| !left_out[k]).map(|k| readings[k]).collect();
        Self::from_all(&used)
    }
}
