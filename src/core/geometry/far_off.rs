//! Detection of a single point far off the others.

use regrind_figures::statistics::median;

use super::Point;

/// Limit of the distance from the middle, in units of the median distance.
const MAX_MEDIAN_RATIO: f64 = 50.0;

/// Finds a single point that lies far from all others. The distances are measured from the middle: the point with the
/// median x, the median y and the median z of all points.
///
/// Returns the index of the point that is farthest from the middle, and its distance from the middle in mm. Returns
/// `None` if this distance is at most [`MAX_MEDIAN_RATIO`] times the median distance, if there are fewer than three
/// points, or if more than half of the points coincide.
pub(crate) fn find_far_off(points: &[Point]) -> Option<(usize, f64)> {
    if points.len() < 3 {
        return None;
    }
    let along = |k: usize| median(&mut points.iter().map(|p| p[k]).collect::<Vec<f64>>());
    let middle = Point::new(along(0)?, along(1)?, along(2)?);
    let apart: Vec<f64> = points.iter().map(|p| (p - middle).norm()).collect();
    let usual_mm = median(&mut apart.clone())?;
    let far = (0..apart.len()).max_by(|&a, &b| apart[a].total_cmp(&apart[b]))?;
    (usual_mm > 0.0 && apart[far] > MAX_MEDIAN_RATIO * usual_mm).then_some((far, apart[far]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn far_off_names_lone_point() {
        let mut points: Vec<Point> = (0..100).map(|k| Point::new(f64::from(k % 10), f64::from(k / 10), 0.0)).collect();
        assert_eq!(find_far_off(&points), None);
        points[17] = Point::new(1e6, 0.0, 0.0);
        let (index, distance_mm) = find_far_off(&points).unwrap();
        assert_eq!(index, 17);
        assert!((distance_mm - 1e6).abs() < 10.0, "{distance_mm}");
        assert_eq!(find_far_off(&[Point::origin(); 5]), None);
        assert_eq!(find_far_off(&points[16..18]), None);
    }
}
