//! Filter from scattered deviations to a smooth map on a grid, with its uncertainty.
//!
//! ```text
//!  readings -> outliers out -> filter (Gaussian, robust, spline) -> levelled off outside -> ErrorMap
//! ```

use regrind_figures::statistics::{median, rms};
use serde::{Deserialize, Serialize};

use super::MapError;
use super::cutoff_limits::{check_cutoff, point_spacings_mm};
use super::filter::{FilterOrder, FilterResult, GaussianFilter, MAX_FILTER_NODES};
use super::inliers::InlierReadings;
use super::level_off::{Levelled, level_off};
use super::robust_filter::{FarReadings, Residuals, RobustResult, filter_robust, residuals};
use super::spline::{SplineSmoothness, fit_spline};
use crate::geometry::{DeviationSample, Grid, GridMap};

/// Minimum cut-off of the surface that readings are compared with, in distances between readings.
const MIN_REFERENCE_CUTOFF_SPACINGS: f64 = 4.0;

/// Filter that smooths the deviations.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "kebab-case")]
pub enum Smoothing {
    /// The areal Gaussian filter, ISO 16610-61.
    #[default]
    Gaussian,
    /// The robust areal Gaussian filter, ISO 16610-71: outliers count less. They are detected on a surface with a
    /// cut-off of at least four distances between readings.
    RobustGaussian,
    /// A smoothing surface of tensor-product cubic B-splines.
    Spline,
}

/// Options of a map.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MapOptions {
    /// Wavelength at which half of the amplitude passes, in millimetres.
    pub cutoff_mm: f64,
    /// Required distance of the nodes, in millimetres.
    pub spacing_mm: f64,
    /// Distance from the measured area over which the map levels off, in millimetres: the radius of the wheel; 0
    /// levels off at once.
    pub level_off_mm: f64,
    /// Width over which the wheel touches, in millimetres, see [`super::contact_width_mm`]; 0 if unknown.
    pub contact_width_mm: f64,
    /// Filter that smooths the deviations.
    pub smoothing: Smoothing,
    /// Order of the polynomial that the Gaussian filters pass unchanged.
    pub order: FilterOrder,
    /// Choice of the spline's smoothness.
    pub spline_smoothness: SplineSmoothness,
    /// Number of standard deviations beyond which a reading is an outlier; `None` keeps all readings.
    pub outlier_limit: Option<f64>,
}

impl MapOptions {
    /// Returns options for the Gaussian filter of order 1 ([`FilterOrder::Plane`]) with the cut-off `cutoff_mm` and the
    /// node spacing `spacing_mm`. Outliers are rejected beyond 5 standard deviations. Outside the measured area the map
    /// is constant.
    pub fn new(cutoff_mm: f64, spacing_mm: f64) -> Self {
        Self {
            cutoff_mm,
            spacing_mm,
            level_off_mm: 0.0,
            contact_width_mm: 0.0,
            smoothing: Smoothing::default(),
            order: FilterOrder::default(),
            spline_smoothness: SplineSmoothness::default(),
            outlier_limit: Some(5.0),
        }
    }
}

/// Smooth map of the error of the part.
#[derive(Clone, Debug, PartialEq)]
pub struct ErrorMap {
    /// Error at every node, finite everywhere. A node is valid if it has enough readings around it; at the others the
    /// error is levelled off from the nearest valid node.
    pub nodes: GridMap,
    /// Standard deviation of the deviations from the map, in millimetres: the part that the filter removed.
    pub residual_sigma_mm: f64,
    /// Standard uncertainty of the error at every node from the noise of single readings, in millimetres. At a node
    /// that is not `valid` it is that of the nearest valid node, and does not include how far the part differs from
    /// the constant there.
    pub sigma_mm: Vec<f64>,
    /// Standard deviation of a single reading in millimetres, from the differences of nearby readings: noise, and
    /// waves that the filter removes.
    pub point_sigma_mm: f64,
    /// Indices of the readings rejected as outliers, ascending.
    pub outliers: Vec<usize>,
    /// Distance of neighbouring readings, in millimetres, in the direction in which it is larger.
    pub point_spacing_mm: f64,
    /// Advice on the measurement and the options, for people; empty if there is none.
    pub advice: Vec<String>,
}

