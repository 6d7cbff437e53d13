//! A grinding cell's truth: one table says what is wrong with everything in it, one seed draws the rest.
//!
//! [`World`] hands out the two machines as [`Body`](crate::body::Body) and answers, to tests alone, what no controller may ask: where the
//! part really lies, how far its surface really stands from the nominal, and what the grinder really did.
//!
//! Grinder and measuring machine share the part. From the beginning of a job to its end (`outcome`) the part is with
//! that machine, and the other one finds its clamp empty (interlock bit 2) and refuses to prepare with answer 9. A machine is
//! clear (bit 1) while it has not begun, has finished, or has been retracted.

use std::fmt;
use std::sync::{Arc, Mutex};

use crate::cmm::{Cmm, Led};
use crate::executed::Wheel;
use crate::part::{Approach, Contact};
use crate::probe::Placement;
use crate::process::{Grinder, systematic_mm};
use crate::spec::{Faults, SpecError, WorldSpec};
use crate::truth::{GrindEntry, State, Sweep, locked};
use crate::wheel::PlainWheel;

/// A simulated cell. Clones share one truth.
#[derive(Clone)]
pub struct World {
    state: Arc<Mutex<State>>,
}

impl fmt::Debug for World {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let state = locked(&self.state);
        f.debug_struct("World").field("spec", &state.spec).field("history", &state.history).finish_non_exhaustive()
    }
}

impl World {
    /// Makes the world of a table.
    ///
    /// # Errors
    /// A number that the simulation does not hold for.
    pub fn new(spec: WorldSpec) -> Result<Self, SpecError> {
        spec.check()?;
        Ok(Self { state: Arc::new(Mutex::new(State::new(spec, systematic_mm))) })
    }

    /// Returns the grinder; there is one, so hand it to one wire.
    pub fn grinder(&self) -> Grinder {
        Grinder::new(self.state.clone())
    }

    /// Returns the measuring machine; there is one, so hand it to one wire.
    pub fn cmm(&self) -> Cmm {
        Cmm::new(self.state.clone())
    }

    /// Returns the probe of the measuring machine, to be led touch by touch; there is one, so hand it to one wire.
    pub fn led(&self) -> Led {
        Led::new(self.state.clone())
    }

    /// Returns a wheel of the grinder that is led from place to place on tracks far apart, stated to have this radius; see [`crate::wheel`]. There is
    /// one grinder, so take this, [`World::wheel`] or [`World::grinder`].
    pub fn plain_wheel(&self, stated_mm: f64) -> PlainWheel {
        PlainWheel::new(self.state.clone(), stated_mm)
    }

    /// Returns the wheel of a grinder whose controller is none of this world, to be moved along the path that that executes; there is one
    /// grinder, so take either this or [`World::grinder`].
    ///
    /// # Errors
    /// A radius that no wheel has.
    pub fn wheel(&self, stated_radius_mm: f64) -> Result<Wheel, SpecError> {
        Wheel::new(self.state.clone(), stated_radius_mm)
    }

    /// Puts a new blank in, as an operator would.
    pub fn load_blank(&self) {
        locked(&self.state).load_blank();
    }

    /// Changes what is broken, from the next job on.
    pub fn set_faults(&self, faults: Faults) {
        let mut state = locked(&self.state);
        state.spec.faults = faults;
        state.on_table = false;
    }

    /// Returns the table.
    pub fn spec(&self) -> WorldSpec {
        locked(&self.state).spec.clone()
    }

    /// Truth: how far the real surface stands over the nominal at (x, y) of the model frame, along the normal, in millimetres, the ridges
    /// between the grinder's tracks included.
    pub fn deviation_mm(&self, x_mm: f64, y_mm: f64) -> f64 {
        locked(&self.state).part.deviation_mm(x_mm, y_mm)
    }

    /// Truth: the same at many places, at one moment.
    pub fn deviations_mm(&self, places_mm: &[[f64; 2]]) -> Vec<f64> {
        let state = locked(&self.state);
        places_mm.iter().map(|&[x, y]| state.part.deviation_mm(x, y)).collect()
    }

    /// Truth: how far the centre of a ball stands above the offset of the nominal, at one moment, where the ball touches the real surface along
    /// the nominal normal over each place, in millimetres.
    ///
    /// In a groove it stands higher or lower than [`Self::deviation_mm`] says: the ball touches beside its centre. Beyond the part it touches nothing.
    pub fn touched_mm(&self, places_mm: &[[f64; 2]], radius_mm: f64) -> Vec<Option<f64>> {
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

    /// Truth: the point of the nominal surface over (x, y) and its unit normal.
    pub fn nominal(&self, x_mm: f64, y_mm: f64) -> (crate::Vec3, crate::Vec3) {
        let state = locked(&self.state);
        (state.part.shape.point(x_mm, y_mm), state.part.shape.normal(x_mm, y_mm))
    }

    /// Truth: where the part lay in the last measurement (before the first: where it will, but for the loading), half a turn included.
    /// Takes the model frame to the CMM's at 20 degrees Celsius.
    pub fn placement(&self) -> Placement {
        locked(&self.state).placement
    }

    /// Truth: mean of the deviation over the part, in millimetres.
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

    /// Truth: RMS of what a pass draws afresh, which no compensation can take away, in millimetres.
    pub fn floor_mm(&self) -> f64 {
        locked(&self.state).spec.grinder.repeatability_um * 1e-3
    }

    /// Truth: every pass that was begun, in order.
    pub fn history(&self) -> Vec<GrindEntry> {
        locked(&self.state).history.clone()
    }

    /// Truth: every pass along an executed path, in order.
    pub fn sweeps(&self) -> Vec<Sweep> {
        locked(&self.state).sweeps.clone()
    }

    /// Truth: how often a pass was begun for a job and cycle.
    pub fn grinds_begun(&self, job: u32, cycle: u16) -> usize {
        locked(&self.state).history.iter().filter(|entry| (entry.job, entry.cycle) == (job, cycle)).count()
    }

    /// Truth: how many measurements were begun.
    pub fn measurements_begun(&self) -> u32 {
        locked(&self.state).measurements_begun
    }

    /// Truth: which blank is in the grinder, counted from 1.
    pub fn blank(&self) -> u32 {
        locked(&self.state).blanks
    }
}
