//! Options of a registration.

use crate::geometry::Pose;
use crate::surface::{DistanceModel, Side};

use super::robust_loss::Loss;

/// Meaning of the measured points.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "kebab-case")]
pub enum Method {
    /// Probe centres, registered to the offset surface: the method of the paper.
    #[default]
    Offset,
    /// Contact points, registered to the nominal surface itself; the probe radius is not used (paper, fig. 12a).
    Contact,
    /// Probe centres, registered to the nominal surface with the radius subtracted from every distance, the facet
    /// looked up below the centre (Xiong and Li; paper, fig. 12b). Wrong by micrometres on curved parts; for
    /// comparison.
    SubtractRadius,
}

/// Start of the search for the pose.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Start {
    /// No start pose: several poses are tried, chosen by the shape of the surface.
    #[default]
    Search,
    /// A start pose `cmm_from_model`.
    Pose(Pose),
}

/// Side of the nominal surface on which the probe centres are.
///
/// A given side is refused if the points fit the other side much better.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "kebab-case")]
pub enum ProbeSide {
    /// The side on which the measured points fit; the side of the normals where both fit alike.
    #[default]
    Auto,
    /// The side to which the normals point: +z for a height over the plane, outwards for a mesh.
    #[serde(alias = "normal")]
    Above,
    /// The side opposite to the normals.
    #[serde(alias = "opposite")]
    Below,
}

impl ProbeSide {
    /// Returns the given side of the nominal surface. Returns `None` for [`ProbeSide::Auto`]: the registration then
    /// determines the side from the points.
    pub fn side(self) -> Option<Side> {
        match self {
            Self::Auto => None,
            Self::Above => Some(Side::Normal),
            Self::Below => Some(Side::Opposite),
        }
    }
}

impl From<Side> for ProbeSide {
    fn from(side: Side) -> Self {
        match side {
            Side::Normal => Self::Above,
            Side::Opposite => Self::Below,
        }
    }
}

/// A coordinate of a pose in the model frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "kebab-case")]
#[allow(missing_docs)]
pub enum Coordinate {
    X,
    Y,
    Z,
    Rx,
    Ry,
    Rz,
}

impl Coordinate {
    /// Returns the name of the coordinate in recipes and commands, such as `x` or `rz`.
    pub fn name(self) -> &'static str {
        ["x", "y", "z", "rx", "ry", "rz"][self as usize]
    }

    /// Returns six flags in the order x, y, z, rx, ry, rz. A flag is true if its coordinate is in `coordinates`. This
    /// is the form of [`RegistrationOptions::locked`].
    pub fn locked_flags(coordinates: &[Self]) -> [bool; 6] {
        [Self::X, Self::Y, Self::Z, Self::Rx, Self::Ry, Self::Rz].map(|coordinate| coordinates.contains(&coordinate))
    }
}

/// Options of a registration.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RegistrationOptions {
    /// Radius of the probe in millimetres.
    pub probe_radius_mm: f64,
    /// Meaning of the measured points.
    pub method: Method,
    /// Shape of the nominal surface between its points.
    pub distance_model: DistanceModel,
    /// Start of the search for the pose.
    pub start: Start,
    /// Side of the nominal surface on which the probe centres lie.
    pub side: ProbeSide,
    /// Locked coordinates, which no step changes: x, y, z, rx, ry, rz of the model frame.
    pub locked: [bool; 6],
    /// Loss function of the distances.
    pub loss: Loss,
    /// Limit for an outlier, in robust standard deviations. A point farther from the surface is an outlier, unless a
    /// neighbour confirms its deviation. With infinity no point is an outlier.
    pub outlier_sigmas: f64,
    /// Relative decrease 1 - f(l+1) / f(l) at which the iteration stops: epsilon in the paper.
    pub tolerance: f64,
    /// Initial radius of the ball, in radians and in units of the cloud's rms size: alpha in eq. (15).
    pub ball_radius: f64,
    /// Maximum number of iterations before the registration fails.
    pub max_iterations: usize,
    /// Largest rms deviation of an accepted fit, in mm; `None` for 0.2 mm plus 1e-4 of the cloud's rms size.
    pub rms_limit_mm: Option<f64>,
}

impl RegistrationOptions {
    /// Returns the default options for a probe radius in millimetres.
    pub fn new(probe_radius_mm: f64) -> Self {
        Self {
            probe_radius_mm,
            method: Method::default(),
            distance_model: DistanceModel::default(),
            start: Start::default(),
            side: ProbeSide::default(),
            locked: [false; 6],
            loss: Loss::default(),
            outlier_sigmas: 6.0,
            tolerance: 1e-9,
            ball_radius: 0.6,
            max_iterations: 100,
            rms_limit_mm: None,
        }
    }
}