/// Computes the map of the error from measured deviations (`readings`, in any order). Rejects outliers, filters the
/// other readings, and returns the result at the nodes of a grid that covers all readings.
///
/// Frames: x and y of the model frame. Units: millimetres. Equation: weighted least squares of a polynomial at every
/// node. The weights are exp(-pi (r / (alpha cutoff))^2), where r is the distance of a reading from the node, see
/// [`FilterOrder::alpha`]. With [`Smoothing::Spline`], a smoothing spline replaces this filter.
///
/// An outlier is a single reading far from the surface. If a neighbouring reading is also far from the surface on the
/// same side, both readings are a feature of the part, and they are not rejected. The Gaussian filter alone makes a
/// small feature too low. So the filter is repeated until the map contains at least half of the height of the feature.
/// This can fail if one pass of the filter keeps less than an eighth of the height.
///
/// A cut-off that is too short for the wheel or for the distance of the points is not an error. It is reported in
/// [`ErrorMap::advice`].
///
/// # Errors
/// Returns an error if a deviation is not finite, if there are too few readings for the cut-off, if an option is out of
/// range, or if no grid can be built for the readings.
pub fn error_map(readings: &[DeviationSample], options: &MapOptions) -> Result<ErrorMap, MapError> {
    check(readings, options)?;
    let grid = Grid::over(readings.iter().map(|r| r.place_mm), options.spacing_mm)?;
    let gaussian = GaussianFilter { cutoff_mm: options.cutoff_mm, order: options.order };
    let worked = refined_grid(&grid, &gaussian)?;
    let apart_mm = point_spacings_mm(readings);
    let wide = GaussianFilter {
        cutoff_mm: options.cutoff_mm.max(MIN_REFERENCE_CUTOFF_SPACINGS * apart_mm[0].max(apart_mm[1])),
        ..gaussian
    };
    let wide = ReferenceFilter { gaussian: wide, grid: refined_grid(&grid, &wide)?, is_map_filter: wide == gaussian };
    let mut kept = InlierReadings::from_all(readings);
    let (mut outliers, mut features, mut found, mut advice) = (Vec::new(), Vec::new(), None, Vec::new());
    if let Some(limit) = options.outlier_limit {
        let all = wide.robust(&kept);
        let far = all.find_far((&kept.places, &kept.values), limit, apart_mm).unwrap_or_else(|| {
            advice.push(
                "more than 10 % of the points look like outliers, so none is rejected; clean part and probe".to_owned(),
            );
            FarReadings::default()
        });
        outliers = far.outliers;
        kept = InlierReadings::without_outliers(readings, &outliers);
        let before = |k: usize| outliers.partition_point(|outlier| *outlier < k);
        features = far.features.into_iter().map(|k| (k - before(k), all.residuals[k])).collect();
        found = Some(all).filter(|_| outliers.is_empty());
    }
    let (filtered, point_sigma) = if options.smoothing == Smoothing::RobustGaussian {
        let found = found.unwrap_or_else(|| wide.robust(&kept));
        let with_weights = || gaussian.filter_scattered(&kept.places, &kept.values, Some(&found.weights), &worked);
        (if wide.is_map_filter { found.filtered.clone() } else { with_weights() }, found.sigma)
    } else {
        let mut filtered = gaussian.filter_scattered(&kept.places, &kept.values, None, &worked);
        let point_sigma = wide.point_sigma(&kept, &filtered);
        preserve_features(&mut filtered, &gaussian, &kept, &features);
        (filtered, point_sigma)
    };
    let smooth = UnlevelledMap::from_filtered(&filtered, &grid, point_sigma);
    let count = smooth.valid.iter().filter(|v| **v).count();
    if count * 4 < grid.len() {
        return Err(MapError::TooSparse { valid: count, nodes: grid.len(), cutoff_mm: options.cutoff_mm });
    }
    let smooth = match options.smoothing {
        Smoothing::Spline => smooth.with_spline(&grid, &kept, density(&filtered, &gaussian), options)?,
        _ => smooth,
    };
    let map = smooth.into_map(grid, &kept, outliers, options.level_off_mm);
    Ok(ErrorMap { advice, ..map }.advised(options, readings.len(), apart_mm))
}

