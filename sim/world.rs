//! Ground truth of a grinding cell. One [`WorldSpec`] contains all errors, and one seed draws all random numbers.
//!
//! [`World`] gives out the two machines as [`Body`](crate::body::Physics). For tests only, it also returns the truth that
//! no controller may ask for: the real placement of the part, the real deviation of its surface from the nominal, and
//! what the grinder really did.
//!
//! Grinder and measuring machine share the part. From the beginning of a job to its end (`outcome`) the part is in that
//! machine. The other machine finds its clamp empty (interlock bit 2) and refuses to prepare with answer 9. A machine
//! is clear (bit 1) before it begins, after it finishes, or after it is retracted.

use std::fmt;
use std::sync::{Arc, Mutex};

use crate::cmm::{Cmm, TouchProbe};
use crate::executed_wheel::Wheel;
use crate::grinder::{Grinder, systematic_mm};
use crate::part::{Approach, Contact};
use crate::probe::Placement;
use crate::spec::{SpecError, WorldFaults, WorldSpec};
use crate::truth::{ExecutedPass, GrindEntry, WorldState, locked};
use crate::wheel::PlainWheel;

/// Simulated cell. Clones share one truth.
#[derive(Clone)]
pub struct World {
    state: Arc<Mutex<WorldState>>,
}

impl fmt::Debug for World {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let state = locked(&self.state);
        f.debug_struct("World").field("spec", &state.spec).field("history", &state.history).finish_non_exhaustive()
    }
}

impl World {
    /// Creates the world that a specification describes.
    ///
    /// # Errors
    /// A number is outside the range for which the simulation is valid.
    pub fn new(spec: WorldSpec) -> Result<Self, SpecError> {
        spec.check()?;
        Ok(Self { state: Arc::new(Mutex::new(WorldState::new(spec, systematic_mm))) })
    }

    /// Returns the simulated grinder. A world has only one grinder, so serve it on only one wire.
    pub fn grinder(&self) -> Grinder {
        Grinder::new(self.state.clone())
    }

    /// Returns the simulated measuring machine. A world has only one, so serve it on only one wire.
    pub fn cmm(&self) -> Cmm {
        Cmm::new(self.state.clone())
    }

    /// Returns the probe of the measuring machine, which makes one touch for each call. A world has only one measuring
    /// machine, so serve it on only one wire.
    pub fn touch_probe(&self) -> TouchProbe {
        TouchProbe::new(self.state.clone())
    }

    /// Returns the wheel of the grinder, for a controller that moves it from position to position on widely spaced
    /// tracks; see [`crate::wheel`]. `stated_mm` is the radius that the controller assumes. There is one grinder, so
    /// take only one of this, [`World::wheel`] and [`World::grinder`].
    pub fn plain_wheel(&self, stated_mm: f64) -> PlainWheel {
        PlainWheel::new(self.state.clone(), stated_mm)
    }

    /// Returns the wheel of the grinder, for an external controller; it is moved along the path that the controller
    /// executes. There is one grinder, so take only one of this, [`World::plain_wheel`] and [`World::grinder`].
    ///
    /// # Errors
    /// The radius is not possible for a wheel.
    pub fn wheel(&self, stated_radius_mm: f64) -> Result<Wheel, SpecError> {
        Wheel::new(self.state.clone(), stated_radius_mm)
    }

    /// Loads a new blank, as an operator would.
    pub fn load_blank(&self) {
        locked(&self.state).load_blank();
    }

    /// Sets the faults, from the next job on.
    pub fn set_faults(&self, faults: WorldFaults) {
        let mut state = locked(&self.state);
        state.spec.faults = faults;
        state.on_table = false;
    }

    /// Returns the specification of this world.
    pub fn spec(&self) -> WorldSpec {
        locked(&self.state).spec.clone()
    }

    /// Returns the true deviation of the real surface from the nominal at (x, y) of the model frame, along the normal,
    /// in mm. The ridges between the grinder's tracks are included.
    pub fn deviation_mm(&self, x_mm: f64, y_mm: f64) -> f64 {
        locked(&self.state).part.deviation_mm(x_mm, y_mm)
    }

