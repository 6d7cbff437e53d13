//! Random effects common to all points, which no point can show: the machine's scales, its angles, its probe, and the
//! position in which a fixture holds the part.
//!
//! Each is an effect on the deviations of unknown size with a stated standard uncertainty: a column of E, scaled so
//! that its factor has the variance 1. The covariance of the deviations is K + s^2 R + E E', and the form is the field
//! alone. So an error of the machine enters the figures once, in the measurement, and is not added to them again. K, s
//! and R are those of [`super::DensePosterior`].

use nalgebra::{DMatrix, Matrix3};

use crate::geometry::{Point, Vector};

/// Standard uncertainties of a measuring machine's effects that are common to all points; 0 where nothing is stated.
///
/// Frame: the axes are those of the machine {W}.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct MachineUncertainty {
    /// Relative standard uncertainty of the length of each axis.
    pub scale: [f64; 3],
    /// Standard uncertainty of the deviations of the angles xy, xz and yz between the axes from a right angle.
    pub squareness_rad: [f64; 3],
    /// Standard uncertainty of the error of the probe in any one direction, without the error of its radius.
    pub probe_mm: f64,
    /// Standard uncertainty of the radius of the reference sphere on which the probe is qualified.
    pub reference_sphere_mm: f64,
}

/// Source of a contribution to the uncertainty of a figure.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum UncertaintySource {
    /// Noise of each touch.
    Scatter,
    /// Form between the touches, and form that is smaller than the noise of the touches.
    Form,
    /// Pose of the part.
    Pose,
    /// Radius of the probe from its qualification, and radius of the reference sphere used for it.
    Radius,
    /// Scales of the machine's axes.
    Scales,
    /// Angles between the machine's axes.
    Squareness,
    /// Error of the probe by direction.
    Probe,
    /// Temperature and thermal expansion.
    Temperature,
    /// Position of the part in its fixture, in directions that were locked in the registration.
    Datum,
}

impl UncertaintySource {
    /// All sources, in the order in which they are reported.
    pub const ALL: [Self; 9] = [
        Self::Scatter,
        Self::Form,
        Self::Pose,
        Self::Radius,
        Self::Scales,
        Self::Squareness,
        Self::Probe,
        Self::Temperature,
        Self::Datum,
    ];
}

/// Random effects common to all points. Effects with a standard uncertainty of 0 are left out.
#[derive(Clone, Debug)]
pub(super) struct MachineEffects {
    machine: MachineUncertainty,
    radius_mm: f64,
    temperature: f64,
    locked_sigmas: [f64; 6],
    centre: Point,
    model_from_machine: Matrix3<f64>,
}

impl MachineEffects {
    /// Creates the random effects of a measuring machine, its probe, the temperature and the fixture.
    ///
    /// - `machine` has the standard uncertainties of the machine and of its probe.
    /// - `radius_mm` is the standard uncertainty of the probe radius from the qualification of the probe, in mm.
    /// - `temperature` is the relative standard uncertainty of all lengths, without a unit.
    /// - `datum` has the standard uncertainties of the position of the part in its fixture: three shifts along the axes
    ///   of the model in mm, then three rotations about these axes in rad.
    /// - `centre` is the point, in the model frame, through which the axes of rotation pass.
    /// - `model_from_machine` rotates directions from the machine frame to the model frame.
    pub(super) fn new(
        machine: MachineUncertainty,
        [radius_mm, temperature]: [f64; 2],
        datum: [f64; 6],
        centre: Point,
        model_from_machine: Matrix3<f64>,
    ) -> Self {
        let radius_mm = radius_mm.hypot(machine.reference_sphere_mm);
        Self { machine, radius_mm, temperature, locked_sigmas: datum, centre, model_from_machine }
    }

    /// Returns the source of each column of [`Self::columns`].
    pub(super) fn sources(&self) -> Vec<UncertaintySource> {
        self.all().into_iter().map(|(source, ..)| source).collect()
    }

    /// Returns the sensitivity matrix of the deviations: one row for each point with its normal, one column for each
    /// effect. An element is the change of the deviation in mm for one standard uncertainty of the effect. Points and
    /// normals are in the model frame.
    pub(super) fn columns(&self, points: impl Iterator<Item = (Point, Vector)>) -> DMatrix<f64> {
        let all = self.all();
        let to_machine = self.model_from_machine.transpose();
        let placed: Vec<(Vector, Vector)> =
            points.map(|(point, normal)| (to_machine * (point - self.centre), to_machine * normal)).collect();
        DMatrix::from_fn(placed.len(), all.len(), |r, c| all[c].2 * all[c].1.of_unit(placed[r].0, placed[r].1))
    }