/// Restores features of the part (places where neighbouring readings confirm a deviation) that the filter has made too
/// low. A small feature, such as a chip with only two measured points, is narrower than the filter.
///
/// Filters the missing height of the features and adds the result to `filtered`. Repeats this until `filtered` contains
/// most of the height of each feature, at most 8 times. `gaussian` is the filter of the map, and `kept` holds the
/// readings without outliers. `features` holds, for each feature, the index of a reading in `kept` and its height above
/// the surface around it, in millimetres.
fn preserve_features(
    filtered: &mut FilterResult,
    gaussian: &GaussianFilter,
    kept: &InlierReadings,
    features: &[(usize, f64)],
) {
    /// Maximum number of repetitions: enough for a feature of which an eighth passes at a time. Where readings are
    /// denser, less of it remains.
    const MAX_ROUNDS: usize = 8;
    /// Share of the height to keep: more than half, since between the nodes of the map there is less than at the
    /// readings.
    const KEPT_HEIGHT_SHARE: f64 = 0.65;
    for _ in 0..MAX_ROUNDS {
        let mut left = vec![0.0; kept.values.len()];
        let mut all_held = true;
        for &(k, height) in features {
            let own = kept.values[k] - filtered.at(kept.places[k]).map_or(kept.values[k], |[value, ..]| value);
            // A feature that is complete does not grow while others do.
            if own * height.signum() > (1.0 - KEPT_HEIGHT_SHARE) * height.abs() {
                left[k] = own;
                all_held = false;
            }
        }
        if all_held {
            return;
        }
        let more = gaussian.filter_scattered(&kept.places, &left, None, &filtered.grid);
        filtered.values.iter_mut().zip(more.values).for_each(|(value, more)| *value += more);
        filtered.slopes.iter_mut().zip(more.slopes).for_each(|(slope, more)| (0..2).for_each(|k| slope[k] += more[k]));
    }
}

/// Computes the error map of a form that a model predicts at many places.
///
/// `told` holds the predicted deviations, each with its standard uncertainty, in millimetres. The filter is applied to
/// the deviations and in the same way to the uncertainties. No prediction is rejected as an outlier, because
/// predictions have no noise. `scatter_mm` is the standard deviation of the noise of a measured point, as estimated by
/// the model, in millimetres; the map reports it as the noise of a reading.
///
/// # Errors
/// Returns the same errors as [`error_map`].
pub fn map_from_model(
    told: &[(DeviationSample, f64)],
    options: &MapOptions,
    scatter_mm: f64,
) -> Result<ErrorMap, MapError> {
    let options = MapOptions { outlier_limit: None, ..*options };
    let form: Vec<DeviationSample> = told.iter().map(|(sample, _)| *sample).collect();
    let sigma = |(sample, sigma_mm): &(DeviationSample, f64)| DeviationSample { deviation_mm: *sigma_mm, ..*sample };
    let (map, sigma) = (error_map(&form, &options)?, error_map(&told.iter().map(sigma).collect::<Vec<_>>(), &options)?);
    // A polynomial fitted to the uncertainties can exceed their range between two places.
    let [least, most] = told.iter().fold([f64::INFINITY, 0.0], |[a, b], (_, of)| [a.min(*of), b.max(*of)]);
    let sigma_mm = sigma.nodes.values_mm.iter().map(|value| value.clamp(least.min(most), most)).collect();
    let residual_sigma_mm = scatter_mm.hypot(map.residual_sigma_mm);
    Ok(ErrorMap { sigma_mm, residual_sigma_mm, point_sigma_mm: scatter_mm, ..map })
}