    /// Returns the true deviations of the real surface from the nominal at many positions (x, y), in mm. All values are
    /// of one moment.
    pub fn deviations_mm(&self, places_mm: &[[f64; 2]]) -> Vec<f64> {
        let state = locked(&self.state);
        places_mm.iter().map(|&[x, y]| state.part.deviation_mm(x, y)).collect()
    }

    /// Returns the true height in mm of the centre of a ball above the offset of the nominal surface, for each position
    /// (x, y), where the ball touches the real surface along the nominal normal. All values are of one moment.
    ///
    /// In a groove, this differs from [`Self::deviation_mm`], because the ball touches beside its centre. Beyond the
    /// part the ball touches nothing.
    pub fn ball_heights_mm(&self, places_mm: &[[f64; 2]], radius_mm: f64) -> Vec<Option<f64>> {
        const REACH_MM: f64 = 1.0;
        let state = locked(&self.state);
        let (part, shape) = (&state.part, &state.part.shape);
        let height_mm = |&[x, y]: &[f64; 2]| {
            let (point_mm, direction) = (shape.point(x, y), shape.normal(x, y));
            let way =
                Approach { point_mm, direction, radius_mm, from_mm: radius_mm + REACH_MM, to_mm: radius_mm - REACH_MM };
            let Contact::Touched { centre_mm, .. } = part.touch(&way) else { return None };
            Some((0..3).map(|i| (centre_mm[i] - point_mm[i]) * direction[i]).sum::<f64>() - radius_mm)
        };
        places_mm.iter().map(height_mm).collect()
    }

    /// Returns the point of the nominal surface over (x, y) and its unit normal.
    pub fn nominal(&self, x_mm: f64, y_mm: f64) -> (crate::Vec3, crate::Vec3) {
        let state = locked(&self.state);
        (state.part.shape.point(x_mm, y_mm), state.part.shape.normal(x_mm, y_mm))
    }

    /// Returns the true placement of the part in the last measurement, half a turn included; before the first
    /// measurement, the placement without the random error of loading. It maps the model frame to the CMM's at 20 °C.
    pub fn placement(&self) -> Placement {
        locked(&self.state).placement
    }

    /// Returns the mean, over the part, of the true deviation of the real surface from the nominal, in mm.
    pub fn level_mm(&self) -> f64 {
        let state = locked(&self.state);
        let part = &state.part;
        let on_part: Vec<f64> = part
            .height
            .nodes()
            .zip(&part.height.heights_mm)
            .filter(|([x, y], _)| part.aperture.contains(*x, *y))
            // The mean of a parabola is a third of its height.
            .map(|([x, y], h)| h + part.ridge_mm(x, y) / 3.0)
            .collect();
        on_part.iter().sum::<f64>() / on_part.len() as f64
    }

    /// Returns the true RMS of the random error of a pass, in mm. No compensation can remove it.
    pub fn repeatability_mm(&self) -> f64 {
        locked(&self.state).spec.grinder.repeatability_um * 1e-3
    }

    /// Returns every pass that was begun, in order.
    pub fn history(&self) -> Vec<GrindEntry> {
        locked(&self.state).history.clone()
    }

    /// Returns every pass along an executed path, in order.
    pub fn executed_passes(&self) -> Vec<ExecutedPass> {
        locked(&self.state).executed_passes.clone()
    }

    /// Returns how often a pass was begun for a job and cycle.
    pub fn grinds_begun(&self, job: u32, cycle: u16) -> usize {
        locked(&self.state).history.iter().filter(|entry| (entry.job, entry.cycle) == (job, cycle)).count()
    }

    /// Returns the number of measurements that were begun.
    pub fn measurements_begun(&self) -> u32 {
        locked(&self.state).measurements_begun
    }

    /// Returns the number of the blank in the grinder, from 1.
    pub fn blank(&self) -> u32 {
        locked(&self.state).blanks
    }
}
