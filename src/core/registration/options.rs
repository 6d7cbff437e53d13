//! How to register: what is asked for.

use crate::geometry::Pose;
use crate::surface::{Distance, Side};

use super::robust::Loss;

/// What the measured points are taken for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "kebab-case")]
pub enum Method {
    /// Probe centres, registered to the offset surface: the method of the paper.
    #[default]
    Offset,
    /// Contact points, registered to the nominal surface itself; the probe radius is not used (paper, fig. 12a).
    Contact,
    /// Probe centres, registered to the nominal surface with the radius subtracted from every distance, the facet looked up
    /// below the centre (Xiong and Li; paper, fig. 12b). Wrong by micrometres on curved parts; for comparison.
    SubtractRadius,
}

/// Where to begin.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Start {
    /// Nowhere in particular: several poses are tried, chosen by the shape of the surface.
    #[default]
    Search,
    /// At a pose `cmm_from_model`.
    Pose(Pose),
}

/// On which side of the nominal surface the probe centres lie.
///
/// A side that is given is refused if the points fit the other one much better.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "kebab-case")]
pub enum ProbeSide {
    /// The side on which the measured points fit; the side of the normals where both fit alike.
    #[default]
    Auto,
    /// Where the normals point: +z for a height over the plane, outwards for a mesh.
    #[serde(alias = "normal")]
    Above,
    /// The other side.
    #[serde(alias = "opposite")]
    Below,
}

impl ProbeSide {
    /// Returns the side, if it is given.
    pub fn given(self) -> Option<Side> {
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
    /// Returns its name, as recipes and commands have it.
    pub fn name(self) -> &'static str {
        ["x", "y", "z", "rx", "ry", "rz"][self as usize]
    }

    /// Returns which of x, y, z, rx, ry, rz are among some coordinates, as [`Options::locked`] has them.
    pub fn locked(coordinates: &[Self]) -> [bool; 6] {
        [Self::X, Self::Y, Self::Z, Self::Rx, Self::Ry, Self::Rz].map(|coordinate| coordinates.contains(&coordinate))
    }
}

/// How to register.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Options {
    /// Radius of the probe in millimetres.
    pub probe_radius_mm: f64,
    /// What the measured points are taken for.
    pub method: Method,
    /// How the nominal surface runs between its points.
    pub distance: Distance,
    /// Where to begin.
    pub start: Start,
    /// On which side of the nominal surface the probe centres lie.
    pub side: ProbeSide,
    /// Coordinates that every step leaves alone: x, y, z, rx, ry, rz of the model frame.
    pub locked: [bool; 6],
    /// How a distance counts.
    pub loss: Loss,
    /// A point farther from the surface than this many robust sigmas is an outlier where no neighbour found the same;
    /// infinity keeps every point.
    pub outlier_sigmas: f64,
    /// Stop when 1 - f(l+1) / f(l) falls to this: the paper's epsilon.
    pub tolerance: f64,
    /// The first radius of the ball, in radians and in units of the cloud's rms size: alpha in eq. (15).
    pub ball_radius: f64,
    /// Give up after this many iterations.
    pub most_iterations: usize,
    /// Refuse a fit whose rms deviation is above this; `None` for 0.2 mm and one part in ten thousand of the cloud's rms size.
    pub rms_limit_mm: Option<f64>,
}

impl Options {
    /// Returns the defaults for a probe radius in millimetres.
    pub fn new(probe_radius_mm: f64) -> Self {
        Self {
            probe_radius_mm,
            method: Method::default(),
            distance: Distance::default(),
            start: Start::default(),
            side: ProbeSide::default(),
            locked: [false; 6],
            loss: Loss::default(),
            outlier_sigmas: 6.0,
            tolerance: 1e-9,
            ball_radius: 0.6,
            most_iterations: 100,
            rms_limit_mm: None,
        }
    }
}