/// Filter for the reference surface, from which outliers and the noise of a reading are determined. Its cut-off is at
/// least four distances between readings: with a shorter cut-off a reading would be compared mostly with itself.
struct ReferenceFilter {
    gaussian: GaussianFilter,
    grid: Grid,
    /// True if this filter and the filter of the map are the same.
    is_map_filter: bool,
}

impl ReferenceFilter {
    fn robust(&self, kept: &InlierReadings) -> RobustResult {
        filter_robust(&self.gaussian, &kept.places, &kept.values, &self.grid)
    }

    /// Returns the standard deviation of the noise of a single reading, in the unit of the readings. It is computed
    /// from the residuals: each reading in `kept` minus the filtered surface.
    ///
    /// The surface comes from this reference filter, whose cut-off is at least four distances between readings.
    /// `filtered` is the surface from the filter of the map. If both filters are the same, `filtered` is used and the
    /// readings are not filtered again.
    fn point_sigma(&self, kept: &InlierReadings, filtered: &FilterResult) -> f64 {
        if self.is_map_filter {
            return residuals(filtered, &kept.places, &kept.values, None).sigma();
        }
        let wide = self.gaussian.filter_scattered(&kept.places, &kept.values, None, &self.grid);
        residuals(&wide, &kept.places, &kept.values, None).sigma()
    }
}

/// Returns the typical number of readings per square millimetre. It is computed from the median of the leverage (change
/// of a filtered value per unit change of a reading at the same place) at the supported nodes of `filtered`. `gaussian`
/// is the filter with which `filtered` was computed.
fn density(filtered: &FilterResult, gaussian: &GaussianFilter) -> f64 {
    let supported = (0..filtered.grid.len()).filter(|&k| filtered.supported[k]);
    let mut shares: Vec<f64> = supported.map(|k| filtered.leverage[k]).collect();
    gaussian.open_leverage() / median(&mut shares).unwrap_or(1.0)
}

fn check(readings: &[DeviationSample], options: &MapOptions) -> Result<(), MapError> {
    let MapOptions { cutoff_mm, level_off_mm, contact_width_mm, outlier_limit, .. } = *options;
    if !(cutoff_mm > 0.0 && cutoff_mm.is_finite()) {
        return Err(MapError::Cutoff { cutoff_mm });
    }
    for (name, value) in [("level_off_mm", level_off_mm), ("contact_width_mm", contact_width_mm)] {
        if !(value >= 0.0 && value.is_finite()) {
            return Err(MapError::Option { name, value, wanted: "0 or more" });
        }
    }
    if let Some(value) = outlier_limit.filter(|limit| limit.is_nan() || *limit < 3.0) {
        return Err(MapError::Option {
            name: "outlier_limit",
            value,
            wanted: "3 or more, so that good points are not rejected",
        });
    }
    match readings.iter().position(|r| !r.is_finite()) {
        Some(index) => Err(MapError::NotFinite { index }),
        None => Ok(()),
    }
}

/// Returns the grid on which the filter computes: the nodes of `grid`, and as many nodes between them as the filter
/// needs ([`GaussianFilter::division`]).
///
/// # Errors
/// Returns [`MapError::CutoffTooShort`] if this grid would have more than [`MAX_FILTER_NODES`] nodes.
fn refined_grid(grid: &Grid, gaussian: &GaussianFilter) -> Result<Grid, MapError> {
    let division = gaussian.division(grid);
    let finer = |k: usize| (grid.counts()[k] - 1) as f64 * division[k] as f64 + 1.0;
    let nodes = finer(0) * finer(1);
    if nodes > MAX_FILTER_NODES {
        let [width_mm, depth_mm] = [0, 1].map(|k| (grid.counts()[k] - 1) as f64 * grid.spacing_mm[k]);
        return Err(MapError::CutoffTooShort { cutoff_mm: gaussian.cutoff_mm, width_mm, depth_mm, nodes });
    }
    let spacing_mm = [0, 1].map(|k| grid.spacing_mm[k] / division[k] as f64);
    Ok(Grid { columns: finer(0) as usize, rows: finer(1) as usize, first_mm: grid.first_mm, spacing_mm })
}