    /// Returns every random effect with a standard uncertainty above 0, in a fixed order. An entry has the source of
    /// the uncertainty, the effect, and the standard uncertainty in the unit of the effect (mm, rad, or a relative
    /// change of length).
    fn all(&self) -> Vec<(UncertaintySource, Effect, f64)> {
        let MachineUncertainty { scale, squareness_rad, probe_mm, .. } = self.machine;
        let radius = (UncertaintySource::Radius, Effect::Radius, self.radius_mm);
        let temperature = (UncertaintySource::Temperature, Effect::Size, self.temperature);
        let scales = (0..3).map(|k| (UncertaintySource::Scales, Effect::Stretch([k, k]), scale[k]));
        let angles = [[0, 1], [0, 2], [1, 2]].into_iter().zip(squareness_rad);
        let angles = angles.map(|(axes, angle)| (UncertaintySource::Squareness, Effect::Stretch(axes), angle));
        let probe = (0..5).map(|k| (UncertaintySource::Probe, Effect::Direction(k), probe_mm));
        let axis = |k: usize| self.model_from_machine.row(k).transpose();
        let shifts = (0..3).map(|k| (UncertaintySource::Datum, Effect::Shift(axis(k)), self.locked_sigmas[k]));
        let turns = (0..3).map(|k| (UncertaintySource::Datum, Effect::Turn(axis(k)), self.locked_sigmas[3 + k]));
        let machine = scales.chain(angles).chain(probe);
        let all = [radius, temperature].into_iter().chain(machine).chain(shifts).chain(turns);
        all.filter(|(.., size)| *size > 0.0).collect()
    }
}

/// Effect on the deviations, with a size of one unit.
#[derive(Clone, Copy, Debug)]
enum Effect {
    /// Shift along the normal, the same everywhere.
    Radius,
    /// Relative change of all lengths.
    Size,
    /// Shift along the first axis, in proportion to the position along the second.
    Stretch([usize; 2]),
    /// One of the five spherical harmonics of degree 2 of the normal. Those of degree 1 are shifts of the part. The
    /// scale makes the sum of their squares 1 in every direction.
    Direction(usize),
    /// Shift of the whole part along an axis.
    Shift(Vector),
    /// Rotation of the whole part about an axis through the centre.
    Turn(Vector),
}

impl Effect {
    /// Returns the deviation at a point, in mm, that one unit of this effect causes. A unit is 1 mm, 1 rad or a
    /// relative change of 1. `arm` is the vector from the centre of the rotations to the point, in mm. `n` is the unit
    /// normal at the point. Both vectors are in the machine frame.
    fn of_unit(&self, arm: Vector, n: Vector) -> f64 {
        let root = 3.0_f64.sqrt();
        match *self {
            Self::Radius => 1.0,
            Self::Size => arm.dot(&n),
            Self::Stretch([along, by]) => arm[by] * n[along],
            Self::Direction(0) => root * n.x * n.y,
            Self::Direction(1) => root * n.y * n.z,
            Self::Direction(2) => root * n.x * n.z,
            Self::Direction(3) => 0.5 * (3.0 * n.z * n.z - 1.0),
            Self::Direction(_) => 0.5 * root * (n.x * n.x - n.y * n.y),
            Self::Shift(along) => along.dot(&n),
            Self::Turn(about) => about.cross(&arm).dot(&n),
        }
    }
}

