//! Inputs of the model of the error.

use super::Prior;
use super::machine_uncertainty::MachineUncertainty;

/// Inputs of the model that the measured points cannot show.
#[derive(Clone, Copy, Debug)]
pub struct ModelInputs {
    /// Prior of range and noise ratio. If None, a prior from the Fisher information of the variance ratio is used.
    pub prior: Option<Prior>,
    /// Uncertainty of the machine that is common to all points, from its cell file.
    pub machine: MachineUncertainty,
    /// Standard uncertainty of the calibrated radius of the probe, in mm. An error of the radius moves every point
    /// along its normal by the same amount.
    pub radius_sigma_mm: f64,
    /// Relative standard uncertainty of all lengths, from temperature and expansion.
    pub scale_sigma: f64,
    /// Standard uncertainties of the pose in the directions that the registration locked: of the shifts along x, y and
    /// z of the model in mm, and of the rotations about these axes through the centroid of the points in rad. 0 in
    /// directions that are known exactly or that the registration found. None if the registration locked no direction.
    pub locked_sigmas: Option<[f64; 6]>,
    /// True if the part was corrected by a measurement of the same machine in the same clamping. The effects of the
    /// machine, the probe, the temperature and the datum are then ground into the part, and the points no longer show
    /// them.
    pub is_corrected: bool,
    /// Noise of the probe itself: its standard deviation in mm, and the relative standard uncertainty of this standard
    /// deviation. Any further noise is form that is too narrow to be resolved. A standard deviation of 0 means that it
    /// is unknown: all noise then counts as noise of the probe.
    pub probe_noise_mm: [f64; 2],
    /// Probability that a figure is beyond each of the bounds [`low_mm`](super::DecisionBounds::low_mm) and
    /// [`high_mm`](super::DecisionBounds::high_mm).
    pub decision_risk: f64,
    /// Minimum probability that a figure is within its limit, for the part to be accepted.
    pub acceptance_probability: f64,
    /// Options of the figures over an area.
    pub area: AreaOptions,
}

impl Default for ModelInputs {
    fn default() -> Self {
        Self {
            prior: None,
            machine: MachineUncertainty::default(),
            radius_sigma_mm: 0.0,
            scale_sigma: 0.0,
            locked_sigmas: None,
            is_corrected: false,
            probe_noise_mm: [0.0; 2],
            decision_risk: 0.005,
            acceptance_probability: 0.975,
            area: AreaOptions::default(),
        }
    }
}

/// Options for the figures of an area.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct AreaOptions {
    /// Centre of symmetry, x and y of the model frame; `None` for the centre of the bounds of the places.
    pub middle_mm: Option<[f64; 2]>,
    /// Integration length of the slopes. It is increased if the places are too far apart for it. `None` for the
    /// shortest length that the places allow.
    pub integration_mm: Option<f64>,
}