/// Values at the nodes of a map, before the nodes outside the measured area are filled.
struct UnlevelledMap {
    values: Vec<f64>,
    slopes: Vec<[f64; 2]>,
    sigma: Vec<f64>,
    valid: Vec<bool>,
    point_sigma: f64,
}

impl UnlevelledMap {
    /// Builds the map from a filter result on a finer grid: copies values, slopes and validity at those nodes that are
    /// also nodes of `grid`, the grid of the map. The uncertainty of each value is computed from `point_sigma`, the
    /// standard deviation of a single reading in millimetres.
    fn from_filtered(filtered: &FilterResult, grid: &Grid, point_sigma: f64) -> Self {
        let step = |worked: usize, wanted: usize| if wanted > 1 { (worked - 1) / (wanted - 1) } else { 1 };
        let (across, along) = (step(filtered.grid.columns, grid.columns), step(filtered.grid.rows, grid.rows));
        let node = |k: usize| (k / grid.columns) * along * filtered.grid.columns + (k % grid.columns) * across;
        let nodes: Vec<usize> = (0..grid.len()).map(node).collect();
        Self {
            values: nodes.iter().map(|&n| filtered.values[n]).collect(),
            slopes: nodes.iter().map(|&n| filtered.slopes[n]).collect(),
            sigma: nodes.iter().map(|&n| point_sigma * filtered.variance[n].max(0.0).sqrt()).collect(),
            valid: nodes.iter().map(|&n| filtered.supported[n]).collect(),
            point_sigma,
        }
    }

    /// Fits a smoothing spline to the readings `kept` and returns a map with its values, slopes and uncertainties at
    /// the nodes of `grid`. Only the validity of the nodes is kept from the Gaussian filter. `density` is the number of
    /// readings per square millimetre. `options` gives the cut-off and the choice of the smoothness.
    ///
    /// # Errors
    /// Returns the error of the spline fit.
    fn with_spline(
        self,
        grid: &Grid,
        kept: &InlierReadings,
        density: f64,
        options: &MapOptions,
    ) -> Result<Self, MapError> {
        let fitted = fit_spline(kept, grid, density, options.cutoff_mm, options.spline_smoothness)?;
        Ok(Self {
            values: fitted.values,
            slopes: fitted.slopes,
            sigma: fitted.sigma,
            valid: self.valid,
            point_sigma: fitted.point_sigma,
        })
    }

    fn into_map(self, grid: Grid, kept: &InlierReadings, outliers: Vec<usize>, level_off_mm: f64) -> ErrorMap {
        let Levelled { values, sources } = level_off(&grid, self.values, &self.slopes, &self.valid, level_off_mm);
        let rest = kept.places.iter().zip(&kept.values).map(|(p, v)| v - grid.interpolate(&values, *p));
        ErrorMap {
            residual_sigma_mm: rms(rest),
            nodes: GridMap { grid, values_mm: values, valid: self.valid },
            sigma_mm: sources.into_iter().map(|source| self.sigma[source]).collect(),
            point_sigma_mm: self.point_sigma,
            outliers,
            point_spacing_mm: 0.0,
            advice: Vec::new(),
        }
    }
}

impl ErrorMap {
    /// Returns an error map with exactly known values: all uncertainties are 0, and there are no outliers and no
    /// advice. `values_mm` (in millimetres) and `valid` have one entry for each node of `grid`.
    pub fn exact(grid: Grid, values_mm: Vec<f64>, valid: Vec<bool>) -> Self {
        Self {
            sigma_mm: vec![0.0; values_mm.len()],
            nodes: GridMap { grid, values_mm, valid },
            residual_sigma_mm: 0.0,
            point_sigma_mm: 0.0,
            outliers: Vec::new(),
            point_spacing_mm: 0.0,
            advice: Vec::new(),
        }
    }

