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
use crate::grinder::Grinder;
use crate::part::Part;
use crate::probe::Placement;
use crate::removal::systematic_mm;
use crate::spec::{SpecError, WorldSpec};
use crate::true_form::TrueForm;
use crate::truth::{ExecutedPass, GrindEntry, WorldState, locked};

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

    /// Returns the simulated grinder. A world has only one grinder, so connect it to only one wire (simulated
    /// interface).
    pub fn grinder(&self) -> Grinder {
        Grinder::new(self.state.clone())
    }

    /// Returns the simulated measuring machine. A client sends a measuring plan to this machine, and the machine then
    /// measures all points of the plan. A world has only one measuring machine, so connect it to only one wire
    /// (simulated interface).
    pub fn cmm(&self) -> Cmm {
        Cmm::new(self.state.clone())
    }

    /// Returns the probe of the simulated measuring machine. Use this probe for a server that has no measuring plan and
    /// commands each touch separately. A world has only one measuring machine, so connect it to only one wire
    /// (simulated interface).
    pub fn touch_probe(&self) -> TouchProbe {
        TouchProbe::new(self.state.clone())
    }

    /// Returns the wheel of the grinder, for a controller that executes programs. The wheel grinds along the executed
    /// path, groove by groove. `stated_radius_mm` is the radius of the wheel that the controller assumes.
    ///
    /// A world has only one grinder, so use only one of [`World::wheel`] and [`World::grinder`].
    ///
    /// # Errors
    /// The radius is outside 0.1 mm to 1000 mm.
    pub fn wheel(&self, stated_radius_mm: f64) -> Result<Wheel, SpecError> {
        Wheel::new(self.state.clone(), stated_radius_mm)
    }

    /// Loads a new blank, as an operator would.
    pub fn load_blank(&self) {
        locked(&self.state).load_blank();
    }

    /// Returns the specification of this world.
    pub fn spec(&self) -> WorldSpec {
        locked(&self.state).spec.clone()
    }

    /// Returns the true deviation of the real surface from the nominal surface, in mm along the normal. Positive means
    /// too much material. `x_mm` and `y_mm` are a position in the model frame. The ridges between the grinder's tracks
    /// are included.
    pub fn deviation_mm(&self, x_mm: f64, y_mm: f64) -> f64 {
        locked(&self.state).part.deviation_mm(x_mm, y_mm)
    }

    /// Returns the true deviation of the real surface from the nominal surface for each position (x, y) in `places_mm`.
    /// The deviation is in mm along the normal, and positive where there is too much material. The positions are in mm
    /// in the model frame. All values belong to the same moment: the part cannot be ground during this call.
    pub fn deviations_mm(&self, places_mm: &[[f64; 2]]) -> Vec<f64> {
        let state = locked(&self.state);
        places_mm.iter().map(|&[x, y]| state.part.deviation_mm(x, y)).collect()
    }

    /// Returns the true form of the part at `places_mm`, positions (x, y) in mm in the model frame, relative to the level
    /// that the last pass was commanded to. `locked` are the directions in which the part is not fitted, as in
    /// [`TrueForm::of_samples`].
    pub fn true_form(&self, places_mm: &[[f64; 2]], locked_directions: [bool; 6]) -> TrueForm {
        let state = locked(&self.state);
        let level_mm = state.history.last().map_or(0.0, |pass| pass.level_mm);
        let sample = |&[x, y]: &[f64; 2]| {
            let (place, normal) = (state.part.shape.point(x, y), state.part.shape.normal(x, y));
            (place, normal, state.part.deviation_mm(x, y) - level_mm)
        };
        let samples: Vec<_> = places_mm.iter().map(sample).collect();
        TrueForm::of_samples(&samples, locked_directions)
    }

    /// Calls the function `look` with the true part, and returns the result of `look`. The part cannot be ground during
    /// this call.
    pub fn with_part<T>(&self, look: impl FnOnce(&Part) -> T) -> T {
        look(&locked(&self.state).part)
    }

    /// Returns a point of the nominal surface in mm, and the unit normal at this point. The point has the coordinates
    /// `x_mm` and `y_mm` in the model frame.
    pub fn nominal(&self, x_mm: f64, y_mm: f64) -> (crate::Vec3, crate::Vec3) {
        let state = locked(&self.state);
        (state.part.shape.point(x_mm, y_mm), state.part.shape.normal(x_mm, y_mm))
    }

    /// Returns the true placement of the part in the last measurement: the rigid motion from the model frame to the
    /// frame of the CMM at 20 °C. The simulated fault "part turned by 180°" is included. Before the first measurement,
    /// the placement has no random error of loading.
    pub fn placement(&self) -> Placement {
        locked(&self.state).placement
    }

    /// Returns one entry for each pass that [`World::grinder`] has begun, in order of time. A running pass is included.
    pub fn history(&self) -> Vec<GrindEntry> {
        locked(&self.state).history.clone()
    }

    /// Returns one entry for each pass of [`World::wheel`], in order of time. In these passes, the wheel follows the
    /// path that a controller executes. A running pass is included.
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

    /// Returns the number of the present blank (the part in the cell). The first blank has the number 1.
    pub fn blank(&self) -> u32 {
        locked(&self.state).blanks
    }
}