/// Returns the name and the value of the first invalid standard uncertainty. It is invalid if it is negative, not a
/// number, or larger than the limit for a real machine or fixture. Returns `None` if all are valid.
///
/// `radius_mm` (probe radius, in mm), `temperature` (relative change of length) and `datum` (pose of the part in its
/// fixture) have the meaning of the same arguments of [`MachineEffects::new`].
pub(super) fn invalid_uncertainty(
    machine: &MachineUncertainty,
    [radius_mm, temperature]: [f64; 2],
    datum: &[f64; 6],
) -> Option<(&'static str, f64)> {
    // Limits: a tenth of all lengths, six degrees and a centimetre for a measuring machine, more than a full turn for a
    // fixture.
    let shares = machine.scale.map(|of| ("scale", of, 0.1)).into_iter();
    let angles = machine.squareness_rad.map(|of| ("squareness", of, 0.1)).into_iter();
    let others = [
        ("probe by direction", machine.probe_mm, 10.0),
        ("reference sphere", machine.reference_sphere_mm, 10.0),
        ("radius of the probe", radius_mm, 10.0),
        ("temperature", temperature, 0.1),
    ];
    let held = datum.map(|of| ("pose of the fixture", of, 10.0)).into_iter();
    shares
        .chain(angles)
        .chain(others)
        .chain(held)
        .find(|(_, of, most)| !(0.0..=*most).contains(of))
        .map(|(what, of, _)| (what, of))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn effects(machine: MachineUncertainty, of_others: [f64; 2]) -> MachineEffects {
        MachineEffects::new(machine, of_others, [0.0; 6], Point::new(1.0, 2.0, 3.0), Matrix3::identity())
    }

    #[test]
    fn machine_effects_of_one_point_by_hand() {
        let machine = MachineUncertainty {
            scale: [1e-6, 0.0, 3e-6],
            squareness_rad: [4e-6, 5e-6, 6e-6],
            probe_mm: 2e-4,
            reference_sphere_mm: 4e-4,
        };
        let of = effects(machine, [3e-4, 1e-5]);
        // The point is at (10, 20, 30) from the centre, with the normal (0.6, 0, 0.8).
        let row = of.columns(std::iter::once((Point::new(11.0, 22.0, 33.0), Vector::new(0.6, 0.0, 0.8))));
        let root = 3.0_f64.sqrt();
        let by_hand = [
            5e-4,
            1e-5 * (6.0 + 24.0),
            6e-6,
            3e-6 * 24.0,
            4e-6 * 20.0 * 0.6,
            5e-6 * 30.0 * 0.6,
            0.0,
            0.0,
            0.0,
            2e-4 * root * 0.48,
            2e-4 * 0.5 * (3.0 * 0.64 - 1.0),
            2e-4 * 0.5 * root * 0.36,
        ];
        assert_eq!(row.ncols(), by_hand.len());
        assert!(row.iter().zip(by_hand).all(|(found, hand)| (found - hand).abs() < 1e-15), "{row}");
        assert_eq!(
            of.sources()[..4],
            [
                UncertaintySource::Radius,
                UncertaintySource::Temperature,
                UncertaintySource::Scales,
                UncertaintySource::Scales
            ]
        );
    }

    #[test]
    fn probe_error_variance_is_isotropic() {
        let of = effects(MachineUncertainty { probe_mm: 3e-4, ..MachineUncertainty::default() }, [0.0; 2]);
        for k in 0..50_u32 {
            let (turn, rise) = (0.7 * f64::from(k), -0.98 + 0.04 * f64::from(k));
            let flat = (1.0 - rise * rise).sqrt();
            let normal = Vector::new(flat * turn.cos(), flat * turn.sin(), rise);
            let row = of.columns(std::iter::once((Point::origin(), normal)));
            assert!((row.norm() / 3e-4 - 1.0).abs() < 1e-12, "{normal}");
        }
    }

    #[test]
    fn machine_effects_use_machine_axes() {
        // The machine's x axis is the model's y axis.
        let turned = Matrix3::new(0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0);
        let machine = MachineUncertainty { scale: [1e-6, 0.0, 0.0], ..MachineUncertainty::default() };
        let of = MachineEffects::new(machine, [0.0; 2], [0.0; 6], Point::origin(), turned);
        let on = |normal| of.columns(std::iter::once((Point::new(10.0, 20.0, 0.0), normal)))[0];
        assert!((on(Vector::y()) - 2e-5).abs() < 1e-18 && on(Vector::x()).abs() < 1e-18);
    }

    #[test]
    fn fixture_pose_effects_by_hand() {
        // The machine's x axis is the model's y axis, its y axis the model's -x axis.
        let turned = Matrix3::new(0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0);
        let centre = Point::new(1.0, 2.0, 3.0);
        let datum = [2e-3, 0.0, 0.0, 0.0, 3e-5, 4e-5];
        let of = MachineEffects::new(MachineUncertainty::default(), [0.0; 2], datum, centre, turned);
        let row = of.columns(std::iter::once((Point::new(11.0, 22.0, 33.0), Vector::new(0.6, 0.0, 0.8))));
        // e_y x (10, 20, 30) = (30, 0, -10), e_z x (10, 20, 30) = (-20, 10, 0).
        let by_hand = [2e-3 * 0.6, 3e-5 * (30.0 * 0.6 - 10.0 * 0.8), 4e-5 * (-20.0 * 0.6)];
        assert_eq!(of.sources(), [UncertaintySource::Datum; 3]);
        assert!(row.iter().zip(by_hand).all(|(found, hand)| (found - hand).abs() < 1e-15), "{row}");
    }

    #[test]
    fn machine_effects_empty_by_default() {
        let none = effects(MachineUncertainty::default(), [0.0; 2]);
        assert!(none.sources().is_empty());
        assert_eq!(none.columns(std::iter::once((Point::origin(), Vector::z()))).shape(), (1, 0));
    }
}