    fn advised(mut self, options: &MapOptions, readings: usize, apart_mm: [f64; 2]) -> Self {
        self.point_spacing_mm = apart_mm[0].max(apart_mm[1]);
        if let Err(short) = check_cutoff(options.cutoff_mm, options.contact_width_mm, self.point_spacing_mm) {
            self.advice.push(short.to_string());
        }
        let left_out = self.outliers.len();
        if left_out * 50 > readings {
            let advice =
                format!("{left_out} of {readings} points are rejected as outliers; clean the part and the probe");
            self.advice.push(advice);
        }
        self
    }
}

/// Filtered surface on a grid.
#[derive(Clone, Debug, PartialEq)]
pub struct FilteredGrid {
    /// Filtered values. A node is valid if it has enough valid values around it; the others have the value of the
    /// nearest valid node.
    pub nodes: GridMap,
    /// Number of times that the filter was applied: 1 if it is not robust.
    pub rounds: usize,
}

/// Filters a map, for example of an interferometer, and returns the filtered map at the same nodes. The filter is the
/// areal Gaussian filter of ISO 16610-61. If `robust_form` is true, it is the robust Gaussian filter of ISO 16610-71.
///
/// Values of nodes that are not valid are not used. `order` is the order of the polynomial that passes the filter
/// unchanged. The cut-off is in millimetres.
///
/// # Errors
/// Returns an error if the number of values differs from the number of nodes, if a valid value is not finite, if the
/// cut-off is not above 0, or if no node has enough valid values around it.
pub fn filter_grid(
    map: &GridMap,
    cutoff_mm: f64,
    order: FilterOrder,
    robust_form: bool,
) -> Result<FilteredGrid, MapError> {
    let GridMap { grid, values_mm: values, valid } = map;
    if values.len() != grid.len() || valid.len() != grid.len() {
        return Err(MapError::Shape { found: values.len().min(valid.len()), nodes: grid.len() });
    }
    if !(cutoff_mm > 0.0 && cutoff_mm.is_finite()) {
        return Err(MapError::Cutoff { cutoff_mm });
    }
    if let Some(index) = (0..grid.len()).find(|&k| valid[k] && !values[k].is_finite()) {
        return Err(MapError::NotFinite { index });
    }
    let gaussian = GaussianFilter { cutoff_mm, order };
    let mask: Vec<f64> = valid.iter().map(|v| f64::from(u8::from(*v))).collect();
    let plain = gaussian.filter_nodes(values, &mask, grid);
    let (filtered, rounds) =
        if robust_form { filter_robustly(&gaussian, plain, values, &mask, grid) } else { (plain, 1) };
    let count = filtered.supported.iter().filter(|s| **s).count();
    if count == 0 {
        return Err(MapError::TooSparse { valid: 0, nodes: grid.len(), cutoff_mm });
    }
    let levelled = level_off(grid, filtered.values, &filtered.slopes, &filtered.supported, 0.0);
    let nodes = GridMap { grid: *grid, values_mm: levelled.values, valid: filtered.supported };
    Ok(FilteredGrid { nodes, rounds })
}

fn filter_robustly(
    gaussian: &GaussianFilter,
    plain: FilterResult,
    values: &[f64],
    mask: &[f64],
    grid: &Grid,
) -> (FilterResult, usize) {
    let masked = |weights: &[f64]| weights.iter().zip(mask).map(|(w, m)| w * m).collect::<Vec<f64>>();
    let again = |weights: &[f64]| gaussian.filter_nodes(values, &masked(weights), grid);
    let compare = |filtered: &FilterResult, _: Option<&[f64]>| {
        let known = |k: usize| mask[k] > 0.0 && filtered.supported[k];
        let plain = (0..grid.len()).map(|k| if known(k) { values[k] - filtered.values[k] } else { f64::NAN }).collect();
        Residuals { values: plain, freedom: vec![1.0; grid.len()] }
    };
    let found = super::robust_filter::iterate(plain, grid.len(), again, compare);
    (found.filtered, found.rounds)
}
